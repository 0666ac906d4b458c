// A CUDA GPU that steps worlds, seen from the host and without Python; cuda.cu implements it.
#pragma once

#include <memory>
#include <string>
#include <vector>

#include "world.hpp"

namespace endopilot {

// Why no GPU can be used, such as "no CUDA-capable device is detected"; empty if one can.
std::string why_no_gpu();

class CudaStepper {
public:
    // Puts the scene into the GPU's memory. This and `step` throw std::runtime_error with CUDA's own words.
    explicit CudaStepper(const OwnedScene& scene);
    ~CudaStepper();

    // Steps all worlds to the end of the inputs, each on a thread of the GPU: the processor's threads and lanes do not matter. `order`
    // names those of similar length next to each other. If `progress` throws, the worlds stay as they were before.
    void step(const Worlds& worlds, const Inputs& in, const Outputs& out, const std::vector<int>& order, int threads, int lanes,
              const Progress& progress);

private:
    struct Memory;
    std::unique_ptr<Memory> memory_;
    Scene scene_;  // in the GPU's memory
};

}  // namespace endopilot
