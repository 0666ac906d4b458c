// Distance to the wall by a quadratic B-spline, wall contact and friction.
#pragma once

#include <cstring>

#include "lumen.hpp"
#include "rod.hpp"
#include "solve.hpp"

namespace endopilot {

template <class V>
struct Distance {
    V value;            // mm
    Vec3<V> gradient;
    Sym3<Single<V>> hessian;    // 1/mm
};

// Three neighbouring coefficients per lane, starting at `offset`.
template <class V>
[[gnu::always_inline]] ENDOPILOT_DEVICE inline void gather(const float* const (&from)[kWidth<V>], int offset, Single<V> (&c)[3]) {
#ifndef __CUDACC__
    if constexpr (kWidth<V> == 4) {  // four rows of four floats, transposed
        float4 row[4];
        for (int lane = 0; lane < 4; ++lane) std::memcpy(&row[lane], from[lane] + offset, sizeof(float4));
        const float4 low01 = __builtin_shufflevector(row[0], row[1], 0, 4, 1, 5);
        const float4 low23 = __builtin_shufflevector(row[2], row[3], 0, 4, 1, 5);
        const float4 high01 = __builtin_shufflevector(row[0], row[1], 2, 6, 3, 7);
        const float4 high23 = __builtin_shufflevector(row[2], row[3], 2, 6, 3, 7);
        c[0] = __builtin_shufflevector(low01, low23, 0, 1, 4, 5);
        c[1] = __builtin_shufflevector(low01, low23, 2, 3, 6, 7);
        c[2] = __builtin_shufflevector(high01, high23, 0, 1, 4, 5);
    } else if constexpr (kWidth<V> == 8) {  // the same in both halves of a vector
        float8 row[4];
        for (int lane = 0; lane < 4; ++lane) {
            float4 low, high;
            std::memcpy(&low, from[lane] + offset, sizeof(float4));
            std::memcpy(&high, from[lane + 4] + offset, sizeof(float4));
            row[lane] = __builtin_shufflevector(low, high, 0, 1, 2, 3, 4, 5, 6, 7);
        }
        const float8 low01 = __builtin_shufflevector(row[0], row[1], 0, 8, 1, 9, 4, 12, 5, 13);
        const float8 low23 = __builtin_shufflevector(row[2], row[3], 0, 8, 1, 9, 4, 12, 5, 13);
        const float8 high01 = __builtin_shufflevector(row[0], row[1], 2, 10, 3, 11, 6, 14, 7, 15);
        const float8 high23 = __builtin_shufflevector(row[2], row[3], 2, 10, 3, 11, 6, 14, 7, 15);
        c[0] = __builtin_shufflevector(low01, low23, 0, 1, 8, 9, 4, 5, 12, 13);
        c[1] = __builtin_shufflevector(low01, low23, 2, 3, 10, 11, 6, 7, 14, 15);
        c[2] = __builtin_shufflevector(high01, high23, 0, 1, 8, 9, 4, 5, 12, 13);
    } else
#endif
    {
        for (int i = 0; i < 3; ++i)
            for (int lane = 0; lane < kWidth<V>; ++lane) set(c[i], lane, from[lane][offset + i]);
    }
}

// The spline, its gradient and its Hessian at one point per lane. Outside the map the value is NaN, which makes the
// line search step back.
template <class V>
[[gnu::noinline]] ENDOPILOT_DEVICE Distance<V> distance_to_wall(const Lumen& lumen, const Vec3<V>& x) {
    using S = Single<V>;
    constexpr int W = kWidth<V>;
    // Adding 1.5 · 2^52 rounds to whole numbers: the stencil's middle cell, and the place in it (-1/2..1/2).
    constexpr double kRound = 6755399441055744.0;
    const double s = lumen.inverse_spacing;
    const Vec3<V> u{s * (x.x - lumen.origin[0]), s * (x.y - lumen.origin[1]), s * (x.z - lumen.origin[2])};
    const Vec3<V> cell{(u.x + kRound) - kRound, (u.y + kRound) - kRound, (u.z + kRound) - kRound};
    const Vec3<V> t = u - cell;
    const float* first[W];
    bool all_deep = true;
    lumen.stencils(cell, first);
    for (int lane = 0; lane < W; ++lane) all_deep = all_deep && lumen.deep(first[lane]);
    if (all_deep) return {broadcast<V>(lumen.clearance), {V{}, V{}, V{}}, {S{}, S{}, S{}, S{}, S{}, S{}}};

    const auto weights = [](const V& p, V (&w)[3], V (&d)[3]) {
        const V left = 0.5 - p, right = 0.5 + p;
        w[0] = 0.5 * left * left;
        w[1] = 0.75 - p * p;
        w[2] = 0.5 * right * right;
        d[0] = -left;
        d[1] = -2.0 * p;
        d[2] = right;
    };
    V wx[3], wy[3], wz[3], dx[3], dy[3], dz[3];
    weights(t.x, wx, dx);
    weights(t.y, wy, dy);
    weights(t.z, wz, dz);

    S sy[3], ey[3];   // wy and dy for the Hessian
    for (int j = 0; j < 3; ++j) {
        sy[j] = narrow(wy[j]);
        ey[j] = narrow(dy[j]);
    }
    V f{}, fx{}, fy{}, fz{};
    S fxx{}, fyy{}, fzz{}, fxy{}, fxz{}, fyz{};
    unroll<0, 3>([&](auto k_) {
        constexpr int k = decltype(k_)::value;
        V g{}, gx{}, gy{};   // contracted along x and y: the value and its slopes
        S cxx{}, cxy{}, cyy{};
        unroll<0, 3>([&](auto j_) {
            constexpr int j = decltype(j_)::value;
            S stored[3];
            gather<V>(first, (k * Lumen::kStored + j) * Lumen::kStored, stored);
            const V c[3] = {widen<V>(stored[0]), widen<V>(stored[1]), widen<V>(stored[2])};
            const V h = wx[0] * c[0] + wx[1] * c[1] + wx[2] * c[2];
            const V hx = dx[0] * c[0] + dx[1] * c[1] + dx[2] * c[2];
            g += wy[j] * h;
            gx += wy[j] * hx;
            gy += dy[j] * h;
            cxx += sy[j] * ((stored[0] + stored[2]) - 2.0f * stored[1]);
            cxy += ey[j] * narrow(hx);
            const S row = narrow(h);
            if constexpr (j == 1)
                cyy -= 2.0f * row;
            else
                cyy += row;
        });
        f += wz[k] * g;
        fz += dz[k] * g;
        fx += wz[k] * gx;
        fy += wz[k] * gy;
        const S sz = narrow(wz[k]), ez = narrow(dz[k]), whole = narrow(g);
        fxz += ez * narrow(gx);
        fyz += ez * narrow(gy);
        fxx += sz * cxx;
        fxy += sz * cxy;
        fyy += sz * cyy;
        if constexpr (k == 1)
            fzz -= 2.0f * whole;
        else
            fzz += whole;
    });
    const float ss = float(s * s);
    return {f, {s * fx, s * fy, s * fz}, {ss * fxx, ss * fyy, ss * fzz, ss * fxy, ss * fxz, ss * fyz}};
}

// The distance to the wall where a node was last evaluated.
template <class V>
struct WallState {
    V distance;          // mm
    Vec3<V> gradient;    // of the distance
};

// The lagged state of friction at a node: frozen at the start of a time step, so that the step has a potential.
template <class V>
struct FrictionState {
    V limit;            // friction coefficient × normal force, N
    Vec3<V> normal;     // unit normal of the wall, into the lumen
    Vec3<V> spin_arm;   // displacement of the touching surface for a unit rotation about the wire's axis, mm/rad
};

// A point of the wire that can touch the wall: a node, or the middle of the element behind it. A node of the polygon does not
// lie on the wire's curve: elements of length l with the direction of their middles put it l²/24 times the curvature vector
// beside, and the middle of an element -l²/12 times (terms of fourth order left out). The wall is asked at the curve.
template <class V>
struct ContactPoint {
    Vec3<V> offset;              // of the curve from the polygon there, mm; frozen at the start of a step
    FrictionState<V> friction;
    WallState<V> wall;
    V normal_force;              // of the wall at the end of the last step, N
    Vec3<V> evaluated;           // where in the distance map the wall was last evaluated,
    V clearance;                 // and its distance there, mm; NaN: never
    V gap, last_gap;             // to the wall at the trial and at the accepted point, mm; no more than the reach of contact
};

// How the further tubes touch the wall at a contact point: the share of it that each covers, how far each has twisted against the
// reference frame since the step's start, and the rotation that their sliding along the mesh brings (tubes.hpp).
template <class V, int T>
struct Touching {
    V spin, weight[T], twisted[T];
};

// The wall's spring at a contact point: it gives way by d to the force k d exp(s d²).
struct WallSpring {
    double stiffness;    // k, N/mm
    double stiffening;   // s, 1/mm²; 0 for a spring that does not stiffen

