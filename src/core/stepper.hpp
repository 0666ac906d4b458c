// The time stepper: a few worlds side by side, each taking its own implicit Euler steps at its own pace.
//
// A step minimises the incremental potential (elastic energy + wall + friction + drag) by Newton's method with an energy
// line search. One pass of the loop evaluates every lane at its trial point; each lane then accepts the trial and takes
// a new direction, shortens its last one, or, having converged, begins its next time step.
#pragma once

#include <algorithm>
#include <atomic>
#include <cmath>
#include <vector>

#include "contact.hpp"
#include "interface.hpp"
#include "solve.hpp"

namespace endopilot {

constexpr int kTicks = 64;     // a step may be halved down to 1/64
constexpr int kMostRejections = 12;
constexpr int kPatience = 5;   // a snap from one shape to another is not shortened by a shorter step
constexpr double kOvershoot = 0.02;      // mm that rounded controls may pull the wire behind the ostium
constexpr double kReach = 0.1;           // mm within which a wall that was touched counts as touched, at first
constexpr double kFirstDamping = 1e-3;   // N/mm (rotations: N mm/rad), where the Hessian is indefinite even without geometric terms
constexpr double kMostDamping = 1e3;
constexpr double kMostBoost = 64;
constexpr double kAtRest = 1e-5;         // N that a damped solution may be out of balance

template <class V>
class Stepper {
public:
    Stepper(const RodModel& rod, const Lumen* lumen, const Loads* loads, const Base& base, const Options& options,
            const Inputs& in, const Outputs& out)
        : rod_(rod), lumen_(lumen), loads_(loads), base_(base), options_(options), in_(in), out_(out),
          node_(rod.nodes), factor_(rod.nodes) {}

    // Runs worlds taken from `order` by the shared counter `next` until none is left or `stop` is set. `done` counts
    // finished samples.
    void run(const std::vector<int>& order, std::atomic<int>& next, std::atomic<long>& done, const std::atomic<bool>& stop) {
        while (!stop.load(std::memory_order_relaxed)) {
            bool busy = false;
            for (int l = 0; l < W; ++l) {
                if (lane_[l].world < 0) {
                    const int ticket = next.fetch_add(1);
                    if (ticket < in_.worlds) start(l, order[ticket]);
                }
                busy = busy || lane_[l].world >= 0;
            }
            if (!busy) return;
            done.fetch_add(pass(), std::memory_order_relaxed);
        }
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
    };

    struct Lane {
        int world = -1, sample = 0, tick = 0, stride = 0, active = 0, iterations = 0, rejections = 0, steps = 0;
        long total_iterations = 0;
        double inserted = 0, rotation = 0, speed = 0, spin = 0;   // at the start of the sample; mm/s, rad/s
        double slip = 0, refused = 0, approach_slip = 0;   // mm in this sample: forwards, backwards; mm before the first
        double push = 0;                                  // N, at the end of the last step
        double start_inserted = 0, start_rotation = 0, end_inserted = 0, end_rotation = 0;
        double energy = 0, slope = 0, scale = 1, shorten = 1, boost = 1, damping = 0, last_duration = 0;
        bool reduced = false, slips = false, first = true, extrapolated = false, finite = true;
    };

    const RodModel& rod_;
    const Lumen* lumen_;
    const Loads* loads_;
    const Base base_;
    const Options options_;
    const Inputs in_;
    const Outputs out_;
    std::vector<Node> node_;
    std::vector<Factor<V>> factor_;
    Lane lane_[W];
    // per lane
    V active_{}, geometric_{}, inverse_dt_{}, eps_{}, first_{}, damping_{}, descent_{}, friction_{}, energy_{}, pivot_{}, force_max_{}, force_sum_{};
    V base_force_{}, base_torque_{};

    double duration(const Lane& lane) const { return options_.time_step * lane.stride / kTicks; }

    Vec3<double> base_position(int i, double inserted) const {
        const Vec3<double> d = frame(base_.orientation).d3;
        return base_.origin + (inserted - rod_.abscissa[i]) * d;
    }

    Quaternion<double> base_orientation(double rotation) const {
        return base_.orientation * Quaternion<double>{std::cos(0.5 * rotation), {0, 0, std::sin(0.5 * rotation)}};
    }

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

    // Places node i of a lane on the catheter's axis as it was at the step's start (start) and is at its end (trial).
    void place(int l, int i) {
        const Lane& lane = lane_[l];
        Node& n = node_[i];
        put(n.start, l, base_position(i, lane.start_inserted));
        put(n.start_q, l, base_orientation(lane.start_rotation));
        put(n.x, l, base_position(i, lane.end_inserted));
        put(n.q, l, base_orientation(lane.end_rotation));
        put(n.from, l, take(n.x, l));
        put(n.from_q, l, base_orientation(lane.end_rotation));
        put(n.last, l, {0, 0, 0});
        put(n.last_turn, l, {0, 0, 0});
        set(n.grip.limit, l, 0);
        put(n.grip.normal, l, {0, 0, 0});
        put(n.grip.spin, l, {0, 0, 0});
    }

