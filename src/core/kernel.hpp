// A run as a kernel: one world a thread, in scalar lanes.
#pragma once

#include <limits>

#include "step.hpp"

namespace endopilot {

// What the threads of one launch have in common, in memory that they see.
struct Launch {
    Run run;
    int count;          // worlds
    const int* order;   // worlds, those of similar length next to each other: threads of a warp step them together
    int* next;          // the sample that comes next, of each world
    int samples;        // that the launch steps each world at most, those of the approach among them
};

// The queue of a kernel thread: one world, for the samples of one launch.
class OneWorld {
public:
    ENDOPILOT_DEVICE OneWorld(int world, int* next, int samples) : world_(world), next_(next), left_(samples) {}

    ENDOPILOT_DEVICE int next(double, int& sample) {
        if (left_ == 0 || *next_ == kFinished) return -1;
        --left_;
        sample = *next_;
        return world_;
    }
    ENDOPILOT_DEVICE void put_back(int, int sample, double) { *next_ = sample; }
    ENDOPILOT_DEVICE void finish() { *next_ = kFinished; }

private:
    static constexpr int kFinished = std::numeric_limits<int>::max();
    const int world_;
    int* const next_;
    int left_;
};

// The work of thread number `thread`. `node` and `factor` are its own, one entry a node of the rod.
template <int T>
ENDOPILOT_DEVICE void step_worlds(const Launch& launch, int thread, Node<double, T>* node, Factor<double, T>* factor) {
    if (thread >= launch.count) return;
    const int world = launch.order[thread];
    OneWorld queue(world, launch.next + world, launch.samples);
    Lanes<double, T> lanes(node, factor);
    while (iterate(launch.run, lanes, queue) >= 0) {
    }
}

}  // namespace endopilot