    template <class V>
    ENDOPILOT_DEVICE V force(const V& depth) const {
        V force = stiffness * depth;
        if (stiffening > 0) force *= exponential<V>(stiffening * depth * depth);
        return force;
    }
};

// Adds the wall's elastic reaction where the depth d = radius - distance is positive, energy k/2 d², of a spring that stiffens
// k/2s (exp(s d²) - 1). Returns the energy. Where `sticky`, gradient and Hessian are those of a wall that can also pull:
// otherwise a node that has just lost contact would move freely in the next Newton step and hit the wall.
template <class V, int T, class Radius>
ENDOPILOT_DEVICE inline V add_wall(const WallSpring& spring, const Radius& radius, const Single<V>& geometric, Mask<V> sticky,
                                   const Distance<V>& d, Diagonal<V, T>& own) {
    using S = Single<V>;
    const Mask<V> clear = d.value >= radius;  // false for NaN, so that NaN reaches the energy
    const V gap = radius - d.value;
    const V touch = select<V>(clear, V{}, gap);
    const V depth = select<V>(sticky, gap, touch);
    V reaction = spring.stiffness * depth;  // N, of the wall on the wire
    V tangent = broadcast<V>(spring.stiffness), energy = 0.5 * spring.stiffness * touch * touch;
    if (spring.stiffening > 0) {
        const V exponent = spring.stiffening * touch * touch, stiffer = exponential<V>(exponent);
        reaction *= stiffer;
        tangent *= stiffer * (1.0 + 2.0 * exponent);
        energy = 0.5 * spring.stiffness / spring.stiffening * (stiffer - 1.0);
    }
    own.gradient_x -= reaction * d.gradient;
    const S k = narrow(select<V>(clear, select<V>(sticky, tangent, V{}), tangent));
    const S bend = geometric * narrow(reaction);
    const Vec3<S> n = narrow(d.gradient), kn = k * n;
    own.xx.xx += kn.x * n.x - bend * d.hessian.xx;
    own.xx.yy += kn.y * n.y - bend * d.hessian.yy;
    own.xx.zz += kn.z * n.z - bend * d.hessian.zz;
    own.xx.xy += kn.x * n.y - bend * d.hessian.xy;
    own.xx.xz += kn.x * n.z - bend * d.hessian.xz;
    own.xx.yz += kn.y * n.z - bend * d.hessian.yz;
    return energy;
}

// Adds smoothed Coulomb friction of the touching surface, energy limit (sqrt(|s|² + eps²) - eps) with s the tangential
// displacement of that surface since the start of the step: of the node, and by rotation about the wire's own axis.
// `moved` is the node's displacement, `p` the element's rotation since the start of the step. Where `tangent` is 1 the Hessian is
// friction's own; where it is 0 friction's secant stands for it, which is nowhere softer. Returns the energy.
template <class V, int T>
ENDOPILOT_DEVICE inline V add_friction(const FrictionState<V>& friction, const V& eps, const Single<V>& tangent,
                                       const Vec3<V>& moved, const Quaternion<V>& p, const Touching<V, T>& touching, Diagonal<V, T>& own) {
    using S = Single<V>;
    V twist = 2.0 * p.v.z;
    if constexpr (T > 0) twist += touching.spin;
    for (int k = 0; k < T; ++k) twist += touching.weight[k] * touching.twisted[k];
    const Vec3<V> slip = moved - dot(moved, friction.normal) * friction.normal + twist * friction.spin_arm;
    const V size = square_root(dot(slip, slip) + eps * eps);
    const V inverse = 1.0 / size;
    const V stiffness = friction.limit * inverse;  // N/mm; the force of friction on the wire is -stiffness times slip
    const Vec3<V> gradient = stiffness * slip;
    Vec3<V> turn{-p.v.y, p.v.x, p.w};  // d twist / d theta
    for (int k = 0; k < T; ++k) turn.z -= touching.weight[k];   // a tube's twist is its turn less theta_3
    own.gradient_x += gradient;
    const V gradient_twist = dot(gradient, friction.spin_arm);
    own.gradient_theta += gradient_twist * turn;

    const Vec3<S> n = narrow(friction.normal), arm = narrow(friction.spin_arm), unit = narrow(inverse * slip);
    const S secant = narrow(stiffness);
    const Vec3<S> sn = secant * n, su = (tangent * secant) * unit;
    own.xx.xx += secant - sn.x * n.x - su.x * unit.x;
    own.xx.yy += secant - sn.y * n.y - su.y * unit.y;
    own.xx.zz += secant - sn.z * n.z - su.z * unit.z;
    own.xx.xy -= sn.x * n.y + su.x * unit.y;
    own.xx.xz -= sn.x * n.z + su.x * unit.z;
    own.xx.yz -= sn.y * n.z + su.y * unit.z;
    const Vec3<S> mixed = secant * arm - dot(unit, arm) * su;  // spin is perpendicular to n
    const S rotary = dot(mixed, arm);
    const Vec3<S> b = narrow(turn), rb = rotary * b;
    const S t[3] = {b.x, b.y, b.z};
    for (int r = 0; r < 3; ++r) {
        own.tx[r][0] += t[r] * mixed.x;
        own.tx[r][1] += t[r] * mixed.y;
        own.tx[r][2] += t[r] * mixed.z;
    }
    own.tt.xx += rb.x * b.x;
    own.tt.yy += rb.y * b.y;
    own.tt.zz += rb.z * b.z;
    own.tt.xy += rb.x * b.y;
    own.tt.xz += rb.x * b.z;
    own.tt.yz += rb.y * b.z;
    for (int k = 0; k < T; ++k) {
        own.twists.gradient[k] += gradient_twist * touching.weight[k];
        const S w = narrow(touching.weight[k]);
        own.twists.px[k][0] += w * mixed.x;
        own.twists.px[k][1] += w * mixed.y;
        own.twists.px[k][2] += w * mixed.z;
        for (int r = 0; r < 3; ++r) own.twists.pt[k][r] += w * (rotary * t[r]);
        for (int c = 0; c <= k; ++c) own.twists.pp[k][c] += w * (rotary * narrow(touching.weight[c]));
    }
    return friction.limit * (size - eps);
}

// Shares out what acts at the middle of an element, x_{i+1} + u/2, between its two ends; rotations are the element's own.
// Elimination counts what holds node i for u, for its coupling to x_{i+1} and for x_{i+1} alike; here these are a quarter, a half and the whole.
template <class V, int T>
ENDOPILOT_DEVICE inline void add_middle(const Diagonal<V, T>& middle, Diagonal<V, T>& own, Diagonal<V, T>& next, Link<V, T>& link) {
    using S = Single<V>;
    const Vec3<V> gradient = broadcast<V>(0.5) * middle.gradient_x;
    own.gradient_x += gradient;
    next.gradient_x += gradient;
    own.gradient_theta += middle.gradient_theta;
    const Sym3<S> xx = broadcast<S>(0.5) * middle.xx;
    own.xx += xx;
    next.xx += xx;
    link.uu -= broadcast<S>(0.25) * middle.xx;
    own.tt += middle.tt;
    for (int r = 0; r < 3; ++r)
        for (int c = 0; c < 3; ++c) {
            own.tx[r][c] += middle.tx[r][c];
            link.tu[r][c] -= 0.5f * middle.tx[r][c];
        }
    for (int k = 0; k < T; ++k) {
        own.twists.gradient[k] += middle.twists.gradient[k];
        for (int c = 0; c < 3; ++c) {
            own.twists.px[k][c] += middle.twists.px[k][c];
            link.twists.pu[k][c] -= 0.5f * middle.twists.px[k][c];
            own.twists.pt[k][c] += middle.twists.pt[k][c];
        }
        for (int c = 0; c <= k; ++c) own.twists.pp[k][c] += middle.twists.pp[k][c];
    }
}

}  // namespace endopilot
