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
struct Block {
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
void add(Matrix& h, const Sym3<V>& s, int at, int lane = 0) {
    const V m[3][3] = {{s.xx, s.xy, s.xz}, {s.xy, s.yy, s.yz}, {s.xz, s.yz, s.zz}};
    for (int r = 0; r < 3; ++r)
        for (int c = 0; c < 3; ++c) h[at + r][at + c] += get(m[r][c], lane);
}

template <class V>
Matrix hessian_of(const Diagonal<V>& d, int lane = 0) {
    Matrix h{};
    add(h, d.xx, 0, lane);
    add(h, d.tt, 3, lane);
    for (int r = 0; r < 3; ++r)
        for (int c = 0; c < 3; ++c) h[3 + r][c] = h[c][3 + r] = get(d.tx[r][c], lane);
    return h;
}

// The core keeps the element's Hessian in u = x_0 - x_1; here it is that of both nodes.
inline Pair pair_of(double energy, const Diagonal<double>& own, const Diagonal<double>& next, const Link<double>& link) {
    Pair p{energy, {gradient_of(own), gradient_of(next)}, {hessian_of(own), hessian_of(next)}, {}};
    add(p.own[0], link.uu, 0);
    add(p.own[1], link.uu, 0);
    add(p.coupling, -1.0f * link.uu, 0);
    for (int r = 0; r < 3; ++r)
        for (int c = 0; c < 3; ++c) {
            p.own[0][3 + r][c] = p.own[0][c][3 + r] += link.tu[r][c];
            p.coupling[3 + r][c] = -link.tu[r][c];
            p.coupling[3 + r][3 + c] = link.tt[r][c];
        }
    return p;
}

// Stretch and shear of element 0 and bend and twist of joint 1, free to bend along `share` of its length. `geometric` is 1 for the whole Hessian.
inline Pair elastic_energy(const RodModel& rod, const Pose& distal, const Pose& proximal, double geometric = 1.0, double share = 1.0) {
    Diagonal<double> own{}, next{};
    Link<double> link{};
    double energy = add_element(rod.length[0], rod.shear[0], rod.stretch[0], float(geometric), distal.x, proximal.x, frame(distal.q), own, next, link);
    energy += add_joint<double>(rod, 1, float(geometric), share, 1 / share, distal.q, proximal.q, own, next, link);
    return pair_of(energy, own, next, link);
}

inline Block wall_energy(const Lumen& lumen, const WallSpring& spring, double radius, const Vec3<double>& x) {
    Diagonal<double> own{};
    const double energy = add_wall<double>(spring, radius, 1.0f, false, distance_to_wall<double>(lumen, x), own);
    return {energy, gradient_of(own), hessian_of(own)};
}

// What `middle` does at the middle of an element, shared out to both ends.
inline Pair middle_of(const Diagonal<double>& middle) {
    Diagonal<double> own{}, next{};
    Link<double> link{};
    add_middle(middle, own, next, link);
    return pair_of(0, own, next, link);
}

inline Block friction_energy(const FrictionState<double>& friction, double eps, const Vec3<double>& start,
                              const Quaternion<double>& start_q, const Pose& now, double tangent = 1.0) {
    Diagonal<double> own{};
    const double energy = add_friction<double>(friction, eps, float(tangent), now.x - start, relative(start_q, now.q), {}, own);
    return {energy, gradient_of(own), hessian_of(own)};
}

// Solves H u = -g, H block-tridiagonal with `own` on its diagonal and `coupling[i]` right of it (upper right 3×3 zero).
// Every system is solved in all lanes at once, lane l with its gradient times l + 1; returns the solutions by lane.
// `positive` tells whether all pivots of lane 0 were.
template <class V>
std::array<std::vector<Vector>, kWidth<V>> solve_chain(const std::vector<Matrix>& own, const std::vector<Matrix>& coupling,
                                                       const std::vector<Vector>& gradient, bool& positive) {
    using S = Single<V>;
    constexpr int W = kWidth<V>;
    const int n = int(own.size());
    const auto sym = [](const Matrix& m, int at) {
        return Sym3<S>{broadcast<S>(m[at][at]),     broadcast<S>(m[at + 1][at + 1]), broadcast<S>(m[at + 2][at + 2]),
                       broadcast<S>(m[at][at + 1]), broadcast<S>(m[at][at + 2]),     broadcast<S>(m[at + 1][at + 2])};
    };
    std::vector<Factor<V>> factor(n);
    Carried<V> carried{};
    positive = true;
    for (int i = 0; i < n; ++i) {
        // an element couples the nodes: what it adds to their own blocks is taken off these
        Matrix rest = own[i], element{};
        for (int r = 0; r < 6; ++r)
            for (int c = 0; c < 3; ++c) {
                if (i + 1 < n) element[r][c] = -coupling[i][r][c];
                rest[r][c] -= element[r][c];
                if (i > 0 && r < 3) rest[r][c] += coupling[i - 1][r][c];
            }
        Diagonal<V> block{};
        block.xx = sym(rest, 0);
        block.tt = sym(rest, 3);
        V g[6];
        for (int r = 0; r < 6; ++r)
            for (int l = 0; l < W; ++l) set(g[r], l, gradient[i][r] * (l + 1));
        block.gradient_x = {g[0], g[1], g[2]};
        block.gradient_theta = {g[3], g[4], g[5]};
        Link<V> link{};
        link.uu = sym(element, 0);
        for (int r = 0; r < 3; ++r)
            for (int c = 0; c < 3; ++c) {
                block.tx[r][c] = broadcast<S>(rest[3 + r][c]);
                link.tu[r][c] = broadcast<S>(element[3 + r][c]);
                if (i + 1 < n) link.tt[r][c] = broadcast<S>(coupling[i][3 + r][3 + c]);
            }
        const S pivot = eliminate(block, link, carried, factor[i]).smallest_pivot;
        positive = positive && get(pivot, 0) > 0;
    }
    std::array<std::vector<Vector>, W> solution;
    for (auto& lane : solution) lane.resize(n);
    Vec3<S> x{}, t{};
    for (int i = n - 1; i >= 0; --i) {
        substitute(factor[i], x, t);
        for (int l = 0; l < W; ++l)
            solution[l][i] = {get(x.x, l), get(x.y, l), get(x.z, l), get(t.x, l), get(t.y, l), get(t.z, l)};
    }
    return solution;
}

}  // namespace adapter
