// The time stepper: a few worlds side by side, each taking its own implicit Euler steps at its own pace.
//
// A step minimises the incremental potential (elastic energy + wall + friction + drag) by Newton's method with an energy
// line search. One pass of the loop evaluates every lane at its trial point; each lane then accepts the trial and takes
// a new direction, shortens its last one, or, having converged, begins its next time step. At the end of a sample the
// lane parks its world and takes another.
#pragma once

#include <algorithm>
#include <atomic>
#include <chrono>
#include <cmath>
#include <thread>
#include <vector>

#include "contact.hpp"
#include "solve.hpp"
#include "world.hpp"

namespace endopilot {

constexpr int kTicks = 64;     // a step may be halved down to 1/64
constexpr int kMostRejections = 12;
constexpr int kPatience = 5;   // a snap from one shape to another is not shortened by a shorter step
constexpr double kReach = 0.1;           // mm within which a wall that was touched counts as touched, at first
constexpr double kFirstDamping = 1e-3;   // N/mm (rotations: N mm/rad), where the Hessian is indefinite even without geometric terms
constexpr double kMostDamping = 1e3;
constexpr double kMostBoost = 64;
constexpr double kAtRest = 1e-5;         // N that a damped solution may be out of balance
constexpr double kStop = 100;            // N/mm, of the stops at both ends of the drive's travel
constexpr double kDriveShare = 1.2;      // of the drive's own motion that a node may move in a step before it counts as a jump

using Moment = std::chrono::steady_clock::time_point;

template <class V>
class Stepper {
public:
    Stepper(const RodModel& rod, const Lumen* lumen, const Loads* loads, const Base& base, const Options& options,
            std::vector<World>& worlds)
        : rod_(rod), lumen_(lumen), loads_(loads), base_(base), options_(options), world_(worlds), node_(rod.nodes),
          factor_(rod.nodes) {}

    // Sets what the next runs are asked, with all lanes free.
    void prepare(const Inputs& in, const Outputs& out) {
        in_ = in;
        out_ = out;
        for (Lane& lane : lane_) lane.world = -1;
    }

    // Steps the crew's worlds until none is left or `stop` is set, and returns whether that is so: else it is `until`, and
    // the next run goes on. `done` counts finished samples.
    bool run(Crew& crew, std::atomic<long>& done, const std::atomic<bool>& stop, Moment until) {
        while (!stop.load(std::memory_order_relaxed)) {
            bool busy = false;
            for (int l = 0; l < W; ++l) {
                if (lane_[l].world < 0) take(l, crew);
                busy = busy || lane_[l].world >= 0;
            }
            if (busy) {
                done.fetch_add(pass(crew), std::memory_order_relaxed);
            } else {
                if (crew.done()) return true;
                std::this_thread::yield();
            }
            if (std::chrono::steady_clock::now() > until) return false;
        }
        return true;
    }

private:
    static constexpr int W = kWidth<V>;
    enum class Verdict { idle, accept, shorten, repeat, converged, restart };

    struct Node {
        Vec3<V> x, from, start, step, last;            // trial, accepted, step start; Newton step; last increment
        Quaternion<V> q, from_q, start_q;
        Vec3<V> turn, last_turn;
        Grip<V> grip;
        Wall<V> wall;
        V force;                                       // of the wall at the end of the last step, N
    };

    // The drive's end of the wire: advance (mm) and rotation (rad).
    struct Drive {
        double advance = 0, rotation = 0;
    };

    // An energy, its gradient and its Hessian in the drive's advance a and rotation r.
    struct DriveTerms {
        double energy, pull_a, pull_r, aa, ar, rr;
    };

