// The one place where the tests meet the core's headers: where a signature there changes, only this file follows.
// Each function states a meaning in plain vectors and matrices; blocks are 6 unknowns (x, y, z, theta1, theta2, theta3).
#pragma once

#include <array>

#include "contact.hpp"
#include "solve.hpp"
#include "spline.hpp"

namespace adapter {

using namespace endopilot;

using Vector = std::array<double, 6>;
using Matrix = std::array<Vector, 6>;

// One node's pose.
struct Pose {
    Vec3<double> x;
    Quaternion<double> q;
};

// Energy of a term that acts on two neighbouring blocks (0 towards the tip), with gradient and Hessian of each and
// their coupling d2E / d(block 0) d(block 1).
struct Pair {
    double energy;
    Vector gradient[2];
    Matrix own[2], coupling;
};

// The same of a term that acts on one block.
struct Single {
    double energy;
    Vector gradient;
    Matrix hessian;
};

template <class V>
Vector gradient_of(const Diagonal<V>& d, int lane = 0) {
    return {get(d.gradient_x.x, lane),  get(d.gradient_x.y, lane),  get(d.gradient_x.z, lane),
            get(d.gradient_theta.x, lane), get(d.gradient_theta.y, lane), get(d.gradient_theta.z, lane)};
}

template <class V>
Matrix hessian_of(const Diagonal<V>& d, int lane = 0) {
    Matrix h{};
    const auto put = [&](const Sym3<V>& s, int at) {
        const V m[3][3] = {{s.xx, s.xy, s.xz}, {s.xy, s.yy, s.yz}, {s.xz, s.yz, s.zz}};
        for (int r = 0; r < 3; ++r)
            for (int c = 0; c < 3; ++c) h[at + r][at + c] = get(m[r][c], lane);
    };
    put(d.xx, 0);
    put(d.tt, 3);
    for (int r = 0; r < 3; ++r)
        for (int c = 0; c < 3; ++c) h[3 + r][c] = h[c][3 + r] = get(d.tx[r][c], lane);
    return h;
}

template <class V>
Matrix coupling_of(const Coupling<V>& k) {
    Matrix h{};
    const V xx[3][3] = {{k.xx.xx, k.xx.xy, k.xx.xz}, {k.xx.xy, k.xx.yy, k.xx.yz}, {k.xx.xz, k.xx.yz, k.xx.zz}};
    for (int r = 0; r < 3; ++r)
        for (int c = 0; c < 3; ++c) {
            h[r][c] = get(xx[r][c], 0);
            h[3 + r][c] = get(k.tx[r][c], 0);
            h[3 + r][3 + c] = get(k.tt[r][c], 0);
        }
    return h;
}

// Stretch and shear of element 0 and bend and twist of joint 1, free to bend along `share` of its length. `geometric` is 1 for the whole Hessian.
inline Pair elastic_energy(const RodModel& rod, const Pose& distal, const Pose& proximal, double geometric = 1.0, double share = 1.0) {
    Diagonal<double> own{}, next{};
    Coupling<double> k{};
    double energy = add_element<double>(rod, 0, geometric, distal.x, proximal.x, frame(distal.q), own, next, k);
    energy += add_joint<double>(rod, 1, geometric, share, distal.q, proximal.q, own, next, k);
    return {energy, {gradient_of(own), gradient_of(next)}, {hessian_of(own), hessian_of(next)}, coupling_of(k)};
}

inline Single wall_energy(const Lumen& lumen, double stiffness, double radius, const Vec3<double>& x) {
    Diagonal<double> own{};
    const double energy = add_wall<double>(stiffness, radius, 1.0, false, distance_to_wall<double>(lumen, x), own);
    return {energy, gradient_of(own), hessian_of(own)};
}

inline Single friction_energy(const FrictionState<double>& friction, double eps, const Vec3<double>& start,
                              const Quaternion<double>& start_q, const Pose& now, double tangent = 1.0) {
    Diagonal<double> own{};
    const double energy = add_friction<double>(friction, eps, tangent, now.x - start, relative(start_q, now.q), own);
    return {energy, gradient_of(own), hessian_of(own)};
}

// Solves H u = -g, H block-tridiagonal with `own` on its diagonal and `coupling[i]` right of it (upper right 3×3 zero).
// Every system is solved in all lanes at once, lane l with its gradient times l + 1; returns the solutions by lane.
// `positive` tells whether all pivots of lane 0 were.
template <class V>
std::array<std::vector<Vector>, kWidth<V>> solve_chain(const std::vector<Matrix>& own, const std::vector<Matrix>& coupling,
                                                       const std::vector<Vector>& gradient, bool& positive) {
    constexpr int W = kWidth<V>;
    const int n = int(own.size());
    const auto sym = [](const Matrix& m, int at) {
        return Sym3<V>{broadcast<V>(m[at][at]),         broadcast<V>(m[at + 1][at + 1]), broadcast<V>(m[at + 2][at + 2]),
                       broadcast<V>(m[at][at + 1]),     broadcast<V>(m[at][at + 2]),     broadcast<V>(m[at + 1][at + 2])};
    };
    std::vector<Factor<V>> factor(n);
    Diagonal<V> carried{};
    positive = true;
    for (int i = 0; i < n; ++i) {
        Diagonal<V> block{};
        block.xx = sym(own[i], 0);
        block.tt = sym(own[i], 3);
        V g[6];
        for (int r = 0; r < 6; ++r)
            for (int l = 0; l < W; ++l) set(g[r], l, gradient[i][r] * (l + 1));
        block.gradient_x = Vec3<V>{g[0], g[1], g[2]} + carried.gradient_x;
        block.gradient_theta = Vec3<V>{g[3], g[4], g[5]} + carried.gradient_theta;
        for (int r = 0; r < 3; ++r)
            for (int c = 0; c < 3; ++c) block.tx[r][c] = broadcast<V>(own[i][3 + r][c]) + carried.tx[r][c];
        const auto add = [](Sym3<V>& a, const Sym3<V>& b) {
            a = {a.xx + b.xx, a.yy + b.yy, a.zz + b.zz, a.xy + b.xy, a.xz + b.xz, a.yz + b.yz};
        };
        add(block.xx, carried.xx);
        add(block.tt, carried.tt);
        Coupling<V> k{};
        if (i + 1 < n) {
            k.xx = sym(coupling[i], 0);
            for (int r = 0; r < 3; ++r)
                for (int c = 0; c < 3; ++c) {
                    k.tx[r][c] = broadcast<V>(coupling[i][3 + r][c]);
                    k.tt[r][c] = broadcast<V>(coupling[i][3 + r][3 + c]);
                }
        }
        carried = Diagonal<V>{};
        const V pivot = eliminate(block, k, factor[i], carried).smallest_pivot;
        positive = positive && get(pivot, 0) > 0;
    }
    std::array<std::vector<Vector>, W> solution;
    for (auto& lane : solution) lane.resize(n);
    Vec3<V> x{}, t{};
    for (int i = n - 1; i >= 0; --i) {
        substitute(factor[i], x, t);
        for (int l = 0; l < W; ++l)
            solution[l][i] = {get(x.x, l), get(x.y, l), get(x.z, l), get(t.x, l), get(t.y, l), get(t.z, l)};
    }
    return solution;
}

}  // namespace adapter
