// The core's interface: options, the base of the wire, the drives' limits, loads, inputs and outputs.
#pragma once

#include <algorithm>
#include <cmath>
#include <cstddef>
#include <cstdint>
#include <functional>
#include <memory>

#include "lumen.hpp"
#include "motion.hpp"
#include "rod.hpp"
#include "transmission.hpp"
#include "tubes.hpp"

namespace endopilot {

// Every option, once: its type, name and unit, and what it is. The struct, the Python class and `_core.OPTIONS` are made of this table.
#define ENDOPILOT_OPTIONS(OPTION)                                                                                                      \
    OPTION(double, stick_velocity, "mm/s", "slip velocity below which friction falls off")                                             \
    OPTION(double, wall_stiffness, "N/mm", "of the wall at a contact point")                                                           \
    OPTION(double, foundation, "N/mm²", "of a compliant wall, for each mm of wire; 0: the wall has wall_stiffness")                    \
    OPTION(double, foundation_stiffening, "1/mm²", "a compliant wall gives way by d to foundation × d exp(stiffening × d²)")           \
    OPTION(double, foundation_at_tip, "mm", "length of the compliant wall that the tip displaces beyond its own")                      \
    OPTION(double, tolerance, "mm, rad", "a step has converged when Newton's step moves and turns no node farther")                    \
    OPTION(double, sample_tolerance, "mm, rad", "the same for the step that ends a sample: its forces are recorded")                   \
    OPTION(double, largest_step, "mm, rad", "motion of a node that one Newton step is clamped to")                                     \
    OPTION(double, largest_jump, "mm, rad", "motion of a node in a step beyond the drive's, above which the step is shortened")        \
    OPTION(int, max_iterations, "", "of one step; then it is halved (the shortest may take kSnapIterations times as many)")            \
    OPTION(double, free_behind, "mm", "nodes farther than this behind the ostium follow the drive")                                    \
    OPTION(double, approach_velocity, "mm/s", "of a device on its way to its first inserted length; 0: it starts there")               \
    OPTION(double, introducer_friction, "N", "Coulomb friction of the introducer's valve")                                             \
    OPTION(double, introducer_drag, "N s/mm", "viscous drag of the introducer's valve")

struct Options {
#define OPTION(Type, name, unit, meaning) Type name;
    ENDOPILOT_OPTIONS(OPTION)
#undef OPTION
};

// The devices, from the inside out, and where their drives slip rather than push, pull (N) or turn (N mm) harder.
struct Drives {
    int count = 1;
    double push[kMostDevices]{}, pull[kMostDevices]{}, torque[kMostDevices]{};
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
    Drives drives;
    Tubes tubes{};
    Motion motion{};
    Transmission transmission{};
};

struct OwnedScene {
    Rod rod;
    std::shared_ptr<const LumenMap> lumen;       // may be null
    std::shared_ptr<const OwnedLoads> loads;     // may be null
    Base base;
    Options options;
    Drives drives;
    std::shared_ptr<const OwnedTubes> tubes{};   // null for a wire alone; else the rod is the mesh that they share
    std::shared_ptr<const OwnedMotion> motion{};  // null for a vessel that lies still
    std::shared_ptr<const OwnedTransmission> transmission{};   // null where drives act at the ostium
};

template <class Place>
Scene view(const OwnedScene& scene, const Place& place) {
    return {.rod = view(scene.rod, place),
            .lumen = scene.lumen ? view(*scene.lumen, place) : Lumen{},
            .loads = scene.loads ? view(*scene.loads, place) : Loads{},
            .base = scene.base,
            .options = scene.options,
            .drives = scene.drives,
            .tubes = scene.tubes ? view(*scene.tubes, place) : Tubes{},
            .motion = scene.motion ? view(*scene.motion, place) : Motion{},
            .transmission = scene.transmission ? view(*scene.transmission, place) : Transmission{}};
}

constexpr int kTicks = 64;   // of a time step, which may be halved down to one

// The inputs of one run: samples of equal length, each with one control for each world.
struct Inputs {
    int worlds, samples, steps_per_sample;
    double time_step;         // s
    bool force_driven;        // controls are an axial force and a torque on the wire, not velocities
    const double* control;    // worlds × samples × devices × 2: mm/s and rad/s, or N and N mm

