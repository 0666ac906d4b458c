// Catheters around a wire: friction between them turns, and with it the drives' forces, which must not leap beyond their limits.
#pragma once

#include <algorithm>

#include "coaxial.hpp"
#include "drives.hpp"

namespace endopilot {

constexpr double kLeap = 0.05;         // share of its limit by which a drive's force may pass it in a step that can be shortened
constexpr double kNear = 0.4;          // share of its limit below which no force passes it in one step
constexpr int kLeastStride = kTicks / 16;   // no shorter steps than these for the sake of a limit

// The drives' forces, N, and which of them has leaped beyond its limit; -1: none.
template <int T>
struct Leap {
    double force[T + 1] = {};
    int drive = -1;
};

// Finds the drives' forces in some lanes, if the step ended now, and which of them has leaped beyond its limit the farthest; nothing is
// kept. Returns whether any has.
template <class V, int T>
ENDOPILOT_DEVICE bool try_forces(const Scene& scene, Lanes<V, T>& lanes, const bool (&on)[kWidth<V>], Leap<T> (&leap)[kWidth<V>]) {
    const TimeStep<V, T> step = lanes.step;
    bool any = false;
    for (int l = 0; l < kWidth<V>; ++l) {
        if (!on[l]) continue;
        const Lane<T> before = lanes.lane[l];
        settle_drives(lanes, l);
        freeze_tubes(scene, lanes, l, false);
        lanes.lane[l] = before;
        leap[l].drive = -1;
        drive_forces(lanes.found, l, leap[l].force);
        double farthest = kLeap;
        for (int k = 0; k <= T; ++k) {
            const double beyond = std::abs(beyond_limit(scene.drives, k, leap[l].force[k]));
            if (!(beyond > farthest && beyond > std::abs(beyond_limit(scene.drives, k, before.device[k].force)))) continue;
            farthest = beyond;
            leap[l].drive = k;
            any = true;
        }
    }
    lanes.step = step;
    return any;
}

// Friction between devices turns within some 0.04 mm, and the drives' forces with it. Where one would leap beyond its limit in a step,
// that drive gives way by so little: friction is as near to where it would turn as the drives bear. Where no friction keeps them within
// their limits, the step is made again in shorter ones.
template <class V, int T>
ENDOPILOT_DEVICE void refuse_leaps(const Scene& scene, Lanes<V, T>& lanes, Next (&next)[kWidth<V>]) {
    constexpr int W = kWidth<V>;
    const Drives& drives = scene.drives;
    bool tried[W] = {};
    for (int l = 0; l < W; ++l) {
        if (next[l] != Next::converge) continue;
        for (int k = 0; k <= T; ++k) {
            const double most = kNear * std::min(drives.push[k], drives.pull[k]);
            tried[l] = tried[l] || std::abs(get(lanes.found.base_force, l)) > most || std::abs(lanes.lane[l].device[k].force) > most;
        }
    }
    Leap<T> turned[W], other[W];   // with friction where it would turn, and as far to one side as it can be
    if (!try_forces(scene, lanes, tried, turned)) return;
    for (int l = 0; l < W; ++l) tried[l] = tried[l] && turned[l].drive >= 0;
    for (const double side : {-1.0, 1.0}) {
        bool on[W];
        for (int l = 0; l < W; ++l) {
            Lane<T>& lane = lanes.lane[l];
            on[l] = tried[l] && lane.friction_share == 0;
            if (on[l]) lane.friction_side = side, lane.friction_share = 1;
        }
        try_forces(scene, lanes, on, other);
        for (int l = 0; l < W; ++l) {
            if (!on[l]) continue;
            const int k = turned[l].drive;
            const double was = turned[l].force[k], change = other[l].force[k] - was;
            const double most = (1 + 0.5 * kLeap) * (was > 0 ? drives.push[k] : -drives.pull[k]);
            const double share = (most - was) / change;
            lanes.lane[l].friction_share = share > 0 && share <= 1 ? share : 0.0;
        }
    }
    try_forces(scene, lanes, tried, other);
    for (int l = 0; l < W; ++l) {
        Lane<T>& lane = lanes.lane[l];
        if (!tried[l] || other[l].drive < 0) continue;
        lane.friction_share = 0;
        if (lane.stride <= kLeastStride) continue;
        next[l] = Next::restart;
        lane.extrapolated = false;
    }
}

}  // namespace endopilot
