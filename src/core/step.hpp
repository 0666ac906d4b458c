// One step of a lane: its begin, what is decided at a trial point, and its end.
#pragma once

#include "stepper.hpp"

namespace endopilot {

constexpr int kMaxRejections = 12;
constexpr int kTurnabout = 10;         // iterations after which friction's tangent and its secant take turns
constexpr int kSnapIterations = 25;   // times max_iterations that the shortest step may take: a snap takes many at any step
constexpr double kAllowedRise = 0.85;    // of what the energy has fallen lately: by so much it may rise in a step that struggles
constexpr double kBackInside = 0.02;    // of a move that left the map, that is tried next
constexpr double kLeastOfMove = 1e-4, kMostOfMove = 0.7;   // of a move that raised the energy, that is tried next
constexpr double kMostPower = 8;         // of the share, that the energy is taken to grow with beyond its slope
constexpr double kFirstDamping = 1e-3;   // N/mm (rotations: N mm/rad), where the Hessian is indefinite even without geometric terms
constexpr double kMaxDamping = 1e3;
constexpr double kMaxBoost = 64;
constexpr double kMaxImbalance = 1e-5;   // N that a damped solution may be out of balance
constexpr double kLooseImbalance = 1e-4;   // the same, in a step that struggles
constexpr double kDriveMotion = 1.2;     // times the drive's own motion that a node may move in a step before it counts as a jump

// Begins a step of lane.stride ticks from the lane's start state; nodes ahead of the base already hold a trial.
template <class V, int T>
void Stepper<V, T>::begin(int l, bool fresh) {
    Lane& lane = lane_[l];
    const int before = lane.active;
    if (motion_.cycles > 0) carry(l);
    const double weight = fresh ? 0.0 : duration(lane) / lane.last_duration;
    aim(l, weight);
    lane.active = Base::count_active(rod_, lane.advance.start, options_.free_behind);
    for (int i = std::min(before, lane.active); i <= std::max(before, lane.active); ++i)
        if (i >= before || i >= lane.active) place(l, i);
    if (lane.active < before) clear(node_[lane.active - 1].at_middle, l);
    if constexpr (T > 0) prepare_tubes(l);
    lane.iterations = lane.rejections = lane.releases = 0;
    lane.boost = 1;
    lane.first = lane.finite = true;
    lane.extrapolated = !fresh;
    const auto planned = [&lane](const Coordinate& c) { return std::abs((lane.by_force ? c.end : c.commanded) - c.start); };
    double slides = planned(lane.advance), turns = 0;
    if (motion_.cycles > 0) slides += lane.strain * std::max(0.0, lane.advance.start);   // a vessel that stretches slides along the wire
    for (const Device& device : lane.device) turns += planned(device.turn);
    const double most_x = options_.largest_jump + kDriveMotion * slides, most_theta = options_.largest_jump + kDriveMotion * turns;
    set(active_, l, lane.active);
    set(share_, l, Base::share_of_last_joint(rod_, lane.advance.start, options_.free_behind, lane.active));
    set(geometric_, l, 0.0);
    set(first_, l, 1.0);
    set_mask<V>(accepted_, l, false);
    set(damping_, l, 0.0);
    set(tangent_, l, 1.0);
    set(inverse_dt_, l, 1.0 / duration(lane));
    set(eps_, l, options_.stick_velocity * in_.time_step);
    set(jump_scale_x_, l, 1.0 / (most_x * most_x));
    set(jump_scale_theta_, l, 4.0 / (most_theta * most_theta));  // of twice the imaginary part of a quaternion
}

// One evaluation, decision and update of all lanes. Returns the number of samples that ended.
template <class V, int T>
template <class Queue>
int Stepper<V, T>::pass(Queue& queue) {
    const int n = most_active();
    evaluate(n);
    Decision decision[W];
    for (V& step : drive_step_) step = V{};
    for (int l = 0; l < W; ++l) decision[l] = decide(l);
    const V largest = solve(n);
    V factor{};
    for (int l = 0; l < W; ++l)
        if (decision[l] == Decision::shorten) set(factor, l, lane_[l].shorten);
    for (int l = 0; l < W; ++l) {
        Lane& lane = lane_[l];
        if (decision[l] != Decision::accept) continue;
        const double size = get(largest, l);
        if (!(size < 1e100)) {  // the direction is not finite
            decision[l] = Decision::restart;
            continue;
        }
        const bool ends_sample = lane.tick + lane.stride == kTicks * in_.steps_per_sample;
        lane.scale = std::min(lane.boost, options_.largest_step / size);
        set(factor, l, lane.scale);
        // Where a drive is at its limit, a wire may come to rest within the energy's rounding, where steps no longer shrink.
        const double tolerance = ends_sample && !last_resort(lane) ? options_.sample_tolerance : options_.tolerance;
        const bool at_rest = size <= options_.tolerance && lane.damping * size <= (struggles(lane) ? kLooseImbalance : kMaxImbalance);
        if (lane.reduced || lane.damping > 0 ? at_rest : size <= tolerance) {
            decision[l] = release(l) ? Decision::repeat : Decision::converged;
            set(factor, l, 1.0);
        } else if (lane.iterations > options_.max_iterations * kSnapIterations) {   // a large snap goes on in the next step
            decision[l] = Decision::converged;
            set(factor, l, 0.0);
        }
    }
    update(n, decision, factor);
    if constexpr (T > 0) refuse_leaps(decision);
    return advance(n, decision, queue);
}

template <class V, int T>
typename Stepper<V, T>::Decision Stepper<V, T>::decide(int l) {
    Lane& lane = lane_[l];
    if (lane.world < 0) return Decision::idle;
    ++lane.iterations;
    ++lane.total_iterations;
    lane.node_iterations += lane.active;
    const double energy = get(energy_, l) + drive_load(lane, l).energy;
    lane.finite = std::isfinite(energy);
    const bool patient = lane.stride == 1 && !lane.extrapolated;   // ends at the first point accepted after its last iteration
    if (lane.iterations > options_.max_iterations * (patient ? kSnapIterations : 1) + (patient ? 2 * kMaxRejections : 0)) return Decision::restart;
    if (!lane.first && lane.stride > 1 && get(jump_, l) > 1.0) {  // a snap: follow it in shorter steps
        lane.extrapolated = false;
        return Decision::restart;
    }
    const double slack = 1e-11 * (std::abs(lane.energy) + 1e-3);
    if (!lane.finite || !(lane.first || energy <= lane.energy + lane.allowed + slack)) {
        if (lane.first) return Decision::restart;
        lane.shorten = lane.finite ? best_share(energy, l) : kBackInside;
        if (++lane.rejections > kMaxRejections) {   // the direction is not downhill, for rounding; a damped one is
            if (lane.stride > 1 || lane.damping >= kMaxDamping) return Decision::restart;
            lane.shorten = 0;
            set(damping_, l, std::max(double{kFirstDamping}, 10 * lane.damping));
        }
        set_mask<V>(accepted_, l, false);
        lane.scale *= lane.shorten;
        return Decision::shorten;
    }
    lane.allowed = struggles(lane) ? kAllowedRise * (lane.allowed + lane.energy - energy) : 0.0;
    if (!(get(pivot_, l) > 0) || !solve_drives(l)) {  // not positive definite: less of the geometric terms
        const double g = get(geometric_, l), damping = get(damping_, l);
        lane.energy = energy;
        if (g > 0) {
            set(geometric_, l, g > 0.05 ? 0.5 * g : 0.0);
            return Decision::repeat;
        }
        if (damping >= kMaxDamping) return Decision::restart;
        set(damping_, l, std::max(double{kFirstDamping}, 10 * damping));
        return Decision::repeat;
    }
    lane.energy = energy;
    lane.slope = get(descent_, l);
    // Where friction turns, a step with its tangent overshoots, and one with its secant creeps: they take turns.
    set(tangent_, l, lane.iterations > kTurnabout && lane.iterations / kTurnabout % 2 == 1 ? 0.0 : 1.0);
    set_mask<V>(accepted_, l, true);
    // Where the energy is not convex the damped steps are short: lengthen them as long as they succeed.
    const double damping = lane.damping = get(damping_, l);
    lane.boost = damping > 0 && lane.rejections == 0 ? std::min(2 * lane.boost, double{kMaxBoost}) : 1.0;
    if (struggles(lane) && lane.rejections > 0)   // a curved valley: shorter along it, but all the way across
        set(damping_, l, std::clamp(4 * damping, double{kFirstDamping}, double{kMaxDamping}));
    else
        set(damping_, l, damping > kFirstDamping ? 0.25 * damping : 0.0);
    lane.rejections = 0;
    set(first_, l, 0.0);
    lane.reduced = get(geometric_, l) < 1.0 && !lane.first;
    set(geometric_, l, lane.first ? 1.0 : std::min(1.0, std::max(0.25, 2 * get(geometric_, l))));
    lane.first = false;
    return Decision::accept;
}

// The share of the last move, which raised the energy, at which the energy is least along it. What raises it are contacts that
// Newton's step did not foresee. If the wire bends into a wall as it slides along it, the energy is C s^p - slope s at the share
// s, with p from the slopes at both ends. If it hits a wall head on at a share s0, it is k (s - s0)² / 2 - slope s from there on.
template <class V, int T>
double Stepper<V, T>::best_share(double energy, int l) const {
    const Lane& lane = lane_[l];
    const double slope = lane.scale * lane.slope, excess = slope + energy - lane.energy;
    const double power = lane.drives_free() ? 2.0 : std::clamp((get(rise_, l) + slope) / excess, 2.0, double{kMostPower});   // else `rise_` lacks the drives' part
    const double sliding = std::pow(slope / (power * excess), 1 / (power - 1));
    const double free = get(hit_, l), rest = 1 - free;
    const double head_on = rest > 0 ? free + rest * rest * slope / (2 * excess) : 0.0;
    return std::clamp(std::max(sliding, head_on), double{kLeastOfMove}, double{kMostOfMove});
}

// Ends the steps that converged, restarts those that failed with half the step. Returns the samples that ended.
template <class V, int T>
template <class Queue>
int Stepper<V, T>::advance(int n, const Decision (&decision)[W], Queue& queue) {
    Mask<V> finished{}, restarted{};
    V weight{};
    bool any_finished = false, failed[W] = {}, ended[W] = {};
    for (int l = 0; l < W; ++l) {
        Lane& lane = lane_[l];
        if (decision[l] == Decision::converged) {
            set_mask<V>(finished, l, true);
            any_finished = true;
            const double took = duration(lane);
            lane.tick += lane.stride;
            ++lane.steps;
            lane.last_duration = took;
            settle(l);
            for (int r = 0; r < N; ++r) lane.coordinate(r).start = lane.coordinate(r).end;
            ended[l] = lane.tick == kTicks * in_.steps_per_sample;
            if (lane.stride < kTicks && lane.tick % (2 * lane.stride) == 0) lane.stride *= 2;
            if (ended[l]) continue;
            set(weight, l, lane.last_duration > 0 ? duration(lane) / lane.last_duration : 0.0);
        } else if (decision[l] == Decision::restart) {
            set_mask<V>(restarted, l, true);
            any_finished = true;
            if (lane.extrapolated) continue;  // perhaps only the extrapolation was bad
            if (lane.stride == 1) {
                failed[l] = true;
            } else {
                lane.stride /= 2;
            }
        }
    }
    if (!any_finished) return 0;
    finish_step(n, finished, restarted, weight);
    int samples = 0;
    for (int l = 0; l < W; ++l) {
        Lane& lane = lane_[l];
        if (decision[l] == Decision::converged) note_forces(l);
        if (failed[l]) {
            samples += std::max(0, in_.samples - std::max(0, lane.sample));
            fail(l);
            queue.finish();
        } else if (ended[l]) {
            samples += lane.sample >= 0;
            end_sample(l, queue);
        } else if (decision[l] == Decision::converged) {
            begin(l, get(weight, l) == 0.0);
        } else if (decision[l] == Decision::restart) {
            begin(l, true);
        }
    }
    return samples;
}

}  // namespace endopilot
