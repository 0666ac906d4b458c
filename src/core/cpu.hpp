// The processor as the device that steps worlds: lanes and threads, with the interpreter lock released.
#pragma once

#include <nanobind/nanobind.h>

#include <atomic>
#include <chrono>
#include <memory>
#include <stdexcept>
#include <string>
#include <thread>
#include <tuple>
#include <vector>

#include "queue.hpp"
#include "stepper.hpp"

namespace endopilot {

namespace nb = nanobind;

using TimePoint = std::chrono::steady_clock::time_point;

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

// A stepper with its nodes.
template <class V, int T>
class ThreadStepper {
public:
    ThreadStepper(const Scene& scene, const Worlds& worlds)
        : node_(std::size_t(scene.rod.nodes)), factor_(std::size_t(scene.rod.nodes)), stepper_(scene, worlds, node_.data(), factor_.data()) {}

    void prepare(const Inputs& in, const Outputs& out) { stepper_.prepare(in, out); }

    // Steps worlds of the queue. Returns true when none is left or `stop` is set, and false at the time `until`: call it
    // again to go on. `done` counts finished samples.
    bool run(WorkQueue& queue, std::atomic<long>& done, const std::atomic<bool>& stop, TimePoint until) {
        while (!stop.load(std::memory_order_relaxed)) {
            const int samples = stepper_.turn(queue);
            if (samples >= 0) {
                done.fetch_add(samples, std::memory_order_relaxed);
            } else {
                if (queue.done()) return true;
                std::this_thread::yield();
            }
            if (std::chrono::steady_clock::now() > until) return false;
        }
        return true;
    }

private:
    std::vector<Node<V, T>> node_;
    std::vector<Factor<V, T>> factor_;
    Stepper<V, T> stepper_;
};

class Cpu {
public:
    explicit Cpu(const OwnedScene& scene) : scene_(view(scene, InPlace{})) {}

    // Steps worlds, `lanes` of them side by side on each thread; `order` names those of similar length next to each other.
    void step(const Worlds& worlds, const Inputs& in, const Outputs& out, std::vector<int> order, int threads, int lanes,
              const nb::object& progress) {
        if (scene_.drives.count == 1)
            step<0>(worlds, in, out, std::move(order), threads, lanes, progress);
        else if (scene_.drives.count == 2)
            step<1>(worlds, in, out, std::move(order), threads, lanes, progress);
        else
            step<2>(worlds, in, out, std::move(order), threads, lanes, progress);
    }

private:
    const Scene scene_;
    template <class V, int T>
    using Steppers = std::vector<std::unique_ptr<ThreadStepper<V, T>>>;  // one a thread, kept from call to call
    template <int T>
    using OfTubes = std::tuple<Steppers<double, T>, Steppers<double4, T>, Steppers<double8, T>>;
    std::tuple<OfTubes<0>, OfTubes<1>, OfTubes<2>> steppers_;
    static constexpr int kUnderWay = 64;  // worlds under way for each thread: enough to find some of similar length

    template <int T>
    void step(const Worlds& worlds, const Inputs& in, const Outputs& out, std::vector<int> order, int threads, int lanes,
              const nb::object& progress) {
        if (lanes == 1)
            step<double, T>(worlds, in, out, std::move(order), std::max(1, threads), progress);
        else if (lanes == 4)
            step<double4, T>(worlds, in, out, std::move(order), std::max(1, threads), progress);
        else if (lanes == 8)
            step<double8, T>(worlds, in, out, std::move(order), std::max(1, threads), progress);
        else
            throw std::invalid_argument("lanes: " + std::to_string(lanes) + "; give 1, 4 or 8");
    }

    template <class V, int T>
    void step(const Worlds& worlds, const Inputs& in, const Outputs& out, std::vector<int> order, int threads, const nb::object& progress) {
        Steppers<V, T>& steppers = std::get<Steppers<V, T>>(std::get<T>(steppers_));
        while (int(steppers.size()) < threads) steppers.push_back(std::make_unique<ThreadStepper<V, T>>(scene_, worlds));
        for (const auto& stepper : steppers) stepper->prepare(in, out);
        std::vector<double> length;
        for (std::size_t w = 0; w < order.size(); ++w) length.push_back(worlds[w][World::kActive]);
        WorkQueue queue(std::move(order), std::move(length), kUnderWay * threads);
        std::atomic<long> done{0};
        std::atomic<bool> stop{false};
        run_threads(threads, progress, done, stop, [&](int thread, TimePoint until) {
            return steppers[std::size_t(thread)]->run(queue, done, stop, until);
        });
    }
};

}  // namespace endopilot
