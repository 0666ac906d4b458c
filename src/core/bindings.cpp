// Python bindings: numpy in, numpy out.
#include <nanobind/nanobind.h>
#include <nanobind/stl/shared_ptr.h>
#include <nanobind/stl/string.h>
#include <nanobind/stl/vector.h>

#include <memory>

#include "arrays.hpp"
#include "levels.hpp"
#include "projection.hpp"
#include "refined.hpp"
#include "simulation.hpp"
#include "spline.hpp"
#ifdef ENDOPILOT_CUDA
#include "gpu.hpp"
using Processor = endopilot::Gpu;
#else
#include "cpu.hpp"
using Processor = endopilot::Cpu;
#endif

using namespace endopilot;
using Simulations = Simulation<Processor>;

namespace {

// All arrays have one entry a node; entries without a meaning (the last element, the first joint) are ignored.
Rod make_rod(const Array<1>& abscissa, const Array<1>& shear, const Array<1>& stretch, const Array<1>& bend,
                  const Array<1>& twist, const Array<2>& rest, const Array<1>& radius, const Array<1>& drag,
                  const Array<1>& spin_drag) {
    Rod rod;
    rod.nodes = int(abscissa.size());
    const std::size_t n = abscissa.size();
    require(n >= 4, "a rod needs at least four nodes");
    require(shear.size() == n && stretch.size() == n && bend.size() == n && twist.size() == n && rest.shape(0) == n &&
                rest.shape(1) == 3 && radius.size() == n && drag.size() == n && spin_drag.size() == n,
            "every array of a rod needs one entry a node");
    rod.abscissa = values(abscissa);
    rod.shear = values(shear);
    rod.stretch = values(stretch);
    rod.bend = values(bend);
    rod.twist = values(twist);
    rod.rest = vectors(rest);
    rod.radius = values(radius);
    rod.drag = values(drag);
    rod.spin_drag = values(spin_drag);
    rod.length.assign(n, 1.0);
    rod.joint_length.assign(n, 1.0);
    for (std::size_t i = 0; i + 1 < n; ++i) rod.length[i] = rod.abscissa[i + 1] - rod.abscissa[i];
    for (std::size_t i = 1; i + 1 < n; ++i) rod.joint_length[i] = 0.5 * (rod.length[i - 1] + rod.length[i]);
    for (double l : rod.length) require(l > 0, "abscissa must increase");
    return rod;
}

LumenMap make_lumen(const Image& values, const Array<1>& origin, double spacing, double near, double far, int finer, const Array<2>& spheres) {
    require(origin.size() == 3 && spacing > 0, "a lumen needs an origin of three numbers and a positive spacing");
    const int size[3] = {int(values.shape(2)), int(values.shape(1)), int(values.shape(0))};
    require(size[0] > 0 && size[1] > 0 && size[2] > 0, "a lumen needs at least one cell");
    require(finer >= 1 && (finer == 1 || spheres.shape(1) == 8), "a finer lumen needs the ends of its spheres' lines and their radii, 8 numbers");
    const double o[3] = {origin.data()[0], origin.data()[1], origin.data()[2]};
    const std::vector<float> coefficients = spline_coefficients(values.data(), size);
    if (finer == 1) return make_lumen_map(coefficients.data(), size, o, spacing, near, far);
    std::vector<InscribedSpheres> inside;
    for (std::size_t i = 0; i < spheres.shape(0); ++i) {
        const double* s = spheres.data() + 8 * i;
        inside.push_back({{float(s[0]), float(s[1]), float(s[2])}, {float(s[3]), float(s[4]), float(s[5])}, float(s[6]), float(s[7])});
    }
    return refined_lumen_map(coefficients.data(), size, o, spacing, finer, inside, near, far);
}

// The distance to the wall at points, mm; very large where no wall is near, NaN outside the map.
nb::object distance(const LumenMap& map, const Array<2>& points) {
    require(points.shape(1) == 3, "points need three coordinates");
    const std::size_t n = points.shape(0);
    OutputArray<double> found(n);
    const Lumen lumen = view(map, InPlace{});
    for (std::size_t i = 0; i < n; ++i) found.data[i] = distance_to_wall<double>(lumen, vec3(points.data() + 3 * i)).value;
    return found.array(n);
}

OwnedLoads make_loads(const Array<2>& force, const Array<2>& moment, const Array<2>& spring, const Array<2>& anchor,
                 const Array<1>& hold, const Array<2>& attitude) {
    const std::size_t n = force.shape(0);
    require(moment.shape(0) == n && spring.shape(0) == n && anchor.shape(0) == n && hold.size() == n &&
                attitude.shape(0) == n,
            "every array of loads needs one entry a node");
    require(force.shape(1) == 3 && moment.shape(1) == 3 && spring.shape(1) == 3 && anchor.shape(1) == 3 &&
                attitude.shape(1) == 4,
            "loads need three components, attitudes four");
    OwnedLoads loads{.force = vectors(force),
                .moment = vectors(moment),
                .spring = vectors(spring),
                .anchor = vectors(anchor),
                .hold = values(hold),
                .attitude = {}};
    for (std::size_t i = 0; i < n; ++i) loads.attitude.push_back(quaternion(attitude.data() + 4 * i));
    return loads;
}

// A row a tube, the innermost first, of at most three; profiles are integrals from the tip at distances `spacing` apart.
OwnedTubes make_tubes(double spacing, double shear_share, const Array<2>& bend, const Array<2>& twist, const Array<2>& stretch,
                      const Array<2>& rest, const Array<1>& radius, const Array<1>& bore_friction) {
    const std::size_t n = radius.size(), points = bend.shape(1);
    require(n >= 2 && n <= 3, "give two or three tubes");
    require(spacing > 0 && points >= 2, "profiles of tubes need two points at least");
    for (const Array<2>* profile : {&bend, &twist, &stretch, &rest})
        require(profile->shape(0) == n && profile->shape(1) == points, "every profile needs a row a tube");
    require(bore_friction.size() == n, "every array of tubes needs one entry a tube");
    const auto flat = [](const Array<2>& a) { return std::vector<double>(a.data(), a.data() + a.size()); };
    return {.tubes = int(n),
            .points = int(points),
            .spacing = spacing,
            .shear_share = shear_share,
            .bend = flat(bend),
            .twist = flat(twist),
            .stretch = flat(stretch),
            .rest = flat(rest),
            .radius = values(radius),
            .bore_friction = values(bore_friction)};
}

// A row a device, from the inside out: the forces (N) that its drive pushes and pulls with at most, and its torque (N mm).
Drives make_drives(const Array<2>& limits) {
    require(limits.shape(0) >= 1 && limits.shape(0) <= kMostDevices && limits.shape(1) == 3, "drives need three limits for each of up to three devices");
    Drives drives{.count = int(limits.shape(0))};
    for (int k = 0; k < drives.count; ++k) {
        const double* row = limits.data() + 3 * k;
        drives.push[k] = row[0], drives.pull[k] = row[1], drives.torque[k] = row[2];
    }
    return drives;
}

// What a run records: (name, what it has an entry of, numbers of an entry, unit, meaning).
nb::list outputs() {
    nb::list all;
#define OUTPUT(Type, name, of, numbers, unit, meaning) all.append(nb::make_tuple(#name, #of, numbers, unit, meaning));
    ENDOPILOT_OUTPUTS(OUTPUT)
#undef OUTPUT
    return all;
}

// `coefficients`: cycles × knots × numbers.
OwnedMotion make_motion(const Array<1>& ostium, const Array<1>& period, const Array<3>& coefficients) {
    const std::size_t cycles = period.size();
    require(ostium.size() == 3, "a motion needs an ostium of three numbers");
    require(cycles >= 1 && cycles <= OwnedMotion::kMostCycles, "a motion has one or two cycles");
    require(coefficients.shape(0) == cycles && coefficients.shape(1) >= 4 && coefficients.shape(2) == OwnedMotion::kNumbers,
            "every cycle of a motion needs four knots of twelve numbers at least");
    OwnedMotion motion{.cycles = int(cycles),
                       .knots = int(coefficients.shape(1)),
                       .ostium = vec3(ostium.data()),
                       .coefficients = std::vector<double>(coefficients.data(), coefficients.data() + coefficients.size())};
    for (std::size_t c = 0; c < cycles; ++c) motion.period[c] = period.data()[c];
    for (double period : values(period)) require(period > 0, "a cycle of a motion lasts longer than nothing");
    return motion;
}

// The maps of points of the vessel to the laboratory, a row of three by four numbers a time, and the rotations in them.
nb::tuple placements(const OwnedMotion& motion, const Array<1>& times) {
    const std::size_t n = times.size();
    OutputArray<double> maps(12 * n), rotations(4 * n);
    const nb::tuple result = nb::make_tuple(maps.array(n, 3, 4), rotations.array(n, 4));
    for (std::size_t k = 0; k < n; ++k) {
        const Placement vessel = placement(motion, times.data()[k]);
        const Vec3<double> at = vessel.to_laboratory({0, 0, 0});
        const Vec3<double> column[4] = {vessel.to_laboratory({1, 0, 0}) - at, vessel.to_laboratory({0, 1, 0}) - at,
                                        vessel.to_laboratory({0, 0, 1}) - at, at};
        for (std::size_t c = 0; c < 4; ++c) {
            maps.data[12 * k + c] = column[c].x;
            maps.data[12 * k + 4 + c] = column[c].y;
            maps.data[12 * k + 8 + c] = column[c].z;
        }
        const Quaternion<double>& q = vessel.rotation;
        const double numbers[4] = {q.w, q.v.x, q.v.y, q.v.z};
        std::copy_n(numbers, 4, rotations.data + 4 * k);
    }
    return result;
}

// All arrays but those of the catheter have a row a vertex; `rival` and `entry` a column a branch.
Projector make_projector(const Array<2>& point, const Array<2>& tangent, const Array<1>& abscissa, const Array<1>& radius,
                         const Indices<1>& first, const Indices<1>& last, const Indices<1>& branch, const Array<2>& rival,
                         const Indices<2>& entry, const Array<1>& ostium, const Array<1>& axis, double catheter_radius) {
    const std::size_t n = point.shape(0), branches = rival.shape(1);
    require(n > 0 && point.shape(1) == 3 && tangent.shape(0) == n && tangent.shape(1) == 3 && abscissa.size() == n &&
                radius.size() == n && first.size() == n && last.size() == n && branch.size() == n && rival.shape(0) == n &&
                entry.shape(0) == n && entry.shape(1) == branches,
            "every array of a projector needs one row a vertex");
    require(ostium.size() == 3 && axis.size() == 3, "the catheter needs a position and a direction");
    std::vector<Vertex> vertices;
    for (std::size_t v = 0; v < n; ++v)
        vertices.push_back({.point = vec3(point.data() + 3 * v),
                            .tangent = vec3(tangent.data() + 3 * v),
                            .abscissa = abscissa.data()[v],
                            .radius = radius.data()[v],
                            .first = first.data()[v],
                            .last = last.data()[v],
                            .branch = branch.data()[v]});
    std::vector<Candidate> candidates;
    for (std::size_t i = 0; i < n * branches; ++i) candidates.push_back({.from = rival.data()[i], .entry = entry.data()[i]});
    const Catheter catheter{.ostium = vec3(ostium.data()), .axis = vec3(axis.data()), .radius = catheter_radius};
    return {std::move(vertices), std::move(candidates), catheter};
}

nb::tuple project(const Projector& projector, const Array<2>& points, const Indices<1>& nearest, const Array<1>& distance) {
    const std::size_t n = points.shape(0);
    require(points.shape(1) == 3 && nearest.size() == n && distance.size() == n, "project needs one row a point");
    OutputArray<double> abscissa(n), offset(n), radius(n);
    OutputArray<std::int64_t> branch(n);
    const nb::tuple result = nb::make_tuple(abscissa.array(n), offset.array(n), branch.array(n), radius.array(n));
    for (std::size_t i = 0; i < n; ++i) {
        const std::int64_t at = nearest.data()[i];
        require(at >= 0 && std::size_t(at) < projector.vertices(), "project names no such vertex");
        const Projected p = projector(vec3(points.data() + 3 * i), at, distance.data()[i]);
        abscissa.data[i] = p.abscissa, offset.data[i] = p.offset, branch.data[i] = p.branch, radius.data[i] = p.radius;
    }
    return result;
}

}  // namespace

