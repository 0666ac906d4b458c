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

// Many worlds of one device in one lumen. `Device` steps them: a processor (cpu.hpp) or a GPU (gpu.hpp).
template <class Device>
class Simulation {
public:
    Simulation(Rod rod, std::shared_ptr<LumenMap> lumen, std::shared_ptr<OwnedLoads> loads, const Array<1>& origin,
               const Array<1>& orientation, const Options& options, std::shared_ptr<OwnedTubes> tubes, std::shared_ptr<OwnedMotion> motion, int worlds)
        : scene_(make_scene(std::move(rod), std::move(lumen), std::move(loads), origin, orientation, options, std::move(tubes), std::move(motion))),
          count_(std::size_t(worlds)) {
        require(worlds >= 1, "a simulation needs at least one world");
        values_.assign(count_ * width(), 0.0);
    }

    Simulation(const Simulation&) = delete;  // `device_` refers to this one's scene

    // Puts worlds at the ostium, ready to be pushed to their first inserted length by the next run.
    void reset(const Indices<1>& index, const Array<2>& initial, const Array<1>& friction, double sample_period) {
        const std::size_t n = index.size();
        const std::size_t drives = std::size_t(this->drives());
        require(initial.shape(0) == n && initial.shape(1) == 2 * drives && friction.size() == n * drives, "reset needs one row a world");
        for (std::size_t k = 0; k < n; ++k) {
            require(index.data()[k] >= 0 && std::size_t(index.data()[k]) < count_, "reset names no such world");
            const double* start = initial.data() + 2 * k * drives;
            const World w = world(std::size_t(index.data()[k]));
            if (drives == 1)
                start_world(view_, w, start[0], start[1], friction.data()[k], sample_period);
            else
                start_tubes(view_, w, start, friction.data() + k * drives, sample_period);
        }
    }

    nb::dict run(const Array<3>& control, bool force_driven, double time_step, int steps_per_sample, bool record_shape,
                 bool record_attitude, int threads, int lanes, const nb::object& progress) {
        const std::size_t worlds = count_, samples = control.shape(1), n = worlds * samples, nodes = std::size_t(scene_.rod.nodes);
        const std::size_t drives = std::size_t(this->drives());
        require(control.shape(0) == worlds && control.shape(2) == 2 * drives, "control needs two numbers a world, sample and drive");
        require(drives == 1 || !force_driven, "tubes are not driven by force");
        require(steps_per_sample >= 1 && time_step > 0, "time step and steps per sample must be positive");
        OutputArray<double> inserted(n), rotation(n), tip(3 * n), direction(3 * n), force_max(n), force_sum(n), wall_force(n),
            base_force(n), base_torque(n), drive_force(n), drive_torque(n), iterations(n), node_iterations(n), slip(n),
            rotation_slip(n), approach_slip(2 * worlds);
        OutputArray<double> tubes(drives > 1 ? n * drives * kTubeOutputs : 0);
        OutputArray<bool> valid(n);
        OutputArray<double> shape(record_shape ? 3 * n * nodes : 0), attitude(record_attitude ? 4 * n * nodes : 0);
        nb::dict result;
        result["inserted_length"] = inserted.array(worlds, samples);
        result["rotation"] = rotation.array(worlds, samples);
        result["tip_position"] = tip.array(worlds, samples, 3);
        result["tip_direction"] = direction.array(worlds, samples, 3);
        result["contact_force_max"] = force_max.array(worlds, samples);
        result["contact_force_sum"] = force_sum.array(worlds, samples);
        result["wall_force"] = wall_force.array(worlds, samples);
        result["base_force"] = base_force.array(worlds, samples);
        result["base_torque"] = base_torque.array(worlds, samples);
        result["drive_force"] = drive_force.array(worlds, samples);
        result["drive_torque"] = drive_torque.array(worlds, samples);
        result["iterations"] = iterations.array(worlds, samples);
        result["node_iterations"] = node_iterations.array(worlds, samples);
        result["slip"] = slip.array(worlds, samples);
        result["rotation_slip"] = rotation_slip.array(worlds, samples);
        result["approach_slip"] = approach_slip.array(worlds, 2);
        result["valid"] = valid.array(worlds, samples);
        nb::object shapes = shape.array(record_shape ? worlds : 0, samples, nodes, 3);
        nb::object attitudes = attitude.array(record_attitude ? worlds : 0, samples, nodes, 4);
        nb::object of_tubes = tubes.array(drives > 1 ? worlds : 0, samples, drives, kTubeOutputs);
        if (drives > 1) result["tubes"] = of_tubes;
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
                          .wall_force = wall_force.data,
                          .base_force = base_force.data,
                          .base_torque = base_torque.data,
                          .drive_force = drive_force.data,
                          .drive_torque = drive_torque.data,
                          .iterations = iterations.data,
                          .node_iterations = node_iterations.data,
                          .slip = slip.data,
                          .rotation_slip = rotation_slip.data,
                          .valid = valid.data,
                          .approach_slip = approach_slip.data,
                          .shape = record_shape ? shape.data : nullptr,
                          .attitude = record_attitude ? attitude.data : nullptr,
                          .tubes = drives > 1 ? tubes.data : nullptr};
        device_.step(this->worlds(), in, out, by_depth(in), threads, lanes, progress);
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

