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
    Sym3<V> hessian;    // 1/mm
};

// Three neighbouring coefficients per lane, starting at `offset`.
template <class V>
[[gnu::always_inline]] ENDOPILOT_DEVICE inline void gather(const float* const (&from)[kWidth<V>], int offset, V (&c)[3]) {
#ifndef __CUDACC__
    if constexpr (kWidth<V> == 4) {  // four rows of four floats, transposed
        typedef float float4 __attribute__((vector_size(16)));
        float4 row[4];
        for (int lane = 0; lane < 4; ++lane) std::memcpy(&row[lane], from[lane] + offset, sizeof(float4));
        const float4 low01 = __builtin_shufflevector(row[0], row[1], 0, 4, 1, 5);
        const float4 low23 = __builtin_shufflevector(row[2], row[3], 0, 4, 1, 5);
        const float4 high01 = __builtin_shufflevector(row[0], row[1], 2, 6, 3, 7);
        const float4 high23 = __builtin_shufflevector(row[2], row[3], 2, 6, 3, 7);
        const auto wide = [](float4 v) -> V {
#ifdef __AVX__
            return __builtin_ia32_cvtps2pd256(v);  // one instruction, where GCC 12 makes five of __builtin_convertvector
#else
            return __builtin_convertvector(v, V);
#endif
        };
        c[0] = wide(__builtin_shufflevector(low01, low23, 0, 1, 4, 5));
        c[1] = wide(__builtin_shufflevector(low01, low23, 2, 3, 6, 7));
        c[2] = wide(__builtin_shufflevector(high01, high23, 0, 1, 4, 5));
    } else if constexpr (kWidth<V> == 8) {
        const float* const half[2][4] = {{from[0], from[1], from[2], from[3]}, {from[4], from[5], from[6], from[7]}};
        double4 low[3], high[3];
        gather<double4>(half[0], offset, low);
        gather<double4>(half[1], offset, high);
        for (int i = 0; i < 3; ++i) c[i] = __builtin_shufflevector(low[i], high[i], 0, 1, 2, 3, 4, 5, 6, 7);
    } else
#endif
    {
        for (int i = 0; i < 3; ++i)
            for (int lane = 0; lane < kWidth<V>; ++lane) set(c[i], lane, double(from[lane][offset + i]));
    }
}

// The spline, its gradient and its Hessian at one point per lane. Outside the map the value is NaN, which makes the
// line search step back.
template <class V>
[[gnu::noinline]] ENDOPILOT_DEVICE Distance<V> distance_to_wall(const Lumen& lumen, const Vec3<V>& x) {
    constexpr int W = kWidth<V>;
    // Adding 1.5 · 2^52 rounds to whole numbers: the stencil's middle cell, and the place in it (-1/2..1/2).
    constexpr double kRound = 6755399441055744.0;
    const double s = lumen.inverse_spacing, ss = s * s;
    const Vec3<V> u{s * (x.x - lumen.origin[0]), s * (x.y - lumen.origin[1]), s * (x.z - lumen.origin[2])};
    const Vec3<V> cell{(u.x + kRound) - kRound, (u.y + kRound) - kRound, (u.z + kRound) - kRound};
    const Vec3<V> t = u - cell;
    const float* first[W];
    bool all_deep = true;
    for (int lane = 0; lane < W; ++lane) {
        first[lane] = lumen.stencil(get(cell.x, lane), get(cell.y, lane), get(cell.z, lane));
        all_deep = all_deep && lumen.deep(first[lane]);
    }
    if (all_deep) return {broadcast<V>(Lumen::kDeep), {V{}, V{}, V{}}, {V{}, V{}, V{}, V{}, V{}, V{}}};

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

    V f{}, fx{}, fy{}, fz{}, fxx{}, fyy{}, fzz{}, fxy{}, fxz{}, fyz{};
    unroll<0, 3>([&](auto k_) {
        constexpr int k = decltype(k_)::value;
        V h[3], hx[3], hxx[3];
        unroll<0, 3>([&](auto j_) {
            constexpr int j = decltype(j_)::value;
            V c[3];
            gather<V>(first, (k * Lumen::kStored + j) * Lumen::kStored, c);
            h[j] = wx[0] * c[0] + wx[1] * c[1] + wx[2] * c[2];
            hx[j] = dx[0] * c[0] + dx[1] * c[1] + dx[2] * c[2];
            hxx[j] = (c[0] + c[2]) - 2.0 * c[1];
        });
        const auto along = [](const V (&w)[3], const V (&v)[3]) { return w[0] * v[0] + w[1] * v[1] + w[2] * v[2]; };
        const V g = along(wy, h), gx = along(wy, hx), gy = along(dy, h);
        f += wz[k] * g;
        fz += dz[k] * g;
        fx += wz[k] * gx;
        fxz += dz[k] * gx;
        fy += wz[k] * gy;
        fyz += dz[k] * gy;
        fxx += wz[k] * along(wy, hxx);
        fxy += wz[k] * along(dy, hx);
        fyy += wz[k] * ((h[0] + h[2]) - 2.0 * h[1]);
        if constexpr (k == 1)
            fzz -= 2.0 * g;
        else
            fzz += g;
    });
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
    Vec3<V> evaluated;           // where the wall was last evaluated,
    V clearance;                 // and its distance there, mm; NaN: never
    V gap, last_gap;             // to the wall at the trial and at the accepted point, mm; no more than the reach of contact
};

