// Roofline of the rod core: floating-point operations and bytes of one Newton iteration a node, the time each part takes
// alone, and the processor's own peak of fused multiply-adds beside it. `make roofline` builds and runs it.
#include <algorithm>
#include <chrono>
#include <cstdio>
#include <random>

#include "contact.hpp"
#include "solve.hpp"

using namespace endopilot;

// A number that counts what is done to it. As a lane type it runs the very formulas of the core.
struct Counted {
    double value;
    static inline long operations = 0;
    Counted(double v = 0.0) : value(v) {}
};
#define COUNTED(op)                                                                                                     \
    inline Counted operator op(Counted a, Counted b) { return ++Counted::operations, Counted(a.value op b.value); }     \
    inline Counted operator op(double a, Counted b) { return ++Counted::operations, Counted(a op b.value); }            \
    inline Counted operator op(Counted a, double b) { return ++Counted::operations, Counted(a.value op b); }            \
    inline Counted& operator op##=(Counted& a, Counted b) { return a = a op b; }                                        \
    inline Counted& operator op##=(Counted& a, double b) { return a = a op b; }
COUNTED(+)
COUNTED(-)
COUNTED(*)
COUNTED(/)
#define COMPARED(op)                                                             \
    inline bool operator op(Counted a, Counted b) { return a.value op b.value; } \
    inline bool operator op(Counted a, double b) { return a.value op b; }
COMPARED(<)
COMPARED(>)
COMPARED(>=)
COMPARED(==)
inline Counted operator-(Counted a) { return Counted(-a.value); }

namespace endopilot {
template <>
struct LaneTraits<Counted> {
    static constexpr int width = 1;
    using Mask = bool;
    using Single = Counted;
    using Scalar = double;
};
template <>
inline Counted narrow<Counted>(const Counted& v) {
    return v;
}
template <>
inline Counted widen<Counted>(const Counted& v) {
    return v;
}
template <>
inline double get(const Counted& v, int) {
    return v.value;
}
template <>
inline void set(Counted& v, int, double value) {
    v.value = value;
}
template <>
inline Counted square_root(Counted a) {
    ++Counted::operations;
    return Counted(std::sqrt(a.value));
}
}  // namespace endopilot

constexpr int kNodes = 80;

// The arrays of a wire in a straight lumen of 1.5 mm radius, and each part of an iteration as a sweep over its nodes.
template <class V>
struct Sweeps {
    Rod owned;
    RodModel rod;
    const Lumen& lumen;
    Vec3<V> x[kNodes + 1];
    Quaternion<V> q[kNodes + 1];
    Distance<V> distance[kNodes];
    Diagonal<V> diagonal[kNodes + 1];
    Link<V> link[kNodes];
    Factor<V> factor[kNodes];
    V one = broadcast<V>(1.0), sink = broadcast<V>(0.0);
    Single<V> full = narrow(one);

    explicit Sweeps(const Lumen& l) : lumen(l) {
        const auto fill = [](double v) { return std::vector<double>(kNodes + 2, v); };
        owned.nodes = kNodes + 2;
        owned.length = fill(0.4), owned.shear = fill(1e3), owned.stretch = fill(2.6e3), owned.joint_length = fill(0.4);
        owned.bend = fill(5), owned.twist = fill(4), owned.radius = fill(0.18);
        owned.rest.assign(kNodes + 2, {0.1, 0, 0});
        rod = view(owned, InPlace{});
        std::mt19937 random(1);
        std::uniform_real_distribution<double> any(-0.5, 0.5);
        for (int i = 0; i <= kNodes; ++i)
            for (int lane = 0; lane < kWidth<V>; ++lane) {
                set(x[i].x, lane, 24 + any(random));
                set(x[i].y, lane, 25.4 + 0.2 * any(random));
                set(x[i].z, lane, 40 - 0.4 * i);
                set(q[i].w, lane, 1.0);
                set(q[i].v.x, lane, 0.02 * any(random));
                set(q[i].v.y, lane, 0.02 * any(random));
                set(q[i].v.z, lane, 0.0);
            }
    }
    void elements() {
        Diagonal<V> own{}, next;
        for (int i = 0; i < kNodes; ++i) {
            sink += add_element<V>(rod.length[i], rod.shear[i], rod.stretch[i], full, x[i], x[i + 1], frame(q[i]), own, next, link[i]);
            sink += add_joint<V>(rod, i + 1, full, one, one, q[i], q[i + 1], own, next, link[i]);
            diagonal[i] = own;
            own = next;
        }
    }
    void wall() {
        for (int i = 0; i < kNodes; ++i) {
            distance[i] = distance_to_wall<V>(lumen, x[i]);
            sink += add_wall<V, 0>(WallSpring{5.0, 0.0}, 0.18, full, distance[i].value > 1e6, distance[i], diagonal[i]);
        }
    }
    void friction() {
        const FrictionState<V> friction{0.01 * one, {one, 0.0 * one, 0.0 * one}, {0.0 * one, 0.18 * one, 0.0 * one}};
        Touching<V, 0> alone;
        for (int i = 0; i < kNodes; ++i) sink += add_friction<V, 0>(friction, 1e-3 * one, full, x[i] - x[0], q[i], alone, diagonal[i]);
    }
    void elimination() {
        Carried<V> carried{};
        for (int i = 0; i < kNodes; ++i) sink += widen<V>(eliminate(diagonal[i], link[i], carried, factor[i]).descent);
    }
    void substitution() {
        Vec3<Single<V>> dx{}, dt{};
        for (int i = kNodes - 1; i >= 0; --i) substitute(factor[i], dx, dt);
        sink += widen<V>(dx.x);
    }
};

