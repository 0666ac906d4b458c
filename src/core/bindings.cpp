// The Python module: numpy in, numpy out. Nothing else of the core knows of Python.
#include <nanobind/nanobind.h>
#include <nanobind/ndarray.h>
#include <nanobind/stl/shared_ptr.h>
#include <nanobind/stl/string.h>
#include <nanobind/stl/vector.h>

#include <memory>
#include <stdexcept>

#include "contact.hpp"
#include "projection.hpp"
#include "refined.hpp"
#include "simulation.hpp"
#include "spline.hpp"
#ifdef ENDOPILOT_CUDA
#include "cuda.hpp"
using Processor = endopilot::CudaStepper;
#else
#include "cpu.hpp"
using Processor = endopilot::Cpu;
#endif

namespace nb = nanobind;
using namespace endopilot;
using Simulations = Simulation<Processor>;

namespace {

template <int Dims>
using Array = nb::ndarray<const double, nb::ndim<Dims>, nb::c_contig, nb::device::cpu>;
template <int Dims>
using Indices = nb::ndarray<const std::int64_t, nb::ndim<Dims>, nb::c_contig, nb::device::cpu>;
using Image = nb::ndarray<const float, nb::ndim<3>, nb::c_contig, nb::device::cpu>;

std::vector<double> values(const Array<1>& a) { return {a.data(), a.data() + a.size()}; }

Vec3<double> vec3(const double* p) { return {p[0], p[1], p[2]}; }

std::vector<Vec3<double>> vectors(const Array<2>& a) {
    std::vector<Vec3<double>> out;
    for (std::size_t i = 0; i < a.shape(0); ++i) out.push_back(vec3(a.data() + 3 * i));
    return out;
}

Quaternion<double> quaternion(const double* p) { return {p[0], {p[1], p[2], p[3]}}; }

void require(bool fine, const char* what) {
    if (!fine) throw std::invalid_argument(what);
}

// An array that belongs to Python.
template <class T>
struct OutputArray {
    T* data;
    nb::object array;
    explicit OutputArray(const std::vector<std::size_t>& shape) {
        std::size_t size = 1;
        for (std::size_t n : shape) size *= n;
        data = new T[size]();
        const nb::capsule owner(data, [](void* p) noexcept { delete[] static_cast<T*>(p); });
        array = nb::cast(nb::ndarray<nb::numpy, T>(data, shape.size(), shape.data(), owner));
    }
};

// The levels that are built and that this processor runs, slowest first. Ask the baseline module, which runs everywhere.
std::vector<std::string> supported_levels() {
    std::vector<std::string> levels{"baseline"};
#ifdef __x86_64__
    __builtin_cpu_init();
    const bool avx2 = __builtin_cpu_supports("avx2");
    if (avx2) levels.push_back("avx2");
    if (avx2 && __builtin_cpu_supports("avx512f") && __builtin_cpu_supports("avx512bw") && __builtin_cpu_supports("avx512cd") &&
        __builtin_cpu_supports("avx512dq") && __builtin_cpu_supports("avx512vl"))
        levels.push_back("avx512");
#endif
    return levels;
}

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
    const OutputArray<double> found({n});
    const Lumen lumen = view(map, InPlace{});
    for (std::size_t i = 0; i < n; ++i) found.data[i] = distance_to_wall<double>(lumen, vec3(points.data() + 3 * i)).value;
    return found.array;
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

// A row a device: the length between drive and ostium (mm), the friction torque a length (N mm/mm), and the integrals of 1/GJ (1/(N mm)).
OwnedTransmission make_transmission(double spacing, const Array<1>& length, const Array<1>& friction, const Array<2>& compliance) {
    const std::size_t n = length.size();
    require(n >= 1 && n <= kMostDevices && friction.size() == n && compliance.shape(0) == n, "a transmission needs a row for each of up to three devices");
    require(spacing > 0 && compliance.shape(1) >= 2, "a transmission needs two points at least");
    OwnedTransmission made{.points = int(compliance.shape(1)),
                           .spacing = spacing,
                           .compliance = std::vector<double>(compliance.data(), compliance.data() + compliance.size())};
    std::copy_n(length.data(), n, made.length);
    std::copy_n(friction.data(), n, made.friction);
    return made;
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
    const OutputArray<double> maps({n, 3, 4}), rotations({n, 4});
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
        write(rotations.data + 4 * k, vessel.rotation);
    }
    return nb::make_tuple(maps.array, rotations.array);
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
    const OutputArray<double> abscissa({n}), offset({n}), radius({n});
    const OutputArray<std::int64_t> branch({n});
    for (std::size_t i = 0; i < n; ++i) {
        const std::int64_t at = nearest.data()[i];
        require(at >= 0 && std::size_t(at) < projector.vertices(), "project names no such vertex");
        const Projected p = projector(vec3(points.data() + 3 * i), at, distance.data()[i]);
        abscissa.data[i] = p.abscissa, offset.data[i] = p.offset, branch.data[i] = p.branch, radius.data[i] = p.radius;
    }
    return nb::make_tuple(abscissa.array, offset.array, branch.array, radius.array);
}

