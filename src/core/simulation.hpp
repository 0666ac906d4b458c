// Many worlds of one device in one lumen: their state, and runs of them.
#pragma once

#include <nanobind/nanobind.h>

#include <algorithm>
#include <cmath>
#include <memory>
#include <numeric>
#include <vector>

#include "arrays.hpp"
#include "stepper.hpp"

namespace endopilot {

// Many worlds of one device in one lumen. `Processor` steps them: a processor (cpu.hpp) or a GPU (gpu.hpp).
template <class Processor>
class Simulation {
public:
    Simulation(Rod rod, std::shared_ptr<LumenMap> lumen, std::shared_ptr<OwnedLoads> loads, const Array<1>& origin,
               const Array<1>& orientation, const Options& options, const Drives& drives, std::shared_ptr<OwnedTubes> tubes,
               std::shared_ptr<OwnedMotion> motion, int worlds)
        : scene_(make_scene(std::move(rod), std::move(lumen), std::move(loads), origin, orientation, options, drives, std::move(tubes), std::move(motion))),
          count_(std::size_t(worlds)) {
        require(worlds >= 1, "a simulation needs at least one world");
        values_.assign(count_ * width(), 0.0);
    }

    Simulation(const Simulation&) = delete;  // `processor_` refers to this one's scene

    // Puts worlds at the ostium, ready to be pushed to their first inserted length by the next run. `initial` and `friction` have a row a
    // world and a column a device.
    void reset(const Indices<1>& index, const Array<3>& initial, const Array<2>& friction, double sample_period) {
        const std::size_t n = index.size(), devices = std::size_t(this->devices());
        require(initial.shape(0) == n && initial.shape(1) == devices && initial.shape(2) == 2 && friction.shape(0) == n && friction.shape(1) == devices,
                "reset needs one row a world and one entry a device");
        for (std::size_t k = 0; k < n; ++k) {
            require(index.data()[k] >= 0 && std::size_t(index.data()[k]) < count_, "reset names no such world");
            start_world(view_, world(std::size_t(index.data()[k])), initial.data() + 2 * k * devices, friction.data() + k * devices, sample_period);
        }
    }

    nb::dict run(const Array<4>& control, bool force_driven, double time_step, int steps_per_sample, bool record_shape,
                 bool record_attitude, int threads, int lanes, const nb::object& progress) {
        const std::size_t samples = control.shape(1), devices = std::size_t(this->devices()), nodes = std::size_t(scene_.rod.nodes);
        require(control.shape(0) == count_ && control.shape(2) == devices && control.shape(3) == 2, "control needs two numbers a world, sample and device");
        require(devices == 1 || !force_driven, "devices with catheters are not driven by force");
        require(steps_per_sample >= 1 && time_step > 0, "time step and steps per sample must be positive");
        const Inputs in{.samples = int(samples),
                        .steps_per_sample = steps_per_sample,
                        .time_step = time_step,
                        .force_driven = force_driven,
                        .control = control.data()};
        Outputs out;
        nb::dict result;
        each_output(out, [&]<class T>(const char* name, T*& array, Of of, int numbers) {
            if ((of == Of::node && !record_shape) || (of == Of::element && !record_attitude)) return;
            std::vector<std::size_t> shape{count_};
            if (of != Of::start) shape.push_back(samples);
            if (of == Of::device || of == Of::start) shape.push_back(devices);
            if (of == Of::node || of == Of::element) shape.push_back(nodes);
            if (numbers > 1) shape.push_back(std::size_t(numbers));
            OutputArray<T> made(count_ * entries(of, samples, devices, nodes) * std::size_t(numbers));
            array = made.data;
            result[name] = made.shaped(shape);
        });
        processor_.step(this->worlds(), in, out, by_depth(in), threads, lanes, progress);
        return result;
    }

    nb::object state() {
        OutputArray<double> all(values_.size());
        std::copy(values_.begin(), values_.end(), all.data);
        return all.array(count_, width());
    }

    void set_state(const Array<2>& all) {
        require(all.shape(0) == count_ && all.shape(1) == width(), "the state has another shape");
        std::copy_n(all.data(), values_.size(), values_.begin());
    }

    // A number of each world.
    nb::object scalar(World::Scalar which) {
        OutputArray<double> out(count_);
        for (std::size_t w = 0; w < count_; ++w) out.data[w] = world(w)[which];
        return out.array(count_);
    }

