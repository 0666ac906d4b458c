// The drive's end of the wire: the introducer that it passes, the drive's limits, and its part of Newton's step.
#pragma once

#include "stepper.hpp"

namespace endopilot {

constexpr double kStopStiffness = 100;  // N/mm, of the stops at both ends of the drive's travel
constexpr int kMaxReleases = 8;         // times in a step that the drive may let go of the wire

// The introducer through which the drive moves the wire: smoothed Coulomb friction of its valve and viscous drag, against
// advance and rotation together; the wire's surface moves by its radius r times the rotation.
template <class V, int T>
typename Stepper<V, T>::DriveEnergy Stepper<V, T>::introducer(const Drive& moved, double r, int l) const {
    const double a = moved.advance, s = r * moved.rotation, eps = get(eps_, l);
    const double drag = options_.introducer_drag * get(inverse_dt_, l), size = std::sqrt(a * a + s * s + eps * eps);
    const double secant = options_.introducer_friction / size, c = secant / (size * size);
    return {.energy = 0.5 * drag * (a * a + s * s) + options_.introducer_friction * (size - eps),
            .gradient_a = (drag + secant) * a,
            .gradient_r = (drag + secant) * s * r,
            .aa = drag + secant - c * a * a,
            .ar = -c * a * s * r,
            .rr = (drag + secant - c * s * s) * r * r};
}

// Where the drive slips at its limit, or the wire is driven by force, the drive's advance and rotation are unknowns too: the
// energy at the trial point of what is lost by slipping, or of the introducer, of the stops at both ends of the drive's
// travel, and of the load.
template <class V, int T>
typename Stepper<V, T>::DriveEnergy Stepper<V, T>::drive_energy(const Lane& lane, int l) const {
    if constexpr (T > 0) return tube_drive_energy(lane);
    const Drive& moved = lane.off;
    if (!lane.by_force) {
        const auto load = [](int side, double forwards, double backwards) { return side > 0 ? forwards : side < 0 ? -backwards : 0.0; };
        const double force = load(lane.slipping.advance, options_.push_limit, options_.pull_limit);
        const double torque = load(lane.slipping.rotation, options_.torque_limit, options_.torque_limit);
        return {.energy = -force * moved.advance - torque * moved.rotation, .gradient_a = -force, .gradient_r = -torque, .aa = 0, .ar = 0, .rr = 0};
    }
    DriveEnergy t = introducer(moved, rod_.radius[lane.active], l);
    const double a = lane.end.advance;
    const double beyond = std::min(0.0, a) + std::max(0.0, a + options_.free_behind - rod_.abscissa[rod_.nodes - 1]);
    t.energy += 0.5 * kStopStiffness * beyond * beyond - lane.speed * moved.advance - lane.spin * moved.rotation;
    t.gradient_a += kStopStiffness * beyond - lane.speed;
    t.gradient_r -= lane.spin;
    t.aa += beyond != 0.0 ? kStopStiffness : 0.0;
    return t;
}

// Newton's step of the drive's unknowns. A drive that slips has them too, but goes no farther than commanded: there it grips
// again. Returns whether the Hessian is positive definite.
template <class V, int T>
bool Stepper<V, T>::solve_drive(int l) {
    if constexpr (T > 0) return solve_tube_drives(l);
    const Lane& lane = lane_[l];
    const Slipping& side = lane.slipping;
    bool holds_a = !lane.by_force && side.advance == 0, holds_r = !lane.by_force && side.rotation == 0;
    if (holds_a && holds_r) return true;
    const DriveEnergy t = drive_energy(lane, l);
    const double damping = get(damping_, l);
    const double aa = t.aa + get(drive_.aa, l) + damping, ar = t.ar + get(drive_.ar, l), rr = t.rr + get(drive_.rr, l) + damping;
    const double determinant = aa * rr - ar * ar;
    if (!((holds_a || aa > 0) && (holds_r || rr > 0) && (holds_a || holds_r || determinant > 0))) return false;
    const double a = t.gradient_a + get(drive_.gradient_a, l), r = t.gradient_r + get(drive_.gradient_r, l);
    double step_a = 0, step_r = 0;
    for (int held = -1; held != holds_a + holds_r;) {  // an unknown that would go beyond its bound is held there
        held = holds_a + holds_r;
        step_a = holds_a ? -lane.off.advance : holds_r ? (ar * lane.off.rotation - a) / aa : (ar * r - rr * a) / determinant;
        step_r = holds_r ? -lane.off.rotation : holds_a ? (ar * lane.off.advance - r) / rr : (ar * a - aa * r) / determinant;
        holds_a = holds_a || side.advance * (lane.off.advance + step_a) > 0;
        holds_r = holds_r || side.rotation * (lane.off.rotation + step_r) > 0;
    }
    set(drive_a_, l, step_a);
    set(drive_r_, l, step_r);
    set(descent_, l, get(descent_, l) - a * step_a - r * step_r);
    return true;
}

// Lets the drive slip where the wire, at rest with the drive where it was commanded, takes more than the drive's limits.
// Returns whether it does.
template <class V, int T>
bool Stepper<V, T>::release(int l) {
    if constexpr (T > 0) return release_tubes(l);
    Lane& lane = lane_[l];
    if (lane.by_force || lane.releases == kMaxReleases) return false;
    const double force = get(drive_.gradient_a, l), torque = get(drive_.gradient_r, l);
    Slipping side = lane.slipping;
    if (lane.off.advance == 0 && force > options_.push_limit) side.advance = 1;
    if (lane.off.advance == 0 && force < -options_.pull_limit) side.advance = -1;
    if (lane.off.rotation == 0 && std::abs(torque) > options_.torque_limit) side.rotation = torque > 0 ? 1 : -1;
    const bool released = side.advance != lane.slipping.advance || side.rotation != lane.slipping.rotation;
    lane.slipping = side;
    lane.releases += released;
    return released;
}

}  // namespace endopilot