// What a run records: (name, what it has an entry of, numbers of an entry, unit, meaning).
nb::list outputs() {
    nb::list all;
#define OUTPUT(Type, name, of, numbers, unit, meaning) all.append(nb::make_tuple(#name, #of, numbers, unit, meaning));
    ENDOPILOT_OUTPUTS(OUTPUT)
#undef OUTPUT
    return all;
}

// The settings: (name, type, unit, meaning).
nb::list options() {
    nb::list all;
#define OPTION(Type, name, unit, meaning) all.append(nb::make_tuple(#name, std::is_same_v<Type, int> ? "int" : "float", unit, meaning));
    ENDOPILOT_OPTIONS(OPTION)
#undef OPTION
    return all;
}

OwnedScene make_scene(Rod rod, std::shared_ptr<LumenMap> lumen, std::shared_ptr<OwnedLoads> loads, const Array<1>& origin,
                      const Array<1>& orientation, const Options& options, const Drives& drives, std::shared_ptr<OwnedTubes> tubes,
                      std::shared_ptr<OwnedMotion> motion, std::shared_ptr<OwnedTransmission> transmission) {
    require(origin.size() == 3 && orientation.size() == 4, "the base needs a position and a quaternion");
    require(!loads || int(loads->force.size()) == rod.nodes, "loads need one entry a node of the rod");
    require(drives.count == (tubes ? tubes->tubes : 1), "every device needs the limits of its drive");
    const Base base{.origin = vec3(origin.data()), .orientation = quaternion(orientation.data())};
    return {std::move(rod), std::move(lumen), std::move(loads), base, options, drives, std::move(tubes), std::move(motion), std::move(transmission)};
}

// Puts worlds at the ostium, ready to be pushed to their first inserted length by the next run. `initial` and `friction` have a row a
// world and a column a device.
void reset(Simulations& s, const Indices<1>& index, const Array<3>& initial, const Array<2>& friction, double sample_period) {
    const std::size_t n = index.size(), devices = s.devices();
    require(initial.shape(0) == n && initial.shape(1) == devices && initial.shape(2) == 2 && friction.shape(0) == n && friction.shape(1) == devices,
            "reset needs one row a world and one entry a device");
    for (std::size_t k = 0; k < n; ++k) {
        const std::int64_t world = index.data()[k];
        require(world >= 0 && std::size_t(world) < s.count(), "reset names no such world");
        start_world(s.scene(), s.worlds()[std::size_t(world)], initial.data() + 2 * k * devices, friction.data() + k * devices, sample_period);
    }
}

