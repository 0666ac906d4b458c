// The GPU's path, run on the processor, against the scalar lanes of a processor's thread: the same numbers to the bit. Built
// with sanitizers and run by test_core_cpp.py; `cuda_runtime.h` is that of cuda_on_cpu.
#include <cstdio>
#include <cstdlib>
#include <cstring>
#include <limits>
#include <random>

#include "cuda.cu"
#include "queue.hpp"
#include "scene.hpp"

using namespace endopilot;

namespace {

int failures = 0;

void expect(bool fine, const char* what) {
    if (fine) return;
    std::printf("FAILED: %s\n", what);
    ++failures;
}

constexpr double kPeriod = 0.5;  // s
constexpr int kWorlds = 9, kSamples = 3, kSteps = 10;

// Worlds at rest and what is recorded of them.
struct Recorded {
    std::size_t nodes, width;
    int devices;
    std::vector<double> values;
    std::vector<std::vector<double>> numbers;
    std::vector<unsigned char> valid;
    Outputs out{};

    explicit Recorded(const Scene& scene) : nodes(std::size_t(scene.rod.nodes)), width(World::size(scene.rod.nodes, scene.drives.count)), devices(scene.drives.count) {
        values.resize(kWorlds * width);
        std::mt19937 random(3);
        std::uniform_real_distribution<double> any(0.0, 1.0);
        for (int w = 0; w < kWorlds; ++w) {
            double initial[2 * kMostDevices], friction[kMostDevices];
            for (int k = 0; k < devices; ++k) {
                initial[2 * k] = (4 + 12 * any(random)) / (1 + k), initial[2 * k + 1] = 6 * any(random);
                friction[k] = 0.05 + 0.2 * any(random);
            }
            start_world(scene, worlds()[std::size_t(w)], initial, friction, kPeriod);
        }
        valid.assign(kWorlds * kSamples, 0);
        out.valid = reinterpret_cast<bool*>(valid.data());
        each_output(out, [this]<class T>(const char*, T*& array, Of of, int size) {
            if constexpr (std::is_same_v<T, double>)
                array = numbers.emplace_back(kWorlds * entries(of, kSamples, std::size_t(devices), nodes) * std::size_t(size)).data();
        });
    }
    Worlds worlds() { return {values.data(), std::ptrdiff_t(width), 1, devices}; }
};

bool same(const std::vector<double>& a, const std::vector<double>& b) {
    return a.size() == b.size() && std::memcmp(a.data(), b.data(), a.size() * sizeof(double)) == 0;
}

template <int T>
void test_kernel(bool by_force, bool with_loads, bool moving = false, bool chained = false) {
    const OwnedScene owned = make_scene(1 + T, with_loads, moving, chained);
    const Scene scene = view(owned, InPlace{});
    std::mt19937 random(4);
    std::uniform_real_distribution<double> any(-1.0, 1.0);
    std::vector<double> control;
    for (int k = 0; k < kWorlds * kSamples * (1 + T); ++k) {
        control.push_back(by_force ? 0.1 * any(random) : 2 + 5 * any(random));
        control.push_back(by_force ? 0.1 * any(random) : 2 * any(random));
    }
    control[2 * (1 + T) * (5 * kSamples + 1)] = std::numeric_limits<double>::quiet_NaN();  // ends world 5
    const Inputs in{.worlds = kWorlds, .samples = kSamples, .steps_per_sample = kSteps, .time_step = kPeriod / kSteps, .force_driven = by_force, .control = control.data()};

    Recorded processor(scene), gpu(scene);
    std::vector<int> order;
    for (int w = 1; w < kWorlds; ++w) order.push_back((w * 7) % kWorlds);   // world 0 stays as it is
    std::vector<Node<double, T>> node(processor.nodes);
    std::vector<Factor<double, T>> factor(processor.nodes);
    const Run run{scene, processor.worlds(), in, processor.out};
    Lanes<double, T> lanes(node.data(), factor.data());
    WorkQueue queue(order, std::vector<double>(kWorlds, 0.0), 8);
    while (iterate(run, lanes, queue) >= 0) {
    }

    long done = 0;
    const int before = launches;
    CudaStepper(owned).step(gpu.worlds(), in, gpu.out, order, 1, 1, [&](long samples) { done += samples; });
    expect(launches - before >= 2, "a run takes several launches");
    expect(done == (kWorlds - 1) * kSamples, "progress counts all samples");

    expect(same(gpu.values, processor.values), "the same worlds");
    expect(gpu.numbers.size() == processor.numbers.size(), "as many arrays");
    for (std::size_t a = 0; a < gpu.numbers.size(); ++a) expect(same(gpu.numbers[a], processor.numbers[a]), "the same records");
    expect(gpu.valid == processor.valid, "the same worlds are valid");

    int touching = 0, invalid = 0, slipping = 0;
    for (int k = 0; k < kWorlds * kSamples; ++k) {
        slipping += processor.out.slip[(1 + T) * k] > 0;
        touching += processor.out.contact_force_max[k] > 0;
        invalid += !processor.out.valid[k];
    }
    expect(touching > kWorlds, "wires touch the wall");
    expect(by_force || slipping > 0, "the drive slips at its limit");
    expect(invalid > 1 && invalid < kWorlds * kSamples / 2, "a world becomes invalid, most do not");
}

void test_longest(int devices, int most) {
    OwnedScene scene = make_scene(devices, false);
    const auto refused = [&](int nodes) {
        scene.rod = make_rod(nodes);
        try {
            const CudaStepper stepper(scene);
        } catch (const std::runtime_error&) {
            return true;
        }
        return false;
    };
    expect(!refused(most) && refused(most + 1), "a device that a thread's memory does not hold is refused");
}

}  // namespace

int main() {
    test_kernel<0>(false, false);
    test_kernel<0>(true, false);
    test_kernel<0>(false, true);
    test_kernel<0>(false, false, true);
    test_kernel<1>(false, false);
    test_kernel<2>(false, false, true);
    test_kernel<0>(false, false, false, true);
    test_kernel<1>(false, false, false, true);
    for (int devices = 1; devices <= kMostDevices; ++devices) test_longest(devices, kMostNodes[devices - 1]);
    std::printf(failures == 0 ? "all core tests passed\n" : "%d core checks failed\n", failures);
    return failures == 0 ? EXIT_SUCCESS : EXIT_FAILURE;
}
