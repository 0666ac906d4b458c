// The least of a quadratic function of a few unknowns, each with a bound.
#pragma once

#include <algorithm>
#include <limits>

#include "lanes.hpp"

namespace endopilot {

constexpr int kUnbounded = 2;   // of an unknown's side: it has no bound

// Solves h s = -g for those s that are not held; a held one is given by s = -off. Returns whether their part of h is positive definite.
template <int N>
ENDOPILOT_DEVICE bool solve_with_held(const double (&h)[N][N], const double (&g)[N], const double (&off)[N], const bool (&held)[N], double (&s)[N]) {
    if constexpr (N == 2) {   // by Cramer's rule
        if (!held[0] && !held[1]) {
            const double determinant = h[0][0] * h[1][1] - h[1][0] * h[1][0];
            s[0] = (h[1][0] * g[1] - h[1][1] * g[0]) / determinant;
            s[1] = (h[1][0] * g[0] - h[0][0] * g[1]) / determinant;
            return h[0][0] > 0 && h[1][1] > 0 && determinant > 0;
        }
    }
    double a[N][N];
    for (int r = 0; r < N; ++r) {
        s[r] = held[r] ? -off[r] : -g[r];
        for (int c = 0; c < N; ++c) {
            a[r][c] = held[r] ? double(r == c) : held[c] ? 0.0 : h[r][c];
            if (!held[r] && held[c]) s[r] += h[r][c] * off[c];
        }
    }
    for (int r = 0; r < N; ++r) {
        if (!(a[r][r] > 0)) return false;
        for (int below = r + 1; below < N; ++below) {
            const double f = a[below][r] / a[r][r];
            for (int c = r; c < N; ++c) a[below][c] -= f * a[r][c];
            s[below] -= f * s[r];
        }
    }
    for (int r = N - 1; r >= 0; --r) {
        for (int c = r + 1; c < N; ++c) s[r] -= a[r][c] * s[c];
        s[r] /= a[r][r];
    }
    return true;
}

// The least g·s + ½ s·h s with side * (off + s) <= 0; s = -off where side is 0, and any where it is kUnbounded. Tries which unknowns its bounds hold: none, as a rule.
// Returns whether h is positive definite.
template <int N>
ENDOPILOT_DEVICE bool bounded_minimum(const double (&h)[N][N], const double (&g)[N], const int (&side)[N], const double (&off)[N], double (&least)[N]) {
    double lowest = std::numeric_limits<double>::infinity();
    for (int bounds = 0; bounds < 1 << N; ++bounds) {
        bool held[N], within = true;
        for (int r = 0; r < N; ++r) {
            held[r] = side[r] == 0 || (bounds >> r & 1);
            within = within && (side[r] != 0 || !(bounds >> r & 1));  // those that do not slip are held once
        }
        double s[N], value = 0;
        if (!within) continue;
        if (!solve_with_held(h, g, off, held, s)) return false;
        for (int r = 0; r < N; ++r) {
            within = within && (held[r] || side[r] == kUnbounded || side[r] * (off[r] + s[r]) <= 0);
            value += g[r] * s[r];
            for (int c = 0; c < N; ++c) value += 0.5 * h[r][c] * s[r] * s[c];
        }
        if (!within || !(value < lowest)) continue;
        lowest = value;
        std::copy(s, s + N, least);
        if (bounds == 0) break;
    }
    return true;
}

}  // namespace endopilot