// Steps the worlds `chosen`, with the interpreter's lock released, and returns what `OUTPUTS` lists: 0 of the others.
nb::dict run(Simulations& s, const Array<4>& control, bool force_driven, double time_step, int steps_per_sample, bool record_shape,
             bool record_attitude, int threads, int lanes, const Indices<1>& chosen, const nb::object& progress) {
    const std::size_t samples = control.shape(1);
    require(control.shape(0) == s.count() && control.shape(2) == s.devices() && control.shape(3) == 2, "control needs two numbers a world, sample and device");
    require(s.devices() == 1 || !force_driven, "devices with catheters are not driven by force");
    require(steps_per_sample >= 1 && time_step > 0, "time step and steps per sample must be positive");
    const std::vector<int> worlds(chosen.data(), chosen.data() + chosen.size());
    for (const int w : worlds) require(w >= 0 && std::size_t(w) < s.count(), "run names no such world");
    const Inputs in{.worlds = int(s.count()),
                    .samples = int(samples),
                    .steps_per_sample = steps_per_sample,
                    .time_step = time_step,
                    .force_driven = force_driven,
                    .control = control.data()};
    Outputs out;
    nb::dict result;
    each_output(out, [&]<class T>(const char* name, T*& array, Of of, int numbers) {
        if ((of == Of::node && !record_shape) || (of == Of::element && !record_attitude)) return;
        std::vector<std::size_t> shape{s.count()};
        if (of != Of::start) shape.push_back(samples);
        if (of == Of::device || of == Of::start) shape.push_back(s.devices());
        if (of == Of::node || of == Of::element) shape.push_back(s.nodes());
        if (numbers > 1) shape.push_back(std::size_t(numbers));
        const OutputArray<T> made(shape);
        array = made.data;
        result[name] = made.array;
    });
    const nb::gil_scoped_release release;
    s.step(in, worlds, out, threads, lanes, [&](long ended) {
        const nb::gil_scoped_acquire acquire;
        if (PyErr_CheckSignals() != 0) throw nb::python_error();
        if (!progress.is_none() && ended > 0) progress(ended);
    });
    return result;
}

// All that the worlds' future depends on, bit by bit: a row a world.
nb::object state(Simulations& s) {
    const OutputArray<double> all({s.count(), s.width()});
    std::copy(s.values().begin(), s.values().end(), all.data);
    return all.array;
}

void set_state(Simulations& s, const Array<2>& all) {
    require(all.shape(0) == s.count() && all.shape(1) == s.width(), "the state has another shape");
    std::copy_n(all.data(), s.values().size(), s.values().begin());
}

// Of each world, `entries` entries of `numbers` numbers, which `write(world, its pose, entry, to)` writes.
template <class Write>
nb::object readout(Simulations& s, std::size_t entries, std::size_t numbers, const Write& write) {
    std::vector<std::size_t> shape{s.count(), entries, numbers};
    if (numbers == 1) shape.pop_back();
    const OutputArray<double> out(shape);
    double* to = out.data;
    for (std::size_t w = 0; w < s.count(); ++w) {
        const World world = s.worlds()[w];
        const Pose pose(s.scene(), world);
        for (std::size_t k = 0; k < entries; ++k, to += numbers) write(world, pose, int(k), to);
    }
    return out.array;
}

nb::object of_world(Simulations& s, World::Scalar which) {
    const OutputArray<double> out({s.count()});
    for (std::size_t w = 0; w < s.count(); ++w) out.data[w] = s.worlds()[w][which];
    return out.array;
}

nb::object of_devices(Simulations& s, World::DeviceQuantity which) {
    return readout(s, s.devices(), 1, [which](const World& w, const Pose&, int k, double* to) { *to = w.device(k)[which]; });
}

nb::object tips(Simulations& s) {
    return readout(s, s.devices(), 3, [](const World&, const Pose& pose, int k, double* to) { write(to, pose.tip(k)); });
}

nb::object tip_directions(Simulations& s) {
    return readout(s, s.devices(), 3, [](const World&, const Pose& pose, int k, double* to) { write(to, pose.tip_direction(k)); });
}

nb::object positions(Simulations& s) {
    return readout(s, s.nodes(), 3, [](const World&, const Pose& pose, int i, double* to) { write(to, pose.position(i)); });
}

nb::object attitudes(Simulations& s) {
    return readout(s, s.nodes(), 4, [](const World&, const Pose& pose, int i, double* to) { write(to, pose.attitude(i)); });
}

// Forces of the wall at each node and at the middle of the element behind it, added up.
nb::object contacts(Simulations& s) {
    return readout(s, s.nodes(), 1, [](const World& w, const Pose&, int i, double* to) { *to = i < w.active() ? w.force(i) : 0.0; });
}

}  // namespace