template <class F>
double fastest(int repeats, const F& f) {
    double best = 1e300;
    for (int r = 0; r < repeats; ++r) {
        const auto t = std::chrono::steady_clock::now();
        f();
        best = std::min(best, std::chrono::duration<double>(std::chrono::steady_clock::now() - t).count());
    }
    return best;
}

// Ten independent chains of fused multiply-adds in registers.
double peak_gflops() {
    double4 a[10];
    for (double4& v : a) v = double4{1, 1, 1, 1};
    double4 factor{1.0000001, 1, 1, 1}, term{1e-9, 0, 0, 0};
    constexpr long rounds = 20'000'000;
    const double s = fastest(5, [&] {
        double4 b[10];
        std::copy(a, a + 10, b);
        for (long i = 0; i < rounds; ++i)
            for (double4& v : b) {
                v = v * factor + term;
                asm volatile("" : : "x"(factor));  // keeps the compiler from folding the rounds
            }
        std::copy(b, b + 10, a);
    });
    if (a[0][0] + a[9][3] > 1e300) std::puts("");  // the result is used
    return rounds * 10 * 8 / s * 1e-9;
}

int main() {
    const int size[3] = {160, 160, 160};
    const double origin[3] = {0, 0, 0};
    std::vector<float> map(160 * 160 * 160);
    for (int z = 0, m = 0; z < 160; ++z)
        for (int y = 0; y < 160; ++y)
            for (int x = 0; x < 160; ++x, ++m) map[m] = float(1.5 - 0.3 * std::hypot(x - 80.0, y - 80.0));
    const LumenMap bricks = make_lumen_map(map.data(), size, origin, 0.3, 0.6, 0.5);
    const Lumen lumen = view(bricks, InPlace{});
    static Sweeps<Counted> count(lumen);
    static Sweeps<double4> run(lumen);
    const double peak = peak_gflops();
    std::printf("peak: %.1f GFLOP/s of fused multiply-adds, one core, four doubles at a time\n\n", peak);
    std::printf("%-24s %12s %12s %12s %10s\n", "a node and iteration", "operations", "ns, 4 lanes", "GFLOP/s", "of peak");
    double all_operations = 0, all_ns = 0;
    const auto part = [&](const char* name, auto sweep) {
        Counted::operations = 0;
        (count.*sweep.first)();
        const double operations = double(Counted::operations) / kNodes;
        const double ns = fastest(3000, [&] { (run.*sweep.second)(); }) / kNodes * 1e9;
        all_operations += operations, all_ns += ns;
        std::printf("%-24s %12.0f %12.1f %12.1f %9.0f%%\n", name, operations, ns, 4 * operations / ns, 400 * operations / ns / peak);
    };
#define PART(name) std::pair(&Sweeps<Counted>::name, &Sweeps<double4>::name)
    part("element and joint", PART(elements));
    part("wall", PART(wall));
    part("friction", PART(friction));
    part("elimination", PART(elimination));
    part("substitution", PART(substitution));
    std::printf("%-24s %12.0f %12.1f %12.1f %9.0f%%\n\n", "all", all_operations, all_ns, 4 * all_operations / all_ns,
                400 * all_operations / all_ns / peak);
    std::printf("factor of a block: %zu bytes a node and lane; its writing and reading move %zu bytes an iteration\n",
                sizeof(Factor<double>), 2 * sizeof(Factor<double>));
    return get(run.sink, 0) > 1e300;
}
