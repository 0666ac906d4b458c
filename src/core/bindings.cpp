// Python bindings: numpy in, numpy out; worlds spread over threads with the interpreter lock released.
#include <nanobind/nanobind.h>
#include <nanobind/stl/shared_ptr.h>

#include <chrono>
#include <memory>
#include <string>
#include <thread>
#include <tuple>

#include "arrays.hpp"
#include "projection.hpp"
#include "spline.hpp"
#include "stepper.hpp"

using namespace endopilot;

namespace {

// The levels that are built and that this processor runs, slowest first. Ask the baseline module, which runs everywhere.
nb::list supported_levels() {
    nb::list levels;
    levels.append("baseline");
#ifdef __x86_64__
    __builtin_cpu_init();
    const bool avx2 = __builtin_cpu_supports("avx2");
    if (avx2) levels.append("avx2");
    if (avx2 && __builtin_cpu_supports("avx512f") && __builtin_cpu_supports("avx512bw") && __builtin_cpu_supports("avx512cd") &&
        __builtin_cpu_supports("avx512dq") && __builtin_cpu_supports("avx512vl"))
        levels.append("avx512");
#endif
    return levels;
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

Lumen make_lumen(const Image& values, const Array<1>& origin, double spacing, double near, double far) {
    require(origin.size() == 3 && spacing > 0, "a lumen needs an origin of three numbers and a positive spacing");
    const int size[3] = {int(values.shape(2)), int(values.shape(1)), int(values.shape(0))};
    require(size[0] > 0 && size[1] > 0 && size[2] > 0, "a lumen needs at least one cell");
    const double o[3] = {origin.data()[0], origin.data()[1], origin.data()[2]};
    return Lumen(spline_coefficients(values.data(), size).data(), size, o, spacing, near, far);
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
        vertices.push_back({vec3(point.data() + 3 * v), vec3(tangent.data() + 3 * v), abscissa.data()[v], radius.data()[v],
                            first.data()[v], last.data()[v], branch.data()[v]});
    std::vector<Rival> rivals;
    for (std::size_t i = 0; i < n * branches; ++i) rivals.push_back({rival.data()[i], entry.data()[i]});
    return {std::move(vertices), std::move(rivals), {vec3(ostium.data()), vec3(axis.data()), catheter_radius}};
}

nb::tuple project(const Projector& projector, const Array<2>& points, const Indices<1>& nearest, const Array<1>& distance) {
    const std::size_t n = points.shape(0);
    require(points.shape(1) == 3 && nearest.size() == n && distance.size() == n, "project needs one row a point");
    Result<double> abscissa(n), offset(n), radius(n);
    Result<std::int64_t> branch(n);
    const nb::tuple result = nb::make_tuple(abscissa.array(n), offset.array(n), branch.array(n), radius.array(n));
    for (std::size_t i = 0; i < n; ++i) {
        const std::int64_t at = nearest.data()[i];
        require(at >= 0 && std::size_t(at) < projector.vertices(), "project names no such vertex");
        const Projected p = projector(vec3(points.data() + 3 * i), at, distance.data()[i]);
        abscissa.data[i] = p.abscissa, offset.data[i] = p.offset, branch.data[i] = p.branch, radius.data[i] = p.radius;
    }
    return result;
}

// Calls `work(thread, until)` on `threads` threads, of which this is number 0, until it says that all is done. On this one
// it is called with a moment to come back at, so that the interpreter's signals and the progress callback stay served.
template <class Work>
void run_threads(int threads, const nb::object& progress, const std::atomic<long>& done, std::atomic<bool>& stop, const Work& work) {
    std::exception_ptr failure;
    long reported = 0;
    const auto serve = [&] {
        try {
            if (PyErr_CheckSignals() != 0) throw nb::python_error();
            const long now = done.load();
            if (!progress.is_none() && now > reported) progress(now - reported);
            reported = now;
        } catch (...) {
            failure = std::current_exception();
            stop.store(true);
        }
    };
    {
        nb::gil_scoped_release release;
        std::vector<std::thread> others;
        for (int t = 1; t < threads; ++t) others.emplace_back([&work, t] { work(t, Moment::max()); });
        while (!work(0, std::chrono::steady_clock::now() + std::chrono::milliseconds(100))) {
            nb::gil_scoped_acquire acquire;
            serve();
        }
        for (std::thread& thread : others) thread.join();
    }
    if (!failure) serve();
    if (failure) std::rethrow_exception(failure);
}

// Many worlds of one device in one lumen.
class Simulation {
public:
    Simulation(RodModel rod, std::shared_ptr<Lumen> lumen, std::shared_ptr<Loads> loads, const Array<1>& origin,
               const Array<1>& orientation, const Options& options, int worlds)
        : rod_(std::move(rod)), lumen_(std::move(lumen)), loads_(std::move(loads)), options_(options) {
        require(worlds >= 1, "a simulation needs at least one world");
        require(origin.size() == 3 && orientation.size() == 4, "the base needs a position and a quaternion");
        require(!loads_ || int(loads_->force.size()) == rod_.nodes, "loads need one entry a node of the rod");
        base_ = {vec3(origin.data()), quaternion(orientation.data())};
        worlds_.assign(std::size_t(worlds), World(rod_.nodes));
    }

    Simulation(const Simulation&) = delete;  // the steppers hold on to this one's rod and worlds

    // Puts worlds at the ostium, ready to be pushed to their first inserted length by the next run.
    void reset(const Indices<1>& index, const Array<2>& initial, const Array<1>& friction, double sample_period) {
        const std::size_t n = index.size();
        require(initial.shape(0) == n && initial.shape(1) == 2 && friction.size() == n, "reset needs one row a world");
        for (std::size_t k = 0; k < n; ++k) {
            require(index.data()[k] >= 0 && std::size_t(index.data()[k]) < worlds_.size(), "reset names no such world");
            World& w = worlds_[std::size_t(index.data()[k])];
            const double depth = initial.data()[2 * k], speed = options_.approach_velocity;
            std::fill(w.values.begin(), w.values.end(), 0.0);
            w[World::kInserted] = speed > 0 ? 0.0 : depth;
            w[World::kRotation] = initial.data()[2 * k + 1];
            w[World::kApproach] = speed > 0 ? std::ceil(depth / (speed * sample_period)) + 1 : 0.0;
            w[World::kDepth] = depth;
            w[World::kFriction] = friction.data()[k];
            w[World::kStride] = kTicks;
            lay_straight(w);
        }
    }

    nb::dict run(const Array<3>& control, bool force_driven, double time_step, int steps_per_sample, bool record_shape,
                 bool record_attitude, int threads, int lanes, const nb::object& progress) {
        const std::size_t worlds = worlds_.size(), samples = control.shape(1), n = worlds * samples, nodes = std::size_t(rod_.nodes);
        require(control.shape(0) == worlds && control.shape(2) == 2, "control needs two numbers a world and sample");
        require(steps_per_sample >= 1 && time_step > 0, "time step and steps per sample must be positive");
        if (lanes != 1 && lanes != 4 && lanes != 8)
            throw std::invalid_argument("lanes: " + std::to_string(lanes) + "; give 1, 4 or 8");
        Result<double> inserted(n), rotation(n), tip(3 * n), direction(3 * n), force_max(n), force_sum(n), base_force(n),
            base_torque(n), drive_force(n), drive_torque(n), iterations(n), slip(n), approach_slip(worlds);
        Result<bool> valid(n);
        Result<double> shape(record_shape ? 3 * n * nodes : 0), attitude(record_attitude ? 4 * n * nodes : 0);
        nb::dict result;
        result["inserted_length"] = inserted.array(worlds, samples);
        result["rotation"] = rotation.array(worlds, samples);
        result["tip_position"] = tip.array(worlds, samples, 3);
        result["tip_direction"] = direction.array(worlds, samples, 3);
        result["contact_force_max"] = force_max.array(worlds, samples);
        result["contact_force_sum"] = force_sum.array(worlds, samples);
        result["base_force"] = base_force.array(worlds, samples);
        result["base_torque"] = base_torque.array(worlds, samples);
        result["drive_force"] = drive_force.array(worlds, samples);
        result["drive_torque"] = drive_torque.array(worlds, samples);
        result["iterations"] = iterations.array(worlds, samples);
        result["slip"] = slip.array(worlds, samples);
        result["approach_slip"] = approach_slip.array(worlds);
        result["valid"] = valid.array(worlds, samples);
        nb::object shapes = shape.array(record_shape ? worlds : 0, samples, nodes, 3);
        nb::object attitudes = attitude.array(record_attitude ? worlds : 0, samples, nodes, 4);
        if (record_shape) result["shape"] = shapes;
        if (record_attitude) result["attitude"] = attitudes;

        const Inputs in{int(samples), steps_per_sample, time_step, force_driven, control.data()};
        const Outputs out{inserted.data,    rotation.data,    tip.data,          direction.data,    force_max.data,
                          force_sum.data,   base_force.data,  base_torque.data,  drive_force.data,  drive_torque.data,
                          iterations.data,  slip.data,        valid.data,        approach_slip.data,
                          record_shape ? shape.data : nullptr, record_attitude ? attitude.data : nullptr};
        if (lanes == 1)
            step<double>(in, out, std::max(1, threads), progress);
        else if (lanes == 4)
            step<double4>(in, out, std::max(1, threads), progress);
        else
            step<double8>(in, out, std::max(1, threads), progress);
        return result;
    }

    nb::object state() const {
        const std::size_t width = worlds_[0].values.size();
        Result<double> all(worlds_.size() * width);
        for (std::size_t w = 0; w < worlds_.size(); ++w)
            std::copy(worlds_[w].values.begin(), worlds_[w].values.end(), all.data + w * width);
        return all.array(worlds_.size(), width);
    }

    void set_state(const Array<2>& all) {
        const std::size_t width = worlds_[0].values.size();
        require(all.shape(0) == worlds_.size() && all.shape(1) == width, "the state has another shape");
        for (std::size_t w = 0; w < worlds_.size(); ++w)
            std::copy_n(all.data() + w * width, width, worlds_[w].values.begin());
    }

    // A number of each world.
    nb::object scalar(World::Scalar which) const {
        Result<double> out(worlds_.size());
        for (std::size_t w = 0; w < worlds_.size(); ++w) out.data[w] = worlds_[w][which];
        return out.array(worlds_.size());
    }

    // Positions of the first nodes.
    nb::object tips() const {
        Result<double> out(3 * worlds_.size());
        double* to = out.data;
        for (const World& w : worlds_) to = std::copy_n(w.node(0) + World::kX, 3, to);
        return out.array(worlds_.size(), 3);
    }

    // `size` numbers of each node, from `offset` on; those of nodes that follow the drive from `behind(world, node)`.
    template <class Behind>
    nb::object per_node(int offset, int size, const Behind& behind) const {
        const std::size_t nodes = std::size_t(rod_.nodes);
        Result<double> out(worlds_.size() * nodes * std::size_t(size));
        double* to = out.data;
        for (const World& w : worlds_)
            for (int i = 0; i < rod_.nodes; ++i, to += size) {
                if (i < int(w[World::kActive]))
                    std::copy_n(w.node(i) + offset, size, to);
                else
                    behind(w, i, to);
            }
        return size == 1 ? out.array(worlds_.size(), nodes) : out.array(worlds_.size(), nodes, size);
    }

    nb::object positions() const {
        return per_node(World::kX, 3, [this](const World& w, int i, double* to) {
            const Vec3<double> x = base_.position(rod_, i, w[World::kInserted]);
            to[0] = x.x, to[1] = x.y, to[2] = x.z;
        });
    }

    nb::object attitudes() const {
        return per_node(World::kQ, 4, [this](const World& w, int, double* to) {
            const Quaternion<double> q = base_.attitude(w[World::kRotation]);
            to[0] = q.w, to[1] = q.v.x, to[2] = q.v.y, to[3] = q.v.z;
        });
    }

    nb::object contacts() const {
        return per_node(World::kForce, 1, [](const World&, int, double* to) { *to = 0.0; });
    }

    int nodes() const { return rod_.nodes; }

private:
    RodModel rod_;
    std::shared_ptr<Lumen> lumen_;
    std::shared_ptr<Loads> loads_;
    Base base_;
    Options options_;
    std::vector<World> worlds_;
    template <class V>
    using Steppers = std::vector<std::unique_ptr<Stepper<V>>>;  // one a thread, kept from call to call
    std::tuple<Steppers<double>, Steppers<double4>, Steppers<double8>> steppers_;

    template <class V>
    void step(const Inputs& in, const Outputs& out, int threads, const nb::object& progress) {
        Steppers<V>& steppers = std::get<Steppers<V>>(steppers_);
        while (int(steppers.size()) < threads)
            steppers.push_back(std::make_unique<Stepper<V>>(rod_, lumen_.get(), loads_.get(), base_, options_, worlds_));
        for (const auto& stepper : steppers) stepper->prepare(in, out);
        Crew crew = assemble(in, threads);
        std::atomic<long> done{0};
        std::atomic<bool> stop{false};
        run_threads(threads, progress, done, stop, [&](int thread, Moment until) {
            return steppers[std::size_t(thread)]->run(crew, done, stop, until);
        });
    }

    void lay_straight(World& w) const {
        const double inserted = w[World::kInserted];
        const Quaternion<double> q = base_.attitude(w[World::kRotation]);
        const int active = base_.count_active(rod_, inserted, options_.free_behind);
        w[World::kActive] = active;
        for (int i = 0; i < active; ++i) {
            const Vec3<double> x = base_.position(rod_, i, inserted);
            double* p = w.node(i);
            p[World::kX] = x.x, p[World::kX + 1] = x.y, p[World::kX + 2] = x.z;
            p[World::kQ] = q.w, p[World::kQ + 1] = q.v.x, p[World::kQ + 2] = q.v.y, p[World::kQ + 3] = q.v.z;
        }
    }

    // Worlds in the order of their mean inserted length, so that those under way together are of like length.
    Crew assemble(const Inputs& in, int threads) const {
        std::vector<double> length, depth;
        std::vector<int> order;
        for (std::size_t w = 0; w < worlds_.size(); ++w) {
            double inserted = worlds_[w][World::kApproach] > 0 ? worlds_[w][World::kDepth] : worlds_[w][World::kInserted], sum = inserted;
            for (int s = 0; s < in.samples && !in.force_driven; ++s) {
                inserted += in.control[2 * (w * std::size_t(in.samples) + std::size_t(s))] * in.time_step * in.steps_per_sample;
                sum += inserted;
            }
            depth.push_back(sum);
            length.push_back(worlds_[w][World::kActive]);
            order.push_back(int(w));
        }
        std::stable_sort(order.begin(), order.end(), [&](int a, int b) { return depth[std::size_t(a)] > depth[std::size_t(b)]; });
        return Crew(std::move(order), std::move(length), kCrew * threads);
    }
    static constexpr int kCrew = 64;  // worlds under way for each thread: enough to find four of like length
};

}  // namespace

NB_MODULE(ENDOPILOT_MODULE, module) {
    module.doc() = "The core of endopilot: Cosserat rods, and projection to centerlines.";
    module.attr("LEVEL") = ENDOPILOT_LEVEL;
    module.attr("LANES") = kLanes;
    module.def("supported_levels", &supported_levels);
    nb::class_<RodModel>(module, "RodModel")
        .def_ro("nodes", &RodModel::nodes);
    module.def("make_rod", &make_rod, nb::kw_only(), nb::arg("abscissa"), nb::arg("shear"), nb::arg("stretch"),
               nb::arg("bend"), nb::arg("twist"), nb::arg("rest"), nb::arg("radius"), nb::arg("drag"), nb::arg("spin_drag"));
    nb::class_<Lumen>(module, "Lumen").def_prop_ro("bytes", &Lumen::bytes);
    module.def("make_lumen", &make_lumen, nb::kw_only(), nb::arg("values"), nb::arg("origin"), nb::arg("spacing"),
               nb::arg("near"), nb::arg("far"));
    nb::class_<Projector>(module, "Projector")
        .def("project", &project, nb::arg("points"), nb::arg("nearest"), nb::arg("distance"));
    module.def("make_projector", &make_projector, nb::kw_only(), nb::arg("point"), nb::arg("tangent"), nb::arg("abscissa"),
               nb::arg("radius"), nb::arg("first"), nb::arg("last"), nb::arg("branch"), nb::arg("rival"), nb::arg("entry"),
               nb::arg("ostium"), nb::arg("axis"), nb::arg("catheter_radius"));
    nb::class_<Loads>(module, "Loads");
    module.def("make_loads", &make_loads, nb::kw_only(), nb::arg("force"), nb::arg("moment"), nb::arg("spring"),
               nb::arg("anchor"), nb::arg("hold"), nb::arg("attitude"));
    nb::class_<Options>(module, "Options")
        .def(nb::init<>())
        .def_rw("stick_velocity", &Options::stick_velocity)
        .def_rw("wall_stiffness", &Options::wall_stiffness)
        .def_rw("tolerance", &Options::tolerance)
        .def_rw("sample_tolerance", &Options::sample_tolerance)
        .def_rw("largest_step", &Options::largest_step)
        .def_rw("largest_jump", &Options::largest_jump)
        .def_rw("most_iterations", &Options::most_iterations)
        .def_rw("free_behind", &Options::free_behind)
        .def_rw("approach_velocity", &Options::approach_velocity)
        .def_rw("push_limit", &Options::push_limit)
        .def_rw("introducer_friction", &Options::introducer_friction)
        .def_rw("introducer_drag", &Options::introducer_drag);
    nb::class_<Simulation>(module, "Simulation")
        .def(nb::init<RodModel, std::shared_ptr<Lumen>, std::shared_ptr<Loads>, const Array<1>&, const Array<1>&, const Options&, int>(),
             nb::kw_only(), nb::arg("rod"), nb::arg("lumen").none(), nb::arg("loads").none(), nb::arg("origin"),
             nb::arg("orientation"), nb::arg("options"), nb::arg("worlds"))
        .def("reset", &Simulation::reset, nb::kw_only(), nb::arg("index"), nb::arg("initial"), nb::arg("friction"), nb::arg("sample_period"))
        .def("run", &Simulation::run, nb::kw_only(), nb::arg("control"), nb::arg("force_driven"), nb::arg("time_step"),
             nb::arg("steps_per_sample"), nb::arg("record_shape"), nb::arg("record_attitude"), nb::arg("threads"),
             nb::arg("lanes"), nb::arg("progress").none())
        .def("state", &Simulation::state)
        .def("set_state", &Simulation::set_state, nb::arg("all"))
        .def("tips", &Simulation::tips)
        .def("positions", &Simulation::positions)
        .def("attitudes", &Simulation::attitudes)
        .def("contacts", &Simulation::contacts)
        .def_prop_ro("nodes", &Simulation::nodes)
        .def("inserted_length", [](const Simulation& s) { return s.scalar(World::kInserted); })
        .def("active", [](const Simulation& s) { return s.scalar(World::kActive); })
        .def("rotation", [](const Simulation& s) { return s.scalar(World::kRotation); })
        .def("reason", [](const Simulation& s) { return s.scalar(World::kReason); })
        .def("base_force", [](const Simulation& s) { return s.scalar(World::kBaseForce); })
        .def("base_torque", [](const Simulation& s) { return s.scalar(World::kBaseTorque); })
        .def("drive_force", [](const Simulation& s) { return s.scalar(World::kDriveForce); })
        .def("drive_torque", [](const Simulation& s) { return s.scalar(World::kDriveTorque); });
}