NB_MODULE(ENDOPILOT_MODULE, module) {
    module.doc() = "The core of endopilot: Cosserat rods, and projection to centerlines.";
    module.attr("LEVEL") = ENDOPILOT_LEVEL;
    module.attr("LANES") = kLanes;
    module.attr("OUTPUTS") = outputs();
    module.attr("OPTIONS") = options();
    module.def("supported_levels", &supported_levels);
#ifdef ENDOPILOT_CUDA
    module.def("why_no_gpu", &why_no_gpu);
#endif
    nb::class_<Rod>(module, "RodModel")
        .def_ro("nodes", &Rod::nodes);
    module.def("make_rod", &make_rod, nb::kw_only(), nb::arg("abscissa"), nb::arg("shear"), nb::arg("stretch"),
               nb::arg("bend"), nb::arg("twist"), nb::arg("rest"), nb::arg("radius"), nb::arg("drag"), nb::arg("spin_drag"));
    nb::class_<LumenMap>(module, "Lumen")
        .def_prop_ro("bytes", &bytes)
        .def_ro("steepest", &LumenMap::steepest)
        .def("distance", &distance, nb::arg("points"));
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
    nb::class_<OwnedTransmission>(module, "Transmission");
    module.def("make_transmission", &make_transmission, nb::kw_only(), nb::arg("spacing"), nb::arg("length"), nb::arg("friction"), nb::arg("compliance"));
    nb::class_<Options>(module, "Options")
        .def(nb::init<>())
#define OPTION(Type, name, unit, meaning) .def_rw(#name, &Options::name, meaning)
        ENDOPILOT_OPTIONS(OPTION);
#undef OPTION
    nb::class_<Simulations> simulation(module, "Simulation");
    simulation
        .def("__init__", [](Simulations* self, Rod rod, std::shared_ptr<LumenMap> lumen, std::shared_ptr<OwnedLoads> loads, const Array<1>& origin,
                            const Array<1>& orientation, const Options& options, const Drives& drives, std::shared_ptr<OwnedTubes> tubes,
                            std::shared_ptr<OwnedMotion> motion, std::shared_ptr<OwnedTransmission> transmission, int worlds) {
                 require(worlds >= 1, "a simulation needs at least one world");
                 new (self) Simulations(make_scene(std::move(rod), lumen, loads, origin, orientation, options, drives, tubes, motion, transmission), std::size_t(worlds));
             },
             nb::kw_only(), nb::arg("rod"), nb::arg("lumen").none(), nb::arg("loads").none(), nb::arg("origin"), nb::arg("orientation"), nb::arg("options"),
             nb::arg("drives"), nb::arg("tubes").none() = nb::none(), nb::arg("motion").none() = nb::none(),
             nb::arg("transmission").none() = nb::none(), nb::arg("worlds"))
        .def("reset", &reset, nb::kw_only(), nb::arg("index"), nb::arg("initial"), nb::arg("friction"), nb::arg("sample_period"))
        .def("run", &run, nb::kw_only(), nb::arg("control"), nb::arg("force_driven"), nb::arg("time_step"), nb::arg("steps_per_sample"),
             nb::arg("record_shape"), nb::arg("record_attitude"), nb::arg("threads"), nb::arg("lanes"), nb::arg("chosen"), nb::arg("progress").none())
        .def("state", &state)
        .def("set_state", &set_state, nb::arg("all"))
        .def("tips", &tips)
        .def("tip_directions", &tip_directions)
        .def("positions", &positions)
        .def("attitudes", &attitudes)
        .def("contacts", &contacts)
        .def_prop_ro("nodes", &Simulations::nodes);
    for (const auto& [name, which] : {std::pair{"time", World::kTime}, {"active", World::kActive}, {"reason", World::kReason}})
        simulation.def(name, [which](Simulations& s) { return of_world(s, which); });
#define NUMBER(name, quantity) simulation.def(#name, [](Simulations& s) { return of_devices(s, World::quantity); });
    ENDOPILOT_DEVICE_NUMBERS(NUMBER)
    NUMBER(drive_rotation, kDriveRotation)
#undef NUMBER
}
