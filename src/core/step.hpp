// A time step of a lane: its begin, and its end once Newton's method has converged. `iterate` is where it all comes together.
#pragma once

#include "coaxial_limits.hpp"
#include "newton.hpp"

namespace endopilot {

constexpr double kDriveMotion = 1.2;     // times the drive's own motion that a node may move in a step before it counts as a jump

// Carries the start of the coming step with the vessel to where that is at the step's end: what a step moves is then its motion
// relative to the wall, and so is what friction and drag resist.
template <class V, int T>
ENDOPILOT_LARGE void carry(const Run& run, Lanes<V, T>& lanes, int l) {
    Lane<T>& lane = lanes.lane[l];
    const Motion& motion = run.scene.motion;
    const bool approaches = lane.sample < 0;   // the vessel then stands still
    const double begins = approaches ? lane.time : lane.time + run.in.seconds(lane.tick);
    const double ends = approaches ? lane.time : lane.time + run.in.seconds(lane.tick + lane.stride);
    const Carriage carriage(placement(motion, lane.carried), placement(motion, ends));
    const Placement& vessel = carriage.to;
    lane.carried = ends;
    lane.strain = strain(placement(motion, begins), vessel);
    lane.base = run.scene.base.moved(vessel);
    set(lanes.step.axis, l, frame(lane.base.orientation).d3);
    const Frame<double> r = frame(vessel.rotation);
    const Vec3<double> x{r.d1.x, r.d2.x, r.d3.x}, y{r.d1.y, r.d2.y, r.d3.y}, z{r.d1.z, r.d2.z, r.d3.z};   // columns of its transpose
    const Vec3<double> a = vessel.shrink * x, b = vessel.shrink * y, c = vessel.shrink * z;
    WallPlace<V>& place = lanes.step.vessel;
    set(place.row[0], l, {a.x, b.x, c.x});
    set(place.row[1], l, {a.y, b.y, c.y});
    set(place.row[2], l, {a.z, b.z, c.z});
    set(place.at, l, vessel.to_vessel({0, 0, 0}));
    const auto turn_point = [&](ContactPoint<V>& point) {
        set(point.offset, l, carriage.direction(get(point.offset, l)));
        set(point.friction.normal, l, carriage.direction(get(point.friction.normal, l)));
        set(point.friction.spin_arm, l, carriage.direction(get(point.friction.spin_arm, l)));
    };
    for (int i = 0; i < lane.active; ++i) {
        Node<V, T>& n = lanes.node[i];
        const Vec3<double> start = get(n.start, l), carried = carriage.point(start);
        set(n.x, l, carried + carriage.direction(get(n.x, l) - start));
        set(n.start, l, carried);
        set(n.q, l, carriage.attitude(get(n.q, l)));
        set(n.start_q, l, carriage.attitude(get(n.start_q, l)));
        turn_point(n.at_node);
        turn_point(n.at_middle);
    }
}

// Begins a step of lane.stride ticks from the lane's start state; nodes ahead of the base already hold a trial, which extrapolates the
// last step by `weight`.
template <class V, int T>
ENDOPILOT_LARGE void begin_step(const Run& run, Lanes<V, T>& lanes, int l, double weight) {
    Lane<T>& lane = lanes.lane[l];
    TimeStep<V, T>& step = lanes.step;
    const RodModel& rod = run.scene.rod;
    const Options& options = run.scene.options;
    const bool moves = run.scene.motion.cycles > 0;
    const int before = lane.active;
    if (moves) carry(run, lanes, l);
    command_drives(run, lanes, l, weight);
    lane.active = Base::count_active(rod, lane.advance.start, options.free_behind);
    for (int i = std::min(before, lane.active); i <= std::max(before, lane.active); ++i)
        if (i >= before || i >= lane.active) place(rod, lanes, l, i);
    if (lane.active < before) clear(lanes.node[lane.active - 1].at_middle, l);
    if constexpr (T > 0) prepare_tubes(run.scene, lanes, l);
    lane.iterations = lane.rejections = lane.releases = 0;
    lane.lengthened = 1;
    lane.first = lane.finite = true;
    lane.extrapolated = weight != 0;
    const auto planned = [&lane](const Coordinate& c) { return std::abs((lane.by_force ? c.end : c.commanded) - c.start); };
    double slides = planned(lane.advance), turns = 0;
    if (moves) slides += lane.strain * std::max(0.0, lane.advance.start);   // a vessel that stretches slides along the wire
    for (const Device& device : lane.device) turns += planned(device.turn);
    const double most_x = options.largest_jump + kDriveMotion * slides, most_theta = options.largest_jump + kDriveMotion * turns;
    set(step.active, l, lane.active);
    set(step.last_joint, l, Base::share_of_last_joint(rod, lane.advance.start, options.free_behind, lane.active));
    set(step.inverse_dt, l, 1.0 / run.in.seconds(lane.stride));
    set(step.eps, l, options.stick_velocity * run.in.time_step);
    set(step.jump_scale_x, l, 1.0 / (most_x * most_x));
    set(step.jump_scale_theta, l, 4.0 / (most_theta * most_theta));  // of twice the imaginary part of a quaternion
    set_mask<V>(lanes.accepted, l, false);
    set(lanes.terms.first, l, 1.0);
    set(lanes.terms.geometric, l, 0.0);
    set(lanes.terms.tangent, l, 1.0);
    set(lanes.terms.damping, l, 0.0);
}

// Freezes the wall at a contact point that has come to rest after the move `step`: friction in the coming step, `weight` times as long,
// then has a potential.
template <class V, int T>
ENDOPILOT_DEVICE void freeze(ContactPoint<V>& point, const Vec3<V>& step, const Vec3<V>& axis, const WallSpring& spring,
                             const Surface<V, T>& surface, Mask<V> on, const V& weight) {
    const V zero{}, one = broadcast<V>(1.0);
    const Vec3<V>& gradient = point.wall.gradient;
    const V distance = point.wall.distance + dot(gradient, step);
    const V norm = square_root(dot(gradient, gradient));
    const Mask<V> touches = (distance < surface.radius) & (norm > 1e-3);
    const V push = select<V>(touches, spring.force<V>(surface.radius - distance) * norm, zero);
    // friction in the coming step acts with the normal force at its middle, extrapolated
    V ahead = push + select<V>(point.normal_force > zero, 0.5 * weight * (push - point.normal_force), zero);
    ahead = select<V>(ahead > 2.0 * push, 2.0 * push, ahead);
    ahead = select<V>(ahead > zero, ahead, zero);
    point.normal_force = select<V>(on, push, point.normal_force);
    const V inverse = select<V>(touches, one / norm, zero);
    const Vec3<V> normal = inverse * gradient;
    point.friction.limit = select<V>(on, surface.friction * ahead, point.friction.limit);
    point.friction.normal = select(on, normal, point.friction.normal);
    point.friction.spin_arm = select(on, (V{} + surface.radius) * cross(normal, axis), point.friction.spin_arm);
}

// Freezes the walls that friction acts on and the curve's offsets from the polygon, for the converged lanes in `mask`.
template <class V, int T>
ENDOPILOT_LARGE void freeze_contacts(const Scene& scene, Lanes<V, T>& lanes, int n, Mask<V> mask, const V& weight) {
    const RodModel& rod = scene.rod;
    Node<V, T>* const nodes = lanes.node;
    const V& active = lanes.step.active;
    const auto direction = [&](int i) { return broadcast<V>(1.0 / rod.length[i]) * (nodes[i].x - nodes[i + 1].x); };
    Vec3<V> ahead = direction(0), behind = direction(1);   // of the elements ahead of a joint and behind it
    Vec3<V> bent = broadcast<V>(1.0 / rod.joint_length[1]) * (ahead - behind);   // curvature vector at the node: at the tip, of the first joint
    for (int i = 0; i < n; ++i) {
        Node<V, T>& node = nodes[i];
        const Mask<V> on = mask & (active > broadcast<V>(i)), middle = mask & (active > broadcast<V>(i + 1));
        const Vec3<V> axis = frame(node.q).d3;
        const Vec3<V> middle_step = broadcast<V>(0.5) * (node.step + nodes[i + 1].step);
        freeze(node.at_node, node.step, axis, spring_at_node(scene, i), surface_at_node(rod, lanes, i), on, weight);
        freeze(node.at_middle, middle_step, axis, spring_at_middle(scene, i), surface_at_middle(rod, lanes, i), middle, weight);
        const Vec3<V> bent_behind = broadcast<V>(1.0 / rod.joint_length[i + 1]) * (ahead - behind);
        const double l = rod.length[i], around = i > 0 ? rod.length[i - 1] * l / 24 : l * l / 8;
        node.at_node.offset = select(on, broadcast<V>(around) * bent, node.at_node.offset);
        node.at_middle.offset = select(middle, broadcast<V>(-l * l / 24) * (bent + bent_behind), node.at_middle.offset);
        bent = bent_behind;
        ahead = behind;
        behind = direction(std::min(i + 2, rod.nodes - 2));
    }
}

// For the lanes in `mask`, makes the converged trial the start of the next step and sets a new trial by extrapolation; for
// those in `restart`, goes back to the start of the step.
template <class V, int T>
ENDOPILOT_LARGE void finish_step(const Scene& scene, Lanes<V, T>& lanes, int n, Mask<V> mask, Mask<V> restart, const V& weight) {
    const V zero{};
    if (scene.lumen.pool) freeze_contacts(scene, lanes, n, mask, weight);
    if constexpr (T > 0)
        for (int l = 0; l < kWidth<V>; ++l)
            if (holds<V>(mask, l)) freeze_tubes(scene, lanes, l, true);
    for (int i = 0; i < n; ++i) {
        Node<V, T>& node = lanes.node[i];
        const Mask<V> active = lanes.step.active > broadcast<V>(i), on = mask & active, back = restart & active;
        const Quaternion<V> turned_by = relative(node.start_q, node.q);
        node.last = select(on, node.x - node.start, node.last);
        node.last_turn = select(on, broadcast<V>(2.0) * turned_by.v, node.last_turn);
        node.start = select(on, node.x, node.start);
        node.start_q = select(on, node.q, node.start_q);
        node.x = select(on, node.start + weight * node.last, select(back, node.start, node.x));
        node.q = select(on, rotated(node.start_q, weight * node.last_turn), select(back, node.start_q, node.q));
        node.step = select(on, {zero, zero, zero}, node.step);
        node.turn = select(on, {zero, zero, zero}, node.turn);
        TubeNode<V, T>& tubes = node.tubes;
        for (int k = 0; k < T; ++k) {
            tubes.last[k] = select<V>(on, tubes.twist[k] - tubes.start[k], tubes.last[k]);
            tubes.start[k] = select<V>(on, tubes.twist[k], tubes.start[k]);
            tubes.twist[k] = select<V>(on, tubes.start[k] + weight * tubes.last[k], select<V>(back, tubes.start[k], tubes.twist[k]));
            tubes.step[k] = select<V>(on, zero, tubes.step[k]);
        }
    }
}

// Stores and records the lane's world at the end of a sample and puts it back into the queue.
template <class V, int T, class Queue>
ENDOPILOT_DEVICE void end_sample(const Run& run, Lanes<V, T>& lanes, int l, Queue& queue) {
    Lane<T>& lane = lanes.lane[l];
    const World w = run.worlds[lane.world];
    const double period = run.in.sample_period();
    for (int k = 0; k <= T; ++k) {
        Device& device = lane.device[k];
        const World::Numbers to = w.device(k);
        device.inserted = lane.by_force ? lane.advance.end : device.inserted + (device.control[0] * period - device.slipped);
        device.rotation = lane.by_force ? device.turn.end : device.rotation + (device.control[1] * period - device.rotation_slipped);
        if (lane.sample < 0) {
            double* slip = run.out.approach_slip + 2 * ((T + 1) * std::size_t(lane.world) + k);
            slip[0] += device.slipped;
            slip[1] += device.rotation_slipped;
            device.depth -= device.slipped;
            if (lane.sample == -1) device.inserted = device.depth;  // exactly
        }
        const double radius = device_radius(run.scene, lane, k);
        const Chain& chain = lanes.chain[l][k];
        const bool chained = device.turn.chained;
        const DriveLoad<T> valve = introducer(run.scene.options, lanes, l, device.end - device.start, chained ? chain.turned : device.turn.last, radius);
        to[World::kDriveForce] = lane.by_force ? device.control[0] : device.force + valve.gradient[0];
        to[World::kDriveTorque] = lane.by_force ? device.control[1] : (chained ? chain.torque : device.torque) + valve.gradient[1];
        to[World::kSlip] = device.slipped + device.refused;
        to[World::kRotationSlip] = device.rotation_slipped;
    }
    if (lane.sample < 0) w[World::kApproach] = -lane.sample - 1;
    store(run, lanes, l);
    if (T == 0 && through_wall(run.scene, w)) w[World::kReason] = kThroughWall;
    if (lane.sample >= 0) record(run, lane.world, lane.sample, double(lane.total_iterations) / lane.steps, double(lane.node_iterations));
    if (lane.sample + 1 < run.in.samples)
        queue.put_back(lane.world, lane.sample + 1, lane.active);
    else
        queue.finish();
    lane.world = -1;
}

// Marks the lane's world invalid from this sample on and frees the lane; its pose stays as last converged.
template <class V, int T>
ENDOPILOT_DEVICE void fail(const Run& run, Lanes<V, T>& lanes, int l) {
    Lane<T>& lane = lanes.lane[l];
    const World w = run.worlds[lane.world];
    for (int k = 0; k <= T; ++k) {
        Device& device = lane.device[k];
        const World::Numbers of_world = w.device(k);
        device.inserted = device.start;
        device.rotation = device.turn.start;
        device.force = of_world[World::kBaseForce];
        device.torque = of_world[World::kBaseTorque];
        of_world[World::kSlip] = of_world[World::kRotationSlip] = 0.0;
    }
    store(run, lanes, l);
    w[World::kReason] = lane.finite ? kNotConverged : kNotFinite;
    for (int sample = std::max(0, lane.sample); sample < run.in.samples; ++sample)
        record(run, lane.world, sample, 0.0, sample == lane.sample ? double(lane.node_iterations) : 0.0);
    lane.world = -1;
}

// Ends the steps that converged, and begins those again that failed. Returns the samples that ended.
template <class V, int T, class Queue>
ENDOPILOT_DEVICE int end_steps(const Run& run, Lanes<V, T>& lanes, const Next (&next)[kWidth<V>], Queue& queue) {
    constexpr int W = kWidth<V>;
    const int n = lanes.most_active();
    Mask<V> converged{}, restarted{};
    V weight{};
    bool any = false, failed[W] = {}, ended[W] = {};
    for (int l = 0; l < W; ++l) {
        Lane<T>& lane = lanes.lane[l];
        any = any || next[l] == Next::converge || next[l] == Next::restart;
        if (next[l] == Next::converge) {
            set_mask<V>(converged, l, true);
            lane.last_duration = run.in.seconds(lane.stride);
            lane.tick += lane.stride;
            ++lane.steps;
            settle_drives(lanes, l);
            for (int k = 0; k <= T; ++k)
                if (lane.device[k].turn.chained) lanes.chain[l][k].end(lane.device[k].turn.end);
            for (int r = 0; r < 2 + T; ++r) lane.coordinate(r).start = lane.coordinate(r).end;
            ended[l] = lane.tick == kTicks * run.in.steps_per_sample;
            if (lane.stride < kTicks && lane.tick % (2 * lane.stride) == 0) lane.stride *= 2;
            if (!ended[l]) set(weight, l, lane.last_duration > 0 ? run.in.seconds(lane.stride) / lane.last_duration : 0.0);
        } else if (next[l] == Next::restart) {
            set_mask<V>(restarted, l, true);
            if (lane.extrapolated) continue;  // perhaps only the extrapolation was bad
            failed[l] = lane.stride == 1;
            if (lane.stride > 1) lane.stride /= 2;
        }
    }
    if (!any) return 0;
    finish_step(run.scene, lanes, n, converged, restarted, weight);
    int samples = 0;
    for (int l = 0; l < W; ++l) {
        Lane<T>& lane = lanes.lane[l];
        if (next[l] == Next::converge) update_drives(run.scene, lanes, l);
        if (failed[l]) {
            samples += std::max(0, run.in.samples - std::max(0, lane.sample));
            fail(run, lanes, l);
            queue.finish();
        } else if (ended[l]) {
            samples += lane.sample >= 0;
            end_sample(run, lanes, l, queue);
        } else if (next[l] == Next::converge || next[l] == Next::restart) {
            begin_step(run, lanes, l, get(weight, l));
        }
    }
    return samples;
}

// Gives an idle lane a world of the queue, if there is one, and begins a step of it.
template <class V, int T, class Queue>
ENDOPILOT_DEVICE void assign_world(const Run& run, Lanes<V, T>& lanes, int l, Queue& queue) {
    double length = 0;
    int others = 0;
    for (const Lane<T>& lane : lanes.lane)
        if (lane.world >= 0) length += lane.active, ++others;
    for (;;) {
        int sample = 0;
        const int world = queue.next(others > 0 ? length / others : -1.0, sample);
        if (world < 0) return;
        const World w = run.worlds[world];
        if (w[World::kApproach] > 0) sample = -int(w[World::kApproach]);
        if (w.valid() && sample < run.in.samples) {
            lanes.lane[l] = Lane<T>{};
            lanes.lane[l].world = world;
            lanes.lane[l].sample = sample;
            begin_step(run, lanes, l, load(run, lanes, l));
            return;
        }
        for (sample = std::max(0, sample); sample < run.in.samples; ++sample) record(run, world, sample, 0.0, 0.0);
        queue.finish();
    }
}

// Gives idle lanes a world of the queue and makes one iteration of Newton's method. Returns the number of samples that ended, -1 if no
// lane has a world. A queue has `next`, `put_back` and `finish` as WorkQueue has.
template <class V, int T, class Queue>
ENDOPILOT_DEVICE int iterate(const Run& run, Lanes<V, T>& lanes, Queue& queue) {
    bool busy = false;
    for (int l = 0; l < kWidth<V>; ++l) {
        if (lanes.lane[l].world < 0) assign_world(run, lanes, l, queue);
        busy = busy || lanes.lane[l].world >= 0;
    }
    if (!busy) return -1;
    Next next[kWidth<V>];
    newton(run, lanes, next);
    if constexpr (T > 0) refuse_leaps(run.scene, lanes, next);
    return end_steps(run, lanes, next, queue);
}

}  // namespace endopilot
