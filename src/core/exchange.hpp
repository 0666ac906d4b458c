// Between lanes and worlds: a lane loads a world, steps it for a sample, and stores it again.
#pragma once

#include <limits>

#include "state.hpp"

namespace endopilot {

constexpr double kOvershoot = 0.02;  // mm that rounded controls may pull the wire behind the ostium
constexpr double kNever = std::numeric_limits<double>::quiet_NaN();

// Takes a contact point off the wall.
template <class V>
ENDOPILOT_DEVICE void clear(ContactPoint<V>& point, int l) {
    set(point.friction.limit, l, 0);
    set(point.friction.normal, l, {0, 0, 0});
    set(point.friction.spin_arm, l, {0, 0, 0});
    set(point.normal_force, l, 0);
    set(point.offset, l, {0, 0, 0});
    set(point.clearance, l, kNever);
}

template <class V>
ENDOPILOT_DEVICE void load(ContactPoint<V>& point, int l, const World::Numbers& from) {
    set(point.friction.limit, l, from[World::kLimit]);
    set(point.friction.normal, l, vec3(from + World::kNormal));
    set(point.friction.spin_arm, l, vec3(from + World::kSpinArm));
    set(point.normal_force, l, from[World::kNormalForce]);
    set(point.offset, l, vec3(from + World::kOffset));
    set(point.clearance, l, kNever);
}

template <class V>
ENDOPILOT_DEVICE void store(const ContactPoint<V>& point, int l, const World::Numbers& to) {
    to[World::kLimit] = get(point.friction.limit, l);
    write(to + World::kNormal, get(point.friction.normal, l));
    write(to + World::kSpinArm, get(point.friction.spin_arm, l));
    to[World::kNormalForce] = get(point.normal_force, l);
    write(to + World::kOffset, get(point.offset, l));
}

// Places the trial of a node that follows the drive.
template <class V, int T>
ENDOPILOT_DEVICE void place_base(const RodModel& rod, Lanes<V, T>& lanes, int l, int i) {
    const Lane<T>& lane = lanes.lane[l];
    const double turned = lane.device[0].turn.end;
    Node<V, T>& n = lanes.node[i];
    set(n.x, l, lane.base.position(rod, i, lane.advance.end));
    set(n.q, l, lane.base.attitude(turned));
    set(n.accepted, l, get(n.x, l));
    set(n.accepted_q, l, get(n.q, l));
    for (int k = 0; k < T; ++k) {
        set(n.tubes.twist[k], l, lane.device[k + 1].turn.end - turned);
        set(n.tubes.accepted[k], l, get(n.tubes.twist[k], l));
    }
}

// Places node i of a lane on the catheter's axis as it was at the step's start (start) and is at its end (trial).
template <class V, int T>
ENDOPILOT_DEVICE void place(const RodModel& rod, Lanes<V, T>& lanes, int l, int i) {
    const Lane<T>& lane = lanes.lane[l];
    Node<V, T>& n = lanes.node[i];
    const Coordinate &advance = lane.advance, &turn = lane.device[0].turn;
    set(n.start, l, lane.base.position(rod, i, advance.start));
    set(n.start_q, l, lane.base.attitude(turn.start));
    set(n.last, l, advance.last * frame(lane.base.orientation).d3);
    set(n.last_turn, l, {0, 0, turn.last});
    clear(n.at_node, l);
    clear(n.at_middle, l);
    if constexpr (T > 0)
        for (int k = 0; k <= T; ++k) set(n.tubes.rate[k], l, 0);
    for (int k = 0; k < T; ++k) {
        set(n.tubes.start[k], l, lane.device[k + 1].turn.start - turn.start);
        set(n.tubes.last[k], l, lane.device[k + 1].turn.last - turn.last);
        set(n.tubes.step[k], l, 0);
        set(n.tubes.limit[k], l, 0);
    }
    place_base(rod, lanes, l, i);
}

// The controls of the lane's sample; before the first one the devices are pushed in at one speed each, then rest for one sample.
template <class V, int T>
ENDOPILOT_DEVICE void read_control(const Run& run, Lanes<V, T>& lanes, int l) {
    Lane<T>& lane = lanes.lane[l];
    const Inputs& in = run.in;
    const World w = run.worlds[lane.world];
    const double period = in.sample_period();
    lane.by_force = lane.sample >= 0 && in.force_driven;
    bool same = double(lane.by_force) == w[World::kByForce];
    for (int k = 0; k <= T; ++k) {
        Device& device = lane.device[k];
        double& speed = device.control[0];
        if (lane.sample < 0) {
            speed = lane.sample == -1 ? 0.0 : (device.depth - device.inserted) / ((-lane.sample - 1) * period);
            device.control[1] = 0.0;
        } else {
            std::copy_n(in.control + 2 * ((T + 1) * (std::size_t(lane.world) * in.samples + lane.sample) + k), 2, device.control);
        }
        if (!lane.by_force && device.inserted + speed * period < -kOvershoot) {
            device.refused = device.inserted + speed * period;  // after a slip there is less of it to pull back
            speed = -device.inserted / period;
        }
        const World::Numbers was = w.device(k);
        same = same && speed == was[World::kSpeed] && device.control[1] == was[World::kSpin];
    }
    if (!same) lane.last_duration = 0;  // do not extrapolate
}

// Loads the world that is lane l's, with a trial that goes on as the last step went. Returns by how much of that; 0: the wire starts anew.
template <class V, int T>
ENDOPILOT_LARGE double load(const Run& run, Lanes<V, T>& lanes, int l) {
    Lane<T>& lane = lanes.lane[l];
    const World w = run.worlds[lane.world];
    lane.advance.start = lane.advance.end = w[World::kInserted];
    lane.advance.slipping = int(w[World::kSlipping]);
    lane.last_duration = w[World::kLastDuration];
    lane.stride = int(w[World::kStride]);
    lane.active = int(w[World::kActive]);
    lane.time = lane.carried = w[World::kTime];
    lane.base = run.scene.base;
    set(lanes.step.axis, l, frame(lane.base.orientation).d3);
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
        if (from[World::kForemost] != 0) lane.foremost = k;
        Chain& chain = lanes.chain[l][k];
        chain.drive = from[World::kDriveRotation];
        for (int i = 0; i < kSections; ++i) chain.node[i] = from[World::kChain + i];
        set(lanes.step.friction[k], l, from[World::kFriction]);
    }
    lane.others_force = pushed - lane.device[lane.foremost].force;
    read_control(run, lanes, l);
    const double weight = lane.last_duration > 0 ? run.in.seconds(lane.stride) / lane.last_duration : 0.0;
    lane.advance.last = weight > 0 ? w[World::kLastAdvance] : 0.0;
    for (int k = 0; k <= T; ++k) lane.device[k].turn.last = weight > 0 ? w.device(k)[World::kLastTurned] : 0.0;
    for (int i = 0; i < lane.active; ++i) {
        const World::Numbers p = w.node(i);
        Node<V, T>& n = lanes.node[i];
        const Vec3<double> x = vec3(p + World::kX), last = vec3(p + World::kLast), turn = vec3(p + World::kLastTurn);
        const Quaternion<double> q = quaternion(p + World::kQ);
        set(n.start, l, x);
        set(n.start_q, l, q);
        set(n.last, l, last);
        set(n.last_turn, l, turn);
        set(n.x, l, x + weight * last);
        set(n.q, l, rotated(q, weight * turn));
        set(n.accepted, l, get(n.x, l));
        set(n.accepted_q, l, get(n.q, l));
        set(n.step, l, {0, 0, 0});
        set(n.turn, l, {0, 0, 0});
        load(n.at_node, l, p + World::kAtNode);
        load(n.at_middle, l, p + World::kAtMiddle);
        if constexpr (T > 0) {
            const World::Numbers t = w.twists(run.scene.rod.nodes, i);
            for (int k = 0; k < T; ++k) {
                set(n.tubes.start[k], l, t[k]);
                set(n.tubes.last[k], l, t[T + k]);
                set(n.tubes.twist[k], l, t[k] + weight * t[T + k]);
                set(n.tubes.accepted[k], l, get(n.tubes.twist[k], l));
                set(n.tubes.step[k], l, 0);
                set(n.tubes.limit[k], l, t[2 * T + k]);
            }
            for (int k = 0; k <= T; ++k) set(n.tubes.rate[k], l, t[3 * T + k]);
        }
    }
    return weight;
}

