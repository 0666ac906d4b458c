// Python bindings: numpy in, numpy out; worlds spread over threads with the interpreter lock released.
#include <nanobind/nanobind.h>
#include <nanobind/ndarray.h>

#include <chrono>
#include <memory>
#include <thread>

#include "stepper.hpp"

namespace nb = nanobind;
using namespace endopilot;

namespace {

template <int Dims>
using Array = nb::ndarray<const double, nb::ndim<Dims>, nb::c_contig, nb::device::cpu>;
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

// All arrays have one entry a node; entries without a meaning (the last element, the first joint) are ignored.
RodModel make_rod(const Array<1>& abscissa, const Array<1>& shear, const Array<1>& stretch, const Array<1>& bend,
                  const Array<1>& twist, const Array<2>& rest, const Array<1>& radius, const Array<1>& drag,
                  const Array<1>& spin_drag) {
    RodModel rod;
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

Lumen make_lumen(const Image& coefficients, const Array<1>& origin, double spacing, double near, double far) {
    require(origin.size() == 3 && spacing > 0, "a lumen needs an origin of three numbers and a positive spacing");
    const int size[3] = {int(coefficients.shape(2)), int(coefficients.shape(1)), int(coefficients.shape(0))};
    require(size[0] > 0 && size[1] > 0 && size[2] > 0, "a lumen needs at least one cell");
    const double o[3] = {origin.data()[0], origin.data()[1], origin.data()[2]};
    return Lumen(coefficients.data(), size, o, spacing, near, far);
}

Loads make_loads(const Array<2>& force, const Array<2>& moment, const Array<2>& spring, const Array<2>& anchor,
                 const Array<1>& hold, const Array<2>& attitude) {
    const std::size_t n = force.shape(0);
    require(moment.shape(0) == n && spring.shape(0) == n && anchor.shape(0) == n && hold.size() == n &&
                attitude.shape(0) == n,
            "every array of loads needs one entry a node");
    require(force.shape(1) == 3 && moment.shape(1) == 3 && spring.shape(1) == 3 && anchor.shape(1) == 3 &&
                attitude.shape(1) == 4,
            "loads need three components, attitudes four");
    Loads loads{vectors(force), vectors(moment), vectors(spring), vectors(anchor), values(hold), {}};
    for (std::size_t i = 0; i < n; ++i) loads.attitude.push_back(quaternion(attitude.data() + 4 * i));
    return loads;
}

template <class T>
struct Result {
    explicit Result(std::size_t size) : data(new T[size]()) {}
    T* data;
    template <class... Shape>
    nb::object array(Shape... shape) {
        nb::capsule owner(data, [](void* p) noexcept { delete[] static_cast<T*>(p); });
        return nb::cast(nb::ndarray<nb::numpy, T>(data, {std::size_t(shape)...}, owner));
    }
};

// Calls `work(thread)` on `threads` threads and keeps the interpreter's signals and the progress callback served.
template <class Work>
void run_threads(int threads, const nb::object& progress, const std::atomic<long>& done, std::atomic<bool>& stop, Work work) {
    std::atomic<int> running{threads};
    std::vector<std::thread> pool;
    for (int t = 0; t < threads; ++t)
        pool.emplace_back([&] {
            work();
            running.fetch_sub(1);
        });
    bool interrupted = false;
    std::exception_ptr failure;
    long reported = 0;
    const auto serve = [&] {
        if (PyErr_CheckSignals() != 0) {
            interrupted = true;
        } else if (!progress.is_none()) {
            const long now = done.load();
            try {
                if (now > reported) progress(now - reported);
            } catch (...) {
                failure = std::current_exception();
            }
            reported = now;
        }
        if (interrupted || failure) stop.store(true);
    };
    {
        nb::gil_scoped_release release;
        int waited = 0;
        while (running.load() > 0) {
            std::this_thread::sleep_for(std::chrono::milliseconds(waited < 20 ? 1 : 50));
            if (++waited % 2 == 0 && waited > 20 && !stop.load()) {
                nb::gil_scoped_acquire acquire;
                serve();
            }
        }
        for (std::thread& thread : pool) thread.join();
    }
    if (!stop.load()) serve();
    if (failure) std::rethrow_exception(failure);
    if (interrupted) throw nb::python_error();
}

nb::dict simulate(const RodModel& rod, const Lumen* lumen, const Loads* loads, const Array<1>& origin,
                  const Array<1>& orientation, const Options& options, const Array<2>& initial, const Array<3>& control,
                  const Array<1>& friction, const Array<1>& order, bool record_shape, bool record_attitude, int threads,
                  int lanes, const nb::object& progress) {
    const std::size_t worlds = control.shape(0), samples = control.shape(1), n = worlds * samples, nodes = rod.nodes;
    require(initial.shape(0) == worlds && initial.shape(1) == 2 && control.shape(2) == 2 && friction.size() == worlds &&
                order.size() == worlds,
            "initial, control, friction and order must agree in the number of worlds");
    require(origin.size() == 3 && orientation.size() == 4, "the base needs a position and a quaternion");
    require(!loads || loads->force.size() == nodes, "loads need one entry a node of the rod");
    require(options.steps_per_sample >= 1 && options.time_step > 0, "time step and steps per sample must be positive");
    std::vector<int> sequence;
    for (std::size_t w = 0; w < worlds; ++w) {
        const double index = order.data()[w];
        require(index >= 0 && index < double(worlds), "order must name existing worlds");
        sequence.push_back(int(index));
    }
    Result<double> tip(3 * n), direction(3 * n), force_max(n), force_sum(n), base_force(n), base_torque(n), iterations(n),
        slip(n), approach_slip(worlds);
    Result<bool> valid(n);
    Result<std::uint8_t> reason(worlds);
    Result<double> shape(record_shape ? 3 * n * nodes : 0), attitude(record_attitude ? 4 * n * nodes : 0);
    const Inputs in{int(worlds), int(samples), initial.data(), control.data(), friction.data()};
    const Outputs out{tip.data,         direction.data, force_max.data, force_sum.data,
                      base_force.data,  base_torque.data, iterations.data, slip.data, valid.data, approach_slip.data, reason.data,
                      record_shape ? shape.data : nullptr, record_attitude ? attitude.data : nullptr};
    const Base base{vec3(origin.data()), quaternion(orientation.data())};
    nb::dict result;
    result["tip_position"] = tip.array(worlds, samples, 3);
    result["tip_direction"] = direction.array(worlds, samples, 3);
    result["contact_force_max"] = force_max.array(worlds, samples);
    result["contact_force_sum"] = force_sum.array(worlds, samples);
    result["base_force"] = base_force.array(worlds, samples);
    result["base_torque"] = base_torque.array(worlds, samples);
    result["iterations"] = iterations.array(worlds, samples);
    result["slip"] = slip.array(worlds, samples);
    result["approach_slip"] = approach_slip.array(worlds);
    result["valid"] = valid.array(worlds, samples);
    result["reason"] = reason.array(worlds);
    nb::object shapes = shape.array(record_shape ? worlds : 0, samples, nodes, 3);
    nb::object attitudes = attitude.array(record_attitude ? worlds : 0, samples, nodes, 4);
    if (record_shape) result["shape"] = shapes;
    if (record_attitude) result["attitude"] = attitudes;

    std::atomic<int> next{0};
    std::atomic<long> done{0};
    std::atomic<bool> stop{false};
    const auto work = [&](auto lane) {
        using V = decltype(lane);
        const auto stepper = std::make_unique<Stepper<V>>(rod, lumen, loads, base, options, in, out);
        stepper->run(sequence, next, done, stop);
    };
    run_threads(std::max(1, threads), progress, done, stop, [&] {
        if (lanes == 1)
            work(double{});
        else if (lanes == 8)
            work(double8{});
        else
            work(double4{});
    });
    return result;
}

}  // namespace

NB_MODULE(_core, module) {
    module.doc() = "The Cosserat rod core of endopilot.";
    nb::class_<RodModel>(module, "RodModel")
        .def_ro("nodes", &RodModel::nodes);
    module.def("make_rod", &make_rod, nb::kw_only(), nb::arg("abscissa"), nb::arg("shear"), nb::arg("stretch"),
               nb::arg("bend"), nb::arg("twist"), nb::arg("rest"), nb::arg("radius"), nb::arg("drag"), nb::arg("spin_drag"));
    nb::class_<Lumen>(module, "Lumen").def_prop_ro("bytes", &Lumen::bytes);
    module.def("make_lumen", &make_lumen, nb::kw_only(), nb::arg("coefficients"), nb::arg("origin"), nb::arg("spacing"),
               nb::arg("near"), nb::arg("far"));
    nb::class_<Loads>(module, "Loads");
    module.def("make_loads", &make_loads, nb::kw_only(), nb::arg("force"), nb::arg("moment"), nb::arg("spring"),
               nb::arg("anchor"), nb::arg("hold"), nb::arg("attitude"));
    nb::class_<Options>(module, "Options")
        .def(nb::init<>())
        .def_rw("time_step", &Options::time_step)
        .def_rw("steps_per_sample", &Options::steps_per_sample)
        .def_rw("stick_velocity", &Options::stick_velocity)
        .def_rw("wall_stiffness", &Options::wall_stiffness)
        .def_rw("tolerance", &Options::tolerance)
        .def_rw("sample_tolerance", &Options::sample_tolerance)
        .def_rw("largest_step", &Options::largest_step)
        .def_rw("most_iterations", &Options::most_iterations)
        .def_rw("free_behind", &Options::free_behind)
        .def_rw("approach_velocity", &Options::approach_velocity)
        .def_rw("push_limit", &Options::push_limit);
    module.def("simulate", &simulate, nb::kw_only(), nb::arg("rod"), nb::arg("lumen").none(), nb::arg("loads").none(),
               nb::arg("origin"), nb::arg("orientation"), nb::arg("options"), nb::arg("initial"), nb::arg("control"),
               nb::arg("friction"), nb::arg("order"), nb::arg("record_shape"), nb::arg("record_attitude"),
               nb::arg("threads"), nb::arg("lanes"), nb::arg("progress").none());
}
