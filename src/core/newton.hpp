// Newton's method with an energy line search, for all lanes at once: `newton` is one iteration.
#pragma once

#include <algorithm>
#include <cmath>

#include "drives.hpp"
#include "evaluate.hpp"
#include "exchange.hpp"

namespace endopilot {

constexpr int kMaxRejections = 12;
constexpr int kSlow = 20;                // iterations after which a step of several devices counts as slow; of a wire alone, max_iterations
constexpr int kTurnabout = 10;           // iterations after which friction's tangent and its secant take turns
constexpr int kSnapIterations = 25;      // times max_iterations that the shortest step may take: a snap takes many at any step
constexpr double kAllowedRise = 0.85;    // share of its latest fall by which the energy may rise in a slow step
constexpr double kBackInside = 0.02;     // of a move that left the map, that is tried next
constexpr double kLeastOfMove = 1e-4, kMostOfMove = 0.7;   // of a move that raised the energy, that is tried next
constexpr double kMostPower = 8;         // of the share, that the energy is taken to grow with beyond its slope
constexpr double kFirstDamping = 1e-3;   // N/mm (rotations: N mm/rad), where the Hessian is indefinite even without geometric terms
constexpr double kMaxDamping = 1e3;
constexpr double kMostLengthened = 64;
constexpr double kMaxImbalance = 1e-5;   // N that a damped solution may be out of balance
constexpr double kLooseImbalance = 1e-4;   // the same, in a slow step

// Whether a step converges slowly: in a curved valley, or where friction turns. It is then damped where it overshoots.
template <int T>
ENDOPILOT_DEVICE bool slow(const Options& options, const Lane<T>& lane) {
    return lane.iterations > (T > 0 ? kSlow : options.max_iterations);
}

// The share of the last move, which raised the energy, at which the energy is least along it. What raises it are contacts that
// Newton's step did not foresee. If the wire bends into a wall as it slides along it, the energy is C s^p - slope s at the share
// s, with p from the slopes at both ends. If it hits a wall head on at a share s0, it is k (s - s0)² / 2 - slope s from there on.
template <class V, int T>
ENDOPILOT_DEVICE double best_share(const Lanes<V, T>& lanes, int l, double energy) {
    const Lane<T>& lane = lanes.lane[l];
    const double slope = lane.step_length * lane.slope, excess = slope + energy - lane.energy;
    // without the drives' part of the slope at the end, where they are free
    const double power = lane.drives_free() ? 2.0 : std::clamp((get(lanes.found.end_slope, l) + slope) / excess, 2.0, double{kMostPower});
    const double sliding = std::pow(slope / (power * excess), 1 / (power - 1));
    const double free = get(lanes.found.first_hit, l), rest = 1 - free;
    const double head_on = rest > 0 ? free + rest * rest * slope / (2 * excess) : 0.0;
    return std::clamp(std::max(sliding, head_on), double{kLeastOfMove}, double{kMostOfMove});
}

// Rejects the trial: back along the last move. A direction that is rejected again and again is not downhill, for rounding; a damped one is.
template <class V, int T>
ENDOPILOT_DEVICE Next shorten(Lanes<V, T>& lanes, int l, double energy) {
    Lane<T>& lane = lanes.lane[l];
    lane.factor = lane.finite ? best_share(lanes, l, energy) : kBackInside;
    if (++lane.rejections > kMaxRejections) {
        if (lane.stride > 1 || lane.damping >= kMaxDamping) return Next::restart;
        lane.factor = 0;
        set(lanes.terms.damping, l, std::max(double{kFirstDamping}, 10 * lane.damping));
    }
    set_mask<V>(lanes.accepted, l, false);
    lane.step_length *= lane.factor;
    return Next::shorten;
}

// Modifies a Hessian that is not positive definite: less and less of its geometric terms, in the end damping.
template <class V, int T>
ENDOPILOT_DEVICE Next modify(Lanes<V, T>& lanes, int l) {
    HessianTerms<V>& terms = lanes.terms;
    const double geometric = get(terms.geometric, l), damping = get(terms.damping, l);
    if (geometric > 0) {
        set(terms.geometric, l, geometric > 0.05 ? 0.5 * geometric : 0.0);
        return Next::modify;
    }
    if (damping >= kMaxDamping) return Next::restart;
    set(terms.damping, l, std::max(double{kFirstDamping}, 10 * damping));
    return Next::modify;
}

// Accepts the trial, from which Newton's step goes on, and chooses the terms of the next Hessian.
template <class V, int T>
ENDOPILOT_DEVICE Next accept(const Options& options, Lanes<V, T>& lanes, int l) {
    Lane<T>& lane = lanes.lane[l];
    HessianTerms<V>& terms = lanes.terms;
    lane.slope = get(lanes.found.decrement, l);
    // Where friction turns, a step with its tangent overshoots, and one with its secant creeps: they take turns.
    set(terms.tangent, l, lane.iterations > kTurnabout && lane.iterations / kTurnabout % 2 == 1 ? 0.0 : 1.0);
    set_mask<V>(lanes.accepted, l, true);
    // Where the energy is not convex the damped steps are short: lengthen them as long as they succeed.
    const double damping = lane.damping = get(terms.damping, l);
    lane.lengthened = damping > 0 && lane.rejections == 0 ? std::min(2 * lane.lengthened, double{kMostLengthened}) : 1.0;
    if (slow(options, lane) && lane.rejections > 0)   // a curved valley: shorter along it, but all the way across
        set(terms.damping, l, std::clamp(4 * damping, double{kFirstDamping}, double{kMaxDamping}));
    else
        set(terms.damping, l, damping > kFirstDamping ? 0.25 * damping : 0.0);
    lane.rejections = 0;
    // the first Hessian is that of Gauss and Newton, the others are full
    const double geometric = get(terms.geometric, l);
    lane.modified = geometric < 1.0 && !lane.first;
    set(terms.geometric, l, lane.first ? 1.0 : std::min(1.0, std::max(0.25, 2 * geometric)));
    set(terms.first, l, 0.0);
    lane.first = false;
    return Next::advance;
}

// The line search of one lane: whether its trial is accepted, and what it does next.
template <class V, int T>
ENDOPILOT_LARGE Next search(const Scene& scene, Lanes<V, T>& lanes, int l) {
    Lane<T>& lane = lanes.lane[l];
    const Options& options = scene.options;
    if (lane.world < 0) return Next::idle;
    ++lane.iterations;
    ++lane.total_iterations;
    lane.node_iterations += lane.active;
    const double energy = get(lanes.found.energy, l) + drive_load(scene, lanes, l).energy;
    lane.finite = std::isfinite(energy);
    const bool last_attempt = lane.stride == 1 && !lane.extrapolated;   // ends at the first point accepted after its last iteration
    const int most = options.max_iterations * (last_attempt ? kSnapIterations : 1) + (last_attempt ? 2 * kMaxRejections : 0);
    if (lane.iterations > most) return Next::restart;
    if (!lane.first && lane.stride > 1 && get(lanes.found.jump, l) > 1.0) {  // a snap: follow it in shorter steps
        lane.extrapolated = false;
        return Next::restart;
    }
    const double rounding = 1e-11 * (std::abs(lane.energy) + 1e-3);
    if (lane.first && !lane.finite) return Next::restart;
    if (!lane.first && !(lane.finite && energy <= lane.energy + lane.rise + rounding)) return shorten(lanes, l, energy);
    lane.rise = slow(options, lane) ? kAllowedRise * (lane.rise + lane.energy - energy) : 0.0;
    lane.energy = energy;
    if (!(get(lanes.found.pivot, l) > 0) || !solve_drives(scene, lanes, l)) return modify(lanes, l);
    return accept(options, lanes, l);
}

// Newton's steps, by back substitution from base to tip. Returns the largest displacement (mm) or rotation (rad) of a node; NaN where
// there is none.
template <class V, int T>
ENDOPILOT_LARGE V solve(Lanes<V, T>& lanes, int n) {
    using S = Single<V>;
    const Vec3<S> drive_x = narrow(lanes.drive_step[0] * lanes.step.axis);
    const Vec3<S> drive_t{S{}, S{}, narrow(lanes.drive_step[1])};
    const S active = narrow(lanes.step.active);
    Vec3<S> x = drive_x, t = drive_t;
    S largest = dot(x, x) + dot(t, t);  // rounded as for the nodes of a shorter wire, which follow the drive
    S twist[T + 1]{}, drive_twist[T + 1]{};   // one more than there are: none is no array on a GPU
    for (int k = 0; k < T; ++k) {
        twist[k] = drive_twist[k] = narrow(lanes.drive_step[2 + k]);
        largest += twist[k] * twist[k];
    }
    for (int i = n - 1; i >= 0; --i) {
        const Mask<S> on = active > broadcast<S>(i);
        Factor<V, T>& factor = lanes.factor[i];
        substitute(factor, x, t, twist);
        x = select(on, x, drive_x);  // the base of a shorter wire follows its drive
        t = select(on, t, drive_t);
        factor.z[0] = x.x;
        factor.z[1] = x.y;
        factor.z[2] = x.z;
        factor.z[3] = t.x;
        factor.z[4] = t.y;
        factor.z[5] = t.z;
        S both = dot(x, x) + dot(t, t);
        for (int k = 0; k < T; ++k) {
            twist[k] = select<S>(on, twist[k], drive_twist[k]);
            factor.z[6 + k] = twist[k];
            both += twist[k] * twist[k];
        }
        largest = largest >= both ? largest : both;  // keeps a NaN of `both`; below, of `largest`
        largest = select<S>(both == both, largest, both);
    }
    return square_root(widen<V>(largest));
}

// How a lane whose trial is accepted goes on, with a Newton step of some size: clamped, or to the end of the time step.
template <class V, int T>
ENDOPILOT_DEVICE Next advance(const Run& run, Lanes<V, T>& lanes, int l, double size) {
    Lane<T>& lane = lanes.lane[l];
    const Options& options = run.scene.options;
    if (!(size < 1e100)) return Next::restart;   // the step is not finite
    lane.factor = lane.step_length = std::min(lane.lengthened, options.largest_step / size);
    const bool last_resort = lane.stride == 1 && lane.iterations > options.max_iterations;
    const bool ends_sample = lane.tick + lane.stride == kTicks * run.in.steps_per_sample;
    // Where a drive is at its limit, a wire may come to rest within the energy's rounding, where steps no longer shrink.
    const double tolerance = ends_sample && !last_resort ? options.sample_tolerance : options.tolerance;
    const bool at_rest = size <= options.tolerance && lane.damping * size <= (slow(options, lane) ? kLooseImbalance : kMaxImbalance);
    if (lane.modified || lane.damping > 0 ? at_rest : size <= tolerance) {
        lane.factor = 1;
        return release_drives(run.scene.drives, lanes, l) ? Next::modify : Next::converge;
    }
    if (lane.iterations <= options.max_iterations * kSnapIterations) return Next::advance;
    lane.factor = 0;   // a large snap goes on in the next time step
    return Next::converge;
}

// Moves each lane's trial point: by Newton's step where the trial was accepted, back along its last move where that is shortened.
template <class V, int T>
ENDOPILOT_LARGE void move(const RodModel& rod, Lanes<V, T>& lanes, int n, const Next (&next)[kWidth<V>]) {
    using S = Single<V>;
    Mask<V> advancing{}, shortening{}, staying{};
    V factor{};
    for (int l = 0; l < kWidth<V>; ++l) {
        const bool advances = next[l] == Next::advance || next[l] == Next::converge, shortens = next[l] == Next::shorten;
        set_mask<V>(advancing, l, advances);
        set_mask<V>(shortening, l, shortens);
        set_mask<V>(staying, l, next[l] == Next::modify);
        if (advances || shortens) set(factor, l, lanes.lane[l].factor);
    }
    for (int i = 0; i < n; ++i) {
        Node<V, T>& node = lanes.node[i];
        const Mask<V> on = lanes.step.active > broadcast<V>(i);
        const S* z = lanes.factor[i].z;
        const Vec3<V> step = factor * widen<V>(Vec3<S>{z[0], z[1], z[2]}), turn = factor * widen<V>(Vec3<S>{z[3], z[4], z[5]});
        const Mask<V> advances = advancing & on, shortens = shortening & on;
        const Mask<V> moves = advances | shortens, accepts = advances | (staying & on);
        node.accepted = select(accepts, node.x, node.accepted);
        node.accepted_q = select(accepts, node.q, node.accepted_q);
        node.step = select(advances, step, select(shortens, factor * node.step, node.step));
        node.turn = select(advances, turn, select(shortens, factor * node.turn, node.turn));
        node.x = select(moves, node.accepted + node.step, node.x);
        node.q = select(moves, rotated(node.accepted_q, node.turn), node.q);
        TubeNode<V, T>& tubes = node.tubes;
        for (int k = 0; k < T; ++k) {
            const V turned = factor * widen<V>(z[6 + k]);
            tubes.accepted[k] = select<V>(accepts, tubes.twist[k], tubes.accepted[k]);
            tubes.step[k] = select<V>(advances, turned, select<V>(shortens, factor * tubes.step[k], tubes.step[k]));
            tubes.twist[k] = select<V>(moves, tubes.accepted[k] + (tubes.step[k] - node.turn.z), tubes.twist[k]);
        }
    }
    for (int l = 0; l < kWidth<V>; ++l)
        if (move_drives(lanes, l, next[l])) place_base(rod, lanes, l, lanes.lane[l].active);
}

// One iteration of Newton's method: what each lane does next, and its next trial point.
template <class V, int T>
ENDOPILOT_DEVICE void newton(const Run& run, Lanes<V, T>& lanes, Next (&next)[kWidth<V>]) {
    const int n = lanes.most_active();
    evaluate(run.scene, lanes, n);                                                       // energy, gradient and Hessian
    for (V& step : lanes.drive_step) step = V{};
    for (int l = 0; l < kWidth<V>; ++l) next[l] = search(run.scene, lanes, l);           // line search
    const V size = solve(lanes, n);                                                      // direction
    for (int l = 0; l < kWidth<V>; ++l)
        if (next[l] == Next::advance) next[l] = advance(run, lanes, l, get(size, l));    // accept, or converge
    move(run.scene.rod, lanes, n, next);
}

}  // namespace endopilot
