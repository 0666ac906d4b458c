// Block-tridiagonal LDLᵀ factorisation, one block row at a time, from tip to base.
#pragma once

#include <type_traits>

#include "rod.hpp"

namespace endopilot {

// Calls f with each integer from Begin to End - 1 as a compile-time constant: 6×6 blocks then live in registers.
template <int Begin, int End, class F>
[[gnu::always_inline]] ENDOPILOT_DEVICE inline void unroll(const F& f) {
    if constexpr (Begin < End) {
        f(std::integral_constant<int, Begin>{});
        unroll<Begin + 1, End>(f);
    }
}

// What back substitution needs of one block row. D = L diag(pivot) L^T with a unit lower triangular L; for the coupling
// C to the next block, w = diag(pivot)^-1 L^-1 C (the upper right 3×3 part of C is zero and so is that of w) and
// z = -diag(pivot)^-1 L^-1 gradient.
template <class V>
struct Factor {
    V lower[15];     // rows 1 to 5 of L
    V wx[6][3];
    V wt[3][3];
    V z[6];
};

// A block is positive definite if its smallest pivot is positive; `descent` is its share of gradient · Hessian^-1 gradient.
template <class V>
struct Elimination {
    V smallest_pivot, descent;
};

// Factors block `own` and eliminates it from block `next`, row by row: work on the coupling hides the latency of the
// division by the row's pivot.
template <class V>
[[gnu::always_inline]] ENDOPILOT_DEVICE inline Elimination<V> eliminate(const Diagonal<V>& own, const Coupling<V>& coupling,
                                                                         Factor<V>& f, Diagonal<V>& next) {
    const V d[6][6] = {{own.xx.xx},
                       {own.xx.xy, own.xx.yy},
                       {own.xx.xz, own.xx.yz, own.xx.zz},
                       {own.tx[0][0], own.tx[0][1], own.tx[0][2], own.tt.xx},
                       {own.tx[1][0], own.tx[1][1], own.tx[1][2], own.tt.xy, own.tt.yy},
                       {own.tx[2][0], own.tx[2][1], own.tx[2][2], own.tt.xz, own.tt.yz, own.tt.zz}};
    const V cx[6][3] = {{coupling.xx.xx, coupling.xx.xy, coupling.xx.xz},
                        {coupling.xx.xy, coupling.xx.yy, coupling.xx.yz},
                        {coupling.xx.xz, coupling.xx.yz, coupling.xx.zz},
                        {coupling.tx[0][0], coupling.tx[0][1], coupling.tx[0][2]},
                        {coupling.tx[1][0], coupling.tx[1][1], coupling.tx[1][2]},
                        {coupling.tx[2][0], coupling.tx[2][1], coupling.tx[2][2]}};
    const V g[6] = {own.gradient_x.x,     own.gradient_x.y,     own.gradient_x.z,
                    own.gradient_theta.x, own.gradient_theta.y, own.gradient_theta.z};
    V lower[6][6], inverse[6], x[6][3], t[6][3], z[6], smallest = d[0][0];
    unroll<0, 6>([&](auto r_) {
        constexpr int r = decltype(r_)::value;
        V scaled[6];  // row r of L diag(pivot)
        V pivot = d[r][r];
        unroll<0, r>([&](auto c_) {
            constexpr int c = decltype(c_)::value;
            V s = d[r][c];
            unroll<0, c>([&](auto k_) {
                constexpr int k = decltype(k_)::value;
                s -= scaled[k] * lower[c][k];
            });
            scaled[c] = s;
            lower[r][c] = s * inverse[c];
            f.lower[r * (r - 1) / 2 + c] = lower[r][c];
            pivot -= s * lower[r][c];
        });
        smallest = pivot < smallest ? pivot : smallest;
        inverse[r] = 1.0 / pivot;
        unroll<0, 3>([&](auto c_) {
            constexpr int c = decltype(c_)::value;
            V s = cx[r][c];
            unroll<0, r>([&](auto k_) {
                constexpr int k = decltype(k_)::value;
                s -= lower[r][k] * x[k][c];
            });
            x[r][c] = s;
            if constexpr (r >= 3) {
                V u = coupling.tt[r - 3][c];
                unroll<3, r>([&](auto k_) {
                    constexpr int k = decltype(k_)::value;
                    u -= lower[r][k] * t[k][c];
                });
                t[r][c] = u;
            }
        });
        V s = -g[r];
        unroll<0, r>([&](auto k_) {
            constexpr int k = decltype(k_)::value;
            s -= lower[r][k] * z[k];
        });
        z[r] = s;
    });
    unroll<0, 6>([&](auto r_) {
        constexpr int r = decltype(r_)::value;
        unroll<0, 3>([&](auto c_) {
            constexpr int c = decltype(c_)::value;
            f.wx[r][c] = inverse[r] * x[r][c];
            if constexpr (r >= 3) f.wt[r - 3][c] = inverse[r] * t[r][c];
        });
        f.z[r] = inverse[r] * z[r];
    });
    const auto xx = [&](auto a_, auto b_) {
        constexpr int a = decltype(a_)::value, b = decltype(b_)::value;
        V s = x[0][a] * f.wx[0][b];
        unroll<1, 6>([&](auto k_) {
            constexpr int k = decltype(k_)::value;
            s += x[k][a] * f.wx[k][b];
        });
        return s;
    };
    const auto tt = [&](int a, int b) { return t[3][a] * f.wt[0][b] + t[4][a] * f.wt[1][b] + t[5][a] * f.wt[2][b]; };
    const auto xz = [&](auto a_) {
        constexpr int a = decltype(a_)::value;
        V s = z[0] * f.wx[0][a];
        unroll<1, 6>([&](auto k_) {
            constexpr int k = decltype(k_)::value;
            s += z[k] * f.wx[k][a];
        });
        return s;
    };
    const auto tz = [&](int a) { return z[3] * f.wt[0][a] + z[4] * f.wt[1][a] + z[5] * f.wt[2][a]; };
    const std::integral_constant<int, 0> X;
    const std::integral_constant<int, 1> Y;
    const std::integral_constant<int, 2> Z;
    next.xx.xx -= xx(X, X);
    next.xx.yy -= xx(Y, Y);
    next.xx.zz -= xx(Z, Z);
    next.xx.xy -= xx(X, Y);
    next.xx.xz -= xx(X, Z);
    next.xx.yz -= xx(Y, Z);
    next.tt.xx -= tt(0, 0);
    next.tt.yy -= tt(1, 1);
    next.tt.zz -= tt(2, 2);
    next.tt.xy -= tt(0, 1);
    next.tt.xz -= tt(0, 2);
    next.tt.yz -= tt(1, 2);
    unroll<0, 3>([&](auto r_) {
        constexpr int r = decltype(r_)::value;
        unroll<0, 3>([&](auto c_) {
            constexpr int c = decltype(c_)::value;
            next.tx[r][c] -= t[3][r] * f.wx[3][c] + t[4][r] * f.wx[4][c] + t[5][r] * f.wx[5][c];
        });
    });
    next.gradient_x += Vec3<V>{xz(X), xz(Y), xz(Z)};
    next.gradient_theta += Vec3<V>{tz(0), tz(1), tz(2)};
    V descent = z[0] * f.z[0];
    for (int r = 1; r < 6; ++r) descent += z[r] * f.z[r];
    return {smallest, descent};
}

// Solves for this block's unknowns, given those of the next one towards the base.
template <class V>
[[gnu::always_inline]] ENDOPILOT_DEVICE inline void substitute(const Factor<V>& f, Vec3<V>& x, Vec3<V>& t) {
    V s[6];
    unroll<0, 6>([&](auto r_) {
        constexpr int r = decltype(r_)::value;
        s[r] = f.z[r] - f.wx[r][0] * x.x - f.wx[r][1] * x.y - f.wx[r][2] * x.z;
        if constexpr (r >= 3) s[r] -= f.wt[r - 3][0] * t.x + f.wt[r - 3][1] * t.y + f.wt[r - 3][2] * t.z;
    });
    unroll<0, 5>([&](auto r_) {
        constexpr int k = 5 - decltype(r_)::value;
        unroll<0, k>([&](auto c_) {
            constexpr int c = decltype(c_)::value;
            s[c] -= f.lower[k * (k - 1) / 2 + c] * s[k];
        });
    });
    x = {s[0], s[1], s[2]};
    t = {s[3], s[4], s[5]};
}

}  // namespace endopilot
