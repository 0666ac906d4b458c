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

// What back substitution needs of one block row, with u = x_i - x_{i+1} for x_i. D = L diag(pivot) L^T with a unit lower
// triangular L; for the coupling C to the next block, w = diag(pivot)^-1 L^-1 C (the upper right 3×3 part of C is zero and so
// is that of w) and z = -diag(pivot)^-1 L^-1 gradient.
template <class V>
struct Factor {
    Single<V> lower[15];     // rows 1 to 5 of L
    Single<V> wx[6][3];
    Single<V> wt[3][3];
    Single<V> z[6];
};

// What the elimination of a block adds to the next: gradient and lower triangular Hessian.
template <class V>
struct Carried {
    Vec3<Single<V>> gradient_x, gradient_theta;
    Sym3<Single<V>> xx;
    Single<V> tx[3][3];
    Sym3<Single<V>> tt;
};

// A block is positive definite if its smallest pivot is positive; `descent` is its share of gradient · Hessian^-1 gradient.
template <class V>
struct Elimination {
    Single<V> smallest_pivot, descent;
};

// Factors a block, to which `carried` was carried, row by row: work on the coupling hides the latency of the division by the
// row's pivot. `carried` becomes what goes to the next block.
//
// As x_i = u + x_{i+1}, what holds node i (A, all but the element) and its gradient also appear as coupling of u to x_{i+1} and at the next
// block: with the element's stiffness k, k - k (A + k)^-1 k becomes A - A (A + k)^-1 A, which keeps a small A.
template <class V>
[[gnu::always_inline]] ENDOPILOT_DEVICE inline Elimination<V> eliminate(const Diagonal<V>& own, const Link<V>& link, Carried<V>& carried,
                                                                         Factor<V>& f) {
    using S = Single<V>;
    const Sym3<S> xx = own.xx + carried.xx, tt = own.tt + carried.tt, uu = xx + link.uu;
    const Vec3<S> gx = narrow(own.gradient_x) + carried.gradient_x, gt = narrow(own.gradient_theta) + carried.gradient_theta;
    S tx[3][3], tu[3][3];
    unroll<0, 3>([&](auto r_) {
        constexpr int r = decltype(r_)::value;
        unroll<0, 3>([&](auto c_) {
            constexpr int c = decltype(c_)::value;
            tx[r][c] = own.tx[r][c] + carried.tx[r][c];
            tu[r][c] = tx[r][c] + link.tu[r][c];
        });
    });
    const S d[6][6] = {{uu.xx},
                       {uu.xy, uu.yy},
                       {uu.xz, uu.yz, uu.zz},
                       {tu[0][0], tu[0][1], tu[0][2], tt.xx},
                       {tu[1][0], tu[1][1], tu[1][2], tt.xy, tt.yy},
                       {tu[2][0], tu[2][1], tu[2][2], tt.xz, tt.yz, tt.zz}};
    const S cx[6][3] = {{xx.xx, xx.xy, xx.xz},
                        {xx.xy, xx.yy, xx.yz},
                        {xx.xz, xx.yz, xx.zz},
                        {tx[0][0], tx[0][1], tx[0][2]},
                        {tx[1][0], tx[1][1], tx[1][2]},
                        {tx[2][0], tx[2][1], tx[2][2]}};
    const S g[6] = {gx.x, gx.y, gx.z, gt.x, gt.y, gt.z};
    S lower[6][6], inverse[6], x[6][3], t[6][3], z[6], smallest = d[0][0];
    unroll<0, 6>([&](auto r_) {
        constexpr int r = decltype(r_)::value;
        S scaled[6];  // row r of L diag(pivot)
        S pivot = d[r][r];
        unroll<0, r>([&](auto c_) {
            constexpr int c = decltype(c_)::value;
            S s = d[r][c];
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
        inverse[r] = 1.0f / pivot;
        unroll<0, 3>([&](auto c_) {
            constexpr int c = decltype(c_)::value;
            S s = cx[r][c];
            unroll<0, r>([&](auto k_) {
                constexpr int k = decltype(k_)::value;
                s -= lower[r][k] * x[k][c];
            });
            x[r][c] = s;
            if constexpr (r >= 3) {
                S u = link.tt[r - 3][c];
                unroll<3, r>([&](auto k_) {
                    constexpr int k = decltype(k_)::value;
                    u -= lower[r][k] * t[k][c];
                });
                t[r][c] = u;
            }
        });
        S s = -g[r];
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
    const auto xwx = [&](auto a_, auto b_) {
        constexpr int a = decltype(a_)::value, b = decltype(b_)::value;
        S s = x[0][a] * f.wx[0][b];
        unroll<1, 6>([&](auto k_) {
            constexpr int k = decltype(k_)::value;
            s += x[k][a] * f.wx[k][b];
        });
        return s;
    };
    const auto twt = [&](int a, int b) { return t[3][a] * f.wt[0][b] + t[4][a] * f.wt[1][b] + t[5][a] * f.wt[2][b]; };
    const auto zwx = [&](auto a_) {
        constexpr int a = decltype(a_)::value;
        S s = z[0] * f.wx[0][a];
        unroll<1, 6>([&](auto k_) {
            constexpr int k = decltype(k_)::value;
            s += z[k] * f.wx[k][a];
        });
        return s;
    };
    const auto zwt = [&](int a) { return z[3] * f.wt[0][a] + z[4] * f.wt[1][a] + z[5] * f.wt[2][a]; };
    const std::integral_constant<int, 0> X;
    const std::integral_constant<int, 1> Y;
    const std::integral_constant<int, 2> Z;
    carried.xx = xx - Sym3<S>{xwx(X, X), xwx(Y, Y), xwx(Z, Z), xwx(X, Y), xwx(X, Z), xwx(Y, Z)};
    carried.tt = {-twt(0, 0), -twt(1, 1), -twt(2, 2), -twt(0, 1), -twt(0, 2), -twt(1, 2)};
    unroll<0, 3>([&](auto r_) {
        constexpr int r = decltype(r_)::value;
        unroll<0, 3>([&](auto c_) {
            constexpr int c = decltype(c_)::value;
            carried.tx[r][c] = -(t[3][r] * f.wx[3][c] + t[4][r] * f.wx[4][c] + t[5][r] * f.wx[5][c]);
        });
    });
    carried.gradient_x = gx + Vec3<S>{zwx(X), zwx(Y), zwx(Z)};
    carried.gradient_theta = {zwt(0), zwt(1), zwt(2)};
    S descent = z[0] * f.z[0];
    for (int r = 1; r < 6; ++r) descent += z[r] * f.z[r];
    return {smallest, descent};
}

// Solves for this block's unknowns, given those of the next one towards the base.
template <class V>
[[gnu::always_inline]] ENDOPILOT_DEVICE inline void substitute(const Factor<V>& f, Vec3<Single<V>>& x, Vec3<Single<V>>& t) {
    Single<V> s[6];
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
    x += Vec3<Single<V>>{s[0], s[1], s[2]};
    t = {s[3], s[4], s[5]};
}

}  // namespace endopilot
