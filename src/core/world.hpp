// Worlds at rest between samples.
#pragma once

#include <cmath>
#include <cstddef>

#include "interface.hpp"

namespace endopilot {

// A view of all that a world's future depends on, as plain numbers: saved and restored bit by bit. Positions and attitudes are
// those at the end of the last step; node quantities are meaningful for the `active` nodes ahead of the base.
struct World {
    enum Scalar {
        kInserted,                     // of the foremost device, mm
        kByForce,                      // the last controls were N and N mm
        kLastDuration, kLastAdvance,   // of the last step, s, mm
        kStride, kActive, kReason,
        kSlipping,                     // 1: the drive of the foremost device slips at its limit forwards, -1: backwards, 0: it holds
        kApproach,                     // samples left of the approach
        kTime,                         // since the reset, s; the vessel stands still in the approach
        kScalars
    };
    // of each device, from the inside out
    enum DeviceQuantity {
        kLength, kRotation,            // inserted length, mm, and rotation, rad
        kSpeed, kSpin,                 // the last control: mm/s and rad/s, or N and N mm
        kLastTurned,                   // in the last step, rad
        kFriction,
        kTurnSlipping,                 // whether its drive slips at its limit of torque, as kSlipping
        kBaseForce, kBaseTorque, kDriveForce, kDriveTorque,  // N, N mm
        kSlip, kRotationSlip,          // commanded in the last sample and not made, mm, rad
        kDepth,                        // inserted length that the approach ends at, mm
        kFeed,                         // share of the commanded motion that a drive makes after it was at its limit
        kMobilized,                    // friction along the device around it, as a share of its most
        kBackdrive,                    // mm/s by which a drive beyond its limit gives way
        kLeads,                        // 1: its tip is the foremost
        kDeviceSize
    };
    // last increments of position and rotation; the contact points at the node and at the middle of the element behind it
    enum NodeQuantity { kX = 0, kQ = 3, kLast = 7, kLastTurn = 10, kAtNode = 13, kAtMiddle = 24, kNodeSize = 35 };
    // of a contact point: friction limit, wall normal, spin arm; normal force, N; offset of the curve from the polygon, mm
    enum PointQuantity { kLimit = 0, kNormal = 1, kSpinArm = 4, kNormalForce = 7, kOffset = 8 };

    // Numbers `stride` apart.
    struct Numbers {
        double* first;
        std::ptrdiff_t stride;
        ENDOPILOT_DEVICE double& operator[](int k) const { return first[k * stride]; }
        ENDOPILOT_DEVICE Numbers operator+(int k) const { return {first + k * stride, stride}; }
    };

    double* values;
    std::ptrdiff_t stride;
    int devices;

    // After the scalars come all devices, the nodes, then, with catheters, the twists of each node.
    static std::size_t size(int nodes, int devices) {
        return kScalars + std::size_t(devices) * kDeviceSize + std::size_t(nodes) * (kNodeSize + (devices > 1 ? twist_size(devices) : 0));
    }
    ENDOPILOT_DEVICE double& operator[](Scalar s) const { return values[s * stride]; }
    ENDOPILOT_DEVICE Numbers device(int k) const { return Numbers{values, stride} + (kScalars + k * kDeviceSize); }
    ENDOPILOT_DEVICE Numbers node(int i) const { return device(devices) + i * kNodeSize; }
    // Of node i, for the catheters: twists, their last increments, limits of friction between devices; all devices' rates of twist.
    ENDOPILOT_DEVICE Numbers twists(int nodes, int i) const { return node(nodes) + i * int(twist_size(devices)); }
    static constexpr std::size_t twist_size(int devices) { return 4 * std::size_t(devices) - 3; }
    ENDOPILOT_DEVICE int active() const { return int((*this)[kActive]); }
    // Force of the wall at node i and at the middle of the element behind it, N.
    ENDOPILOT_DEVICE double force(int i) const {
        return node(i)[kAtNode + kNormalForce] + node(i)[kAtMiddle + kNormalForce];
    }
    ENDOPILOT_DEVICE bool valid() const { return (*this)[kReason] == double(kFine); }
};

ENDOPILOT_DEVICE inline Vec3<double> vec3(const World::Numbers& p) { return {p[0], p[1], p[2]}; }
ENDOPILOT_DEVICE inline Quaternion<double> quaternion(const World::Numbers& p) { return {p[0], vec3(p + 1)}; }
ENDOPILOT_DEVICE inline void write(const World::Numbers& to, const Vec3<double>& v) { to[0] = v.x, to[1] = v.y, to[2] = v.z; }
ENDOPILOT_DEVICE inline void write(const World::Numbers& to, const Quaternion<double>& q) { to[0] = q.w, write(to + 1, q.v); }

// Where device k ends: in element `element`, at `share` of its length from its distal node.
struct DeviceEnd {
    int element;
    double share;
};
ENDOPILOT_DEVICE inline DeviceEnd device_end(const RodModel& rod, const World& w, int k) {
    const double behind = w[World::kInserted] - w.device(k)[World::kLength];
    int i = 0;
    while (i < rod.nodes - 2 && rod.abscissa[i + 1] < behind) ++i;
    return {i, (behind - rod.abscissa[i]) / rod.length[i]};
}

// A world's wire as it is reported: in the vessel as CT shows it, wherever the vessel has moved.
class Pose {
public:
    ENDOPILOT_DEVICE Pose(const Scene& scene, const World& world) : Pose(scene.rod, scene.base, scene.motion, world) {}
    ENDOPILOT_DEVICE Pose(const RodModel& rod, const Base& base, const Motion& motion, const World& world)
        : rod_(rod), world_(world), moves_(motion.cycles > 0), base_(base) {
        if (!moves_) return;
        vessel_ = placement(motion, world[World::kTime]);
        base_ = base.moved(vessel_);
    }

