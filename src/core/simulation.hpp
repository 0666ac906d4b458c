// Many worlds of one device in one lumen, spread over threads with the interpreter lock released.
#pragma once

#include <nanobind/nanobind.h>

#include <atomic>
#include <chrono>
#include <memory>
#include <string>
#include <thread>
#include <tuple>
#include <vector>

#include "arrays.hpp"
#include "stepper.hpp"

namespace endopilot {

// Calls `work(thread, until)` on `threads` threads, this one being number 0, until it returns true. On this thread it gets
// a time to return at, so that the interpreter's signals and the progress callback are served.
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
        for (int t = 1; t < threads; ++t) others.emplace_back([&work, t] { work(t, TimePoint::max()); });
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
        base_ = {.origin = vec3(origin.data()), .orientation = quaternion(orientation.data())};
        worlds_.assign(std::size_t(worlds), World(rod_.nodes));
    }

    Simulation(const Simulation&) = delete;  // the steppers refer to this one's rod and worlds

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
        OutputArray<double> inserted(n), rotation(n), tip(3 * n), direction(3 * n), force_max(n), force_sum(n), base_force(n),
            base_torque(n), drive_force(n), drive_torque(n), iterations(n), slip(n), approach_slip(worlds);
        OutputArray<bool> valid(n);
        OutputArray<double> shape(record_shape ? 3 * n * nodes : 0), attitude(record_attitude ? 4 * n * nodes : 0);
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

        const Inputs in{.samples = int(samples),
                        .steps_per_sample = steps_per_sample,
                        .time_step = time_step,
                        .force_driven = force_driven,
                        .control = control.data()};
        const Outputs out{.inserted = inserted.data,
                          .rotation = rotation.data,
                          .tip_position = tip.data,
                          .tip_direction = direction.data,
                          .force_max = force_max.data,
                          .force_sum = force_sum.data,
                          .base_force = base_force.data,
                          .base_torque = base_torque.data,
                          .drive_force = drive_force.data,
                          .drive_torque = drive_torque.data,
                          .iterations = iterations.data,
                          .slip = slip.data,
                          .valid = valid.data,
                          .approach_slip = approach_slip.data,
                          .shape = record_shape ? shape.data : nullptr,
                          .attitude = record_attitude ? attitude.data : nullptr};
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
        OutputArray<double> all(worlds_.size() * width);
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
        OutputArray<double> out(worlds_.size());
        for (std::size_t w = 0; w < worlds_.size(); ++w) out.data[w] = worlds_[w][which];
        return out.array(worlds_.size());
    }

    // Positions of the first nodes.
    nb::object tips() const {
        OutputArray<double> out(3 * worlds_.size());
        double* to = out.data;
        for (const World& w : worlds_) to = std::copy_n(w.node(0) + World::kX, 3, to);
        return out.array(worlds_.size(), 3);
    }

    // `size` numbers of each node, from `offset` on; those of nodes that follow the drive from `behind(world, node)`.
    template <class Behind>
    nb::object per_node(int offset, int size, const Behind& behind) const {
        const std::size_t nodes = std::size_t(rod_.nodes);
        OutputArray<double> out(worlds_.size() * nodes * std::size_t(size));
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
        return per_node(World::kNormalForce, 1, [](const World&, int, double* to) { *to = 0.0; });
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
        WorkQueue queue = make_queue(in, threads);
        std::atomic<long> done{0};
        std::atomic<bool> stop{false};
        run_threads(threads, progress, done, stop, [&](int thread, TimePoint until) {
            return steppers[std::size_t(thread)]->run(queue, done, stop, until);
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

    // The worlds in the order of their mean inserted length, so that those under way together are of similar length.
    WorkQueue make_queue(const Inputs& in, int threads) const {
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
        return WorkQueue(std::move(order), std::move(length), kUnderWay * threads);
    }
    static constexpr int kUnderWay = 64;  // worlds under way for each thread: enough to find some of similar length
};

}  // namespace endopilot