    // Where one of the devices ends, the wire (0) or a catheter around it.
    nb::object tips(int device) {
        require(device >= 0 && device < drives(), "there is no such device");
        OutputArray<double> out(3 * count_);
        for (std::size_t w = 0; w < count_; ++w) {
            const Pose pose(view_, world(w));
            put(drives() == 1 ? pose.position(0) : pose.tube_tip(device), out.data + 3 * w);
        }
        return out.array(count_, 3);
    }

    nb::object tip_directions(int device) {
        require(device >= 0 && device < drives(), "there is no such device");
        OutputArray<double> out(3 * count_);
        for (std::size_t w = 0; w < count_; ++w) {
            const Pose pose(view_, world(w));
            put(drives() == 1 ? pose.tip_direction() : pose.tube_direction(device), out.data + 3 * w);
        }
        return out.array(count_, 3);
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

    // The numbers of each tube, as World has them: worlds × tubes × TubeQuantity.
    nb::object tubes() {
        const std::size_t drives = std::size_t(this->drives());
        require(drives > 1, "a wire alone has no tubes");
        OutputArray<double> out(count_ * drives * World::kTubeSize);
        for (std::size_t w = 0; w < count_; ++w)
            for (std::size_t k = 0; k < drives * World::kTubeSize; ++k) out.data[w * drives * World::kTubeSize + k] = world(w).tube(nodes(), 0)[int(k)];
        return out.array(count_, drives, World::kTubeSize);
    }

    int nodes() const { return scene_.rod.nodes; }

private:
    const OwnedScene scene_;
    const Scene view_ = view(scene_, InPlace{});
    const std::size_t count_;
    std::vector<double> values_;  // of all worlds, one after the other
    Device device_{scene_};

    int drives() const { return scene_.tubes ? scene_.tubes->tubes : 1; }

    static OwnedScene make_scene(Rod rod, std::shared_ptr<LumenMap> lumen, std::shared_ptr<OwnedLoads> loads, const Array<1>& origin,
                                 const Array<1>& orientation, const Options& options, std::shared_ptr<OwnedTubes> tubes,
                                 std::shared_ptr<OwnedMotion> motion) {
        require(origin.size() == 3 && orientation.size() == 4, "the base needs a position and a quaternion");
        require(!loads || int(loads->force.size()) == rod.nodes, "loads need one entry a node of the rod");
        const Base base{.origin = vec3(origin.data()), .orientation = quaternion(orientation.data())};
        return {std::move(rod), std::move(lumen), std::move(loads), base, options, std::move(tubes), std::move(motion)};
    }

    std::size_t width() const { return World::size(scene_.rod.nodes, drives() - 1); }
    Worlds worlds() { return {values_.data(), std::ptrdiff_t(width()), 1}; }
    World world(std::size_t w) { return worlds()[w]; }

    static void put(const Vec3<double>& v, double* to) { to[0] = v.x, to[1] = v.y, to[2] = v.z; }

    // The worlds in the order of their mean inserted length, so that those under way together are of similar length.
    std::vector<int> by_depth(const Inputs& in) {
        std::vector<double> depth;
        for (std::size_t w = 0; w < count_; ++w) {
            const World start = world(w);
            double inserted = start[World::kApproach] > 0 ? start[World::kDepth] : start[World::kInserted], sum = inserted;
            for (int s = 0; s < in.samples && !in.force_driven; ++s) {
                inserted += in.control[2 * std::size_t(drives()) * (w * std::size_t(in.samples) + std::size_t(s))] * in.time_step * in.steps_per_sample;
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
