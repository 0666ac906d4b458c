// From a drive to the ostium: the twist of a device in its guiding catheter, under Coulomb friction.
//
// What lies behind the ostium is a chain: drive, `kSections` nodes at the middles of equal sections, base, with springs between them. A
// torque of `friction` at most holds each node where it was. Within a step the drive's rotation is known. So the torque that the chain
// puts up against the base is a piecewise linear function of the base's rotation, and its integral is what the chain adds to the step's
// energy: convex, exact, and found before Newton's method begins.
#pragma once

#include <algorithm>
#include <limits>

#include "views.hpp"

namespace endopilot {

constexpr int kMostDevices = 3;   // a wire and two catheters around it
constexpr int kSections = 8;      // of the length behind the ostium
constexpr double kLeastReach = 1e-9;   // rad; friction that turns within less turns at once

// The devices behind the ostium. Integrals of 1/GJ, from the tips on at equal distances, are twists by a torque, 1/(N mm).
template <template <class> class Array>
struct TransmissionArrays {
    int points = 0;
    double spacing = 0;                  // mm
    double length[kMostDevices]{};       // between drive and ostium, mm; 0: the drive acts at the ostium
    double friction[kMostDevices]{};     // torque a length, N mm/mm
    Array<double> compliance{};

    // The twist by a torque of the first `at` mm of device k. Beyond the last point it goes on as before.
    ENDOPILOT_DEVICE double twist(int k, double at) const {
        const double place = std::max(0.0, at) / spacing;   // 0 for NaN
        const int i = int(std::min(place, points - 2.0));
        const double before = compliance[k * points + i];
        return before + (place - i) * (compliance[k * points + i + 1] - before);
    }
};

using OwnedTransmission = TransmissionArrays<Owned>;
using Transmission = TransmissionArrays<Viewed>;

template <class Place>
Transmission view(const OwnedTransmission& from, const Place& place) {
    Transmission to{.points = from.points, .spacing = from.spacing, .compliance = place(from.compliance)};
    std::copy_n(from.length, kMostDevices, to.length);
    std::copy_n(from.friction, kMostDevices, to.friction);
    return to;
}

// What a chain adds to a step at some rotation of the base.
struct ChainLoad {
    double energy, torque, stiffness;    // N mm, from the step's start on; N mm, against the base; N mm/rad
};

// One device behind the ostium. Nodes count from the drive on.
class Chain {
public:
    double drive = 0, node[kSections]{};   // rotations at the step's start, rad
    double turned = 0, torque = 0;         // of the drive in the last step: its rotation, rad, and its torque, N mm

    // Begins a step in which the drive turns by `by` rad, or less at a torque of `limit`. The chain stands for device k with the base `at`
    // mm from its tip and turned by `base`. Where the device slides by `slide` mm, the friction of its surface, `radius` from the axis, is
    // along its path and resists a small rotation in proportion to it.
    ENDOPILOT_DEVICE void begin(const Transmission& scene, int k, double at, double by, double limit, double base, double slide, double radius) {
        const double section = scene.length[k] / kSections;
        double end = scene.twist(k, at + scene.length[k]);
        for (int i = 0; i <= kSections; ++i) {
            const double begin = i < kSections ? scene.twist(k, at + (kSections - i - 0.5) * section) : scene.twist(k, at);
            stiffness_[i] = 1 / (end - begin);
            end = begin;
        }
        friction_ = scene.friction[k] * section;
        reach_ = slide / radius < kLeastReach ? 0.0 : slide / radius;
        driven_ = drive + by;
        limit_ = limit;
        const double first = stiffness_[0];
        if (limit < std::numeric_limits<double>::infinity()) {
            points_ = 2, slope_ = 0;
            at_[0] = driven_ - limit / first, torque_[0] = -limit;
            at_[1] = driven_ + limit / first, torque_[1] = limit;
        } else {
            points_ = 1, slope_ = first;
            at_[0] = driven_, torque_[0] = 0;
        }
        for (int i = 0; i < kSections; ++i) {
            held_[i] = value(node[i]).torque;
            if (friction_ > 0) add_friction(node[i]);
            for (int p = 0; p < points_; ++p) at_[p] += torque_[p] / stiffness_[i + 1];
            slope_ *= stiffness_[i + 1] / (slope_ + stiffness_[i + 1]);
        }
        energy_[0] = 0;
        for (int p = 1; p < points_; ++p) energy_[p] = energy_[p - 1] + 0.5 * (torque_[p - 1] + torque_[p]) * (at_[p] - at_[p - 1]);
        start_energy_ = value(base).energy;
    }