NB_MODULE(ENDOPILOT_MODULE, module) {
    module.doc() = "The core of endopilot: Cosserat rods, and projection to centerlines.";
    module.attr("LEVEL") = ENDOPILOT_LEVEL;
    module.attr("LANES") = kLanes;
    module.attr("OUTPUTS") = outputs();
    module.def("supported_levels", &supported_levels);
#ifdef ENDOPILOT_CUDA
    module.def("why_no_gpu", &why_no_gpu);
#endif
    nb::class_<Rod>(module, "RodModel")
        .def_ro("nodes", &Rod::nodes);
    module.def("make_rod", &make_rod, nb::kw_only(), nb::arg("abscissa"), nb::arg("shear"), nb::arg("stretch"),
               nb::arg("bend"), nb::arg("twist"), nb::arg("rest"), nb::arg("radius"), nb::arg("drag"), nb::arg("spin_drag"));
    nb::class_<LumenMap>(module, "Lumen").def_prop_ro("bytes", &bytes).def("distance", &distance, nb::arg("points"));
    module.def("make_lumen", &make_lumen, nb::kw_only(), nb::arg("values"), nb::arg("origin"), nb::arg("spacing"),
               nb::arg("near"), nb::arg("far"), nb::arg("finer"), nb::arg("spheres"));
    nb::class_<Projector>(module, "Projector")
        .def("project", &project, nb::arg("points"), nb::arg("nearest"), nb::arg("distance"));
    module.def("make_projector", &make_projector, nb::kw_only(), nb::arg("point"), nb::arg("tangent"), nb::arg("abscissa"),
               nb::arg("radius"), nb::arg("first"), nb::arg("last"), nb::arg("branch"), nb::arg("rival"), nb::arg("entry"),
               nb::arg("ostium"), nb::arg("axis"), nb::arg("catheter_radius"));
    nb::class_<OwnedLoads>(module, "Loads");
    module.def("make_loads", &make_loads, nb::kw_only(), nb::arg("force"), nb::arg("moment"), nb::arg("spring"),
               nb::arg("anchor"), nb::arg("hold"), nb::arg("attitude"));
    nb::class_<OwnedTubes>(module, "Tubes");
    module.def("make_tubes", &make_tubes, nb::kw_only(), nb::arg("spacing"), nb::arg("shear_share"), nb::arg("bend"),
               nb::arg("twist"), nb::arg("stretch"), nb::arg("rest"), nb::arg("radius"), nb::arg("bore_friction"));
    nb::class_<Drives>(module, "Drives");
    module.def("make_drives", &make_drives, nb::arg("limits"));
    nb::class_<OwnedMotion>(module, "Motion").def("placements", &placements, nb::arg("times"));
    module.def("make_motion", &make_motion, nb::kw_only(), nb::arg("ostium"), nb::arg("period"), nb::arg("coefficients"));
    nb::class_<Options>(module, "Options")
        .def(nb::init<>())
#define OPTION(Type, name, meaning) .def_rw(#name, &Options::name, meaning)
        ENDOPILOT_OPTIONS(OPTION);
#undef OPTION
    nb::class_<Simulations>(module, "Simulation")
        .def(nb::init<Rod, std::shared_ptr<LumenMap>, std::shared_ptr<OwnedLoads>, const Array<1>&, const Array<1>&, const Options&,
                      const Drives&, std::shared_ptr<OwnedTubes>, std::shared_ptr<OwnedMotion>, int>(),
             nb::kw_only(), nb::arg("rod"), nb::arg("lumen").none(), nb::arg("loads").none(), nb::arg("origin"),
             nb::arg("orientation"), nb::arg("options"), nb::arg("drives"), nb::arg("tubes").none() = nb::none(), nb::arg("motion").none() = nb::none(), nb::arg("worlds"))
        .def("reset", &Simulations::reset, nb::kw_only(), nb::arg("index"), nb::arg("initial"), nb::arg("friction"), nb::arg("sample_period"))
        .def("run", &Simulations::run, nb::kw_only(), nb::arg("control"), nb::arg("force_driven"), nb::arg("time_step"),
             nb::arg("steps_per_sample"), nb::arg("record_shape"), nb::arg("record_attitude"), nb::arg("threads"),
             nb::arg("lanes"), nb::arg("progress").none())
        .def("state", &Simulations::state)
        .def("set_state", &Simulations::set_state, nb::arg("all"))
        .def("tips", &Simulations::tips)
        .def("tip_directions", &Simulations::tip_directions)
        .def("positions", &Simulations::positions)
        .def("attitudes", &Simulations::attitudes)
        .def("contacts", &Simulations::contacts)
        .def_prop_ro("nodes", &Simulations::nodes)
        .def("time", [](Simulations& s) { return s.scalar(World::kTime); })
        .def("active", [](Simulations& s) { return s.scalar(World::kActive); })
        .def("reason", [](Simulations& s) { return s.scalar(World::kReason); })
        .def("inserted_length", [](Simulations& s) { return s.per_device(World::kLength); })
        .def("rotation", [](Simulations& s) { return s.per_device(World::kRotation); })
        .def("base_force", [](Simulations& s) { return s.per_device(World::kBaseForce); })
        .def("base_torque", [](Simulations& s) { return s.per_device(World::kBaseTorque); })
        .def("drive_force", [](Simulations& s) { return s.per_device(World::kDriveForce); })
        .def("drive_torque", [](Simulations& s) { return s.per_device(World::kDriveTorque); })
        .def("slip", [](Simulations& s) { return s.per_device(World::kSlip); })
        .def("rotation_slip", [](Simulations& s) { return s.per_device(World::kRotationSlip); });
}
