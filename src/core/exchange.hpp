// Between lanes and worlds: a lane takes a world from the queue, steps it for a sample, records it and stores it again.
#pragma once

#include <limits>

#include "stepper.hpp"

namespace endopilot {

constexpr double kOvershoot = 0.02;  // mm that rounded controls may pull the wire behind the ostium
constexpr double kNever = std::numeric_limits<double>::quiet_NaN();
constexpr double kResultantLength = 2.0;  // mm of wire whose forces of the wall are added up: nodes may share one contact

// Puts a world at the ostium, straight, ready to be pushed in before its first sample. `initial` holds inserted length (mm) and rotation
// (rad) of each device then, `friction` the coefficient of each. The foremost is pushed at the approach velocity, the others arrive with it.
inline void start_world(const Scene& scene, const World& w, const double* initial, const double* friction, double sample_period) {
    const double speed = scene.options.approach_velocity;
    double depth = initial[0];
    for (int k = 1; k < w.devices; ++k) depth = std::max(depth, initial[2 * k]);
    const double inserted = speed > 0 ? 0.0 : depth;
    for (std::size_t k = 0; k < World::size(scene.rod.nodes, w.devices); ++k) w.values[std::ptrdiff_t(k) * w.stride] = 0.0;
    w[World::kInserted] = inserted;
    w[World::kApproach] = speed > 0 ? std::ceil(depth / (speed * sample_period)) + 1 : 0.0;
    w[World::kStride] = kTicks;
    w[World::kActive] = Base::count_active(scene.rod, inserted, scene.options.free_behind);
    for (int k = 0; k < w.devices; ++k) {
        const World::Numbers device = w.device(k);
        device[World::kLength] = speed > 0 ? 0.0 : initial[2 * k];
        device[World::kDepth] = initial[2 * k];
        device[World::kRotation] = initial[2 * k + 1];
        device[World::kFriction] = friction[k];
        device[World::kFeed] = 1.0;
    }
    const Base base = scene.motion.cycles > 0 ? scene.base.moved(placement(scene.motion, w[World::kTime])) : scene.base;
    for (int i = 0; i < w.active(); ++i) {
        write(w.node(i) + World::kX, base.position(scene.rod, i, inserted));
        write(w.node(i) + World::kQ, base.attitude(initial[1]));
        for (int k = 1; k < w.devices; ++k) w.twists(scene.rod.nodes, i)[k - 1] = initial[2 * k + 1] - initial[1];
    }
}

template <class V, int T>
template <class Queue>
void Stepper<V, T>::next_world(int l, Queue& queue) {
    double length = 0;
    int others = 0;
    for (const Lane& lane : lane_)
        if (lane.world >= 0) length += lane.active, ++others;
    Lane& lane = lane_[l];
    for (;;) {
        int sample = 0;
        const int world = queue.next(others > 0 ? length / others : -1.0, sample);
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
        for (sample = std::max(0, sample); sample < in_.samples; ++sample) record(world, sample, 0.0, 0.0);
        queue.finish();
    }
}

// Places node i of a lane on the catheter's axis as it was at the step's start (start) and is at its end (trial).
template <class V, int T>
void Stepper<V, T>::place(int l, int i) {
    const Lane& lane = lane_[l];
    Node<V, T>& n = node_[i];
    const Coordinate &advance = lane.advance, &turn = lane.device[0].turn;
    put(n.start, l, lane.base.position(rod_, i, advance.start));
    put(n.start_q, l, lane.base.attitude(turn.start));
    put(n.last, l, advance.last * frame(lane.base.orientation).d3);
    put(n.last_turn, l, {0, 0, turn.last});
    clear(n.at_node, l);
    clear(n.at_middle, l);
    if constexpr (T > 0) {
        for (int k = 0; k <= T; ++k) set(n.tubes.rate[k], l, 0);
        for (int k = 0; k < T; ++k) {
            set(n.tubes.start[k], l, lane.device[k + 1].turn.start - turn.start);
            set(n.tubes.last[k], l, lane.device[k + 1].turn.last - turn.last);
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
        put(point.offset, l, carriage.direction(read(point.offset, l)));
        put(point.friction.normal, l, carriage.direction(read(point.friction.normal, l)));
        put(point.friction.spin_arm, l, carriage.direction(read(point.friction.spin_arm, l)));
    };
    for (int i = 0; i < lane.active; ++i) {
        Node<V, T>& n = node_[i];
        const Vec3<double> start = read(n.start, l), carried = carriage.point(start);
        put(n.x, l, carried + carriage.direction(read(n.x, l) - start));
        put(n.start, l, carried);
        put(n.q, l, carriage.attitude(read(n.q, l)));
        put(n.start_q, l, carriage.attitude(read(n.start_q, l)));
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
    write(to + World::kNormal, read(point.friction.normal, l));
    write(to + World::kSpinArm, read(point.friction.spin_arm, l));
    to[World::kNormalForce] = get(point.normal_force, l);
    write(to + World::kOffset, read(point.offset, l));
}

// Places the trial of a node that follows the drive.
template <class V, int T>
void Stepper<V, T>::place_base(int l, int i) {
    const Lane& lane = lane_[l];
    const double turned = lane.device[0].turn.end;
    Node<V, T>& n = node_[i];
    put(n.x, l, lane.base.position(rod_, i, lane.advance.end));
    put(n.q, l, lane.base.attitude(turned));
    put(n.from, l, read(n.x, l));
    put(n.from_q, l, read(n.q, l));
    if constexpr (T > 0) {
        for (int k = 0; k < T; ++k) {
            set(n.tubes.twist[k], l, lane.device[k + 1].turn.end - turned);
            set(n.tubes.from[k], l, get(n.tubes.twist[k], l));
        }
    }
}

template <class V, int T>
void Stepper<V, T>::load(int l) {
    Lane& lane = lane_[l];
    const World w = world_[lane.world];
    lane.advance.start = lane.advance.end = w[World::kInserted];
    lane.advance.slipping = int(w[World::kSlipping]);
    lane.last_duration = w[World::kLastDuration];
    lane.stride = int(w[World::kStride]);
    lane.active = int(w[World::kActive]);
    lane.time = lane.carried = w[World::kTime];
    lane.base = base_;
    put(axis_, l, frame(base_.orientation).d3);
    double pushed = 0;
    for (int k = 0; k <= T; ++k) {
        Device& device = lane.device[k];
        const World::Numbers from = w.device(k);
        device.inserted = device.start = from[World::kLength];
        device.rotation = device.turn.start = device.turn.end = from[World::kRotation];
        device.turn.slipping = int(from[World::kTurnSlipping]);
        device.depth = from[World::kDepth];
        device.feed = from[World::kFeed];
        device.backdrive = from[World::kBackdrive];
        device.mobilized = from[World::kMobilized];
        device.force = from[World::kBaseForce];
        device.torque = from[World::kBaseTorque];
        pushed += device.force;
        if (from[World::kLeads] != 0) lane.lead = k;
        set(friction_[k], l, from[World::kFriction]);
    }
    if constexpr (T > 0) lane.tubes.others = pushed - lane.device[lane.lead].force;
    read_control(l);
    const double weight = lane.last_duration > 0 ? duration(lane) / lane.last_duration : 0.0;
    lane.advance.last = weight > 0 ? w[World::kLastAdvance] : 0.0;
    for (int k = 0; k <= T; ++k) lane.device[k].turn.last = weight > 0 ? w.device(k)[World::kLastTurned] : 0.0;
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
        put(n.from, l, read(n.x, l));
        put(n.from_q, l, read(n.q, l));
        put(n.step, l, {0, 0, 0});
        put(n.turn, l, {0, 0, 0});
        load(n.at_node, l, p + World::kAtNode);
        load(n.at_middle, l, p + World::kAtMiddle);
        if constexpr (T > 0) {
            const World::Numbers t = w.twists(rod_.nodes, i);
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
    w[World::kByForce] = lane.by_force;
    w[World::kLastDuration] = lane.last_duration;
    w[World::kLastAdvance] = lane.advance.last;
    w[World::kStride] = lane.stride;
    w[World::kActive] = lane.active;
    w[World::kTime] = motion_.cycles > 0 || lane.sample < 0 ? lane.carried : lane.time + elapsed(lane.tick);
    w[World::kSlipping] = lane.advance.slipping;
    double foremost = lane.device[0].inserted;
    for (int k = 0; k <= T; ++k) {
        const Device& device = lane.device[k];
        const World::Numbers to = w.device(k);
        foremost = std::max(foremost, device.inserted);
        to[World::kLength] = device.inserted;
        to[World::kRotation] = device.rotation;
        to[World::kSpeed] = device.speed;
        to[World::kSpin] = device.spin;
        to[World::kLastTurned] = device.turn.last;
        to[World::kTurnSlipping] = device.turn.slipping;
        to[World::kDepth] = device.depth;
        to[World::kFeed] = device.feed;
        to[World::kBackdrive] = device.backdrive;
        to[World::kMobilized] = device.mobilized;
        to[World::kLeads] = k == lane.lead;
        to[World::kBaseForce] = device.force;
        to[World::kBaseTorque] = device.torque;
    }
    w[World::kInserted] = foremost;
    for (int i = 0; i < lane.active; ++i) {
        const World::Numbers p = w.node(i);
        const Node<V, T>& n = node_[i];
        write(p + World::kX, read(n.start, l));
        write(p + World::kQ, read(n.start_q, l));
        write(p + World::kLast, read(n.last, l));
        write(p + World::kLastTurn, read(n.last_turn, l));
        store(n.at_node, l, p + World::kAtNode);
        store(n.at_middle, l, p + World::kAtMiddle);
        if constexpr (T > 0) {
            const World::Numbers t = w.twists(rod_.nodes, i);
            for (int k = 0; k < T; ++k) {
                t[k] = get(n.tubes.start[k], l);
                t[T + k] = get(n.tubes.last[k], l);
                t[2 * T + k] = get(n.tubes.limit[k], l);
            }
            for (int k = 0; k <= T; ++k) t[3 * T + k] = get(n.tubes.rate[k], l);
        }
    }
}

// The controls of the lane's sample; before the first one the devices are pushed in at one speed each, then rest for one sample.
template <class V, int T>
void Stepper<V, T>::read_control(int l) {
    Lane& lane = lane_[l];
    const World w = world_[lane.world];
    lane.by_force = lane.sample >= 0 && in_.force_driven;
    bool same = double(lane.by_force) == w[World::kByForce];
    for (int k = 0; k <= T; ++k) {
        Device& device = lane.device[k];
        if (lane.sample < 0) {
            device.speed = lane.sample == -1 ? 0.0 : (device.depth - device.inserted) / ((-lane.sample - 1) * sample_period());
            device.spin = 0.0;
        } else {
            const double* control = in_.control + 2 * ((T + 1) * (std::size_t(lane.world) * in_.samples + lane.sample) + k);
            device.speed = control[0];
            device.spin = control[1];
        }
        if (!lane.by_force && device.inserted + device.speed * sample_period() < -kOvershoot) {
            device.refused = device.inserted + device.speed * sample_period();  // after a slip there is less of it to pull back
            device.speed = -device.inserted / sample_period();
        }
        const World::Numbers was = w.device(k);
        same = same && device.speed == was[World::kSpeed] && device.spin == was[World::kSpin];
    }
    if (!same) lane.last_duration = 0;  // do not extrapolate
}

template <class V, int T>
template <class Queue>
void Stepper<V, T>::end_sample(int l, Queue& queue) {
    Lane& lane = lane_[l];
    const World w = world_[lane.world];
    for (int k = 0; k <= T; ++k) {
        Device& device = lane.device[k];
        const World::Numbers to = w.device(k);
        device.inserted = lane.by_force ? lane.advance.end : device.inserted + (device.speed * sample_period() - device.slipped);
        device.rotation = lane.by_force ? device.turn.end : device.rotation + (device.spin * sample_period() - device.rotation_slipped);
        if (lane.sample < 0) {
            double* slip = out_.approach_slip + 2 * ((T + 1) * std::size_t(lane.world) + k);
            slip[0] += device.slipped;
            slip[1] += device.rotation_slipped;
            device.depth -= device.slipped;
            if (lane.sample == -1) device.inserted = device.depth;  // exactly
        }
        const DriveLoad valve = introducer(device.end - device.start, device.turn.last, device_radius(k, lane), l);
        to[World::kDriveForce] = lane.by_force ? device.speed : device.force + valve.gradient[0];
        to[World::kDriveTorque] = lane.by_force ? device.spin : device.torque + valve.gradient[1];
        to[World::kSlip] = device.slipped + device.refused;
        to[World::kRotationSlip] = device.rotation_slipped;
    }
    if (lane.sample < 0) w[World::kApproach] = -lane.sample - 1;
    store(l);
    if (T == 0 && through_wall(w)) w[World::kReason] = kThroughWall;
    if (lane.sample >= 0) record(lane.world, lane.sample, double(lane.total_iterations) / lane.steps, double(lane.node_iterations));
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
    const World w = world_[lane.world];
    for (int k = 0; k <= T; ++k) {
        Device& device = lane.device[k];
        device.inserted = device.start;
        device.rotation = device.turn.start;
        device.force = w.device(k)[World::kBaseForce];
        device.torque = w.device(k)[World::kBaseTorque];
        w.device(k)[World::kSlip] = w.device(k)[World::kRotationSlip] = 0.0;
    }
    store(l);
    w[World::kReason] = lane.finite ? kNotConverged : kNotFinite;
    for (int sample = std::max(0, lane.sample); sample < in_.samples; ++sample)
        record(lane.world, sample, 0.0, sample == lane.sample ? double(lane.node_iterations) : 0.0);
    lane.world = -1;
}

template <class V, int T>
void Stepper<V, T>::record(int world, int sample, double iterations, double node_iterations) const {
    const World w = world_[world];
    const std::size_t at = std::size_t(world) * in_.samples + sample;
    const int active = w.active();
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
    out_.contact_force_max[at] = largest;
    out_.contact_force_sum[at] = sum;
    out_.wall_force[at] = std::sqrt(resultant);
    out_.iterations[at] = iterations;
    out_.node_iterations[at] = node_iterations;
    out_.valid[at] = w.valid();
    const auto write = [](double* to, const Vec3<double>& v) { to[0] = v.x, to[1] = v.y, to[2] = v.z; };
    const Pose pose(rod_, base_, motion_, w);
    for (int k = 0; k <= T; ++k) {
        const std::size_t here = at * (T + 1) + k;
        const World::Numbers device = w.device(k);
        out_.inserted_length[here] = device[World::kLength];
        out_.rotation[here] = device[World::kRotation];
        out_.base_force[here] = device[World::kBaseForce];
        out_.base_torque[here] = device[World::kBaseTorque];
        out_.drive_force[here] = device[World::kDriveForce];
        out_.drive_torque[here] = device[World::kDriveTorque];
        out_.slip[here] = device[World::kSlip];
        out_.rotation_slip[here] = device[World::kRotationSlip];
        write(out_.tip_position + 3 * here, pose.tip(k));
        write(out_.tip_direction + 3 * here, pose.tip_direction(k));
        out_.tip_twist[here] = 0;
        if (k == 0) continue;
        const int i = device_end(rod_, w, k).element;
        out_.tip_twist[here] = i < active ? w.twists(rod_.nodes, i)[k - 1] : device[World::kRotation] - w.device(0)[World::kRotation];
    }
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
