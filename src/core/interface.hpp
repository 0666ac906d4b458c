// What the core is asked and what it answers: options, the drive's base, loads, inputs and outputs.
#pragma once

#include <cstdint>
#include <vector>

#include "rod.hpp"

namespace endopilot {

struct Options {
    double time_step;          // s
    int steps_per_sample;
    double stick_velocity;     // slip velocity below which friction falls off, mm/s
    double wall_stiffness;     // N/mm
    double tolerance;          // largest displacement of a last Newton step, mm (rotations: rad)
    double sample_tolerance;   // the same for the step that ends a sample, whose forces are recorded
    double largest_step;       // displacement that one Newton step is clamped to, mm (rotations: rad)
    int most_iterations;       // for one step; then the step is halved, and the shortest may take kPatience times as many
    double free_behind;        // nodes farther behind the ostium than this follow the drive, mm
    double approach_velocity;  // at which a wire is brought to its first inserted length, mm/s
    double push_limit;         // the drive slips rather than push the wire harder than this, N
};

// The guiding catheter: wire enters at `origin` along the third director of `orientation`.
struct Base {
    Vec3<double> origin;
    Quaternion<double> orientation;
};

// Dead loads and springs for verification: arrays of one entry a node, or of an element where they act on rotations.
struct Loads {
    std::vector<Vec3<double>> force;           // N
    std::vector<Vec3<double>> moment;          // in the element's axes, N mm
    std::vector<Vec3<double>> spring;          // N/mm along the world's axes, towards `anchor`
    std::vector<Vec3<double>> anchor;          // mm
    std::vector<double> hold;                  // N mm/rad, towards `attitude`
    std::vector<Quaternion<double>> attitude;
};

struct Inputs {
    int worlds, samples;
    const double* initial;    // worlds × 2: inserted length mm, rotation rad
    const double* control;    // worlds × samples × 2: mm/s, rad/s
    const double* friction;   // worlds
};

enum Reason : std::uint8_t { kFine = 0, kNotFinite = 1, kNotConverged = 2 };

// Arrays of worlds × samples (× 3, × nodes × 3). `slip` is the advance (mm) that was asked for and not made, and
// `approach_slip` that before the first sample.
struct Outputs {
    double *tip_position, *tip_direction, *force_max, *force_sum, *base_force, *base_torque, *iterations, *slip;
    bool* valid;
    double* approach_slip;    // worlds
    std::uint8_t* reason;     // worlds
    double* shape;            // may be null
    double* attitude;         // may be null: worlds × samples × nodes × 4, quaternions w x y z
};

}  // namespace endopilot
