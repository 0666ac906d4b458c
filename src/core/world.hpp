// Worlds at rest between samples: their numbers, their pose, how they start and what is recorded of them.
#pragma once

#include <cmath>
#include <cstddef>

#include "interface.hpp"

namespace endopilot {

constexpr double kResultantLength = 2.0;  // mm of wire whose forces of the wall are added up: nodes may share one contact

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
        kForemost,                     // 1: its tip is
        kDriveRotation,                // rad; ahead of kRotation by the twist between drive and ostium
        kChain,                        // rotations of the nodes between them, rad
        kDeviceSize = kChain + kSections
    };
    // of a node: last increments of position and rotation; the contact points at the node and at the middle of the element behind it
    static constexpr int kX = 0, kQ = 3, kLast = 7, kLastTurn = 10, kAtNode = 13, kAtMiddle = 24, kNodeSize = 35;
    // of a contact point: friction limit, wall normal, spin arm; normal force, N; offset of the curve from the polygon, mm
    static constexpr int kLimit = 0, kNormal = 1, kSpinArm = 4, kNormalForce = 7, kOffset = 8;

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
ENDOPILOT_DEVICE inline void write(double* to, const Vec3<double>& v) { write(World::Numbers{to, 1}, v); }
ENDOPILOT_DEVICE inline void write(double* to, const Quaternion<double>& q) { write(World::Numbers{to, 1}, q); }

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

// A run: what all its worlds have in common, the worlds, and what goes in and out.
struct Run {
    Scene scene;
    Worlds worlds;
    Inputs in;
    Outputs out;
};

// Puts a world at the ostium, straight, ready to be pushed in before its first sample. `initial` holds inserted length (mm) and rotation
// (rad) of each device then, `friction` the coefficient of each. The foremost is pushed at the approach velocity, the others arrive with it.
inline void start_world(const Scene& scene, const World& w, const double* initial, const double* friction, double sample_period) {
    const double speed = scene.options.approach_velocity;
    double depth = initial[0];
    for (int k = 1; k < w.devices; ++k) depth = std::max(depth, initial[2 * k]);
    const double inserted = speed > 0 ? 0.0 : depth;
    for (std::size_t k = 0; k < World::size(scene.rod.nodes, w.devices); ++k) w.values[std::ptrdiff_t(k) * w.stride] = 0.0;
    w[World::kInserted] = inserted;
    w[World::kApproach] = speed > 0 ? std::ceil(depth / (speed * sample_period)) + 1 : 0.0;
    w[World::kStride] = kTicks;
    w[World::kActive] = Base::count_active(scene.rod, inserted, scene.options.free_behind);
    for (int k = 0; k < w.devices; ++k) {
        const World::Numbers device = w.device(k);
        device[World::kLength] = speed > 0 ? 0.0 : initial[2 * k];
        device[World::kDepth] = initial[2 * k];
        device[World::kRotation] = initial[2 * k + 1];
        device[World::kFriction] = friction[k];
        device[World::kFeed] = 1.0;
        device[World::kDriveRotation] = initial[2 * k + 1];
        for (int i = 0; i < kSections; ++i) device[World::kChain + i] = initial[2 * k + 1];
    }
    const Base base = scene.motion.cycles > 0 ? scene.base.moved(placement(scene.motion, w[World::kTime])) : scene.base;
    for (int i = 0; i < w.active(); ++i) {
        write(w.node(i) + World::kX, base.position(scene.rod, i, inserted));
        write(w.node(i) + World::kQ, base.attitude(initial[1]));
        for (int k = 1; k < w.devices; ++k) w.twists(scene.rod.nodes, i)[k - 1] = initial[2 * k + 1] - initial[1];
    }
}

// Whether a wire's middle has left the lumen of a vessel that does not give way. The wall then holds it on both sides of a septum, and
// pushes itself apart through the wire, whatever the drive does.
ENDOPILOT_DEVICE inline bool through_wall(const Scene& scene, const World& w) {
    if (scene.options.foundation != 0) return false;
    for (int i = 0; i < w.active(); ++i) {
        const double most = scene.options.wall_stiffness * scene.rod.radius[i];
        const World::Numbers node = w.node(i);
        if (node[World::kAtNode + World::kNormalForce] > most || node[World::kAtMiddle + World::kNormalForce] > most) return true;
    }
    return false;
}

// Outputs that are numbers of a world's device as they are: the output and the number. Python can also read them between runs.
#define ENDOPILOT_DEVICE_NUMBERS(NUMBER)                                                                          \
    NUMBER(inserted_length, kLength) NUMBER(rotation, kRotation)                                                  \
    NUMBER(base_force, kBaseForce) NUMBER(base_torque, kBaseTorque)                                               \
    NUMBER(drive_force, kDriveForce) NUMBER(drive_torque, kDriveTorque)                                           \
    NUMBER(slip, kSlip) NUMBER(rotation_slip, kRotationSlip)

// Records a world at the end of a sample.
ENDOPILOT_LARGE inline void record(const Run& run, int world, int sample, double iterations, double node_iterations) {
    const RodModel& rod = run.scene.rod;
    const Outputs& out = run.out;
    const World w = run.worlds[std::size_t(world)];
    const std::size_t at = std::size_t(world) * run.in.samples + sample;
    const int active = w.active();
    double largest = 0, sum = 0, resultant = 0;
    // Contact points from tip to base: 2 i is node i, 2 i + 1 the middle of the element behind it.
    const auto point = [&](int p) { return w.node(p / 2) + (p % 2 ? World::kAtMiddle : World::kAtNode); };
    const auto abscissa = [&](int p) { return p % 2 ? Base::middle(rod, p / 2) : rod.abscissa[p / 2]; };
    for (int i = 0; i < active; ++i) {
        largest = std::max(largest, w.force(i));
        sum += w.force(i);
    }
    for (int p = 0; p < 2 * active; ++p) {
        if (point(p)[World::kNormalForce] == 0) continue;
        Vec3<double> all{0, 0, 0};
        for (int o = p; o < 2 * active && abscissa(o) <= abscissa(p) + kResultantLength; ++o)
            all += point(o)[World::kNormalForce] * vec3(point(o) + World::kNormal);
        resultant = std::max(resultant, dot(all, all));
    }
    out.contact_force_max[at] = largest;
    out.contact_force_sum[at] = sum;
    out.wall_force[at] = std::sqrt(resultant);
    out.iterations[at] = iterations;
    out.node_iterations[at] = node_iterations;
    out.valid[at] = w.valid();
    const Pose pose(run.scene, w);
    for (int k = 0; k < w.devices; ++k) {
        const std::size_t here = at * w.devices + k;
        const World::Numbers device = w.device(k);
#define NUMBER(name, quantity) out.name[here] = device[World::quantity];
        ENDOPILOT_DEVICE_NUMBERS(NUMBER)
#undef NUMBER
        write(out.tip_position + 3 * here, pose.tip(k));
        write(out.tip_direction + 3 * here, pose.tip_direction(k));
        out.tip_twist[here] = 0;
        if (k == 0) continue;
        const int i = device_end(rod, w, k).element;
        out.tip_twist[here] = i < active ? w.twists(rod.nodes, i)[k - 1] : device[World::kRotation] - w.device(0)[World::kRotation];
    }
    for (int i = 0; i < rod.nodes && (out.shape || out.attitude); ++i) {
        if (out.shape) write(out.shape + 3 * (at * rod.nodes + i), pose.position(i));
        if (out.attitude) write(out.attitude + 4 * (at * rod.nodes + i), pose.attitude(i));
    }
}

}  // namespace endopilot
