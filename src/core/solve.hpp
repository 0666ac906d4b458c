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
// T further tubes add as many rows and, but for wx, columns.
template <class V, int T = 0>
struct Factor {
    Single<V> lower[(6 + T) * (5 + T) / 2];     // rows 1 and on of L
    Single<V> wx[6 + T][3];
    Single<V> wt[3 + T][3 + T];
    Single<V> z[6 + T];
};

// What the elimination of a block adds to the next: gradient and lower triangular Hessian.
template <class V, int T = 0>
struct Carried {
    Vec3<Single<V>> gradient_x, gradient_theta;
    Sym3<Single<V>> xx;
    Single<V> tx[3][3];
    Sym3<Single<V>> tt;
    struct {
        Single<V> gradient[T], px[T][3], pt[T][3], pp[T][T];
    } twists;
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
template <class V, int T>
[[gnu::always_inline]] ENDOPILOT_DEVICE inline Elimination<V> eliminate(const Diagonal<V, T>& own, const Link<V, T>& link,
                                                                         Carried<V, T>& carried, Factor<V, T>& f) {
    using S = Single<V>;
    constexpr int B = 6 + T;
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
    S d[B][B] = {{uu.xx},
                       {uu.xy, uu.yy},
                       {uu.xz, uu.yz, uu.zz},
                       {tu[0][0], tu[0][1], tu[0][2], tt.xx},
                       {tu[1][0], tu[1][1], tu[1][2], tt.xy, tt.yy},
                       {tu[2][0], tu[2][1], tu[2][2], tt.xz, tt.yz, tt.zz}};
    S cx[B][3] = {{xx.xx, xx.xy, xx.xz},
                        {xx.xy, xx.yy, xx.yz},
                        {xx.xz, xx.yz, xx.zz},
                        {tx[0][0], tx[0][1], tx[0][2]},
                        {tx[1][0], tx[1][1], tx[1][2]},
                        {tx[2][0], tx[2][1], tx[2][2]}};
    S g[B] = {gx.x, gx.y, gx.z, gt.x, gt.y, gt.z};
    for (int k = 0; k < T; ++k) {
        for (int c = 0; c < 3; ++c) {
            cx[6 + k][c] = own.twists.px[k][c] + carried.twists.px[k][c];
            d[6 + k][c] = cx[6 + k][c] + link.twists.pu[k][c];
            d[6 + k][3 + c] = own.twists.pt[k][c] + carried.twists.pt[k][c];
        }
        for (int c = 0; c <= k; ++c) d[6 + k][6 + c] = own.twists.pp[k][c] + carried.twists.pp[k][c];
        g[6 + k] = narrow(own.twists.gradient[k]) + carried.twists.gradient[k];
    }
    // the coupling of theta and twists to those of the next block
    const auto coupling = [&](auto r_, auto c_) {
        constexpr int r = decltype(r_)::value, c = decltype(c_)::value;
        if constexpr (r < 3 && c < 3) return link.tt[r][c];
        else if constexpr (r < 3) return link.twists.tp[r][c - 3];
        else if constexpr (c < 3) return link.twists.pt[r - 3][c];
        else return link.twists.pp[r - 3][c - 3];
    };
    S lower[B][B], inverse[B], x[B][3], t[B][3 + T], z[B], smallest = d[0][0];
    unroll<0, B>([&](auto r_) {
        constexpr int r = decltype(r_)::value;
        S scaled[B];  // row r of L diag(pivot)
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
                S u = coupling(std::integral_constant<int, r - 3>{}, c_);
                unroll<3, r>([&](auto k_) {
                    constexpr int k = decltype(k_)::value;
                    u -= lower[r][k] * t[k][c];
                });
                t[r][c] = u;
            }
        });
        if constexpr (r >= 3) {
            unroll<3, 3 + T>([&](auto c_) {
                constexpr int c = decltype(c_)::value;
                S u = coupling(std::integral_constant<int, r - 3>{}, c_);
                unroll<3, r>([&](auto k_) {
                    constexpr int k = decltype(k_)::value;
                    u -= lower[r][k] * t[k][c];
                });
                t[r][c] = u;
            });
        }
        S s = -g[r];
        unroll<0, r>([&](auto k_) {
            constexpr int k = decltype(k_)::value;
            s -= lower[r][k] * z[k];
        });
        z[r] = s;
    });
    unroll<0, B>([&](auto r_) {
        constexpr int r = decltype(r_)::value;
        unroll<0, 3>([&](auto c_) {
            constexpr int c = decltype(c_)::value;
            f.wx[r][c] = inverse[r] * x[r][c];
            if constexpr (r >= 3) f.wt[r - 3][c] = inverse[r] * t[r][c];
        });
        if constexpr (r >= 3)
            for (int c = 3; c < 3 + T; ++c) f.wt[r - 3][c] = inverse[r] * t[r][c];
        f.z[r] = inverse[r] * z[r];
    });
    // sums over the rows of the block, from row `first` on
    const auto product = [&](auto first_, const auto& a, const auto& b) {
        constexpr int first = decltype(first_)::value;
        S s = a(first_) * b(first_);
        unroll<first + 1, B>([&](auto k_) { s += a(k_) * b(k_); });
        return s;
    };
    const std::integral_constant<int, 0> all;
    const std::integral_constant<int, 3> turns;   // rows of theta and twists
    const auto xwx = [&](int a, int b) {
        return product(all, [&](auto k) { return x[k][a]; }, [&](auto k) { return f.wx[k][b]; });
    };
    const auto twt = [&](int a, int b) {
        return product(turns, [&](auto k) { return t[k][a]; }, [&](auto k) { return f.wt[k - 3][b]; });
    };
    const auto twx = [&](int a, int b) {
        return product(turns, [&](auto k) { return t[k][a]; }, [&](auto k) { return f.wx[k][b]; });
    };
    const auto zwx = [&](int a) { return product(all, [&](auto k) { return z[k]; }, [&](auto k) { return f.wx[k][a]; }); };
    const auto zwt = [&](int a) { return product(turns, [&](auto k) { return z[k]; }, [&](auto k) { return f.wt[k - 3][a]; }); };
    constexpr int X = 0, Y = 1, Z = 2;
    carried.xx = xx - Sym3<S>{xwx(X, X), xwx(Y, Y), xwx(Z, Z), xwx(X, Y), xwx(X, Z), xwx(Y, Z)};
    carried.tt = {-twt(0, 0), -twt(1, 1), -twt(2, 2), -twt(0, 1), -twt(0, 2), -twt(1, 2)};
    unroll<0, 3>([&](auto r_) {
        constexpr int r = decltype(r_)::value;
        unroll<0, 3>([&](auto c_) {
            constexpr int c = decltype(c_)::value;
            carried.tx[r][c] = -twx(r, c);
        });
    });
    carried.gradient_x = gx + Vec3<S>{zwx(X), zwx(Y), zwx(Z)};
    carried.gradient_theta = {zwt(0), zwt(1), zwt(2)};
    for (int k = 0; k < T; ++k) {
        carried.twists.gradient[k] = zwt(3 + k);
        for (int c = 0; c < 3; ++c) {
            carried.twists.px[k][c] = -twx(3 + k, c);
            carried.twists.pt[k][c] = -twt(3 + k, c);
        }
        for (int c = 0; c <= k; ++c) carried.twists.pp[k][c] = -twt(3 + k, 3 + c);
    }
    S descent = z[0] * f.z[0];
    for (int r = 1; r < B; ++r) descent += z[r] * f.z[r];
    return {smallest, descent};
}

