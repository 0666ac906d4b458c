// The core's interface: options, the base of the wire, loads, inputs and outputs.
#pragma once

#include <algorithm>
#include <cmath>
#include <cstddef>
#include <cstdint>
#include <memory>

#include "lumen.hpp"
#include "motion.hpp"
#include "rod.hpp"
#include "tubes.hpp"

namespace endopilot {

struct Options {
    double stick_velocity;     // slip velocity below which friction falls off, mm/s
    double wall_stiffness;     // of a contact point, N/mm
    double foundation;         // of a compliant wall, for each mm of wire, N/mm²: in place of it where not 0
    double foundation_stiffening;  // the compliant wall yields by d to foundation × d exp(stiffening × d²), 1/mm²
    double tip_takes_along;    // length of the compliant wall that the tip displaces beyond its own, mm
    double tolerance;          // a step has converged when Newton's step moves no node farther, mm (rotations: rad)
    double sample_tolerance;   // the same for the step that ends a sample: its forces are recorded
    double largest_step;       // displacement that one Newton step is clamped to, mm (rotations: rad)
    double largest_jump;       // motion of a node in a time step beyond the drive's, mm (rotations: rad); the step is shortened
    int max_iterations;        // of one step; then the step is halved (the shortest may take kSnapIterations times as many)
    double free_behind;        // nodes farther than this behind the ostium follow the drive, mm
    double approach_velocity;  // at which a wire is brought to its first inserted length, mm/s; 0: it is put there, straight
    double push_limit, pull_limit;  // the drive slips rather than push or pull the wire harder than this, N
    double torque_limit;       // it slips rather than turn the wire harder than this, N mm
    double introducer_friction;  // Coulomb friction of the introducer's valve, N
    double introducer_drag;      // its viscous drag, N s/mm
};

// The guiding catheter: wire enters at `origin` along the third director of `orientation`. Nodes more than
// `free_behind` mm behind the origin follow the drive exactly.
struct Base {
    Vec3<double> origin;
    Quaternion<double> orientation;

    // The catheter once the vessel has moved there.
    ENDOPILOT_DEVICE Base moved(const Placement& vessel) const {
        return {vessel.to_laboratory(origin), vessel.rotation * orientation};
    }

    // Where node i of a wire of some inserted length lies if it follows the drive.
    ENDOPILOT_DEVICE Vec3<double> position(const RodModel& rod, int i, double inserted) const {
        return origin + (inserted - rod.abscissa[i]) * frame(orientation).d3;
    }

    ENDOPILOT_DEVICE Quaternion<double> attitude(double rotation) const {
        return orientation * Quaternion<double>{std::cos(0.5 * rotation), {0, 0, std::sin(0.5 * rotation)}};
    }

    // The number of active nodes, which do not follow the drive: the middle of their element is ahead of the point
    // `free_behind` mm behind the origin. One at least, and all but two at most.
    ENDOPILOT_DEVICE static int count_active(const RodModel& rod, double inserted, double free_behind) {
        int n = 1;
        while (n < rod.nodes - 2 && inserted - middle(rod, n) + free_behind > 0) ++n;
        return n;
    }

    // The share (0 to 1) of the joint between the last active element and the first that follows the drive that lies ahead
    // of that point: the joint is freed gradually, since freeing a whole node at once would jolt the wire.
    ENDOPILOT_DEVICE static double share_of_last_joint(const RodModel& rod, double inserted, double free_behind, int active) {
        const double ahead = middle(rod, active - 1), behind = middle(rod, active);
        return std::clamp((inserted - ahead + free_behind) / (behind - ahead), double{kLeastShare}, 1.0);
    }