    // Where the wire's curve passes node i: beside the polygon's node.
    ENDOPILOT_DEVICE Vec3<double> position(int i) const {
        const Vec3<double> x = i >= world_.active() ? base_.position(rod_, i, world_[World::kInserted])
                                                    : vec3(world_.node(i) + World::kX) + vec3(world_.node(i) + (World::kAtNode + World::kOffset));
        return moves_ ? vessel_.to_vessel(x) : x;
    }

    // The element's attitude in the vessel, which turns with the vessel's rotation.
    ENDOPILOT_DEVICE Quaternion<double> attitude(int i) const {
        const Quaternion<double> q = in_laboratory(i);
        return moves_ ? relative(vessel_.rotation, q) : q;
    }

    ENDOPILOT_DEVICE Vec3<double> tip(int k) const {
        const DeviceEnd end = device_end(rod_, world_, k);
        const Vec3<double> ahead = position(end.element);
        return ahead + end.share * (position(end.element + 1) - ahead);
    }

    // Device k's direction where it ends: behind the foremost tip, that of the element there. The first element, of length l, has the
    // direction at its middle; the tip's offset from the polygon is l²/8 times the curvature vector.
    ENDOPILOT_DEVICE Vec3<double> tip_direction(int k) const {
        const DeviceEnd end = device_end(rod_, world_, k);
        const bool foremost = end.element == 0 && end.share <= 0;
        Vec3<double> direction = frame(in_laboratory(end.element)).d3;
        if (foremost && world_.active() > 0) direction += (4 / rod_.length[0]) * vec3(world_.node(0) + (World::kAtNode + World::kOffset));
        return foremost || moves_ ? unit_in_vessel(direction) : direction;
    }

private:
    const RodModel& rod_;
    const World world_;
    const bool moves_;
    Base base_;
    Placement vessel_{};

    ENDOPILOT_DEVICE Vec3<double> unit_in_vessel(Vec3<double> direction) const {
        if (moves_) direction = vessel_.shrink * turn_back(vessel_.rotation, direction);
        return (1 / std::sqrt(dot(direction, direction))) * direction;
    }

    ENDOPILOT_DEVICE Quaternion<double> in_laboratory(int i) const {
        return i < world_.active() ? quaternion(world_.node(i) + World::kQ) : base_.attitude(world_.device(0)[World::kRotation]);
    }
};

// All worlds of a run, `between_worlds` and `between_numbers` numbers apart. A processor keeps each world's numbers side by
// side (the default); a GPU, whose neighbouring threads step neighbouring worlds, keeps side by side the same number of all.
struct Worlds {
    double* values;
    std::ptrdiff_t between_worlds, between_numbers;
    int devices;

    ENDOPILOT_DEVICE World operator[](std::size_t world) const {
        return {values + std::ptrdiff_t(world) * between_worlds, between_numbers, devices};
    }
};

}  // namespace endopilot
