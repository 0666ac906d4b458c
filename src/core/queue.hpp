// The queue that hands worlds to the lanes of a processor's threads.
#pragma once

#include <algorithm>
#include <cmath>
#include <limits>
#include <mutex>
#include <vector>

namespace endopilot {

// A work queue: hands worlds to lanes, one sample at a time. Lanes of a stepper sweep over the nodes of the longest wire
// among them, so they are given worlds of similar length. A world's result does not depend on the lane that steps it.
class WorkQueue {
public:
    // `order`: the worlds, those of similar length next to each other; `length`: their active nodes. At most `size` of them
    // are under way at a time.
    WorkQueue(std::vector<int> order, std::vector<double> length, int size)
        : order_(std::move(order)), length_(std::move(length)), size_(size) {}

    // Takes a world whose number of active nodes is near `length` (any, if negative); -1 where none is ready. `sample` is
    // the one that comes next.
    int next(double length, int& sample) {
        const std::lock_guard<std::mutex> lock(mutex_);
        while (under_way_ < size_ && next_ < order_.size()) {
            const int world = order_[next_++];
            ready_.push_back({world, 0, length_[std::size_t(world)]});
            ++under_way_;
        }
        if (ready_.empty()) return -1;
        int first = std::numeric_limits<int>::max();
        for (const Ready& r : ready_) first = std::min(first, r.sample);
        std::size_t best = ready_.size();
        double least = 0;
        for (std::size_t i = 0; i < ready_.size(); ++i) {
            if (ready_[i].sample > first + kLead) continue;  // so that all end at about the same time
            const double off = length < 0 ? double(ready_[i].sample) : std::abs(ready_[i].length - length);
            if (best == ready_.size() || off < least) best = i, least = off;
        }
        const Ready taken = ready_[best];
        ready_.erase(ready_.begin() + std::ptrdiff_t(best));
        sample = taken.sample;
        return taken.world;
    }

    void put_back(int world, int sample, double length) {
        const std::lock_guard<std::mutex> lock(mutex_);
        ready_.push_back({world, sample, length});
    }

    void finish() {
        const std::lock_guard<std::mutex> lock(mutex_);
        --under_way_;
    }

    bool done() {
        const std::lock_guard<std::mutex> lock(mutex_);
        return under_way_ == 0 && next_ == order_.size();
    }

private:
    static constexpr int kLead = 8;  // samples
    struct Ready {
        int world, sample;
        double length;
    };
    std::mutex mutex_;
    std::vector<int> order_;
    std::vector<double> length_;
    std::size_t next_ = 0;
    int size_, under_way_ = 0;
    std::vector<Ready> ready_;
};

}  // namespace endopilot