    // `size` numbers of each device, which `write(world, its pose, device, to)` writes.
    template <class Write>
    nb::object per_device(int size, const Write& write) {
        OutputArray<double> out(count_ * std::size_t(devices() * size));
        double* to = out.data;
        for (std::size_t w = 0; w < count_; ++w) {
            const Pose pose(view_, world(w));
            for (int k = 0; k < devices(); ++k, to += size) write(world(w), pose, k, to);
        }
        return size == 1 ? out.array(count_, devices()) : out.array(count_, devices(), size);
    }

    nb::object per_device(World::DeviceQuantity which) {
        return per_device(1, [which](const World& w, const Pose&, int k, double* to) { *to = w.device(k)[which]; });
    }

    nb::object tips() {
        return per_device(3, [](const World&, const Pose& pose, int k, double* to) { put(pose.tip(k), to); });
    }

    nb::object tip_directions() {
        return per_device(3, [](const World&, const Pose& pose, int k, double* to) { put(pose.tip_direction(k), to); });
    }

    // `size` numbers of each node, which `write(world, its pose, node, to)` writes.
    template <class Write>
    nb::object per_node(int size, const Write& write) {
        const std::size_t nodes = std::size_t(scene_.rod.nodes);
        OutputArray<double> out(count_ * nodes * std::size_t(size));
        double* to = out.data;
        for (std::size_t k = 0; k < count_; ++k) {
            const Pose pose(view_, world(k));
            for (int i = 0; i < scene_.rod.nodes; ++i, to += size) write(world(k), pose, i, to);
        }
        return size == 1 ? out.array(count_, nodes) : out.array(count_, nodes, size);
    }

    nb::object positions() {
        return per_node(3, [](const World&, const Pose& pose, int i, double* to) { put(pose.position(i), to); });
    }

    nb::object attitudes() {
        return per_node(4, [](const World&, const Pose& pose, int i, double* to) {
            const Quaternion<double> q = pose.attitude(i);
            to[0] = q.w;
            put(q.v, to + 1);
        });
    }

    // Forces of the wall at each node and at the middle of the element behind it, added up.
    nb::object contacts() {
        return per_node(1, [](const World& w, const Pose&, int i, double* to) { *to = i < w.active() ? w.force(i) : 0.0; });
    }

    int nodes() const { return scene_.rod.nodes; }

private:
    const OwnedScene scene_;
    const Scene view_ = view(scene_, InPlace{});
    const std::size_t count_;
    std::vector<double> values_;  // of all worlds, one after the other
    Processor processor_{scene_};

    int devices() const { return scene_.drives.count; }

    static OwnedScene make_scene(Rod rod, std::shared_ptr<LumenMap> lumen, std::shared_ptr<OwnedLoads> loads, const Array<1>& origin,
                                 const Array<1>& orientation, const Options& options, const Drives& drives, std::shared_ptr<OwnedTubes> tubes,
                                 std::shared_ptr<OwnedMotion> motion) {
        require(origin.size() == 3 && orientation.size() == 4, "the base needs a position and a quaternion");
        require(!loads || int(loads->force.size()) == rod.nodes, "loads need one entry a node of the rod");
        require(drives.count == (tubes ? tubes->tubes : 1), "every device needs the limits of its drive");
        const Base base{.origin = vec3(origin.data()), .orientation = quaternion(orientation.data())};
        return {std::move(rod), std::move(lumen), std::move(loads), base, options, drives, std::move(tubes), std::move(motion)};
    }

    std::size_t width() const { return World::size(scene_.rod.nodes, devices()); }
    Worlds worlds() { return {values_.data(), std::ptrdiff_t(width()), 1, devices()}; }
    World world(std::size_t w) { return worlds()[w]; }

    static void put(const Vec3<double>& v, double* to) { to[0] = v.x, to[1] = v.y, to[2] = v.z; }

    // The worlds in the order of their mean inserted length, so that those under way together are of similar length.
    std::vector<int> by_depth(const Inputs& in) {
        std::vector<double> depth;
        for (std::size_t w = 0; w < count_; ++w) {
            const World start = world(w);
            double inserted = start[World::kApproach] > 0 ? start.device(0)[World::kDepth] : start[World::kInserted], sum = inserted;
            for (int s = 0; s < in.samples && !in.force_driven; ++s) {
                inserted += in.control[2 * std::size_t(devices()) * (w * std::size_t(in.samples) + std::size_t(s))] * in.time_step * in.steps_per_sample;
                sum += inserted;
            }
            depth.push_back(sum);
        }
        std::vector<int> order(count_);
        std::iota(order.begin(), order.end(), 0);
        std::stable_sort(order.begin(), order.end(), [&](int a, int b) { return depth[std::size_t(a)] > depth[std::size_t(b)]; });
        return order;
    }
};

}  // namespace endopilot
