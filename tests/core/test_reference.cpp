// The lanes against a step that is written to be read (reference_step.hpp): wires pushed, turned and pulled back in a tube that bends.
//
// Both minimise the same energy, step by step, with friction that each takes from its own last step. The lanes' directions are in single
// precision: Newton's method gains some six digits an iteration. They end a step when Newton's step moves no node by 1e-8 mm; what is
// left then is rounding, and forty steps of friction pass on less than 1e-9 mm of it. Times the stiffness of the wall, 100 N/mm, and of
// an element along its axis, 555 N/mm, that is 1e-7 and 6e-7 N.
#include <cstdio>
#include <cstdlib>
#include <string>

#include "queue.hpp"
#include "reference_step.hpp"
#include "scene.hpp"
#include "step.hpp"

using namespace endopilot;

namespace {

constexpr int kWorlds = 4, kSamples = 5, kSteps = 8;
constexpr double kPeriod = 0.5;  // s
int failures = 0;

void expect(bool fine, const std::string& what) {
    if (fine) return;
    std::printf("FAILED: %s\n", what.c_str());
    ++failures;
}

double largest(const Vec3<double>& v) { return std::max({std::abs(v.x), std::abs(v.y), std::abs(v.z)}); }

}  // namespace

int main() {
    OwnedScene owned = make_scene(1, false);
    owned.options.tolerance = owned.options.sample_tolerance = 1e-8;
    owned.options.largest_jump = 1e9;          // no shorter steps
    owned.options.approach_velocity = 0;       // worlds start where they are put
    owned.drives.push[0] = owned.drives.pull[0] = owned.drives.torque[0] = 1e9;
    const Scene scene = view(owned, InPlace{});
    const Map map = make_map();
    const reference::DistanceMap distance{map.coefficients, {map.size[0], map.size[1], map.size[2]}, {map.origin[0], map.origin[1], map.origin[2]}, map.spacing};

    const double start[kWorlds][2] = {{6, 0.3}, {8, -1}, {4, 2}, {7, 0}}, friction[kWorlds] = {0.0, 0.1, 0.2, 0.05};
    const double control[kSamples][2] = {{12, 0.5}, {10, -2}, {11, 3}, {-6, 1}, {9, -1}};   // mm/s, rad/s
    const std::size_t width = World::size(scene.rod.nodes, 1);
    std::vector<double> values(kWorlds * width);
    const Worlds worlds{values.data(), std::ptrdiff_t(width), 1, 1};
    std::vector<reference::Wire> wire;
    for (int w = 0; w < kWorlds; ++w) {
        start_world(scene, worlds[std::size_t(w)], start[w], &friction[w], kPeriod);
        wire.emplace_back(scene, distance, friction[w], start[w][0], start[w][1]);
    }

    std::vector<std::vector<double>> numbers;
    bool valid[kWorlds];
    Outputs out;
    each_output(out, [&]<class T>(const char*, T*& array, Of of, int size) {
        if constexpr (std::is_same_v<T, double>)
            array = numbers.emplace_back(kWorlds * entries(of, 1, 1, std::size_t(scene.rod.nodes)) * std::size_t(size)).data();
    });
    out.valid = valid;
    std::vector<Node<double4, 0>> node(std::size_t(scene.rod.nodes));
    std::vector<Factor<double4, 0>> factor(std::size_t(scene.rod.nodes));

    double position = 0, attitude = 0, wall = 0, base = 0, torque = 0, pressed = 0;   // largest differences; largest force of the wall
    for (int sample = 0; sample < kSamples; ++sample) {
        std::vector<double> controls;
        for (int w = 0; w < kWorlds; ++w) controls.insert(controls.end(), {control[(sample + w) % kSamples][0], control[(sample + w) % kSamples][1]});
        const Inputs in{.worlds = kWorlds, .samples = 1, .steps_per_sample = kSteps, .time_step = kPeriod / kSteps, .force_driven = false, .control = controls.data()};
        const Run run{scene, worlds, in, out};
        Lanes<double4, 0> lanes(node.data(), factor.data());
        WorkQueue queue({0, 1, 2, 3}, std::vector<double>(kWorlds, 0.0), kWorlds);
        while (iterate(run, lanes, queue) >= 0) {
        }
        for (int w = 0; w < kWorlds; ++w) {
            reference::Wire& ours = wire[std::size_t(w)];
            ours.sample(controls[2 * std::size_t(w)], controls[2 * std::size_t(w) + 1], in.time_step, kSteps);
            const World world = worlds[std::size_t(w)];
            expect(valid[w] && world.active() == ours.active, "the same nodes are active");
            for (int i = 0; i < ours.active; ++i) {
                const World::Numbers theirs = world.node(i);
                const reference::Node& n = ours.node[std::size_t(i)];
                position = std::max(position, largest(vec3(theirs + World::kX) - n.x));
                attitude = std::max(attitude, 2 * largest(relative(n.q, quaternion(theirs + World::kQ)).v));
                const double force = n.at_node.normal_force + n.at_middle.normal_force;
                wall = std::max(wall, std::abs(world.force(i) - force));
                pressed = std::max(pressed, force);
            }
            base = std::max(base, std::abs(out.base_force[w] - ours.base_force));
            torque = std::max(torque, std::abs(out.base_torque[w] - ours.base_torque));
        }
    }
    std::printf("differences: %.1e mm, %.1e rad, %.1e N of the wall, which presses with up to %.2f N, %.1e N and %.1e N mm at the base\n", position, attitude,
                wall, pressed, base, torque);
    expect(pressed > 0.03, "wires press the wall");
    expect(position < 1e-9, "positions");
    expect(attitude < 1e-9, "attitudes");
    expect(wall < 1e-7, "forces of the wall");
    expect(base < 6e-7, "force at the base");
    expect(torque < 1e-7, "torque at the base");
    std::printf(failures == 0 ? "all core tests passed\n" : "%d core checks failed\n", failures);
    return failures == 0 ? EXIT_SUCCESS : EXIT_FAILURE;
}
