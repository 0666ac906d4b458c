// Many worlds of one stack of devices in one lumen.
#pragma once

#include <algorithm>
#include <utility>
#include <vector>

#include "world.hpp"

namespace endopilot {

// `Processor` steps the worlds: the processor's threads (cpu.hpp) or a GPU (cuda.hpp).
template <class Processor>
class Simulation {
public:
    Simulation(OwnedScene scene, std::size_t count) : scene_(std::move(scene)), count_(count), values_(count * width()) {}
    Simulation(const Simulation&) = delete;  // `processor_` refers to this one's scene

    const Scene& scene() const { return view_; }
    std::size_t count() const { return count_; }
    std::size_t devices() const { return std::size_t(scene_.drives.count); }
    std::size_t nodes() const { return std::size_t(scene_.rod.nodes); }
    std::size_t width() const { return World::size(scene_.rod.nodes, scene_.drives.count); }   // numbers of a world
    std::vector<double>& values() { return values_; }   // of all worlds, one after the other
    Worlds worlds() { return {values_.data(), std::ptrdiff_t(width()), 1, scene_.drives.count}; }

    // Steps the worlds that are `chosen`; the others stay as they are, and so do their outputs.
    void step(const Inputs& in, std::vector<int> chosen, const Outputs& out, int threads, int lanes, const Progress& progress) {
        processor_.step(worlds(), in, out, by_depth(in, std::move(chosen)), threads, lanes, progress);
    }

private:
    const OwnedScene scene_;
    const Scene view_ = view(scene_, InPlace{});
    const std::size_t count_;
    std::vector<double> values_;
    Processor processor_{scene_};

    // Worlds in the order of their mean inserted length, so that those under way together are of similar length.
    std::vector<int> by_depth(const Inputs& in, std::vector<int> order) {
        std::vector<double> depth;
        for (std::size_t w = 0; w < count_; ++w) {
            const World start = worlds()[w];
            double inserted = start[World::kApproach] > 0 ? start.device(0)[World::kDepth] : start[World::kInserted], sum = inserted;
            for (int s = 0; s < in.samples && !in.force_driven; ++s) {
                inserted += in.control[2 * devices() * (w * std::size_t(in.samples) + std::size_t(s))] * in.time_step * in.steps_per_sample;
                sum += inserted;
            }
            depth.push_back(sum);
        }
        std::stable_sort(order.begin(), order.end(), [&](int a, int b) { return depth[std::size_t(a)] > depth[std::size_t(b)]; });
        return order;
    }
};

}  // namespace endopilot