// Keeps the lane's world as it was at the end of the last step that converged.
template <class V, int T>
ENDOPILOT_LARGE void store(const Run& run, const Lanes<V, T>& lanes, int l) {
    const Lane<T>& lane = lanes.lane[l];
    const World w = run.worlds[lane.world];
    w[World::kByForce] = lane.by_force;
    w[World::kLastDuration] = lane.last_duration;
    w[World::kLastAdvance] = lane.advance.last;
    w[World::kStride] = lane.stride;
    w[World::kActive] = lane.active;
    w[World::kTime] = run.scene.motion.cycles > 0 || lane.sample < 0 ? lane.carried : lane.time + run.in.seconds(lane.tick);
    w[World::kSlipping] = lane.advance.slipping;
    double inserted = lane.device[0].inserted;
    for (int k = 0; k <= T; ++k) {
        const Device& device = lane.device[k];
        const World::Numbers to = w.device(k);
        inserted = std::max(inserted, device.inserted);
        to[World::kLength] = device.inserted;
        to[World::kRotation] = device.rotation;
        to[World::kSpeed] = device.control[0];
        to[World::kSpin] = device.control[1];
        to[World::kLastTurned] = device.turn.last;
        to[World::kTurnSlipping] = device.turn.slipping;
        to[World::kDepth] = device.depth;
        to[World::kFeed] = device.feed;
        to[World::kBackdrive] = device.backdrive;
        to[World::kMobilized] = device.mobilized;
        to[World::kForemost] = k == lane.foremost;
        const Chain& chain = lanes.chain[l][k];
        to[World::kDriveRotation] = run.scene.transmission.length[k] > 0 ? chain.drive : device.rotation;
        for (int i = 0; i < kSections; ++i) to[World::kChain + i] = chain.node[i];
        to[World::kBaseForce] = device.force;
        to[World::kBaseTorque] = device.torque;
    }
    w[World::kInserted] = inserted;
    for (int i = 0; i < lane.active; ++i) {
        const World::Numbers p = w.node(i);
        const Node<V, T>& n = lanes.node[i];
        write(p + World::kX, get(n.start, l));
        write(p + World::kQ, get(n.start_q, l));
        write(p + World::kLast, get(n.last, l));
        write(p + World::kLastTurn, get(n.last_turn, l));
        store(n.at_node, l, p + World::kAtNode);
        store(n.at_middle, l, p + World::kAtMiddle);
        if constexpr (T > 0) {
            const World::Numbers t = w.twists(run.scene.rod.nodes, i);
            for (int k = 0; k < T; ++k) {
                t[k] = get(n.tubes.start[k], l);
                t[T + k] = get(n.tubes.last[k], l);
                t[2 * T + k] = get(n.tubes.limit[k], l);
            }
            for (int k = 0; k <= T; ++k) t[3 * T + k] = get(n.tubes.rate[k], l);
        }
    }
}

}  // namespace endopilot