// Solves for this block's unknowns, given those of the next one towards the base; `p` are the twists of the further tubes.
template <class V, int T>
[[gnu::always_inline]] ENDOPILOT_DEVICE inline void substitute(const Factor<V, T>& f, Vec3<Single<V>>& x, Vec3<Single<V>>& t,
                                                               Single<V>* p = nullptr) {
    constexpr int B = 6 + T;
    Single<V> s[B];
    unroll<0, B>([&](auto r_) {
        constexpr int r = decltype(r_)::value;
        s[r] = f.z[r] - f.wx[r][0] * x.x - f.wx[r][1] * x.y - f.wx[r][2] * x.z;
        if constexpr (r >= 3) {
            s[r] -= f.wt[r - 3][0] * t.x + f.wt[r - 3][1] * t.y + f.wt[r - 3][2] * t.z;
            for (int k = 0; k < T; ++k) s[r] -= f.wt[r - 3][3 + k] * p[k];
        }
    });
    unroll<0, B - 1>([&](auto r_) {
        constexpr int k = B - 1 - decltype(r_)::value;
        unroll<0, k>([&](auto c_) {
            constexpr int c = decltype(c_)::value;
            s[c] -= f.lower[k * (k - 1) / 2 + c] * s[k];
        });
    });
    x += Vec3<Single<V>>{s[0], s[1], s[2]};
    t = {s[3], s[4], s[5]};
    for (int k = 0; k < T; ++k) p[k] = s[6 + k];
}

}  // namespace endopilot
