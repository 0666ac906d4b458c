// The lumen: the coefficients of a distance map's B-spline, where the wall is near.
#pragma once

#include <algorithm>
#include <cmath>
#include <cstddef>
#include <cstdint>
#include <limits>

#include "views.hpp"

namespace endopilot {

// B-spline coefficients of the signed distance to the wall (positive inside, mm), kept in bricks of 8³ cells and only
// where the wall is near. A brick stores one cell more on each side, so that the 3³ stencil never leaves it.
template <template <class> class Array>
struct LumenArrays {
    double origin[3]{}, inverse_spacing = 0, cells[3]{};
    double clearance = 0;          // mm: cells deep inside are at least as far from the wall
    double steepest = 0;           // the largest slope of the spline inside
    int bricks[3]{};
    Array<std::int32_t> index{};   // the brick of each 8³ cells; 0: deep inside, 1: outside
    Array<float> pool{};           // the bricks' coefficients

    static constexpr int kEdge = 8, kStored = kEdge + 2, kVolume = kStored * kStored * kStored;
    static constexpr double kDeep = 1e3;   // mm: farther from a wall than any place

    // The first coefficient of the 3³ stencils around the cells with whole-numbered coordinates `cell`, for each lane.
    template <class V>
    ENDOPILOT_DEVICE void stencils(const Vec3<V>& cell, const float* (&first)[kWidth<V>]) const {
        constexpr double kRound = 6755399441055744.0;   // 1.5 · 2^52: adding it rounds to whole numbers
        const V zero{};
        // written so that a NaN counts as outside
        const Mask<V> inside = (cell.x >= zero) & (cell.x < cells[0]) & (cell.y >= zero) & (cell.y < cells[1]) & (cell.z >= zero) & (cell.z < cells[2]);
        const auto brick = [](const V& c) { return ((1.0 / kEdge) * c - (0.5 - 0.5 / kEdge) + kRound) - kRound; };
        const Vec3<V> b{brick(cell.x), brick(cell.y), brick(cell.z)};
        const Vec3<V> in = cell - broadcast<V>(kEdge) * b;
        const V at = select<V>(inside, (b.z * double(bricks[1]) + b.y) * double(bricks[0]) + b.x, broadcast<V>(-1));
        const V from = (in.z * double(kStored) + in.y) * double(kStored) + in.x;
        for (int lane = 0; lane < kWidth<V>; ++lane) {
            const int place = int(get(at, lane));
            first[lane] = place < 0 ? &pool[kVolume] : &pool[std::size_t(index[place]) * kVolume + unsigned(int(get(from, lane)))];
        }
    }

