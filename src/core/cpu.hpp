// The processor as the device that steps worlds: lanes and threads.
#pragma once

#include <atomic>
#include <chrono>
#include <stdexcept>
#include <string>
#include <thread>
#include <tuple>
#include <utility>
#include <vector>

#include "queue.hpp"
#include "step.hpp"

namespace endopilot {

using TimePoint = std::chrono::steady_clock::time_point;

// Calls `work(thread, until)` on `threads` threads, this one being number 0, until it returns true. On this thread it gets
// a time to return at, so that `progress` learns of the samples that are `done`; if that throws, `stop` is set.
template <class Work>
void run_threads(int threads, const Progress& progress, const std::atomic<long>& done, std::atomic<bool>& stop, const Work& work) {
    std::exception_ptr failure;
    long reported = 0;
    const auto report = [&] {
        try {
            const long now = done.load();
            progress(now - std::exchange(reported, now));
        } catch (...) {
            failure = std::current_exception();
            stop.store(true);
        }
    };
    std::vector<std::thread> others;
    for (int t = 1; t < threads; ++t) others.emplace_back([&work, t] { work(t, TimePoint::max()); });
    while (!work(0, std::chrono::steady_clock::now() + std::chrono::milliseconds(100))) report();
    for (std::thread& thread : others) thread.join();
    if (!failure) report();
    if (failure) std::rethrow_exception(failure);
}

class Cpu {
public:
    explicit Cpu(const OwnedScene& scene) : scene_(view(scene, InPlace{})) {}

    // Steps worlds, `lanes` of them side by side on each thread; `order` names those of similar length next to each other.
    void step(const Worlds& worlds, const Inputs& in, const Outputs& out, std::vector<int> order, int threads, int lanes,
              const Progress& progress) {
        std::vector<double> length;
        for (int w = 0; w < in.worlds; ++w) length.push_back(worlds[std::size_t(w)][World::kActive]);
        const Run run{scene_, worlds, in, out};
        threads = std::max(1, threads);
        WorkQueue queue(std::move(order), std::move(length), kUnderWay * threads);
        const auto run_with = [&]<class V, int T>(std::vector<Memory<V, T>>& memory) { step(run, queue, memory, threads, progress); };
        const auto with_lanes = [&]<int T>(OfStack<T>& memory) {
            if (lanes == 1) run_with(std::get<0>(memory));
            else if (lanes == 4) run_with(std::get<1>(memory));
            else if (lanes == 8) run_with(std::get<2>(memory));
            else throw std::invalid_argument("lanes: " + std::to_string(lanes) + "; give 1, 4 or 8");
        };
        if (scene_.drives.count == 1) with_lanes(std::get<0>(memory_));
        else if (scene_.drives.count == 2) with_lanes(std::get<1>(memory_));
        else with_lanes(std::get<2>(memory_));
    }

private:
    // What a thread works with, an entry a node of the rod; kept from call to call.
    template <class V, int T>
    struct Memory {
        std::vector<Node<V, T>> node;
        std::vector<Factor<V, T>> factor;
    };
    template <int T>
    struct OfStack : std::tuple<std::vector<Memory<double, T>>, std::vector<Memory<double4, T>>, std::vector<Memory<double8, T>>> {};
    const Scene scene_;
    std::tuple<OfStack<0>, OfStack<1>, OfStack<2>> memory_;
    static constexpr int kUnderWay = 64;  // worlds under way for each thread: enough to find some of similar length

    template <class V, int T>
    static void step(const Run& run, WorkQueue& queue, std::vector<Memory<V, T>>& memory, int threads, const Progress& progress) {
        const std::size_t nodes = std::size_t(run.scene.rod.nodes);
        while (int(memory.size()) < threads) memory.push_back({std::vector<Node<V, T>>(nodes), std::vector<Factor<V, T>>(nodes)});
        std::vector<Lanes<V, T>> lanes;
        for (int t = 0; t < threads; ++t) lanes.emplace_back(memory[std::size_t(t)].node.data(), memory[std::size_t(t)].factor.data());
        std::atomic<long> done{0};
        std::atomic<bool> stop{false};
        // true when no world is left or `stop` is set, false at the time `until`
        run_threads(threads, progress, done, stop, [&](int thread, TimePoint until) {
            while (!stop.load(std::memory_order_relaxed)) {
                const int samples = iterate(run, lanes[std::size_t(thread)], queue);
                if (samples >= 0) {
                    done.fetch_add(samples, std::memory_order_relaxed);
                } else {
                    if (queue.done()) return true;
                    std::this_thread::yield();
                }
                if (std::chrono::steady_clock::now() > until) return false;
            }
            return true;
        });
    }
};

}  // namespace endopilot