    int count_active(double inserted) const {
        int n = 1;
        while (n < rod_.nodes - 2 && inserted - rod_.abscissa[n] > -options_.free_behind) ++n;
        return n;
    }

    void start(int l, int world) {
        Lane& lane = lane_[l] = Lane{};
        lane.world = world;
        const double depth = in_.initial[2 * world];
        const double sample = options_.time_step * options_.steps_per_sample;
        const int approach = options_.approach_velocity > 0 ? int(std::ceil(depth / (options_.approach_velocity * sample))) + 1 : 0;
        lane.sample = -approach;
        lane.inserted = approach > 0 ? 0.0 : depth;
        lane.rotation = in_.initial[2 * world + 1];
        set(friction_, l, in_.friction[world]);
        lane.start_inserted = lane.end_inserted = lane.inserted;
        lane.start_rotation = lane.end_rotation = lane.rotation;
        for (int i = 0; i < rod_.nodes; ++i) place(l, i);
        lane.active = count_active(lane.inserted);
        read_control(l);
        lane.stride = kTicks;
        begin(l, true);
    }

    void read_control(int l) {
        Lane& lane = lane_[l];
        double speed, spin;
        if (lane.sample < 0) {  // the approach: pushed in at one speed, then one sample at rest
            const double depth = in_.initial[2 * lane.world];
            const double sample = options_.time_step * options_.steps_per_sample;
            const int moving = int(std::ceil(depth / (options_.approach_velocity * sample)));
            speed = lane.sample == -1 || moving == 0 ? 0.0 : depth / (moving * sample);
            spin = 0.0;
        } else {
            const double* control = in_.control + 2 * (std::size_t(lane.world) * in_.samples + lane.sample);
            speed = control[0];
            spin = control[1];
        }
        const double sample = options_.time_step * options_.steps_per_sample;
        lane.refused = 0;
        if (lane.inserted + speed * sample < -kOvershoot) {  // after a slip there is less wire to pull back
            lane.refused = lane.inserted + speed * sample;
            speed = -lane.inserted / sample;
        }
        if (speed != lane.speed || spin != lane.spin) lane.last_duration = 0;  // the control changed: do not extrapolate
        lane.speed = speed;
        lane.spin = spin;
    }

    double elapsed(int tick) const { return options_.time_step * tick / kTicks; }

    // Begins a step of lane.stride ticks from the lane's start state; nodes ahead of the base already hold a trial.
    void begin(int l, bool fresh) {
        Lane& lane = lane_[l];
        const int before = lane.active;
        lane.start_inserted = lane.inserted - lane.slip + lane.speed * elapsed(lane.tick);
        lane.start_rotation = lane.rotation + lane.spin * elapsed(lane.tick);
        lane.end_inserted =
            lane.slips ? lane.start_inserted : lane.inserted - lane.slip + lane.speed * elapsed(lane.tick + lane.stride);
        lane.end_rotation = lane.rotation + lane.spin * elapsed(lane.tick + lane.stride);
        lane.active = count_active(lane.end_inserted);
        for (int i = std::min(before, lane.active); i <= std::max(before, lane.active); ++i)
            if (i >= before || i >= lane.active) place(l, i);
        lane.iterations = lane.rejections = 0;
        lane.boost = 1;
        lane.first = lane.finite = true;
        lane.extrapolated = !fresh;
        set(active_, l, lane.active);
        set(geometric_, l, 0.0);
        set(first_, l, 1.0);
        set(damping_, l, 0.0);
        set(inverse_dt_, l, 1.0 / duration(lane));
        set(eps_, l, options_.stick_velocity * options_.time_step);
    }

    int most_active() const {
        int n = 0;
        for (const Lane& lane : lane_)
            if (lane.world >= 0) n = std::max(n, lane.active);
        return n;
    }

    // One evaluation, decision and update of all lanes. Returns the number of samples that ended.
    int pass() {
        const int n = most_active();
        evaluate(n);
        Verdict verdict[W];
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
            const bool ends_sample = lane.tick + lane.stride == kTicks * options_.steps_per_sample;
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
        return advance(n, verdict);
    }

    // Energy, gradient and Hessian at the trial point, eliminated on the fly from tip to base.
    void evaluate(int n);
    // Adds dead loads and springs. Returns their energy.
    V add_loads(int i, const Node& node, Diagonal<V>& own) const;