    // The same, without the energy, for all lanes.
    struct DriveRows {
        V pull_a, pull_r, aa, ar, rr;
        friend DriveRows operator+(const DriveRows& a, const DriveRows& b) {
            return {a.pull_a + b.pull_a, a.pull_r + b.pull_r, a.aa + b.aa, a.ar + b.ar, a.rr + b.rr};
        }
        friend DriveRows select(Mask<V> mask, const DriveRows& yes, const DriveRows& no) {
            return {endopilot::select<V>(mask, yes.pull_a, no.pull_a), endopilot::select<V>(mask, yes.pull_r, no.pull_r),
                    endopilot::select<V>(mask, yes.aa, no.aa), endopilot::select<V>(mask, yes.ar, no.ar),
                    endopilot::select<V>(mask, yes.rr, no.rr)};
        }
    };

    struct Lane {
        int world = -1, sample = 0, tick = 0, stride = 0, active = 0, iterations = 0, rejections = 0, steps = 0;
        long total_iterations = 0;
        double inserted = 0, rotation = 0, speed = 0, spin = 0;   // at the start of the sample; mm/s, rad/s, or N, N mm
        double slip = 0, refused = 0;                             // mm in this sample: forwards, backwards
        double push = 0;                                          // N, at the end of the last step
        Drive start, end, from, move, last;   // step start, trial, accepted; Newton step; last increment
        double energy = 0, slope = 0, scale = 1, shorten = 1, boost = 1, damping = 0, last_duration = 0;
        bool reduced = false, slips = false, first = true, extrapolated = false, finite = true, by_force = false;
    };

    const RodModel& rod_;
    const Lumen* lumen_;
    const Loads* loads_;
    const Base base_;
    const Options options_;
    Inputs in_{};
    Outputs out_{};
    std::vector<World>& world_;
    std::vector<Node> node_;
    std::vector<Factor<V>> factor_;
    static constexpr int kTogether = 8;            // nodes that a part of the evaluation takes at a time
    Diagonal<V> block_[kTogether + 1];
    Coupling<V> coupling_[kTogether];
    Lane lane_[W];
    // per lane: settings of the step, results of a sweep
    V active_{}, share_{}, geometric_{}, inverse_dt_{}, eps_{}, first_{}, damping_{}, friction_{}, way_{}, swing_{};
    V energy_{}, descent_{}, pivot_{}, jump_{}, base_force_{}, base_torque_{};
    DriveRows drive_{};            // of the wire's energy, all nodes eliminated
    V drive_a_{}, drive_r_{};      // the drive's Newton step

    double duration(const Lane& lane) const { return in_.time_step * lane.stride / kTicks; }
    double elapsed(int tick) const { return in_.time_step * tick / kTicks; }
    double sample_period() const { return in_.time_step * in_.steps_per_sample; }

    static void put(Vec3<V>& to, int l, const Vec3<double>& v) {
        set(to.x, l, v.x);
        set(to.y, l, v.y);
        set(to.z, l, v.z);
    }
    static void put(Quaternion<V>& to, int l, const Quaternion<double>& q) {
        set(to.w, l, q.w);
        put(to.v, l, q.v);
    }
    static Vec3<double> take(const Vec3<V>& v, int l) { return {get(v.x, l), get(v.y, l), get(v.z, l)}; }
    static Quaternion<double> take(const Quaternion<V>& q, int l) { return {get(q.w, l), take(q.v, l)}; }

    int most_active() const {
        int n = 0;
        for (const Lane& lane : lane_)
            if (lane.world >= 0) n = std::max(n, lane.active);
        return n;
    }

    // The lanes' exchange with the worlds (exchange.hpp).
    void take(int l, Crew& crew);
    void load(int l);
    void park(int l);
    void read_control(int l);
    void place(int l, int i);
    void place_base(int l, int i);
    void end_sample(int l, Crew& crew);
    void fail(int l);
    void record(int world, int sample, double iterations, double slip) const;

    // The step of one lane (below).
    void begin(int l, bool fresh);
    Verdict judge(int l);
    DriveTerms introducer(const Drive& moved, int l) const;
    DriveTerms drive_terms(const Lane& lane, int l) const;
    bool solve_drive(int l);
    int pass(Crew& crew);
    int advance(int n, const Verdict (&verdict)[W], Crew& crew);

