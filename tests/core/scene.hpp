// A scene for the core's C++ tests: a wire, alone or in catheters, in a tube that bends.
#pragma once

#include <cmath>
#include <memory>
#include <vector>

#include "interface.hpp"
#include "spline.hpp"

namespace endopilot {

// A uniform wire with a bent tip.
inline Rod make_rod(int nodes) {
    Rod rod{.nodes = nodes};
    for (int i = 0; i < nodes; ++i) rod.abscissa.push_back(0.9 * i);
    rod.length.assign(nodes, 0.9), rod.joint_length.assign(nodes, 0.9);
    rod.shear.assign(nodes, 200.0), rod.stretch.assign(nodes, 500.0);
    rod.bend.assign(nodes, 4.0), rod.twist.assign(nodes, 3.0);
    rod.radius.assign(nodes, 0.18), rod.drag.assign(nodes, 1e-3), rod.spin_drag.assign(nodes, 1e-4);
    for (int i = 0; i < nodes; ++i) rod.rest.push_back({i < 6 ? 0.15 : 0.0, 0, 0});
    return rod;
}

// A tube of 1.5 mm radius: straight along x up to the origin, then a quarter of a circle of 18 mm radius towards z.
struct Map {
    int size[3] = {73, 14, 62};
    double origin[3] = {-8.2, -2.6, -2.6}, spacing = 0.4;
    std::vector<float> coefficients;   // of the spline through it, x fastest
};
inline Map make_map() {
    Map map;
    std::vector<float> values;
    for (int k = 0; k < map.size[2]; ++k)
        for (int j = 0; j < map.size[1]; ++j)
            for (int i = 0; i < map.size[0]; ++i) {
                const double x = map.origin[0] + map.spacing * i, y = map.origin[1] + map.spacing * j, z = map.origin[2] + map.spacing * k;
                const double off = x < 0 ? z : std::hypot(x, z - 18.0) - 18.0;
                values.push_back(float(1.5 - std::hypot(off, y)));
            }
    map.coefficients = spline_coefficients(values.data(), map.size);
    return map;
}
inline LumenMap make_lumen() {
    const Map map = make_map();
    return make_lumen_map(map.coefficients.data(), map.size, map.origin, map.spacing, 0.6, 0.5);
}

// Dead forces on the tip, and a weak spring.
inline OwnedLoads make_loads(std::size_t nodes) {
    OwnedLoads loads{.force = {}, .moment = {}, .spring = {}, .anchor = {}, .hold = {}, .attitude = {}};
    loads.force.assign(nodes, {0, 0, 0}), loads.moment.assign(nodes, {0, 0, 0}), loads.spring.assign(nodes, {1e-3, 0, 1e-3});
    loads.anchor.assign(nodes, {5, 0, 2}), loads.hold.assign(nodes, 0.0), loads.attitude.assign(nodes, {1, {0, 0, 0}});
    loads.force[0] = {0, 1e-3, 0};
    return loads;
}

// Shifts, turns and shrinks by a few per cent and back in 0.8 s.
inline OwnedMotion make_motion() {
    OwnedMotion motion{.cycles = 1, .knots = 8, .ostium = {-3.0, 0.0, 0.0}, .coefficients = {}};
    motion.period[0] = 0.8;
    const double most[OwnedMotion::kNumbers] = {3, -2, 1, 0.1, 0.05, -0.1, -0.05, -0.03, -0.04, 0.01, 0, 0.02};
    for (int k = 0; k < motion.knots; ++k)
        for (double number : most) motion.coefficients.push_back(number * (1 - std::cos(2 * std::acos(-1.0) * k / motion.knots)) / 2);
    return motion;
}

// A wire with a bent tip, and catheters around it: profiles are integrals from the tip, 0.5 mm apart.
inline OwnedTubes make_tubes(int devices) {
    OwnedTubes tubes{.tubes = devices, .points = 100, .spacing = 0.5, .shear_share = 0.4};
    for (int k = 0; k < devices; ++k) {
        for (int i = 0; i < tubes.points; ++i) {
            const double at = tubes.spacing * i;
            tubes.bend.push_back((4.0 + 3 * k) * at), tubes.twist.push_back((3.0 + 2 * k) * at), tubes.stretch.push_back(500.0 * at);
            tubes.rest.push_back((k == 0 ? 0.15 : 0.05) * std::min(at, 6.0));
        }
        tubes.radius.push_back(0.18 + 0.15 * k), tubes.bore_friction.push_back(k == 0 ? 0.0 : 0.1);
    }
    return tubes;
}

// A hundred millimetres of each device between drive and ostium.
inline OwnedTransmission make_transmission(int devices) {
    OwnedTransmission made{.points = 3, .spacing = 80.0};
    for (int k = 0; k < devices; ++k) {
        made.length[k] = 100.0, made.friction[k] = 1e-3;
        for (int i = 0; i < made.points; ++i) made.compliance.push_back(made.spacing * i / (3.0 + 2 * k));
    }
    return made;
}

inline OwnedScene make_scene(int devices, bool with_loads, bool moving = false, bool chained = false) {
    const double half = std::sqrt(0.5);
    OwnedScene scene{.rod = make_rod(40),
                     .lumen = std::make_shared<LumenMap>(make_lumen()),
                     .loads = with_loads ? std::make_shared<OwnedLoads>(make_loads(40)) : nullptr,
                     .base = {.origin = {-3.0, 0.0, 0.0}, .orientation = {half, {0, half, 0}}},
                     .options = {.stick_velocity = 0.05, .wall_stiffness = 100.0, .foundation = 0.0, .foundation_stiffening = 0.0, .foundation_at_tip = 0.0, .tolerance = 1e-3, .sample_tolerance = 1e-6,
                                 .largest_step = 0.3, .largest_jump = 0.1, .max_iterations = 400, .free_behind = 3.0,
                                 .approach_velocity = 20.0, .introducer_friction = 0.05, .introducer_drag = 0.002},
                     .drives = {.count = devices},
                     .tubes = devices > 1 ? std::make_shared<OwnedTubes>(make_tubes(devices)) : nullptr,
                     .motion = moving ? std::make_shared<OwnedMotion>(make_motion()) : nullptr,
                     .transmission = chained ? std::make_shared<OwnedTransmission>(make_transmission(devices)) : nullptr};
    for (int k = 0; k < devices; ++k) scene.drives.push[k] = scene.drives.pull[k] = 0.05, scene.drives.torque[k] = 0.5;
    return scene;
}

}  // namespace endopilot
