// The drives of a lane's devices: where they are to go, the introducer that they pass, their limits, and their part of Newton's step.
#pragma once

#include <algorithm>

#include "bounds.hpp"
#include "state.hpp"

namespace endopilot {

constexpr double kStopStiffness = 100;  // N/mm, of the stops at both ends of a drive's travel
constexpr int kMaxReleases = 8;         // times in a step that a drive may begin to slip
constexpr double kMobilizingLength = 0.02;   // mm of sliding that turn friction along two devices from one direction to the other by half
constexpr double kFaster = 1.25, kLeastFeed = 1.0 / 64;   // of the share of its motion that a drive makes after it was at its limit
constexpr double kBackdrive = 20, kMostBackdrive = 40;   // mm/s by which a drive at twice its limit gives way faster with each step, and at most

// The energy of the drives' loads, with its gradient, and its Hessian for the first two coordinates and of chains.
template <int T>
struct DriveLoad {
    double energy = 0, gradient[2 + T]{}, aa = 0, ar = 0, rr = 0, chain[T + 1]{};
};

// Radius of a device where it passes the introducer, mm.
template <int T>
ENDOPILOT_DEVICE double device_radius(const Scene& scene, const Lane<T>& lane, int k) {
    return T == 0 ? scene.rod.radius[lane.active] : scene.tubes.radius[k];
}

// By how much a force of drive k is beyond its limit, as a share of that: positive where it pushes, negative where it pulls.
ENDOPILOT_DEVICE inline double beyond_limit(const Drives& drives, int k, double force) {
    if (force > drives.push[k]) return force / drives.push[k] - 1;
    return force < -drives.pull[k] ? force / drives.pull[k] + 1 : 0.0;
}

// Where the devices are at the start of the step and are to be at its end; `weight` extrapolates the last step. The mesh follows the
// device whose tip is foremost.
template <class V, int T>
ENDOPILOT_DEVICE void command_drives(const Run& run, Lanes<V, T>& lanes, int l, double weight) {
    Lane<T>& lane = lanes.lane[l];
    const Inputs& in = run.in;
    if (lane.by_force) {   // of a wire alone
        for (int r = 0; r < 2 + T; ++r) {
            Coordinate& free = lane.coordinate(r);
            free.slipping = 0;
            free.commanded = free.start;
            free.offset = free.accepted = weight * free.last;
            free.end = free.commanded + free.offset;
        }
        lane.device[0].start = lane.advance.start;
        return;
    }
    const double began = in.seconds(lane.tick), ends = in.seconds(lane.tick + lane.stride);
    const auto reach = [weight](Coordinate& c) {   // where a drive that slips would come to, and no farther than commanded
        const double offset = c.start + weight * c.last - c.commanded;
        c.offset = c.accepted = c.chained || c.slipping * offset < 0 ? offset : 0.0;
        c.end = c.commanded + c.offset;
    };
    int lead = 0;
    double foremost = 0;
    for (int k = 0; k <= T; ++k) {
        Device& device = lane.device[k];
        const double inserted = device.inserted - device.slipped, rotation = device.rotation - device.rotation_slipped;
        device.start = inserted + device.control[0] * began;
        device.commanded = inserted + device.control[0] * ends;
        device.turn.start = rotation + device.control[1] * began;
        device.turn.commanded = rotation + device.control[1] * ends;
        device.turn.chained = run.scene.transmission.length[k] > 0;
        reach(device.turn);
        if (k == 0 || device.start > foremost) foremost = device.start;
        if (device.commanded > lane.device[lead].commanded) lead = k;
    }
    if (lead != lane.foremost) lane.advance.slipping = 0;
    lane.foremost = lead;
    lane.advance.start = foremost;
    lane.advance.commanded = lane.device[lead].commanded;
    reach(lane.advance);
    const double end = lane.advance.end;
    for (int k = 0; k <= T; ++k) {
        Device& device = lane.device[k];
        if (k == lead) device.feed = 1, device.backdrive = 0;
        double made = device.commanded;
        if (device.feed < 1 || device.backdrive != 0)
            made = std::max(0.0, device.start + device.feed * (device.commanded - device.start) + device.backdrive * in.seconds(lane.stride));
        device.end = k == lead ? end : std::min(made, end);
        set(lanes.step.slide[k], l, (device.end - device.start) - (end - foremost));
        if (k > 0) set(lanes.step.mobilized[k - 1], l, lane.device[k - 1].mobilized);
        if (device.turn.chained)
            lanes.chain[l][k].begin(run.scene.transmission, k, device.start + run.scene.options.free_behind, device.control[1] * (ends - began),
                                    run.scene.drives.torque[k], device.turn.start, std::abs(device.commanded - device.start),
                                    device_radius(run.scene, lane, k));
    }
    lane.friction_share = 0;
}

// The introducer through which a drive moves its device: smoothed Coulomb friction of its valve and viscous drag, against advance and
// rotation together; the device's surface moves by its radius r times the rotation.
template <class V, int T>
ENDOPILOT_DEVICE DriveLoad<T> introducer(const Options& options, const Lanes<V, T>& lanes, int l, double advance, double rotation, double r) {
    const double a = advance, s = r * rotation, eps = get(lanes.step.eps, l);
    const double drag = options.introducer_drag * get(lanes.step.inverse_dt, l), size = std::sqrt(a * a + s * s + eps * eps);
    const double secant = options.introducer_friction / size, c = secant / (size * size);
    DriveLoad<T> load;
    load.energy = 0.5 * drag * (a * a + s * s) + options.introducer_friction * (size - eps);
    load.gradient[0] = (drag + secant) * a;
    load.gradient[1] = (drag + secant) * s * r;
    load.aa = drag + secant - c * a * a;
    load.ar = -c * a * s * r;
    load.rr = (drag + secant - c * s * s) * r * r;
    return load;
}

// What the other drives than the foremost device's bear of the force on all devices: that of the end of the last step, and no more than
// their limits. Else a force beyond them would stay: where the foremost drive slips, that of all devices is its limit and what the others bear.
template <int T>
ENDOPILOT_DEVICE double borne_by_others(const Drives& drives, const Lane<T>& lane) {
    double most = 0, least = 0;
    for (int k = 0; k <= T; ++k) {
        if (k == lane.foremost) continue;
        most += drives.push[k];
        least -= drives.pull[k];
    }
    return T == 0 ? 0.0 : std::clamp(lane.others_force, least, most);
}

// The energy at the trial point of what is lost where drives slip at their limits; the foremost one also moves what the others bear. Or,
// of a wire driven by force, that of the introducer, of the stops at both ends of the drive's travel, and of the load.
template <class V, int T>
ENDOPILOT_DEVICE DriveLoad<T> drive_load(const Scene& scene, const Lanes<V, T>& lanes, int l) {
    const Lane<T>& lane = lanes.lane[l];
    const Drives& drives = scene.drives;
    const Coordinate& advance = lane.advance;
    if (lane.by_force) {
        const Device& wire = lane.device[0];
        const RodModel& rod = scene.rod;
        DriveLoad<T> t = introducer(scene.options, lanes, l, advance.offset, wire.turn.offset, rod.radius[lane.active]);
        const double beyond = std::min(0.0, advance.end) + std::max(0.0, advance.end + scene.options.free_behind - rod.abscissa[rod.nodes - 1]);
        t.energy += 0.5 * kStopStiffness * beyond * beyond - wire.control[0] * advance.offset - wire.control[1] * wire.turn.offset;
        t.gradient[0] += kStopStiffness * beyond - wire.control[0];
        t.gradient[1] -= wire.control[1];
        t.aa += beyond != 0.0 ? kStopStiffness : 0.0;
        return t;
    }
    DriveLoad<T> t;
    if (const int side = advance.slipping; side != 0) {
        t.gradient[0] = -(borne_by_others(drives, lane) + (side > 0 ? drives.push[lane.foremost] : -drives.pull[lane.foremost]));
        t.energy = t.gradient[0] * advance.offset;
        if (advance.end < 0) {   // a stop holds devices that are all out
            t.energy += 0.5 * kStopStiffness * advance.end * advance.end;
            t.gradient[0] += kStopStiffness * advance.end;
            t.aa = kStopStiffness;
        }
    }
    for (int k = 0; k <= T; ++k) {
        const Coordinate& turn = lane.device[k].turn;
        if (turn.chained) {
            const ChainLoad chain = lanes.chain[l][k].load(turn.end);
            t.energy += chain.energy;
            t.gradient[1 + k] = chain.torque;
            t.chain[k] = chain.stiffness;
        }
        if (turn.slipping == 0) continue;   // a limit may be infinite
        t.gradient[1 + k] = -(turn.slipping * drives.torque[k]);
        t.energy += t.gradient[1 + k] * turn.offset;
    }
    return t;
}

// Newton's step of the drives' coordinates that are unknowns. A drive that slips goes no farther than commanded: there it holds again.
// Returns whether the Hessian is positive definite.
template <class V, int T>
ENDOPILOT_LARGE bool solve_drives(const Scene& scene, Lanes<V, T>& lanes, int l) {
    constexpr int N = 2 + T;
    const Lane<T>& lane = lanes.lane[l];
    if (!lane.drives_free()) return true;
    const DriveLoad<T> load = drive_load(scene, lanes, l);
    const DriveBlock<V, T>& drive = lanes.found.drive;
    const double damping = get(lanes.terms.damping, l);
    double h[N][N], g[N], offset[N], step[N] = {};
    int side[N];
    for (int r = 0; r < N; ++r) {
        const Coordinate& coordinate = lane.coordinate(r);
        side[r] = lane.by_force || coordinate.chained ? kUnbounded : coordinate.slipping;
        offset[r] = coordinate.offset;
        g[r] = get(drive.gradient[r], l) + load.gradient[r];
        for (int c = 0; c <= r; ++c) h[r][c] = get(drive.h(r, c), l);
    }
    h[0][0] += load.aa;
    h[1][0] += load.ar;
    h[1][1] += load.rr;
    for (int k = 0; k <= T; ++k) h[1 + k][1 + k] += load.chain[k];
    for (int r = 0; r < N; ++r) {
        h[r][r] += damping;
        for (int c = 0; c < r; ++c) h[c][r] = h[r][c];
    }
    if (!bounded_minimum(h, g, side, offset, step)) return false;
    double decrement = get(lanes.found.decrement, l);
    for (int r = 0; r < N; ++r) {
        set(lanes.drive_step[r], l, step[r]);
        if (side[r] != 0) decrement -= g[r] * step[r];
    }
    set(lanes.found.decrement, l, decrement);
    return true;
}

// Lets drives slip where the devices, at rest with the drives where they were commanded, take more than their limits; the foremost bears
// its own of the force on all devices, the others theirs by `update_drives`. Returns whether any does.
template <class V, int T>
ENDOPILOT_DEVICE bool release_drives(const Drives& drives, Lanes<V, T>& lanes, int l) {
    Lane<T>& lane = lanes.lane[l];
    const V(&gradient)[2 + T] = lanes.found.drive.gradient;
    if (lane.by_force || lane.releases == kMaxReleases) return false;
    bool released = false;
    const auto release = [&released](Coordinate& coordinate, double load, double forwards, double backwards) {
        if (coordinate.chained || coordinate.offset != 0 || !(load > forwards || load < -backwards)) return;
        const int side = load > 0 ? 1 : -1;
        released = released || coordinate.slipping != side;
        coordinate.slipping = side;
    };
    release(lane.advance, get(gradient[0], l) - borne_by_others(drives, lane), drives.push[lane.foremost], drives.pull[lane.foremost]);
    for (int k = 0; k <= T; ++k) release(lane.device[k].turn, get(gradient[1 + k], l), drives.torque[k], drives.torque[k]);
    lane.releases += released;
    return released;
}

// Moves the drives' coordinates as `move` moves the nodes. Returns whether they have moved.
template <class V, int T>
ENDOPILOT_DEVICE bool move_drives(Lanes<V, T>& lanes, int l, Next next) {
    Lane<T>& lane = lanes.lane[l];
    if (lane.world < 0 || !lane.drives_free()) return false;
    const bool advances = next == Next::advance || next == Next::converge, shortens = next == Next::shorten;
    for (int r = 0; r < 2 + T; ++r) {
        Coordinate& coordinate = lane.coordinate(r);
        if (advances || next == Next::modify) coordinate.accepted = coordinate.offset;
        if (advances) coordinate.step = lane.factor * get(lanes.drive_step[r], l);
        if (shortens) coordinate.step = lane.factor * coordinate.step;
        if (!advances && !shortens) continue;
        coordinate.offset = coordinate.accepted + coordinate.step;
        coordinate.end = coordinate.commanded + coordinate.offset;
    }
    return advances || shortens;
}

// Where the step, which has converged, has brought the devices. None comes to lie ahead of the foremost.
template <class V, int T>
ENDOPILOT_DEVICE void settle_drives(Lanes<V, T>& lanes, int l) {
    Lane<T>& lane = lanes.lane[l];
    V(&slide)[T + 1] = lanes.step.slide;
    const double advanced = lane.advance.end - lane.advance.start;
    for (int k = 0; k <= T; ++k) {
        Device& device = lane.device[k];
        device.end = k == lane.foremost ? lane.advance.end : std::min(device.end, lane.advance.end);
        if (!lane.by_force) {
            device.slipped += k == lane.foremost ? -lane.advance.offset : device.commanded - device.end;
            device.rotation_slipped -= device.turn.offset;
        }
        set(slide[k], l, (device.end - device.start) - advanced);
        if (k == 0) continue;
        double& mobilized = lane.device[k - 1].mobilized;
        const double along = get(slide[k], l) - get(slide[k - 1], l);
        mobilized = std::clamp(mobilized + along / kMobilizingLength, -1.0, 1.0);
        mobilized += lane.friction_share * (lane.friction_side - mobilized);
        set(lanes.step.mobilized[k - 1], l, mobilized);
    }
    for (int r = 0; r < 2 + T; ++r) {
        Coordinate& coordinate = lane.coordinate(r);
        coordinate.last = coordinate.end - coordinate.start;
        if (coordinate.offset == 0) coordinate.slipping = 0;
    }
}

// The axial force of each drive, once friction between the devices is known.
template <class V, int T>
ENDOPILOT_DEVICE void drive_forces(const Evaluation<V, T>& found, int l, double (&force)[T + 1]) {
    double pushed = 0;
    for (int k = 0; k <= T; ++k) {
        const double bundle = k < T ? -get(found.tension[k], l) : get(found.base_force, l);
        force[k] = bundle - pushed;
        pushed += force[k];
    }
}

// Updates the force and torque of each drive after a step. A drive of a device that is not foremost and that is beyond its limit stops and
// gives way; within it, it takes its motion up again step by step.
template <class V, int T>
ENDOPILOT_DEVICE void update_drives(const Scene& scene, Lanes<V, T>& lanes, int l) {
    Lane<T>& lane = lanes.lane[l];
    double force[T + 1], pushed = 0;
    drive_forces(lanes.found, l, force);
    for (int k = 0; k <= T; ++k) {
        Device& device = lane.device[k];
        device.force = force[k];
        device.torque = get(lanes.found.base_torque[k], l);
        pushed += device.force;
        if (T == 0) continue;
        const double beyond = beyond_limit(scene.drives, k, device.force);
        device.feed = beyond * device.control[0] > 0 ? 0.0 : std::min(1.0, kFaster * device.feed + kLeastFeed);
        device.backdrive = beyond == 0 ? 0.5 * device.backdrive
                                       : std::clamp(device.backdrive - kBackdrive * beyond, double{-kMostBackdrive}, double{kMostBackdrive});
        if (std::abs(device.backdrive) < scene.options.stick_velocity) device.backdrive = 0;
    }
    lane.others_force = pushed - lane.device[lane.foremost].force;
}

}  // namespace endopilot