    // Sweeps over the nodes of all lanes (sweeps.hpp).
    void evaluate(int n);
    void add_rod(int first, int count);
    DriveRows along_drive(const Diagonal<V>& block) const;
    void clear_drive_rows(Mask<V> mask, Diagonal<V>& block) const;
    void add_lumen(int first, int count);
    void add_drag(int first, int count);
    void eliminate_nodes(int first, int count);
    V add_loads(int i, const Node& node, Diagonal<V>& own) const;
    V solve(int n);
    void update(int n, const Verdict (&verdict)[W], const V& factor);
    void finish_step(int n, Mask<V> mask, Mask<V> restart, const V& weight);
};

// Begins a step of lane.stride ticks from the lane's start state; nodes ahead of the base already hold a trial.
template <class V>
void Stepper<V>::begin(int l, bool fresh) {
    Lane& lane = lane_[l];
    const int before = lane.active;
    if (lane.by_force) {
        const double weight = fresh ? 0.0 : duration(lane) / lane.last_duration;
        lane.end = {lane.start.advance + weight * lane.last.advance, lane.start.rotation + weight * lane.last.rotation};
    } else {
        lane.start = {lane.inserted - lane.slip + lane.speed * elapsed(lane.tick), lane.rotation + lane.spin * elapsed(lane.tick)};
        lane.end.advance =
            lane.slips ? lane.start.advance : lane.inserted - lane.slip + lane.speed * elapsed(lane.tick + lane.stride);
        lane.end.rotation = lane.rotation + lane.spin * elapsed(lane.tick + lane.stride);
    }
    lane.from = lane.end;
    lane.active = Base::count_active(rod_, lane.start.advance, options_.free_behind);
    for (int i = std::min(before, lane.active); i <= std::max(before, lane.active); ++i)
        if (i >= before || i >= lane.active) place(l, i);
    lane.iterations = lane.rejections = 0;
    lane.boost = 1;
    lane.first = lane.finite = true;
    lane.extrapolated = !fresh;
    const double way = options_.largest_jump + kDriveShare * std::abs(lane.end.advance - lane.start.advance);
    const double swing = options_.largest_jump + kDriveShare * std::abs(lane.end.rotation - lane.start.rotation);
    set(active_, l, lane.active);
    set(share_, l, Base::share_of_last_joint(rod_, lane.start.advance, options_.free_behind, lane.active));
    set(geometric_, l, 0.0);
    set(first_, l, 1.0);
    set(damping_, l, 0.0);
    set(inverse_dt_, l, 1.0 / duration(lane));
    set(eps_, l, options_.stick_velocity * in_.time_step);
    set(way_, l, 1.0 / (way * way));
    set(swing_, l, 4.0 / (swing * swing));  // of twice the imaginary part of a quaternion
}

// One evaluation, decision and update of all lanes. Returns the number of samples that ended.
template <class V>
int Stepper<V>::pass(Crew& crew) {
    const int n = most_active();
    evaluate(n);
    Verdict verdict[W];
    drive_a_ = drive_r_ = V{};
    for (int l = 0; l < W; ++l) verdict[l] = judge(l);
    const V largest = solve(n);
    V factor{};
    for (int l = 0; l < W; ++l)
        if (verdict[l] == Verdict::shorten) set(factor, l, lane_[l].shorten);
    for (int l = 0; l < W; ++l) {
        Lane& lane = lane_[l];
        if (verdict[l] != Verdict::accept) continue;
        const double size = get(largest, l);
        if (!(size < 1e100)) {  // the direction is not finite
            verdict[l] = Verdict::restart;
            continue;
        }
        const bool ends_sample = lane.tick + lane.stride == kTicks * in_.steps_per_sample;
        lane.scale = std::min(lane.boost, options_.largest_step / size);
        set(factor, l, lane.scale);
        const double tolerance = ends_sample ? options_.sample_tolerance : options_.tolerance;
        const bool at_rest = size <= options_.tolerance && lane.damping * size <= kAtRest;
        if (lane.reduced || lane.damping > 0 ? at_rest : size <= tolerance) {
            verdict[l] = Verdict::converged;
            set(factor, l, 1.0);
        }
    }
    update(n, verdict, factor);
    return advance(n, verdict, crew);
}

template <class V>
typename Stepper<V>::Verdict Stepper<V>::judge(int l) {
    Lane& lane = lane_[l];
    if (lane.world < 0) return Verdict::idle;
    ++lane.iterations;
    ++lane.total_iterations;
    const double energy = get(energy_, l) + (lane.by_force ? drive_terms(lane, l).energy : 0.0);
    lane.finite = std::isfinite(energy);
    if (lane.iterations > options_.most_iterations * (lane.stride == 1 && !lane.extrapolated ? kPatience : 1)) return Verdict::restart;
    if (!lane.first && lane.stride > 1 && get(jump_, l) > 1.0) {  // a snap: follow it in shorter steps
        lane.extrapolated = false;
        return Verdict::restart;
    }
    const double slack = 1e-11 * (std::abs(lane.energy) + 1e-3);
    if (!lane.finite || !(lane.first || energy <= lane.energy + slack)) {
        if (lane.first || ++lane.rejections > kMostRejections) return Verdict::restart;
        // the minimum of the parabola through the accepted energy, its slope and the energy just found
        const double slope = lane.scale * lane.slope;
        const double best = lane.finite ? 0.5 * slope / (slope + energy - lane.energy) : 0.0;
        lane.shorten = std::clamp(best, 0.02, 0.5);
        lane.scale *= lane.shorten;
        return Verdict::shorten;
    }
    if (!(get(pivot_, l) > 0) || !solve_drive(l)) {  // not positive definite: less of the geometric terms
        const double g = get(geometric_, l), damping = get(damping_, l);
        lane.energy = energy;
        if (g > 0) {
            set(geometric_, l, g > 0.05 ? 0.5 * g : 0.0);
            return Verdict::repeat;
        }
        if (damping >= kMostDamping) return Verdict::restart;
        set(damping_, l, std::max(kFirstDamping, 10 * damping));
        return Verdict::repeat;
    }
    lane.energy = energy;
    lane.slope = get(descent_, l);
    // Where the energy is not convex the damped steps are short: lengthen them as long as they succeed.
    const double damping = lane.damping = get(damping_, l);
    lane.boost = damping > 0 && lane.rejections == 0 ? std::min(2 * lane.boost, kMostBoost) : 1.0;
    set(damping_, l, damping > kFirstDamping ? 0.25 * damping : 0.0);
    lane.rejections = 0;
    set(first_, l, 0.0);
    lane.reduced = get(geometric_, l) < 1.0 && !lane.first;
    set(geometric_, l, lane.first ? 1.0 : std::min(1.0, std::max(0.25, 2 * get(geometric_, l))));
    lane.first = false;
    return Verdict::accept;
}

// Ends the steps that converged, restarts those that failed with half the step. Returns the samples that ended.
template <class V>
int Stepper<V>::advance(int n, const Verdict (&verdict)[W], Crew& crew) {
    Mask<V> finished{}, restarted{};
    V weight{};
    bool any_finished = false, failed[W] = {}, ended[W] = {};
    for (int l = 0; l < W; ++l) {
        Lane& lane = lane_[l];
        if (verdict[l] == Verdict::converged) {
            set_mask<V>(finished, l, true);
            any_finished = true;
            const double took = duration(lane);
            lane.tick += lane.stride;
            ++lane.steps;
            lane.last_duration = took;
            lane.push = get(base_force_, l);
            lane.last = {lane.end.advance - lane.start.advance, lane.end.rotation - lane.start.rotation};
            lane.start = lane.end;
            if (lane.slips) lane.slip += lane.speed * took;
            ended[l] = lane.tick == kTicks * in_.steps_per_sample;
            if (lane.stride < kTicks && lane.tick % (2 * lane.stride) == 0) lane.stride *= 2;
            if (ended[l]) continue;
            const bool slips = !lane.by_force && lane.speed > 0 && lane.push > options_.push_limit;
            if (slips != lane.slips) lane.last_duration = 0;  // do not extrapolate
            lane.slips = slips;
            set(weight, l, lane.last_duration > 0 ? duration(lane) / lane.last_duration : 0.0);
        } else if (verdict[l] == Verdict::restart) {
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
        if (failed[l]) {
            samples += std::max(0, in_.samples - std::max(0, lane.sample));
            fail(l);
            crew.finish();
        } else if (ended[l]) {
            samples += lane.sample >= 0;
            end_sample(l, crew);
        } else if (verdict[l] == Verdict::converged) {
            begin(l, get(weight, l) == 0.0);
        } else if (verdict[l] == Verdict::restart) {
            begin(l, true);
        }
    }
    return samples;
}

// The introducer through which the drive moves the wire: smoothed Coulomb friction of its valve and viscous drag, against
// advance and rotation together; the wire's surface moves by its radius times the rotation.
template <class V>
typename Stepper<V>::DriveTerms Stepper<V>::introducer(const Drive& moved, int l) const {
    const double r = rod_.radius[lane_[l].active], a = moved.advance, s = r * moved.rotation, eps = get(eps_, l);
    const double drag = options_.introducer_drag * get(inverse_dt_, l), size = std::sqrt(a * a + s * s + eps * eps);
    const double grip = options_.introducer_friction / size, c = grip / (size * size);
    return {0.5 * drag * (a * a + s * s) + options_.introducer_friction * (size - eps),
            (drag + grip) * a, (drag + grip) * s * r,
            drag + grip - c * a * a, -c * a * s * r, (drag + grip - c * s * s) * r * r};
}

// Where the wire is driven by force, the drive's advance and rotation are unknowns too: the energy at the trial point of
// the introducer, of the stops at both ends of the drive's travel, and of the load.
template <class V>
typename Stepper<V>::DriveTerms Stepper<V>::drive_terms(const Lane& lane, int l) const {
    const Drive moved{lane.end.advance - lane.start.advance, lane.end.rotation - lane.start.rotation};
    DriveTerms t = introducer(moved, l);
    const double a = lane.end.advance;
    const double beyond = std::min(0.0, a) + std::max(0.0, a + options_.free_behind - rod_.abscissa.back());
    t.energy += 0.5 * kStop * beyond * beyond - lane.speed * moved.advance - lane.spin * moved.rotation;
    t.pull_a += kStop * beyond - lane.speed;
    t.pull_r -= lane.spin;
    t.aa += beyond != 0.0 ? kStop : 0.0;
    return t;
}

// Newton's step of the drive where it is driven by force. Returns whether the Hessian is positive definite.
template <class V>
bool Stepper<V>::solve_drive(int l) {
    const Lane& lane = lane_[l];
    if (!lane.by_force) return true;
    const DriveTerms t = drive_terms(lane, l);
    const double damping = get(damping_, l);
    const double aa = t.aa + get(drive_.aa, l) + damping, ar = t.ar + get(drive_.ar, l), rr = t.rr + get(drive_.rr, l) + damping;
    const double determinant = aa * rr - ar * ar;
    if (!(aa > 0 && determinant > 0)) return false;
    const double a = t.pull_a + get(drive_.pull_a, l), r = t.pull_r + get(drive_.pull_r, l);
    const double step_a = (ar * r - rr * a) / determinant, step_r = (ar * a - aa * r) / determinant;
    set(drive_a_, l, step_a);
    set(drive_r_, l, step_r);
    set(descent_, l, get(descent_, l) - a * step_a - r * step_r);
    return true;
}

}  // namespace endopilot

#include "exchange.hpp"
#include "sweeps.hpp"
