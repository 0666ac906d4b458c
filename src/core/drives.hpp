// The drives of a lane's devices: where they are to go, the introducer that they pass, their limits, and their part of Newton's step.
#pragma once

#include <algorithm>

#include "bounds.hpp"
#include "stepper.hpp"

namespace endopilot {

constexpr double kStopStiffness = 100;  // N/mm, of the stops at both ends of a drive's travel
constexpr int kMaxReleases = 8;         // times in a step that a drive may let go of its device
constexpr double kMobilizingLength = 0.02;   // mm of sliding that turn friction along two devices from one direction to the other by half
constexpr double kFaster = 1.25, kLeastFeed = 1.0 / 64;   // of the share of its motion that a drive makes after it was at its limit
constexpr double kBackdrive = 20, kMostBackdrive = 40;   // mm/s by which a drive at twice its limit gives way faster with each step, and at most

template <class V, int T>
double Stepper<V, T>::device_radius(int k, const Lane& lane) const {
    if constexpr (T == 0) return rod_.radius[lane.active];
    return tubes_.radius[k];
}

// Where the devices are at the start of the step and are to be at its end. The mesh follows the device whose tip is foremost.
template <class V, int T>
void Stepper<V, T>::aim(int l, double weight) {
    Lane& lane = lane_[l];
    if (lane.by_force) {   // of a wire alone
        for (int r = 0; r < N; ++r) {
            Coordinate& free = lane.coordinate(r);
            free.slipping = 0;
            free.commanded = free.start;
            free.off = free.from = weight * free.last;
            free.end = free.commanded + free.off;
        }
        lane.device[0].start = lane.advance.start;
        return;
    }
    const double began = elapsed(lane.tick), ends = elapsed(lane.tick + lane.stride);
    const auto reach = [weight](Coordinate& c) {   // where a drive that slips would come to, and no farther than commanded
        const double off = c.start + weight * c.last - c.commanded;
        c.off = c.from = c.slipping * off < 0 ? off : 0.0;
        c.end = c.commanded + c.off;
    };
    int lead = 0;
    double foremost = 0;
    for (int k = 0; k <= T; ++k) {
        Device& device = lane.device[k];
        const double inserted = device.inserted - device.slipped, rotation = device.rotation - device.rotation_slipped;
        device.start = inserted + device.speed * began;
        device.commanded = inserted + device.speed * ends;
        device.turn.start = rotation + device.spin * began;
        device.turn.commanded = rotation + device.spin * ends;
        reach(device.turn);
        if (k == 0 || device.start > foremost) foremost = device.start;
        if (device.commanded > lane.device[lead].commanded) lead = k;
    }
    if (lead != lane.lead) lane.advance.slipping = 0;
    lane.lead = lead;
    lane.advance.start = foremost;
    lane.advance.commanded = lane.device[lead].commanded;
    reach(lane.advance);
    const double end = lane.advance.end;
    for (int k = 0; k <= T; ++k) {
        Device& device = lane.device[k];
        if (k == lead) device.feed = 1, device.backdrive = 0;
        double made = device.commanded;
        if (device.feed < 1 || device.backdrive != 0)
            made = std::max(0.0, device.start + device.feed * (device.commanded - device.start) + device.backdrive * duration(lane));
        device.end = k == lead ? end : std::min(made, end);
        if constexpr (T > 0) {
            set(of_tubes_.slide[k], l, (device.end - device.start) - (end - foremost));
            if (k > 0) set(of_tubes_.mobilized[k - 1], l, lane.device[k - 1].mobilized);
        }
    }
    if constexpr (T > 0) lane.tubes.given = 0;
}

// The introducer through which a drive moves its device: smoothed Coulomb friction of its valve and viscous drag, against advance and
// rotation together; the device's surface moves by its radius r times the rotation.
template <class V, int T>
typename Stepper<V, T>::DriveLoad Stepper<V, T>::introducer(double advance, double rotation, double r, int l) const {
    const double a = advance, s = r * rotation, eps = get(eps_, l);
    const double drag = options_.introducer_drag * get(inverse_dt_, l), size = std::sqrt(a * a + s * s + eps * eps);
    const double secant = options_.introducer_friction / size, c = secant / (size * size);
    DriveLoad load;
    load.energy = 0.5 * drag * (a * a + s * s) + options_.introducer_friction * (size - eps);
    load.gradient[0] = (drag + secant) * a;
    load.gradient[1] = (drag + secant) * s * r;
    load.aa = drag + secant - c * a * a;
    load.ar = -c * a * s * r;
    load.rr = (drag + secant - c * s * s) * r * r;
    return load;
}

// What the other drives than the leading one bear of the force on all devices: that of the end of the last step, and no more than their
// limits. Else a force beyond them would stay: where the lead slips, that of all devices is its limit and what the others bear.
template <class V, int T>
double Stepper<V, T>::borne_by_others(const Lane& lane) const {
    if constexpr (T == 0) return 0.0;
    else {
        double most = 0, least = 0;
        for (int k = 0; k <= T; ++k) {
            if (k == lane.lead) continue;
            most += drives_.push[k];
            least -= drives_.pull[k];
        }
        return std::clamp(lane.tubes.others, least, most);
    }
}

// The energy at the trial point of what is lost where drives slip at their limits; the leading one also moves what the others bear. Or, of
// a wire driven by force, that of the introducer, of the stops at both ends of the drive's travel, and of the load.
template <class V, int T>
typename Stepper<V, T>::DriveLoad Stepper<V, T>::drive_load(const Lane& lane, int l) const {
    const double advanced = lane.advance.end;
    if (lane.by_force) {
        const Coordinate &a = lane.advance, &r = lane.device[0].turn;
        DriveLoad t = introducer(a.off, r.off, rod_.radius[lane.active], l);
        const double beyond = std::min(0.0, advanced) + std::max(0.0, advanced + options_.free_behind - rod_.abscissa[rod_.nodes - 1]);
        t.energy += 0.5 * kStopStiffness * beyond * beyond - lane.device[0].speed * a.off - lane.device[0].spin * r.off;
        t.gradient[0] += kStopStiffness * beyond - lane.device[0].speed;
        t.gradient[1] -= lane.device[0].spin;
        t.aa += beyond != 0.0 ? kStopStiffness : 0.0;
        return t;
    }
    DriveLoad t;
    if (const int side = lane.advance.slipping; side != 0) {
        t.gradient[0] = -(borne_by_others(lane) + (side > 0 ? drives_.push[lane.lead] : -drives_.pull[lane.lead]));
        t.energy = t.gradient[0] * lane.advance.off;
        if (advanced < 0) {   // a stop holds devices that are all out
            t.energy += 0.5 * kStopStiffness * advanced * advanced;
            t.gradient[0] += kStopStiffness * advanced;
            t.aa = kStopStiffness;
        }
    }
    for (int k = 0; k <= T; ++k) {
        const Coordinate& turn = lane.device[k].turn;
        if (turn.slipping == 0) continue;   // a limit may be infinite
        t.gradient[1 + k] = -(turn.slipping * drives_.torque[k]);
        t.energy += t.gradient[1 + k] * turn.off;
    }
    return t;
}

// Newton's step of the drives' coordinates that are unknowns. A drive that slips goes no farther than commanded: there it holds again.
// Returns whether the Hessian is positive definite.
template <class V, int T>
bool Stepper<V, T>::solve_drives(int l) {
    const Lane& lane = lane_[l];
    if (!lane.drives_free()) return true;
    const DriveLoad load = drive_load(lane, l);
    const double damping = get(damping_, l);
    double h[N][N], g[N], off[N], step[N] = {};
    int side[N];
    for (int r = 0; r < N; ++r) {
        const Coordinate& coordinate = lane.coordinate(r);
        side[r] = lane.by_force ? kUnbounded : coordinate.slipping;
        off[r] = coordinate.off;
        g[r] = get(drive_.gradient[r], l) + load.gradient[r];
        for (int c = 0; c <= r; ++c) h[r][c] = get(drive_.h(r, c), l);
    }
    h[0][0] += load.aa;
    h[1][0] += load.ar;
    h[1][1] += load.rr;
    for (int r = 0; r < N; ++r) {
        h[r][r] += damping;
        for (int c = 0; c < r; ++c) h[c][r] = h[r][c];
    }
    if (!bounded_minimum(h, g, side, off, step)) return false;
    double descent = get(descent_, l);
    for (int r = 0; r < N; ++r) {
        set(drive_step_[r], l, step[r]);
        if (side[r] != 0) descent -= g[r] * step[r];
    }
    set(descent_, l, descent);
    return true;
}

// Lets drives slip where the devices, at rest with the drives where they were commanded, take more than their limits; the lead bears its
// own of the force on all devices, the others theirs by `note_forces`. Returns whether any does.
template <class V, int T>
bool Stepper<V, T>::release(int l) {
    Lane& lane = lane_[l];
    if (lane.by_force || lane.releases == kMaxReleases) return false;
    bool released = false;
    const auto let_go = [&released](Coordinate& coordinate, double load, double forwards, double backwards) {
        if (coordinate.off != 0 || !(load > forwards || load < -backwards)) return;
        const int side = load > 0 ? 1 : -1;
        released = released || coordinate.slipping != side;
        coordinate.slipping = side;
    };
    let_go(lane.advance, get(drive_.gradient[0], l) - borne_by_others(lane), drives_.push[lane.lead], drives_.pull[lane.lead]);
    for (int k = 0; k <= T; ++k) let_go(lane.device[k].turn, get(drive_.gradient[1 + k], l), drives_.torque[k], drives_.torque[k]);
    lane.releases += released;
    return released;
}

// Moves the drives' coordinates as `update` moves the nodes.
template <class V, int T>
void Stepper<V, T>::move_drives(int l, Decision decision, double factor) {
    Lane& lane = lane_[l];
    if (lane.world < 0 || !lane.drives_free()) return;
    const bool accepts = decision == Decision::accept || decision == Decision::converged, shortens = decision == Decision::shorten;
    for (int r = 0; r < N; ++r) {
        Coordinate& coordinate = lane.coordinate(r);
        if (accepts || decision == Decision::repeat) coordinate.from = coordinate.off;
        if (accepts) coordinate.move = factor * get(drive_step_[r], l);
        if (shortens) coordinate.move = factor * coordinate.move;
        if (!accepts && !shortens) continue;
        coordinate.off = coordinate.from + coordinate.move;
        coordinate.end = coordinate.commanded + coordinate.off;
    }
    if (accepts || shortens) place_base(l, lane.active);
}

// Where the step, which has converged, has brought the devices. None comes to lie ahead of the lead.
template <class V, int T>
void Stepper<V, T>::settle(int l) {
    Lane& lane = lane_[l];
    const double led = lane.advance.end - lane.advance.start;
    for (int k = 0; k <= T; ++k) {
        Device& device = lane.device[k];
        device.end = k == lane.lead ? lane.advance.end : std::min(device.end, lane.advance.end);
        if (!lane.by_force) {
            device.slipped += k == lane.lead ? -lane.advance.off : device.commanded - device.end;
            device.rotation_slipped -= device.turn.off;
        }
        if constexpr (T > 0) {
            set(of_tubes_.slide[k], l, (device.end - device.start) - led);
            if (k == 0) continue;
            Device& inner = lane.device[k - 1];
            const double along = get(of_tubes_.slide[k], l) - get(of_tubes_.slide[k - 1], l);
            inner.mobilized = std::clamp(inner.mobilized + along / kMobilizingLength, -1.0, 1.0);
            inner.mobilized += lane.tubes.given * (lane.tubes.side - inner.mobilized);
            set(of_tubes_.mobilized[k - 1], l, inner.mobilized);
        }
    }
    for (int r = 0; r < N; ++r) {
        Coordinate& coordinate = lane.coordinate(r);
        coordinate.last = coordinate.end - coordinate.start;
        if (coordinate.off == 0) coordinate.slipping = 0;
    }
}

// The axial force of each drive, once friction between the devices is known.
template <class V, int T>
void Stepper<V, T>::drive_forces(int l, double (&force)[T + 1]) const {
    double pushed = 0;
    for (int k = 0; k <= T; ++k) {
        double bundle = get(base_force_, l);
        if constexpr (T > 0)
            if (k < T) bundle = -get(of_tubes_.bundle[k], l);
        force[k] = bundle - pushed;
        pushed += force[k];
    }
}

// Notes the force and torque of each drive after a step. A drive that does not lead and is beyond its limit stops and gives way; within
// it, it takes its motion up again step by step.
template <class V, int T>
void Stepper<V, T>::note_forces(int l) {
    Lane& lane = lane_[l];
    double force[T + 1];
    drive_forces(l, force);
    for (int k = 0; k <= T; ++k) {
        lane.device[k].force = force[k];
        lane.device[k].torque = get(base_torque_[k], l);
    }
    if constexpr (T > 0) {
        double pushed = 0;
        for (Device& device : lane.device) {
            pushed += device.force;
            const double beyond = beyond_limit(int(&device - lane.device), device.force);
            device.feed = beyond * device.speed > 0 ? 0.0 : std::min(1.0, kFaster * device.feed + kLeastFeed);
            device.backdrive = beyond == 0 ? 0.5 * device.backdrive
                                           : std::clamp(device.backdrive - kBackdrive * beyond, double{-kMostBackdrive}, double{kMostBackdrive});
            if (std::abs(device.backdrive) < options_.stick_velocity) device.backdrive = 0;
        }
        lane.tubes.others = pushed - lane.device[lane.lead].force;
    }
}

}  // namespace endopilot
