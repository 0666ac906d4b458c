// Catheters around a wire: friction between them turns, and with it the drives' forces, which must not leap beyond their limits.
#pragma once

#include <algorithm>

#include "stepper.hpp"

namespace endopilot {

constexpr double kLeap = 0.05;         // share of its limit by which a drive's force may pass it in a step that can be shortened
constexpr double kNear = 0.4;          // share of its limit below which no force passes it in one step
constexpr int kLeastStride = kTicks / 16;   // no shorter steps than these for the sake of a limit

// By how much a force of drive k is beyond its limit, as a share of that: positive where it pushes, negative where it pulls.
template <class V, int T>
double Stepper<V, T>::beyond_limit(int k, double force) const {
    if (force > drives_.push[k]) return force / drives_.push[k] - 1;
    return force < -drives_.pull[k] ? force / drives_.pull[k] + 1 : 0.0;
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
            const double most = kNear * std::min(drives_.push[k], drives_.pull[k]);
            tried[l] = tried[l] || std::abs(get(base_force_, l)) > most || std::abs(lane.device[k].force) > most;
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
            const double most = (1 + 0.5 * kLeap) * (was > 0 ? drives_.push[k] : -drives_.pull[k]);
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
        settle(l);
        freeze_tubes(l, false);
        lane_[l] = before;
        leap[l].drive = -1;
        drive_forces(l, leap[l].force);
        double farthest = kLeap;
        for (int k = 0; k <= T; ++k) {
            const double beyond = std::abs(beyond_limit(k, leap[l].force[k])), was = std::abs(beyond_limit(k, before.device[k].force));
            if (!(beyond > farthest && beyond > was)) continue;
            farthest = beyond;
            leap[l].drive = k;
            any = true;
        }
    }
    of_tubes_ = of_tubes;
    return any;
}

}  // namespace endopilot