// Adds the wall's elastic reaction, energy k/2 (radius - distance)² where positive. Returns the energy. Where `sticky`,
// gradient and Hessian are those of a wall that can also pull: otherwise a node that has just lost contact would move
// freely in the next Newton step and hit the wall.
template <class V>
ENDOPILOT_DEVICE inline V add_wall(double stiffness, double radius, const V& geometric, Mask<V> sticky, const Distance<V>& d,
                  Diagonal<V>& own) {
    const Mask<V> clear = d.value >= radius;  // false for NaN, so that NaN reaches the energy
    const V gap = radius - d.value;
    const V touch = select<V>(clear, V{}, gap);
    const V depth = select<V>(sticky, gap, touch);
    const V k = select<V>(clear, select<V>(sticky, broadcast<V>(stiffness), V{}), broadcast<V>(stiffness));
    const V reaction = stiffness * depth;  // N, of the wall on the wire
    own.gradient_x -= reaction * d.gradient;
    const V bend = geometric * reaction;
    own.xx.xx += k * d.gradient.x * d.gradient.x - bend * d.hessian.xx;
    own.xx.yy += k * d.gradient.y * d.gradient.y - bend * d.hessian.yy;
    own.xx.zz += k * d.gradient.z * d.gradient.z - bend * d.hessian.zz;
    own.xx.xy += k * d.gradient.x * d.gradient.y - bend * d.hessian.xy;
    own.xx.xz += k * d.gradient.x * d.gradient.z - bend * d.hessian.xz;
    own.xx.yz += k * d.gradient.y * d.gradient.z - bend * d.hessian.yz;
    return 0.5 * stiffness * touch * touch;
}

// Adds smoothed Coulomb friction of the touching surface, energy limit (sqrt(|s|² + eps²) - eps) with s the tangential
// displacement of that surface since the start of the step: of the node, and by rotation about the wire's own axis.
// `moved` is the node's displacement, `p` the element's rotation since the start of the step. Where `tangent` is 1 the Hessian is
// friction's own; where it is 0 friction's secant stands for it, which is nowhere softer. Returns the energy.
template <class V>
ENDOPILOT_DEVICE inline V add_friction(const FrictionState<V>& friction, const V& eps, const V& tangent, const Vec3<V>& moved,
                                       const Quaternion<V>& p, Diagonal<V>& own) {
    const Vec3<V>& n = friction.normal;
    const V twist = 2.0 * p.v.z;
    const Vec3<V> s = moved - dot(moved, n) * n + twist * friction.spin_arm;
    const V size = square_root(dot(s, s) + eps * eps);
    const V a = 1.0 / size;
    const V secant = friction.limit * a;  // N/mm; the force of friction on the wire is -secant s
    const Vec3<V> gradient = secant * s;
    const Vec3<V> turn{-p.v.y, p.v.x, p.w};  // d twist / d theta
    own.gradient_x += gradient;
    const V gradient_twist = dot(gradient, friction.spin_arm);
    own.gradient_theta += gradient_twist * turn;

    const V c = tangent * secant * a * a;
    own.xx.xx += secant * (1.0 - n.x * n.x) - c * s.x * s.x;
    own.xx.yy += secant * (1.0 - n.y * n.y) - c * s.y * s.y;
    own.xx.zz += secant * (1.0 - n.z * n.z) - c * s.z * s.z;
    own.xx.xy -= secant * n.x * n.y + c * s.x * s.y;
    own.xx.xz -= secant * n.x * n.z + c * s.x * s.z;
    own.xx.yz -= secant * n.y * n.z + c * s.y * s.z;
    const Vec3<V> mixed = secant * friction.spin_arm - (c * dot(s, friction.spin_arm)) * s;  // spin is perpendicular to n
    const V rotary = dot(mixed, friction.spin_arm);
    const V t[3] = {turn.x, turn.y, turn.z};
    for (int r = 0; r < 3; ++r) {
        own.tx[r][0] += t[r] * mixed.x;
        own.tx[r][1] += t[r] * mixed.y;
        own.tx[r][2] += t[r] * mixed.z;
    }
    own.tt.xx += rotary * turn.x * turn.x;
    own.tt.yy += rotary * turn.y * turn.y;
    own.tt.zz += rotary * turn.z * turn.z;
    own.tt.xy += rotary * turn.x * turn.y;
    own.tt.xz += rotary * turn.x * turn.z;
    own.tt.yz += rotary * turn.y * turn.z;
    return friction.limit * (size - eps);
}

// Shares out what acts at the middle of an element between its two ends; rotations are the element's own.
template <class V>
ENDOPILOT_DEVICE inline void add_middle(const Diagonal<V>& middle, Diagonal<V>& own, Diagonal<V>& next, Coupling<V>& coupling) {
    const V half = broadcast<V>(0.5), quarter = broadcast<V>(0.25);
    const Vec3<V> gradient = half * middle.gradient_x;
    own.gradient_x += gradient;
    next.gradient_x += gradient;
    own.gradient_theta += middle.gradient_theta;
    const Sym3<V> xx = quarter * middle.xx;
    own.xx += xx;
    next.xx += xx;
    coupling.xx += xx;
    own.tt += middle.tt;
    for (int r = 0; r < 3; ++r)
        for (int c = 0; c < 3; ++c) {
            const V tx = half * middle.tx[r][c];
            own.tx[r][c] += tx;
            coupling.tx[r][c] += tx;
        }
}

}  // namespace endopilot