    ENDOPILOT_DEVICE static double middle(const RodModel& rod, int element) { return rod.abscissa[element] + 0.5 * rod.length[element]; }

private:
    static constexpr double kLeastShare = 1e-3;  // so that the joint's stiffness stays finite
};

// Dead loads and springs for verification: arrays of one entry a node, or of an element where they act on rotations.
template <template <class> class Array>
struct LoadArrays {
    Array<Vec3<double>> force{};           // N
    Array<Vec3<double>> moment{};          // in the element's axes, N mm
    Array<Vec3<double>> spring{};          // N/mm along the world's axes, towards `anchor`
    Array<Vec3<double>> anchor{};          // mm
    Array<double> hold{};                  // N mm/rad, towards `attitude`
    Array<Quaternion<double>> attitude{};
};

using OwnedLoads = LoadArrays<Owned>;
using Loads = LoadArrays<Viewed>;   // no loads if it refers to nothing

// `place` puts a vector where the stepper reads it, and returns its address there.
template <class Place>
Loads view(const OwnedLoads& loads, const Place& place) {
    return {.force = place(loads.force),
            .moment = place(loads.moment),
            .spring = place(loads.spring),
            .anchor = place(loads.anchor),
            .hold = place(loads.hold),
            .attitude = place(loads.attitude)};
}

// What all worlds of a run have in common, as views.
struct Scene {
    RodModel rod;
    Lumen lumen;
    Loads loads;
    Base base;
    Options options;
    Tubes tubes{};
    Motion motion{};
};

struct OwnedScene {
    Rod rod;
    std::shared_ptr<const LumenMap> lumen;       // may be null
    std::shared_ptr<const OwnedLoads> loads;     // may be null
    Base base;
    Options options;
    std::shared_ptr<const OwnedTubes> tubes{};   // null for a wire alone; else the rod is the mesh that they share
    std::shared_ptr<const OwnedMotion> motion{};  // null for a vessel that lies still
};

template <class Place>
Scene view(const OwnedScene& scene, const Place& place) {
    return {.rod = view(scene.rod, place),
            .lumen = scene.lumen ? view(*scene.lumen, place) : Lumen{},
            .loads = scene.loads ? view(*scene.loads, place) : Loads{},
            .base = scene.base,
            .options = scene.options,
            .tubes = scene.tubes ? view(*scene.tubes, place) : Tubes{},
            .motion = scene.motion ? view(*scene.motion, place) : Motion{}};
}

// The inputs of one run: samples of equal length, each with one control for each world.
struct Inputs {
    int samples, steps_per_sample;
    double time_step;         // s
    bool force_driven;        // controls are an axial force and a torque on the wire, not velocities
    const double* control;    // worlds × samples × 2 (of each tube): mm/s and rad/s, or N and N mm
};

enum Reason : std::uint8_t { kFine = 0, kNotFinite = 1, kNotConverged = 2, kThroughWall = 3 };

// Arrays of worlds × samples (× 3, × nodes × 3). `slip` is the commanded advance (mm) that was not made, `rotation_slip`
// the commanded rotation (rad), and `approach_slip` (worlds × 2) both before the first sample. `iterations` are Newton's, a
// step; `node_iterations` count every evaluation of an active node, those of attempts that were given up too.
struct Outputs {
    double *inserted, *rotation;                 // mm, rad
    double *tip_position, *tip_direction;        // mm, unit vector
    double *force_max, *force_sum;               // of the wall on a node, N
    double* wall_force;                          // largest resultant on any kResultantLength of the wire, N
    double *base_force, *base_torque;            // of the base on the wire, forwards positive, N, N mm
    double *drive_force, *drive_torque;          // of the drive: that of the base and the introducer's resistance, N, N mm
    double *iterations, *node_iterations, *slip, *rotation_slip;
    bool* valid;
    double* approach_slip;
    double* shape;            // may be null
    double* attitude;         // may be null: worlds × samples × nodes × 4, quaternions w x y z
    double* tubes = nullptr;  // may be null: worlds × samples × tubes × kTubeOutputs
};

// Numbers recorded of each tube: advance (mm) and rotation (rad), force (N) and torque (N mm) of the base on it, of its drive, advance and
// rotation that were asked and not made, where its tip is, mm, and its twist against tube 0 there, rad.
constexpr int kTubeOutputs = 12;

// Calls f(array, numbers for each world) for every array that is recorded.
template <class F>
void each_array(Outputs& out, std::size_t samples, std::size_t nodes, const F& f) {
    for (double** array : {&out.inserted, &out.rotation, &out.force_max, &out.force_sum, &out.wall_force, &out.base_force,
                           &out.base_torque, &out.drive_force, &out.drive_torque, &out.iterations, &out.node_iterations, &out.slip,
                           &out.rotation_slip})
        f(*array, samples);
    f(out.tip_position, 3 * samples);
    f(out.tip_direction, 3 * samples);
    f(out.valid, samples);
    f(out.approach_slip, std::size_t(2));
    if (out.shape) f(out.shape, 3 * samples * nodes);
    if (out.attitude) f(out.attitude, 4 * samples * nodes);
}

}  // namespace endopilot
