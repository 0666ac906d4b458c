// The drives of telescoping tubes: their forces, and how they give way at their limits.
#pragma once

#include <algorithm>

#include "bounds.hpp"
#include "stepper.hpp"

namespace endopilot {

constexpr double kFaster = 1.25, kLeastPace = 1.0 / 64;   // of the share of its motion that a drive makes after it was at its limit
constexpr double kYield = 20, kMostYield = 40;   // mm/s by which a drive at twice its limit gives way faster with each step, and at most
constexpr double kLeap = 0.05;         // share of its limit by which a drive's force may pass it in a step that can be shortened
constexpr double kNear = 0.4;          // share of its limit below which no force passes it in one step
constexpr int kLeastStride = kTicks / 16;   // no shorter steps than these for the sake of a limit

// The axial force of each drive, after freeze_tubes.
template <class V, int T>
void Stepper<V, T>::tell_forces(int l, double (&force)[T + 1]) const {
    double pushed = 0;
    for (int k = 0; k <= T; ++k) {
        force[k] = (k < T ? -get(of_tubes_.bundle[k], l) : get(base_force_, l)) - pushed;
        pushed += force[k];
    }
}

// By how much a force of drive k is beyond its limit, as a share of that: positive where it pushes, negative where it pulls.
template <class V, int T>
double Stepper<V, T>::beyond_limit(int k, double force) const {
    if (force > tubes_.push_limit[k]) return force / tubes_.push_limit[k] - 1;
    return force < -tubes_.pull_limit[k] ? force / tubes_.pull_limit[k] + 1 : 0.0;
}

// Friction between tubes turns within some 0.04 mm, and the drives' forces with it. Where one would leap beyond its limit in a step,
// that drive gives way by so little: friction is as near to where it would turn as the drives bear. Where no friction keeps them within
// their limits, the step is made again in shorter ones.
template <class V, int T>
void Stepper<V, T>::refuse_leaps(Decision (&decision)[W]) {
    bool tried[W] = {};
    for (int l = 0; l < W; ++l) {
        const Lane& lane = lane_[l];
        if (decision[l] != Decision::converged) continue;
        for (int k = 0; k <= T; ++k) {
            const double most = kNear * std::min(tubes_.push_limit[k], tubes_.pull_limit[k]);
            tried[l] = tried[l] || std::abs(get(base_force_, l)) > most || std::abs(lane.tubes.tube[k].force) > most;
        }
    }
    Leap turned[W], other[W];   // with friction where it would turn, and as far to one side as it can be
    if (!try_forces(tried, turned)) return;
    for (int l = 0; l < W; ++l) tried[l] = tried[l] && turned[l].drive >= 0;
    for (const double side : {-1.0, 1.0}) {
        bool on[W];
        for (int l = 0; l < W; ++l) {
            on[l] = tried[l] && lane_[l].tubes.given == 0;
            if (on[l]) lane_[l].tubes.side = side, lane_[l].tubes.given = 1;
        }
        try_forces(on, other);
        for (int l = 0; l < W; ++l) {
            if (!on[l]) continue;
            const int k = turned[l].drive;
            const double was = turned[l].force[k], change = other[l].force[k] - was;
            const double most = (1 + 0.5 * kLeap) * (was > 0 ? tubes_.push_limit[k] : -tubes_.pull_limit[k]);
            const double share = (most - was) / change;
            lane_[l].tubes.given = share > 0 && share <= 1 ? share : 0.0;
        }
    }
    try_forces(tried, other);
    for (int l = 0; l < W; ++l) {
        Lane& lane = lane_[l];
        if (!tried[l] || other[l].drive < 0) continue;
        lane.tubes.given = 0;
        if (lane.stride <= kLeastStride) continue;
        decision[l] = Decision::restart;
        lane.extrapolated = false;
    }
}

// Finds the drives' forces in some lanes, if the step ended now, and which of them has leaped beyond its limit the farthest; nothing is
// kept. Returns whether any has.
template <class V, int T>
bool Stepper<V, T>::try_forces(const bool (&on)[W], Leap (&leap)[W]) {
    const TubeLanes<V, T> of_tubes = of_tubes_;
    bool any = false;
    for (int l = 0; l < W; ++l) {
        if (!on[l]) continue;
        const Lane before = lane_[l];
        settle_tubes(l);
        freeze_tubes(l, false);
        lane_[l] = before;
        leap[l].drive = -1;
        tell_forces(l, leap[l].force);
        double farthest = kLeap;
        for (int k = 0; k <= T; ++k) {
            const double beyond = std::abs(beyond_limit(k, leap[l].force[k])), was = std::abs(beyond_limit(k, before.tubes.tube[k].force));
            if (!(beyond > farthest && beyond > was)) continue;
            farthest = beyond;
            leap[l].drive = k;
            any = true;
        }
    }
    of_tubes_ = of_tubes;
    return any;
}

// The force and torque of each drive after a step. A drive that does not lead and is beyond its limit stops and gives way; within it,
// it takes its motion up again by and by.
template <class V, int T>
void Stepper<V, T>::pace_tubes(int l) {
    Lane& lane = lane_[l];
    double force[T + 1], pushed = 0;
    tell_forces(l, force);
    for (int k = 0; k <= T; ++k) {
        Tube& tube = lane.tubes.tube[k];
        tube.force = force[k];
        pushed += tube.force;
        tube.torque = k > 0 ? get(of_tubes_.torque[k - 1], l) : get(base_torque_, l);
        const double beyond = beyond_limit(k, tube.force);
        tube.pace = beyond * tube.speed > 0 ? 0.0 : std::min(1.0, kFaster * tube.pace + kLeastPace);
        tube.yield = beyond == 0 ? 0.5 * tube.yield : std::clamp(tube.yield - kYield * beyond, double{-kMostYield}, double{kMostYield});
        if (std::abs(tube.yield) < options_.stick_velocity) tube.yield = 0;
    }
    lane.tubes.others = pushed - lane.tubes.tube[lane.tubes.lead].force;
}

// What the other drives than the leading one bear of the force on all tubes: that of the end of the last step, and no more than their
// limits. Else a force beyond them would stay: where the lead slips, that of all tubes is its limit and what the others bear.
template <class V, int T>
double Stepper<V, T>::borne_by_others(const Lane& lane) const {
    double most = 0, least = 0;
    for (int k = 0; k <= T; ++k) {
        if (k == lane.tubes.lead) continue;
        most += tubes_.push_limit[k];
        least -= tubes_.pull_limit[k];
    }
    return std::clamp(lane.tubes.others, least, most);
}

template <class V, int T>
bool Stepper<V, T>::tubes_slip(const Lane& lane) const {
    bool slips = lane.slipping.advance != 0 || lane.slipping.rotation != 0;
    for (int k = 1; k <= T; ++k) slips = slips || lane.tubes.tube[k].slipping != 0;
    return slips;
}

// The energy of drives that slip at their limits; the leading one also moves what the others bear. A stop holds tubes that are all out.
template <class V, int T>
typename Stepper<V, T>::DriveEnergy Stepper<V, T>::tube_drive_energy(const Lane& lane) const {
    const int lead = lane.tubes.lead, side = lane.slipping.advance;
    const double force = side == 0 ? 0.0 : borne_by_others(lane) + (side > 0 ? tubes_.push_limit[lead] : -tubes_.pull_limit[lead]);
    const double torque = lane.slipping.rotation == 0 ? 0.0 : lane.slipping.rotation * tubes_.torque_limit[0];   // a limit may be infinite
    DriveEnergy e{.energy = 0, .gradient_a = -force, .gradient_r = -torque, .aa = 0, .ar = 0, .rr = 0};
    if (side != 0) e.energy += e.gradient_a * lane.off.advance;
    if (const double beyond = std::min(0.0, lane.end.advance); side != 0 && beyond < 0) {
        e.energy += 0.5 * kStopStiffness * beyond * beyond;
        e.gradient_a += kStopStiffness * beyond;
        e.aa = kStopStiffness;
    }
    if (lane.slipping.rotation != 0) e.energy += e.gradient_r * lane.off.rotation;
    for (int k = 1; k <= T; ++k) {
        const Tube& tube = lane.tubes.tube[k];
        if (tube.slipping != 0) e.energy -= tube.slipping * tubes_.torque_limit[k] * tube.off;
    }
    return e;
}

// Newton's step of the drives that slip: the advance of the leading one and the rotation of each. As solve_drive.
template <class V, int T>
bool Stepper<V, T>::solve_tube_drives(int l) {
    Lane& lane = lane_[l];
    if (!tubes_slip(lane)) return true;
    constexpr int N = 2 + T;
    const DriveBlock& d = drive_;
    const double damping = get(damping_, l);
    double h[N][N] = {}, g[N] = {}, off[N], step[N] = {};
    int side[N];
    g[1] = get(d.gradient_r, l);
    const DriveEnergy load = tube_drive_energy(lane);
    h[0][0] = load.aa + get(d.aa, l) + damping;
    h[1][0] = get(d.ar, l);
    h[1][1] = get(d.rr, l) + damping;
    for (int k = 0; k < T; ++k) {
        const int r = 2 + k;
        g[r] = get(d.twists.gradient[k], l);
        h[r][0] = get(d.twists.ap[k], l);
        h[r][1] = get(d.twists.rp[k], l);
        for (int c = 0; c <= k; ++c) h[r][2 + c] = get(d.twists.pp[k][c], l);
        h[r][r] += damping;
    }
    g[0] = get(d.gradient_a, l) + load.gradient_a;
    g[1] += load.gradient_r;
    side[0] = lane.slipping.advance, off[0] = lane.off.advance;
    side[1] = lane.slipping.rotation, off[1] = lane.off.rotation;
    for (int k = 1; k <= T; ++k) {
        const Tube& tube = lane.tubes.tube[k];
        side[k + 1] = tube.slipping, off[k + 1] = tube.off;
        if (tube.slipping != 0) g[k + 1] -= tube.slipping * tubes_.torque_limit[k];
    }
    for (int r = 0; r < N; ++r) {
        for (int c = 0; c < r; ++c) h[c][r] = h[r][c];
    }
    if (!bounded_minimum(h, g, side, off, step)) return false;
    set(drive_a_, l, step[0]);
    set(drive_r_, l, step[1]);
    double descent = get(descent_, l);
    for (int r = 0; r < N; ++r) {
        if (r >= 2) set(of_tubes_.turn[r - 2], l, step[r]);
        if (side[r] != 0) descent -= g[r] * step[r];
    }
    set(descent_, l, descent);
    return true;
}

// As `release`; the lead bears its own limit of the force on all tubes, the others theirs by `pace_tubes`.
template <class V, int T>
bool Stepper<V, T>::release_tubes(int l) {
    Lane& lane = lane_[l];
    if (lane.releases == kMaxReleases) return false;
    const int lead = lane.tubes.lead;
    const double force = get(drive_.gradient_a, l) - borne_by_others(lane);
    bool released = false;
    const auto let_go = [&](int& slipping, int side) {
        released = released || slipping != side;
        slipping = side;
    };
    if (lane.off.advance == 0 && force > tubes_.push_limit[lead]) let_go(lane.slipping.advance, 1);
    if (lane.off.advance == 0 && force < -tubes_.pull_limit[lead]) let_go(lane.slipping.advance, -1);
    const double first = get(drive_.gradient_r, l);
    for (int k = 1; k <= T; ++k) {
        Tube& tube = lane.tubes.tube[k];
        const double torque = get(drive_.twists.gradient[k - 1], l);
        if (tube.off == 0 && std::abs(torque) > tubes_.torque_limit[k]) let_go(tube.slipping, torque > 0 ? 1 : -1);
    }
    if (lane.off.rotation == 0 && std::abs(first) > tubes_.torque_limit[0]) let_go(lane.slipping.rotation, first > 0 ? 1 : -1);
    lane.releases += released;
    return released;
}

// The rotations of drives that slip, after Newton's step.
template <class V, int T>
void Stepper<V, T>::turn_tubes(int l, bool keeps, bool takes, bool shortens, double factor) {
    for (int k = 1; k <= T; ++k) {
        Tube& tube = lane_[l].tubes.tube[k];
        if (keeps) tube.from = tube.off;
        if (takes) tube.move = factor * get(of_tubes_.turn[k - 1], l);
        if (shortens) tube.move *= factor;
        if (!takes && !shortens) continue;
        tube.off = tube.from + tube.move;
        tube.end_rotation = tube.asked_rotation + tube.off;
    }
}

}  // namespace endopilot