    Verdict judge(int l) {
        Lane& lane = lane_[l];
        if (lane.world < 0) return Verdict::idle;
        ++lane.iterations;
        ++lane.total_iterations;
        const double energy = get(energy_, l);
        lane.finite = std::isfinite(energy);
        if (lane.iterations > options_.most_iterations * (lane.stride == 1 && !lane.extrapolated ? kPatience : 1)) return Verdict::restart;
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
        if (!(get(pivot_, l) > 0)) {  // not positive definite: less of the geometric terms
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

    // Back substitution. Returns the largest displacement (mm) or rotation (rad) of a node; NaN where the solve failed.
    V solve(int n);
    // Moves each lane's trial point as its verdict says.
    void update(int n, const Verdict (&verdict)[W], const V& factor);
    // Ends the steps that converged, restarts those that failed with half the step. Returns the samples that ended.
    int advance(int n, const Verdict (&verdict)[W]);
    void finish_step(int n, Mask<V> mask, Mask<V> restart, const V& weight);
    bool end_sample(int l);
    void record(int l, bool valid);
    void fail(int l);
};

template <class V>
int Stepper<V>::advance(int n, const Verdict (&verdict)[W]) {
    Mask<V> finished{}, restarted{};
    V weight{};
    bool any_finished = false, failed[W] = {};
    int ended = 0;
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
            if (lane.slips) lane.slip += lane.speed * took;
            const bool whole = lane.tick == kTicks * options_.steps_per_sample;
            if (lane.stride < kTicks && lane.tick % (2 * lane.stride) == 0) lane.stride *= 2;
            if (whole) {
                ++ended;
                if (end_sample(l)) continue;  // the world is done
                read_control(l);
            }
            const bool slips = lane.speed > 0 && lane.push > options_.push_limit;
            if (slips != lane.slips) lane.last_duration = 0;
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
    for (int l = 0; l < W; ++l) {
        Lane& lane = lane_[l];
        if (failed[l]) {
            ended += std::max(0, in_.samples - std::max(0, lane.sample));
            fail(l);
        } else if (lane.world >= 0 && verdict[l] == Verdict::converged) {
            begin(l, get(weight, l) == 0.0);
        } else if (verdict[l] == Verdict::restart) {
            begin(l, true);
        }
    }
    return ended;
}

template <class V>
bool Stepper<V>::end_sample(int l) {
    Lane& lane = lane_[l];
    if (lane.sample >= 0) record(l, true);
    const double sample = options_.time_step * options_.steps_per_sample;
    lane.inserted += lane.speed * sample - lane.slip;
    lane.rotation += lane.spin * sample;
    if (lane.sample < 0) lane.approach_slip += lane.slip;
    if (lane.sample == -1) {  // the approach ends exactly at the asked length
        lane.inserted = in_.initial[2 * lane.world] - lane.approach_slip;
        out_.approach_slip[lane.world] = lane.approach_slip;
    }
    lane.slip = 0;
    lane.tick = lane.steps = 0;
    lane.total_iterations = 0;
    if (++lane.sample < in_.samples) return false;
    out_.reason[lane.world] = kFine;
    lane.world = -1;
    return true;
}

template <class V>
void Stepper<V>::record(int l, bool valid) {
    const Lane& lane = lane_[l];
    const std::size_t at = std::size_t(lane.world) * in_.samples + lane.sample;
    const Node& tip = node_[0];
    const auto write = [](double* to, const Vec3<double>& v) { to[0] = v.x, to[1] = v.y, to[2] = v.z; };
    const auto orientation = [l](const Quaternion<V>& q) { return Quaternion<double>{get(q.w, l), take(q.v, l)}; };
    const auto position = [&](const Node& n) { return take(valid ? n.x : n.start, l); };
    const auto attitude = [&](const Node& n) { return orientation(valid ? n.q : n.start_q); };
    write(out_.tip_position + 3 * at, position(tip));
    write(out_.tip_direction + 3 * at, frame(attitude(tip)).d3);
    out_.force_max[at] = valid ? get(force_max_, l) : 0.0;
    out_.force_sum[at] = valid ? get(force_sum_, l) : 0.0;
    out_.base_force[at] = valid ? get(base_force_, l) : 0.0;
    out_.base_torque[at] = valid ? get(base_torque_, l) : 0.0;
    out_.iterations[at] = lane.steps > 0 ? double(lane.total_iterations) / lane.steps : 0.0;
    out_.slip[at] = valid ? lane.slip + lane.refused : 0.0;
    out_.valid[at] = valid;
    for (int i = 0; i < rod_.nodes && (out_.shape || out_.attitude); ++i) {
        const bool free = i < lane.active;
        if (out_.shape)
            write(out_.shape + 3 * (at * rod_.nodes + i), free ? position(node_[i]) : base_position(i, lane.end_inserted));
        if (out_.attitude) {
            const Quaternion<double> q = free ? attitude(node_[i]) : base_orientation(lane.end_rotation);
            double* to = out_.attitude + 4 * (at * rod_.nodes + i);
            to[0] = q.w;
            write(to + 1, q.v);
        }
    }
}

// Marks the lane's world invalid from this sample on and frees the lane; its pose stays as last converged.
template <class V>
void Stepper<V>::fail(int l) {
    Lane& lane = lane_[l];
    out_.reason[lane.world] = lane.finite ? kNotConverged : kNotFinite;
    for (lane.sample = std::max(0, lane.sample); lane.sample < in_.samples; ++lane.sample) record(l, false);
    lane.world = -1;
}

}  // namespace endopilot

#include "sweeps.hpp"
