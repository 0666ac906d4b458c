// Between lanes and worlds: a lane takes a world from the queue, steps it for a sample, records it and stores it again.
#pragma once

#include <limits>

#include "stepper.hpp"

namespace endopilot {

constexpr double kOvershoot = 0.02;  // mm that rounded controls may pull the wire behind the ostium
constexpr double kNever = std::numeric_limits<double>::quiet_NaN();
constexpr double kResultantLength = 2.0;  // mm of wire whose forces of the wall are added up: nodes may share one contact

// Puts a world at the ostium, straight, ready to be pushed to the inserted length `depth` (mm) before its first sample.
inline void start_world(const Scene& scene, const World& w, double depth, double rotation, double friction, double sample_period) {
    const double speed = scene.options.approach_velocity, inserted = speed > 0 ? 0.0 : depth;
    for (std::size_t k = 0; k < World::size(scene.rod.nodes); ++k) w.values[std::ptrdiff_t(k) * w.stride] = 0.0;
    w[World::kInserted] = inserted;
    w[World::kRotation] = rotation;
    w[World::kApproach] = speed > 0 ? std::ceil(depth / (speed * sample_period)) + 1 : 0.0;
    w[World::kDepth] = depth;
    w[World::kFriction] = friction;
    w[World::kStride] = kTicks;
    w[World::kActive] = Base::count_active(scene.rod, inserted, scene.options.free_behind);
    const Base base = scene.motion.cycles > 0 ? scene.base.moved(placement(scene.motion, w[World::kTime])) : scene.base;
    for (int i = 0; i < int(w[World::kActive]); ++i) {
        write(w.node(i) + World::kX, base.position(scene.rod, i, inserted));
        write(w.node(i) + World::kQ, base.attitude(rotation));
    }
}

// The same for tubes: `initial` and `friction` hold advance and rotation, and the coefficient, of each. The foremost is approached at
// the approach velocity, the others arrive with it.
inline void start_tubes(const Scene& scene, const World& w, const double* initial, const double* friction, double sample_period) {
    const int tubes = scene.tubes.tubes, nodes = scene.rod.nodes;
    double depth = 0;
    for (int k = 0; k < tubes; ++k) depth = std::max(depth, initial[2 * k]);
    start_world(scene, w, depth, initial[1], friction[0], sample_period);
    for (std::size_t k = World::size(nodes); k < World::size(nodes, tubes - 1); ++k) w.values[std::ptrdiff_t(k) * w.stride] = 0.0;
    for (int k = 0; k < tubes; ++k) {
        const World::Numbers tube = w.tube(nodes, k);
        tube[World::kTubeInserted] = scene.options.approach_velocity > 0 ? 0.0 : initial[2 * k];
        tube[World::kTubeDepth] = initial[2 * k];
        tube[World::kTubeRotation] = initial[2 * k + 1];
        tube[World::kTubeFriction] = friction[k];
        tube[World::kTubePace] = 1.0;
    }
    for (int i = 0; i < w.active(); ++i)
        for (int k = 1; k < tubes; ++k) w.twists(nodes, tubes - 1, i)[k - 1] = initial[2 * k + 1] - initial[1];
}

template <class V, int T>
template <class Queue>
void Stepper<V, T>::take(int l, Queue& queue) {
    double length = 0;
    int others = 0;
    for (const Lane& lane : lane_)
        if (lane.world >= 0) length += lane.active, ++others;
    Lane& lane = lane_[l];
    for (;;) {
        int sample = 0;
        const int world = queue.take(others > 0 ? length / others : -1.0, sample);
        if (world < 0) return;
        const World w = world_[world];
        if (w[World::kApproach] > 0) sample = -int(w[World::kApproach]);
        if (w.valid() && sample < in_.samples) {
            lane = Lane{};
            lane.world = world;
            lane.sample = sample;
            load(l);
            return;
        }
        for (sample = std::max(0, sample); sample < in_.samples; ++sample) record(world, sample, 0.0, 0.0, {});
        queue.finish();
    }
}

// Places node i of a lane on the catheter's axis as it was at the step's start (start) and is at its end (trial).
template <class V, int T>
void Stepper<V, T>::place(int l, int i) {
    const Lane& lane = lane_[l];
    Node<V, T>& n = node_[i];
    put(n.start, l, lane.base.position(rod_, i, lane.start.advance));
    put(n.start_q, l, lane.base.attitude(lane.start.rotation));
    put(n.last, l, lane.last.advance * frame(lane.base.orientation).d3);
    put(n.last_turn, l, {0, 0, lane.last.rotation});
    clear(n.at_node, l);
    clear(n.at_middle, l);
    if constexpr (T > 0) {
        const auto& tube = lane.tubes.tube;
        for (int k = 0; k <= T; ++k) set(n.tubes.rate[k], l, 0);
        for (int k = 0; k < T; ++k) {
            set(n.tubes.start[k], l, tube[k + 1].turned - lane.start.rotation);
            set(n.tubes.last[k], l, tube[k + 1].last_rotation - lane.last.rotation);
            set(n.tubes.step[k], l, 0);
            set(n.tubes.limit[k], l, 0);
        }
    }
    place_base(l, i);
}

// Carries the start of the coming step with the vessel to where that is at the step's end: what a step moves is then its motion
// relative to the wall, and so is what friction and drag resist.
template <class V, int T>
void Stepper<V, T>::carry(int l) {
    Lane& lane = lane_[l];
    const bool waits = lane.sample < 0;
    const double begins = waits ? lane.time : lane.time + elapsed(lane.tick), ends = waits ? lane.time : lane.time + elapsed(lane.tick + lane.stride);
    const Carriage carriage(placement(motion_, lane.carried), placement(motion_, ends));
    const Placement& vessel = carriage.to;
    lane.carried = ends;
    lane.strain = strain(placement(motion_, begins), vessel);
    lane.base = base_.moved(vessel);
    put(axis_, l, frame(lane.base.orientation).d3);
    const Frame<double> r = frame(vessel.rotation);
    const Vec3<double> x{r.d1.x, r.d2.x, r.d3.x}, y{r.d1.y, r.d2.y, r.d3.y}, z{r.d1.z, r.d2.z, r.d3.z};   // columns of its transpose
    const Vec3<double> a = vessel.shrink * x, b = vessel.shrink * y, c = vessel.shrink * z;
    put(wall_.row[0], l, {a.x, b.x, c.x});
    put(wall_.row[1], l, {a.y, b.y, c.y});
    put(wall_.row[2], l, {a.z, b.z, c.z});
    put(wall_.at, l, vessel.to_vessel({0, 0, 0}));
    const auto turn_point = [&](ContactPoint<V>& point) {
        put(point.offset, l, carriage.direction(take(point.offset, l)));
        put(point.friction.normal, l, carriage.direction(take(point.friction.normal, l)));
        put(point.friction.spin_arm, l, carriage.direction(take(point.friction.spin_arm, l)));
    };
    for (int i = 0; i < lane.active; ++i) {
        Node<V, T>& n = node_[i];
        const Vec3<double> start = take(n.start, l), carried = carriage.point(start);
        put(n.x, l, carried + carriage.direction(take(n.x, l) - start));
        put(n.start, l, carried);
        put(n.q, l, carriage.attitude(take(n.q, l)));
        put(n.start_q, l, carriage.attitude(take(n.start_q, l)));
        turn_point(n.at_node);
        turn_point(n.at_middle);
    }
}

// Takes a contact point off the wall.
template <class V, int T>
void Stepper<V, T>::clear(ContactPoint<V>& point, int l) {
    set(point.friction.limit, l, 0);
    put(point.friction.normal, l, {0, 0, 0});
    put(point.friction.spin_arm, l, {0, 0, 0});
    set(point.normal_force, l, 0);
    put(point.offset, l, {0, 0, 0});
    set(point.clearance, l, kNever);
}

template <class V, int T>
void Stepper<V, T>::load(ContactPoint<V>& point, int l, const World::Numbers& from) {
    set(point.friction.limit, l, from[World::kLimit]);
    put(point.friction.normal, l, vec3(from + World::kNormal));
    put(point.friction.spin_arm, l, vec3(from + World::kSpinArm));
    set(point.normal_force, l, from[World::kNormalForce]);
    put(point.offset, l, vec3(from + World::kOffset));
    set(point.clearance, l, kNever);
}

template <class V, int T>
void Stepper<V, T>::store(const ContactPoint<V>& point, int l, const World::Numbers& to) {
    to[World::kLimit] = get(point.friction.limit, l);
    write(to + World::kNormal, take(point.friction.normal, l));
    write(to + World::kSpinArm, take(point.friction.spin_arm, l));
    to[World::kNormalForce] = get(point.normal_force, l);
    write(to + World::kOffset, take(point.offset, l));
}

// Places the trial of a node that follows the drive.
template <class V, int T>
void Stepper<V, T>::place_base(int l, int i) {
    const Drive& end = lane_[l].end;
    const Base& base = lane_[l].base;
    Node<V, T>& n = node_[i];
    put(n.x, l, base.position(rod_, i, end.advance));
    put(n.q, l, base.attitude(end.rotation));
    put(n.from, l, take(n.x, l));
    put(n.from_q, l, take(n.q, l));
    if constexpr (T > 0) {
        for (int k = 0; k < T; ++k) {
            set(n.tubes.twist[k], l, lane_[l].tubes.tube[k + 1].end_rotation - end.rotation);
            set(n.tubes.from[k], l, get(n.tubes.twist[k], l));
        }
    }
}

template <class V, int T>
void Stepper<V, T>::load(int l) {
    Lane& lane = lane_[l];
    const World w = world_[lane.world];
    lane.inserted = lane.start.advance = lane.end.advance = w[World::kInserted];
    lane.rotation = lane.start.rotation = lane.end.rotation = w[World::kRotation];
    lane.last_duration = w[World::kLastDuration];
    lane.stride = int(w[World::kStride]);
    lane.active = int(w[World::kActive]);
    lane.time = lane.carried = w[World::kTime];
    lane.base = base_;
    put(axis_, l, frame(base_.orientation).d3);
    lane.slipping = {int(w[World::kSlipping]), int(w[World::kSpinSlipping])};
    set(friction_, l, w[World::kFriction]);
    if constexpr (T > 0) load_tubes(l);
    read_control(l);
    const double weight = lane.last_duration > 0 ? duration(lane) / lane.last_duration : 0.0;
    lane.last = {weight > 0 ? w[World::kLastAdvance] : 0.0, weight > 0 ? w[World::kLastTurned] : 0.0};
    if constexpr (T > 0)
        if (!(weight > 0))
            for (Tube& tube : lane.tubes.tube) tube.last_rotation = 0;
    for (int i = 0; i < lane.active; ++i) {
        const World::Numbers p = w.node(i);
        Node<V, T>& n = node_[i];
        const Vec3<double> x = vec3(p + World::kX), last = vec3(p + World::kLast), turn = vec3(p + World::kLastTurn);
        const Quaternion<double> q = quaternion(p + World::kQ);
        put(n.start, l, x);
        put(n.start_q, l, q);
        put(n.last, l, last);
        put(n.last_turn, l, turn);
        put(n.x, l, x + weight * last);
        put(n.q, l, rotated(q, weight * turn));
        put(n.from, l, take(n.x, l));
        put(n.from_q, l, take(n.q, l));
        put(n.step, l, {0, 0, 0});
        put(n.turn, l, {0, 0, 0});
        load(n.at_node, l, p + World::kAtNode);
        load(n.at_middle, l, p + World::kAtMiddle);
        if constexpr (T > 0) {
            const World::Numbers t = w.twists(rod_.nodes, T, i);
            for (int k = 0; k < T; ++k) {
                set(n.tubes.start[k], l, t[k]);
                set(n.tubes.last[k], l, t[T + k]);
                set(n.tubes.twist[k], l, t[k] + weight * t[T + k]);
                set(n.tubes.from[k], l, get(n.tubes.twist[k], l));
                set(n.tubes.step[k], l, 0);
                set(n.tubes.limit[k], l, t[2 * T + k]);
            }
            for (int k = 0; k <= T; ++k) set(n.tubes.rate[k], l, t[3 * T + k]);
        }
    }
    begin(l, weight == 0.0);
}

// Keeps the lane's world as it was at the end of the last step that converged.
template <class V, int T>
void Stepper<V, T>::store(int l) {
    const Lane& lane = lane_[l];
    const World w = world_[lane.world];
    w[World::kInserted] = lane.inserted;
    w[World::kRotation] = lane.rotation;
    w[World::kSpeed] = lane.speed;
    w[World::kSpin] = lane.spin;
    w[World::kByForce] = lane.by_force;
    w[World::kLastDuration] = lane.last_duration;
    w[World::kLastAdvance] = lane.last.advance;
    w[World::kLastTurned] = lane.last.rotation;
    w[World::kStride] = lane.stride;
    w[World::kActive] = lane.active;
    w[World::kTime] = motion_.cycles > 0 || lane.sample < 0 ? lane.carried : lane.time + elapsed(lane.tick);
    w[World::kSlipping] = lane.slipping.advance;
    w[World::kSpinSlipping] = lane.slipping.rotation;
    for (int i = 0; i < lane.active; ++i) {
        const World::Numbers p = w.node(i);
        const Node<V, T>& n = node_[i];
        write(p + World::kX, take(n.start, l));
        write(p + World::kQ, take(n.start_q, l));
        write(p + World::kLast, take(n.last, l));
        write(p + World::kLastTurn, take(n.last_turn, l));
        store(n.at_node, l, p + World::kAtNode);
        store(n.at_middle, l, p + World::kAtMiddle);
        if constexpr (T > 0) {
            const World::Numbers t = w.twists(rod_.nodes, T, i);
            for (int k = 0; k < T; ++k) {
                t[k] = get(n.tubes.start[k], l);
                t[T + k] = get(n.tubes.last[k], l);
                t[2 * T + k] = get(n.tubes.limit[k], l);
            }
            for (int k = 0; k <= T; ++k) t[3 * T + k] = get(n.tubes.rate[k], l);
        }
    }
    if constexpr (T > 0) store_tubes(l);
}

template <class V, int T>
void Stepper<V, T>::read_control(int l) {
    if constexpr (T > 0) return read_tube_controls(l);
    Lane& lane = lane_[l];
    const World w = world_[lane.world];
    if (lane.sample < 0) {  // the approach: pushed in at one speed, then one sample at rest
        const double left = w[World::kDepth] - lane.inserted;
        lane.speed = lane.sample == -1 ? 0.0 : left / ((-lane.sample - 1) * sample_period());
        lane.spin = 0.0;
    } else {
        const double* control = in_.control + 2 * (std::size_t(lane.world) * in_.samples + lane.sample);
        lane.speed = control[0];
        lane.spin = control[1];
        lane.by_force = in_.force_driven;
    }
    if (!lane.by_force && lane.inserted + lane.speed * sample_period() < -kOvershoot) {
        lane.refused = lane.inserted + lane.speed * sample_period();  // after a slip there is less wire to pull back
        lane.speed = -lane.inserted / sample_period();
    }
    const bool same = lane.speed == w[World::kSpeed] && lane.spin == w[World::kSpin] && double(lane.by_force) == w[World::kByForce];
    if (!same) lane.last_duration = 0;  // do not extrapolate
}

template <class V, int T>
template <class Queue>
void Stepper<V, T>::end_sample(int l, Queue& queue) {
    Lane& lane = lane_[l];
    const World w = world_[lane.world];
    if constexpr (T > 0) {
        end_tubes(l);
    } else if (lane.by_force) {
        lane.inserted = lane.end.advance;
        lane.rotation = lane.end.rotation;
    } else {
        lane.inserted += lane.speed * sample_period() - lane.slip.advance;
        lane.rotation += lane.spin * sample_period() - lane.slip.rotation;
    }
    if (lane.sample < 0 && T == 0) {
        out_.approach_slip[2 * lane.world] += lane.slip.advance;
        out_.approach_slip[2 * lane.world + 1] += lane.slip.rotation;
        w[World::kApproach] = -lane.sample - 1;
        w[World::kDepth] -= lane.slip.advance;
        if (lane.sample == -1) lane.inserted = w[World::kDepth];  // exactly
    }
    store(l);
    if constexpr (T == 0) {
        const DriveEnergy valve = introducer(lane.last, rod_.radius[lane.active], l);
        w[World::kBaseForce] = get(base_force_, l);
        w[World::kBaseTorque] = get(base_torque_, l);
        w[World::kDriveForce] = lane.by_force ? lane.speed : w[World::kBaseForce] + valve.gradient_a;
        w[World::kDriveTorque] = lane.by_force ? lane.spin : w[World::kBaseTorque] + valve.gradient_r;
    }
    if (T == 0 && through_wall(w)) w[World::kReason] = kThroughWall;
    if (lane.sample >= 0)
        record(lane.world, lane.sample, double(lane.total_iterations) / lane.steps, double(lane.node_iterations),
               {lane.slip.advance + lane.refused, lane.slip.rotation});
    if (lane.sample + 1 < in_.samples)
        queue.put_back(lane.world, lane.sample + 1, lane.active);
    else
        queue.finish();
    lane.world = -1;
}

// Whether a wire's middle has left the lumen of a vessel that does not yield. The wall then holds it on both sides of a septum, and
// pushes itself apart through the wire, whatever the drive does.
template <class V, int T>
bool Stepper<V, T>::through_wall(const World& w) const {
    if (options_.foundation != 0) return false;
    for (int i = 0; i < w.active(); ++i) {
        const double most = options_.wall_stiffness * rod_.radius[i];
        const World::Numbers node = w.node(i);
        if (node[World::kAtNode + World::kNormalForce] > most || node[World::kAtMiddle + World::kNormalForce] > most) return true;
    }
    return false;
}

// Marks the lane's world invalid from this sample on and frees the lane; its pose stays as last converged.
template <class V, int T>
void Stepper<V, T>::fail(int l) {
    Lane& lane = lane_[l];
    lane.inserted = lane.start.advance;
    lane.rotation = lane.start.rotation;
    if constexpr (T > 0)
        for (Tube& tube : lane.tubes.tube) tube.inserted = tube.advanced, tube.rotation = tube.turned;
    store(l);
    world_[lane.world][World::kReason] = lane.finite ? kNotConverged : kNotFinite;
    for (int sample = std::max(0, lane.sample); sample < in_.samples; ++sample)
        record(lane.world, sample, 0.0, sample == lane.sample ? double(lane.node_iterations) : 0.0, {});
    lane.world = -1;
}

template <class V, int T>
void Stepper<V, T>::record(int world, int sample, double iterations, double node_iterations, const Drive& slip) const {
    const World w = world_[world];
    const std::size_t at = std::size_t(world) * in_.samples + sample;
    const int active = w.active();
    out_.inserted[at] = w[World::kInserted];
    out_.rotation[at] = w[World::kRotation];
    double largest = 0, sum = 0, resultant = 0;
    // Contact points from tip to base: 2 i is node i, 2 i + 1 the middle of the element behind it.
    const auto point = [&](int p) { return w.node(p / 2) + (p % 2 ? World::kAtMiddle : World::kAtNode); };
    const auto abscissa = [&](int p) { return p % 2 ? Base::middle(rod_, p / 2) : rod_.abscissa[p / 2]; };
    for (int i = 0; i < active; ++i) {
        largest = std::max(largest, w.force(i));
        sum += w.force(i);
    }
    for (int p = 0; p < 2 * active; ++p) {
        if (point(p)[World::kNormalForce] == 0) continue;
        Vec3<double> all{0, 0, 0};
        for (int o = p; o < 2 * active && abscissa(o) <= abscissa(p) + kResultantLength; ++o)
            all += point(o)[World::kNormalForce] * vec3(point(o) + World::kNormal);
        resultant = std::max(resultant, dot(all, all));
    }
    out_.force_max[at] = largest;
    out_.force_sum[at] = sum;
    out_.wall_force[at] = std::sqrt(resultant);
    out_.base_force[at] = w[World::kBaseForce];
    out_.base_torque[at] = w[World::kBaseTorque];
    out_.drive_force[at] = w[World::kDriveForce];
    out_.drive_torque[at] = w[World::kDriveTorque];
    out_.iterations[at] = iterations;
    out_.node_iterations[at] = node_iterations;
    out_.slip[at] = slip.advance;
    out_.rotation_slip[at] = slip.rotation;
    out_.valid[at] = w.valid();
    if constexpr (T > 0) record_tubes(world, sample);
    const auto write = [](double* to, const Vec3<double>& v) { to[0] = v.x, to[1] = v.y, to[2] = v.z; };
    const Pose pose(rod_, base_, motion_, w);
    write(out_.tip_position + 3 * at, pose.position(0));
    write(out_.tip_direction + 3 * at, pose.tip_direction());
    for (int i = 0; i < rod_.nodes && (out_.shape || out_.attitude); ++i) {
        if (out_.shape) write(out_.shape + 3 * (at * rod_.nodes + i), pose.position(i));
        if (out_.attitude) {
            const Quaternion<double> q = pose.attitude(i);
            double* to = out_.attitude + 4 * (at * rod_.nodes + i);
            to[0] = q.w;
            write(to + 1, q.v);
        }
    }
}

}  // namespace endopilot
