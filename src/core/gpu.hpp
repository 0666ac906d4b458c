// A GPU as the device that steps worlds, with the interpreter lock released.
#pragma once

#include <nanobind/nanobind.h>

#include "cuda.hpp"

namespace endopilot {

namespace nb = nanobind;

class Gpu {
public:
    explicit Gpu(const OwnedScene& scene) : stepper_(scene) {}

    // Steps worlds, each on a thread of the GPU: the processor's threads and lanes do not matter.
    void step(const Worlds& worlds, const Inputs& in, const Outputs& out, const std::vector<int>& order, int /*threads*/,
              int /*lanes*/, const nb::object& progress) {
        const nb::gil_scoped_release release;
        stepper_.step(worlds, in, out, order, [&](long samples) {
            const nb::gil_scoped_acquire acquire;
            if (PyErr_CheckSignals() != 0) throw nb::python_error();
            if (!progress.is_none() && samples > 0) progress(samples);
        });
    }

private:
    CudaStepper stepper_;
};

}  // namespace endopilot