    ENDOPILOT_DEVICE bool deep(const float* stencil) const { return stencil < &pool[kVolume]; }
};

using LumenMap = LumenArrays<Owned>;
using Lumen = LumenArrays<Viewed>;   // no lumen if it refers to nothing

// The largest slope, squared, in (coefficient per cell)², of the spline in the cell whose 3³ stencil begins at `stencil`; or a bound of
// it that is no larger than `enough`. In each axis a cell's three coefficients a, b, c are a parabola through (a + b)/2 and (b + c)/2
// with the control point b between them, and its slope runs from b - a to c - b. A polynomial stays in the hull of its control points
// (Farin, Curves and Surfaces for CAGD, 2002, section 4.3), here 3³ of the gradient.
inline float steepest_in_cell(const float* stencil, float enough) {
    constexpr int kStored = Lumen::kStored, kRow[3] = {1, kStored, kStored * kStored};
    float bound = 0.0f, largest = 0.0f;
    for (int a = 0; a < 3; ++a) {
        const int along = kRow[a], u = kRow[(a + 1) % 3], v = kRow[(a + 2) % 3];
        float step = 0.0f;
        for (int i = 0; i < 2; ++i)
            for (int j = 0; j < 9; ++j) {
                const float* c = stencil + i * along + j / 3 * u + j % 3 * v;
                step = std::max(step, std::abs(c[along] - c[0]));
            }
        bound += step * step;
    }
    if (!(bound > enough)) return bound;
    static constexpr float kValue[3][3] = {{0.5f, 0.5f, 0.0f}, {0.0f, 1.0f, 0.0f}, {0.0f, 0.5f, 0.5f}};
    static constexpr float kSlope[3][3] = {{-1.0f, 1.0f, 0.0f}, {-0.5f, 0.0f, 0.5f}, {0.0f, -1.0f, 1.0f}};
    for (int at = 0; at < 27; ++at) {
        const int p[3] = {at % 3, at / 3 % 3, at / 9};
        float slope[3] = {};
        for (int m = 0; m < 27; ++m) {
            const int s[3] = {m % 3, m / 3 % 3, m / 9};
            const float c = stencil[s[0] + s[1] * kStored + s[2] * kStored * kStored];
            for (int a = 0; a < 3; ++a) {
                float weight = c;
                for (int b = 0; b < 3; ++b) weight *= (a == b ? kSlope : kValue)[p[b]][s[b]];
                slope[a] += weight;
            }
        }
        largest = std::max(largest, slope[0] * slope[0] + slope[1] * slope[1] + slope[2] * slope[2]);
    }
    return largest;
}

// The largest slope, squared, of the spline in a brick's cells that reach inside; at least `so_far`.
inline float steepest_in_brick(const std::vector<float>& brick, float so_far) {
    constexpr int kEdge = Lumen::kEdge, kStored = Lumen::kStored;
    for (int z = 0; z < kEdge; ++z)
        for (int y = 0; y < kEdge; ++y)
            for (int x = 0; x < kEdge; ++x) {
                const float* stencil = &brick[std::size_t((z * kStored + y) * kStored + x)];
                float highest = stencil[0];
                for (int m = 0; m < 27; ++m) highest = std::max(highest, stencil[m % 3 + m / 3 % 3 * kStored + m / 9 * kStored * kStored]);
                if (highest > 0) so_far = std::max(so_far, steepest_in_cell(stencil, so_far));
            }
    return so_far;
}

// Gathers the bricks of a grid of `size` cells. `fill` is asked for each brick: it writes its coefficients and the lowest and highest of
// them; or it returns false where all are farther outside than `far`. Cells whose whole stencil is deeper inside than `near` carry no
// contact; cells whose whole stencil is farther outside than `far` count as outside the map.
template <class Fill>
LumenMap gather_bricks(const int (&size)[3], const double (&origin)[3], double spacing, double near, double far, Fill&& fill) {
    constexpr int kEdge = Lumen::kEdge, kVolume = Lumen::kVolume;
    LumenMap map;
    map.inverse_spacing = 1.0 / spacing;
    map.clearance = near;
    for (int a = 0; a < 3; ++a) {
        map.origin[a] = origin[a];
        map.bricks[a] = (size[a] + kEdge - 1) / kEdge;
        map.cells[a] = map.bricks[a] * kEdge;
    }
    map.pool.assign(2 * kVolume, float(near));  // brick 0: deep inside, brick 1: outside
    std::fill(map.pool.begin() + kVolume, map.pool.end(), std::numeric_limits<float>::quiet_NaN());
    map.index.resize(std::size_t(map.bricks[0]) * map.bricks[1] * map.bricks[2]);
    std::vector<float> brick(kVolume);
    std::size_t at = 0;
    float steepest = 0.0f;
    for (int z = 0; z < map.bricks[2]; ++z)
        for (int y = 0; y < map.bricks[1]; ++y)
            for (int x = 0; x < map.bricks[0]; ++x, ++at) {
                float lowest, highest;
                const bool filled = fill({x, y, z}, brick, lowest, highest);
                if (filled && highest > 0) steepest = steepest_in_brick(brick, steepest);
                if (filled && lowest > near) {
                    map.index[at] = 0;
                } else if (!filled || highest < -far) {
                    map.index[at] = 1;
                } else {
                    map.index[at] = std::int32_t(map.pool.size() / kVolume);
                    map.pool.insert(map.pool.end(), brick.begin(), brick.end());
                }
            }
    map.steepest = std::sqrt(double(steepest)) / spacing;
    map.pool.push_back(0.0f);  // rows are read four at a time
    return map;
}

// coefficients: nz × ny × nx, x fastest.
inline LumenMap make_lumen_map(const float* coefficients, const int (&size)[3], const double (&origin)[3], double spacing, double near,
                               double far) {
    constexpr int kEdge = Lumen::kEdge, kStored = Lumen::kStored;
    return gather_bricks(size, origin, spacing, near, far,
                         [&](const int (&at)[3], std::vector<float>& brick, float& lowest, float& highest) {
        lowest = std::numeric_limits<float>::max(), highest = -lowest;
        for (int z = 0, m = 0; z < kStored; ++z)
            for (int y = 0; y < kStored; ++y)
                for (int x = 0; x < kStored; ++x, ++m) {
                    const int gx = std::clamp(at[0] * kEdge + x - 1, 0, size[0] - 1);
                    const int gy = std::clamp(at[1] * kEdge + y - 1, 0, size[1] - 1);
                    const int gz = std::clamp(at[2] * kEdge + z - 1, 0, size[2] - 1);
                    const float c = coefficients[(std::size_t(gz) * size[1] + gy) * size[0] + gx];
                    brick[std::size_t(m)] = c;
                    lowest = std::min(lowest, c);
                    highest = std::max(highest, c);
                }
        return true;
    });
}

inline std::size_t bytes(const LumenMap& map) {
    return map.pool.size() * sizeof(float) + map.index.size() * sizeof(std::int32_t);
}

// `place` puts a vector where the stepper reads it, and returns its address there.
template <class Place>
Lumen view(const LumenMap& map, const Place& place) {
    Lumen lumen{.inverse_spacing = map.inverse_spacing, .clearance = map.clearance, .steepest = map.steepest};
    lumen.index = place(map.index), lumen.pool = place(map.pool);
    for (int a = 0; a < 3; ++a) {
        lumen.origin[a] = map.origin[a];
        lumen.cells[a] = map.cells[a];
        lumen.bricks[a] = map.bricks[a];
    }
    return lumen;
}

}  // namespace endopilot
