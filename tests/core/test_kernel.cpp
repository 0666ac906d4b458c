// The GPU's path, run on the processor, against the scalar lanes of a processor's thread: the same numbers to the bit. Built
// with sanitizers and run by test_core_sanitized.py; `cuda_runtime.h` is that of cuda_on_cpu.
#include <cmath>
#include <cstdio>
#include <cstdlib>
#include <cstring>
#include <limits>
#include <random>

#include "cuda.cu"
#include "queue.hpp"
#include "spline.hpp"

using namespace endopilot;

namespace {

int failures = 0;

void expect(bool fine, const char* what) {
    if (fine) return;
    std::printf("FAILED: %s\n", what);
    ++failures;
}

constexpr double kPeriod = 0.5;  // s
constexpr int kWorlds = 37, kSamples = 6, kSteps = 10;

// A uniform wire with a bent tip.
Rod make_rod(int nodes) {
    Rod rod{.nodes = nodes};
    for (int i = 0; i < nodes; ++i) rod.abscissa.push_back(0.9 * i);
    rod.length.assign(nodes, 0.9), rod.joint_length.assign(nodes, 0.9);
    rod.shear.assign(nodes, 200.0), rod.stretch.assign(nodes, 500.0);
    rod.bend.assign(nodes, 4.0), rod.twist.assign(nodes, 3.0);
    rod.radius.assign(nodes, 0.18), rod.drag.assign(nodes, 1e-3), rod.spin_drag.assign(nodes, 1e-4);
    for (int i = 0; i < nodes; ++i) rod.rest.push_back({i < 6 ? 0.15 : 0.0, 0, 0});
    return rod;
}

// A tube of 1.5 mm radius: straight along x up to the origin, then a quarter of a circle of 18 mm radius towards z.
LumenMap make_map() {
    const int size[3] = {73, 14, 62};
    const double origin[3] = {-8.2, -2.6, -2.6}, spacing = 0.4;
    std::vector<float> values;
    for (int k = 0; k < size[2]; ++k)
        for (int j = 0; j < size[1]; ++j)
            for (int i = 0; i < size[0]; ++i) {
                const double x = origin[0] + spacing * i, y = origin[1] + spacing * j, z = origin[2] + spacing * k;
                const double off = x < 0 ? z : std::hypot(x, z - 18.0) - 18.0;
                values.push_back(float(1.5 - std::hypot(off, y)));
            }
    return make_lumen_map(spline_coefficients(values.data(), size).data(), size, origin, spacing, 0.6, 0.5);
}

// Dead forces on the tip, and a weak spring.
OwnedLoads make_loads(std::size_t nodes) {
    OwnedLoads loads{.force = {}, .moment = {}, .spring = {}, .anchor = {}, .hold = {}, .attitude = {}};
    loads.force.assign(nodes, {0, 0, 0}), loads.moment.assign(nodes, {0, 0, 0}), loads.spring.assign(nodes, {1e-3, 0, 1e-3});
    loads.anchor.assign(nodes, {5, 0, 2}), loads.hold.assign(nodes, 0.0), loads.attitude.assign(nodes, {1, {0, 0, 0}});
    loads.force[0] = {0, 1e-3, 0};
    return loads;
}

// Shifts, turns and shrinks by a few per cent and back in 0.8 s.
OwnedMotion make_motion() {
    OwnedMotion motion{.cycles = 1, .knots = 8, .ostium = {-3.0, 0.0, 0.0}, .coefficients = {}};
    motion.period[0] = 0.8;
    const double most[OwnedMotion::kNumbers] = {3, -2, 1, 0.1, 0.05, -0.1, -0.05, -0.03, -0.04, 0.01, 0, 0.02};
    for (int k = 0; k < motion.knots; ++k)
        for (double number : most) motion.coefficients.push_back(number * (1 - std::cos(2 * std::acos(-1.0) * k / motion.knots)) / 2);
    return motion;
}

// A wire with a bent tip, and catheters around it: profiles are integrals from the tip, 0.5 mm apart.
OwnedTubes make_tubes(int devices) {
    OwnedTubes tubes{.tubes = devices, .points = 100, .spacing = 0.5, .shear_share = 0.4};
    for (int k = 0; k < devices; ++k) {
        for (int i = 0; i < tubes.points; ++i) {
            const double at = tubes.spacing * i;
            tubes.bend.push_back((4.0 + 3 * k) * at), tubes.twist.push_back((3.0 + 2 * k) * at), tubes.stretch.push_back(500.0 * at);
            tubes.rest.push_back((k == 0 ? 0.15 : 0.05) * std::min(at, 6.0));
        }
        tubes.radius.push_back(0.18 + 0.15 * k), tubes.bore_friction.push_back(k == 0 ? 0.0 : 0.1);
    }
    return tubes;
}

OwnedScene make_scene(int devices, bool with_loads, bool moving = false) {
    const double half = std::sqrt(0.5);
    OwnedScene scene{.rod = make_rod(40),
                     .lumen = std::make_shared<LumenMap>(make_map()),
                     .loads = with_loads ? std::make_shared<OwnedLoads>(make_loads(40)) : nullptr,
                     .base = {.origin = {-3.0, 0.0, 0.0}, .orientation = {half, {0, half, 0}}},
                     .options = {.stick_velocity = 0.05, .wall_stiffness = 100.0, .foundation = 0.0, .foundation_stiffening = 0.0, .foundation_at_tip = 0.0, .tolerance = 1e-3, .sample_tolerance = 1e-6,
                                 .largest_step = 0.3, .largest_jump = 0.1, .max_iterations = 400, .free_behind = 3.0,
                                 .approach_velocity = 20.0, .introducer_friction = 0.05, .introducer_drag = 0.002},
                     .drives = {.count = devices},
                     .tubes = devices > 1 ? std::make_shared<OwnedTubes>(make_tubes(devices)) : nullptr,
                     .motion = moving ? std::make_shared<OwnedMotion>(make_motion()) : nullptr};
    for (int k = 0; k < devices; ++k) scene.drives.push[k] = scene.drives.pull[k] = 0.05, scene.drives.torque[k] = 0.5;
    return scene;
}

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
void test_kernel(bool by_force, bool with_loads, bool moving = false) {
    const OwnedScene owned = make_scene(1 + T, with_loads, moving);
    const Scene scene = view(owned, InPlace{});
    std::mt19937 random(4);
    std::uniform_real_distribution<double> any(-1.0, 1.0);
    std::vector<double> control;
    for (int k = 0; k < kWorlds * kSamples * (1 + T); ++k) {
        control.push_back(by_force ? 0.1 * any(random) : 2 + 5 * any(random));
        control.push_back(by_force ? 0.1 * any(random) : 2 * any(random));
    }
    control[2 * (1 + T) * (5 * kSamples + 2)] = std::numeric_limits<double>::quiet_NaN();  // ends world 5
    const Inputs in{.samples = kSamples, .steps_per_sample = kSteps, .time_step = kPeriod / kSteps, .force_driven = by_force, .control = control.data()};

    Recorded processor(scene), gpu(scene);
    std::vector<int> order;
    for (int w = 0; w < kWorlds; ++w) order.push_back((w * 7) % kWorlds);
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
    expect(done == kWorlds * kSamples, "progress counts all samples");

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
    for (int devices = 1; devices <= kMostDevices; ++devices) test_longest(devices, kMostNodes[devices - 1]);
    std::printf(failures == 0 ? "all core tests passed\n" : "%d core checks failed\n", failures);
    return failures == 0 ? EXIT_SUCCESS : EXIT_FAILURE;
}