    ENDOPILOT_DEVICE double seconds(int ticks) const { return time_step * ticks / kTicks; }
    ENDOPILOT_DEVICE double sample_period() const { return time_step * steps_per_sample; }
};

// Called while a run goes on, with how many samples have ended since the last call. Where it throws, the run ends.
using Progress = std::function<void(long)>;

enum Reason : std::uint8_t { kFine = 0, kNotFinite = 1, kNotConverged = 2, kThroughWall = 3 };

// What an output has an entry of at each sample; `start`: of each device, once a run. Nodes and elements only where they are asked for.
enum class Of { sample, device, node, element, start };

// Every output of a run, once: its type and name, what it has entries of and the numbers of one, its unit, and what it is. The arrays of
// `Outputs`, their allocation here and on a GPU, and `OUTPUTS` in Python are made of this table; of that, the columns of files and tables
// (`simulation/signals.py`). Devices count from the inside out. The 2 mm of wall_force are kResultantLength.
#define ENDOPILOT_OUTPUTS(OUTPUT)                                                                                                   \
    OUTPUT(double, inserted_length, device, 1, "mm", "Δ, how far the device is inserted")                                           \
    OUTPUT(double, rotation, device, 1, "rad", "φ, by which it is turned where it enters")                                       \
    OUTPUT(double, tip_position, device, 3, "mm", "of its tip, LPS, in the vessel as CT shows it")                                  \
    OUTPUT(double, tip_direction, device, 3, "", "unit vector along the device at its tip")                                         \
    OUTPUT(double, tip_twist, device, 1, "rad", "of its frame at its tip against that of the innermost device there")               \
    OUTPUT(double, base_force, device, 1, "N", "axial force that holds it where it enters, positive when it pushes")                \
    OUTPUT(double, base_torque, device, 1, "N·mm", "torque that holds it there, about its axis")                                    \
    OUTPUT(double, drive_force, device, 1, "N", "axial force of its drive: base_force and what the introducer's valve takes")       \
    OUTPUT(double, drive_torque, device, 1, "N·mm", "torque of its drive, likewise")                                                \
    OUTPUT(double, slip, device, 1, "mm", "advance that was commanded in the period and not made; below 0 where it pulled, or was out")\
    OUTPUT(double, rotation_slip, device, 1, "rad", "rotation that was commanded in the period and not made")                       \
    OUTPUT(double, contact_force_max, sample, 1, "N", "largest force of the wall on one node")                                      \
    OUTPUT(double, contact_force_sum, sample, 1, "N", "sum of the magnitudes of the wall's forces")                                 \
    OUTPUT(double, wall_force, sample, 1, "N", "largest resultant of the wall's forces on any 2 mm of the line that the devices share")\
    OUTPUT(double, iterations, sample, 1, "", "Newton's, mean over the time steps of the period")                                   \
    OUTPUT(double, node_iterations, sample, 1, "", "evaluations of active nodes in the period, those of attempts that were given up too")\
    OUTPUT(bool, valid, sample, 1, "", "false from the sample on in which the world failed")                                        \
    OUTPUT(double, approach_slip, start, 2, "mm, rad", "advance and rotation that the approach did not make")                       \
    OUTPUT(double, shape, node, 3, "mm", "where the nodes are, if that is recorded")                                                \
    OUTPUT(double, attitude, element, 4, "", "of the elements, quaternions w x y z, if they are recorded")

struct Outputs {
#define OUTPUT(Type, name, of, numbers, unit, meaning) Type* name = nullptr;
    ENDOPILOT_OUTPUTS(OUTPUT)
#undef OUTPUT
};

// Calls f(name, array, what it has entries of, numbers of an entry) for every output.
template <class F>
void each_output(Outputs& out, const F& f) {
#define OUTPUT(Type, name, of, numbers, unit, meaning) f(#name, out.name, Of::of, numbers);
    ENDOPILOT_OUTPUTS(OUTPUT)
#undef OUTPUT
}

// Numbers of an output that a world has, for each of its entries' numbers.
inline std::size_t entries(Of of, std::size_t samples, std::size_t devices, std::size_t nodes) {
    switch (of) {
        case Of::device: return samples * devices;
        case Of::node:
        case Of::element: return samples * nodes;
        case Of::start: return devices;
        default: return samples;
    }
}

}  // namespace endopilot