    ENDOPILOT_DEVICE ChainLoad load(double base) const {
        const ChainLoad found = value(base);
        return {found.energy - start_energy_, found.torque, found.stiffness};
    }

    // Ends the step with the base where it has come to rest: where nodes and drive are then. A node that friction holds stays exactly.
    ENDOPILOT_DEVICE void end(double base) {
        double passed = value(base).torque, here = base;
        for (int i = kSections - 1; i >= 0; --i) {
            here -= passed / stiffness_[i + 1];
            if (reach_ > 0) {
                passed -= friction_ * std::clamp((here - node[i]) / reach_, -1.0, 1.0);
            } else {
                passed = std::clamp(held_[i], passed - friction_, passed + friction_);
                if (friction_ > 0 && passed == held_[i]) here = node[i];
            }
            node[i] = here;
        }
        const double end = passed > -limit_ && passed < limit_ ? driven_ : here - passed / stiffness_[0];
        turned = end - drive;
        drive = end;
        torque = -passed;
    }

private:
    static constexpr int kMostPoints = 2 + 2 * kSections;
    double stiffness_[kSections + 1]{}, held_[kSections]{};   // of the springs, N mm/rad; torques under which a node stays without friction
    double friction_ = 0, reach_ = 0;        // of a node, N mm; rad by which it turns until friction is whole
    double driven_ = 0, limit_ = 0;          // rotation of the drive, if it does not slip; its most torque
    double at_[kMostPoints]{}, torque_[kMostPoints]{}, energy_[kMostPoints]{};   // of the base, against it
    double slope_ = 0, start_energy_ = 0;    // beyond the first and the last point; at the step's start
    int points_ = 0;

    ENDOPILOT_DEVICE ChainLoad value(double at) const {
        int p = 0;
        while (p < points_ && at_[p] < at) ++p;   // the first point that lies ahead
        const int near = std::max(p - 1, 0);
        const double slope = p == 0 || p == points_ ? slope_ : (torque_[p] - torque_[near]) / (at_[p] - at_[near]);
        const double by = at - at_[near];
        return {energy_[near] + by * (torque_[near] + 0.5 * slope * by), torque_[near] + slope * by, slope};
    }

    // Friction of a node at `held`: whole beyond `reach_` to both sides.
    ENDOPILOT_DEVICE void add_friction(double held) {
        const double low = held - reach_, high = held + reach_;
        const double at_low = value(low).torque - friction_, at_high = value(high).torque + friction_;
        int below = 0, above = points_;
        while (below < points_ && at_[below] < low) ++below;
        while (above > below && at_[above - 1] > high) --above;
        for (int p = points_ - 1; p >= above; --p) at_[p + 2] = at_[p], torque_[p + 2] = torque_[p] + friction_;
        at_[above + 1] = high, torque_[above + 1] = at_high;
        for (int p = above - 1; p >= below; --p) {
            at_[p + 1] = at_[p];
            torque_[p + 1] = torque_[p] + (reach_ > 0 ? friction_ * (at_[p] - held) / reach_ : 0.0);
        }
        at_[below] = low, torque_[below] = at_low;
        for (int p = 0; p < below; ++p) torque_[p] -= friction_;
        points_ += 2;
    }
};

}  // namespace endopilot
