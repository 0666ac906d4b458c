// Block-tridiagonal Cholesky factorisation, one block row at a time, from tip to base.
#pragma once

#include <type_traits>

#include "rod.hpp"

namespace endopilot {

// Calls f with each integer from Begin to End - 1 as a compile-time constant: 6×6 blocks then live in registers.
template <int Begin, int End, class F>
[[gnu::always_inline]] inline void unroll(const F& f) {
    if constexpr (Begin < End) {
        f(std::integral_constant<int, Begin>{});
        unroll<Begin + 1, End>(f);
    }
}

// What back substitution needs of one block row: D = L L^T, W = L^-1 C (C the coupling to the next block; its upper
// right 3×3 part is zero and so is W's) and z = -L^-1 gradient.
template <class V>
struct Factor {
    V lower[6][6];   // diagonal entries are stored inverted
    V wx[6][3];
    V wt[3][3];
    V z[6];
};

// Factors block `own` and eliminates it from block `next`. Returns the smallest pivot: the block is positive definite
// if that is positive.
template <class V>
inline V eliminate(const Diagonal<V>& own, const Coupling<V>& coupling, Factor<V>& f, Diagonal<V>& next) {
    V d[6][6];
    d[0][0] = own.xx.xx;
    d[1][0] = own.xx.xy;
    d[1][1] = own.xx.yy;
    d[2][0] = own.xx.xz;
    d[2][1] = own.xx.yz;
    d[2][2] = own.xx.zz;
    for (int r = 0; r < 3; ++r)
        for (int c = 0; c < 3; ++c) d[3 + r][c] = own.tx[r][c];
    d[3][3] = own.tt.xx;
    d[4][3] = own.tt.xy;
    d[4][4] = own.tt.yy;
    d[5][3] = own.tt.xz;
    d[5][4] = own.tt.yz;
    d[5][5] = own.tt.zz;

    V smallest = d[0][0];
    unroll<0, 6>([&](auto c_) {
        constexpr int c = decltype(c_)::value;
        V pivot = d[c][c];
        unroll<0, c>([&](auto k_) {
            constexpr int k = decltype(k_)::value;
            pivot -= d[c][k] * d[c][k];
        });
        smallest = pivot < smallest ? pivot : smallest;
        const V inverse = 1.0 / square_root(pivot);
        d[c][c] = inverse;
        unroll<c + 1, 6>([&](auto r_) {
            constexpr int r = decltype(r_)::value;
            V s = d[r][c];
            unroll<0, c>([&](auto k_) {
                constexpr int k = decltype(k_)::value;
                s -= d[r][k] * d[c][k];
            });
            d[r][c] = s * inverse;
        });
    });
    unroll<0, 6>([&](auto r_) {
        constexpr int r = decltype(r_)::value;
        unroll<0, r + 1>([&](auto c_) {
            constexpr int c = decltype(c_)::value;
            f.lower[r][c] = d[r][c];
        });
    });

    const V cx[6][3] = {{coupling.xx.xx, coupling.xx.xy, coupling.xx.xz},
                        {coupling.xx.xy, coupling.xx.yy, coupling.xx.yz},
                        {coupling.xx.xz, coupling.xx.yz, coupling.xx.zz},
                        {coupling.tx[0][0], coupling.tx[0][1], coupling.tx[0][2]},
                        {coupling.tx[1][0], coupling.tx[1][1], coupling.tx[1][2]},
                        {coupling.tx[2][0], coupling.tx[2][1], coupling.tx[2][2]}};
    V wx[6][3], wt[3][3], z[6];
    const V rhs[6] = {-own.force.x, -own.force.y, -own.force.z, -own.moment.x, -own.moment.y, -own.moment.z};
    unroll<0, 6>([&](auto r_) {
        constexpr int r = decltype(r_)::value;
        unroll<0, 3>([&](auto c_) {
            constexpr int c = decltype(c_)::value;
            V s = cx[r][c];
            unroll<0, r>([&](auto k_) {
                constexpr int k = decltype(k_)::value;
                s -= d[r][k] * wx[k][c];
            });
            wx[r][c] = s * d[r][r];
        });
        V s = rhs[r];
        unroll<0, r>([&](auto k_) {
            constexpr int k = decltype(k_)::value;
            s -= d[r][k] * z[k];
        });
        z[r] = s * d[r][r];
    });
    unroll<0, 3>([&](auto r_) {
        constexpr int r = decltype(r_)::value;
        unroll<0, 3>([&](auto c_) {
            constexpr int c = decltype(c_)::value;
            V s = coupling.tt[r][c];
            unroll<0, r>([&](auto k_) {
                constexpr int k = decltype(k_)::value;
                s -= d[3 + r][3 + k] * wt[k][c];
            });
            wt[r][c] = s * d[3 + r][3 + r];
        });
    });

    const auto xx = [&](int a, int b) {
        V s = wx[0][a] * wx[0][b];
        unroll<1, 6>([&](auto k_) {
            constexpr int k = decltype(k_)::value;
            s += wx[k][a] * wx[k][b];
        });
        return s;
    };
    const auto tt = [&](int a, int b) { return wt[0][a] * wt[0][b] + wt[1][a] * wt[1][b] + wt[2][a] * wt[2][b]; };
    const auto xz = [&](int a) {
        V s = wx[0][a] * z[0];
        unroll<1, 6>([&](auto k_) {
            constexpr int k = decltype(k_)::value;
            s += wx[k][a] * z[k];
        });
        return s;
    };
    const auto tz = [&](int a) { return wt[0][a] * z[3] + wt[1][a] * z[4] + wt[2][a] * z[5]; };
    next.xx.xx -= xx(0, 0);
    next.xx.yy -= xx(1, 1);
    next.xx.zz -= xx(2, 2);
    next.xx.xy -= xx(0, 1);
    next.xx.xz -= xx(0, 2);
    next.xx.yz -= xx(1, 2);
    next.tt.xx -= tt(0, 0);
    next.tt.yy -= tt(1, 1);
    next.tt.zz -= tt(2, 2);
    next.tt.xy -= tt(0, 1);
    next.tt.xz -= tt(0, 2);
    next.tt.yz -= tt(1, 2);
    for (int r = 0; r < 3; ++r)
        for (int c = 0; c < 3; ++c)
            next.tx[r][c] -= wt[0][r] * wx[3][c] + wt[1][r] * wx[4][c] + wt[2][r] * wx[5][c];
    next.force += Vec3<V>{xz(0), xz(1), xz(2)};
    next.moment += Vec3<V>{tz(0), tz(1), tz(2)};

    for (int r = 0; r < 6; ++r) {
        f.z[r] = z[r];
        for (int c = 0; c < 3; ++c) f.wx[r][c] = wx[r][c];
    }
    for (int r = 0; r < 3; ++r)
        for (int c = 0; c < 3; ++c) f.wt[r][c] = wt[r][c];
    return smallest;
}

// Solves for this block's unknowns, given those of the next one towards the base.
template <class V>
inline void substitute(const Factor<V>& f, Vec3<V>& x, Vec3<V>& t) {
    V s[6];
    unroll<0, 6>([&](auto r_) {
        constexpr int r = decltype(r_)::value;
        s[r] = f.z[r] - f.wx[r][0] * x.x - f.wx[r][1] * x.y - f.wx[r][2] * x.z;
    });
    unroll<0, 3>([&](auto r_) {
        constexpr int r = decltype(r_)::value;
        s[3 + r] -= f.wt[r][0] * t.x + f.wt[r][1] * t.y + f.wt[r][2] * t.z;
    });
    unroll<0, 5 + 1>([&](auto r_) {
        constexpr int r = 5 - decltype(r_)::value;
        unroll<r + 1, 6>([&](auto k_) {
            constexpr int k = decltype(k_)::value;
            s[r] -= f.lower[k][r] * s[k];
        });
        s[r] *= f.lower[r][r];
    });
    x = {s[0], s[1], s[2]};
    t = {s[3], s[4], s[5]};
}

}  // namespace endopilot
