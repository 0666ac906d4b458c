// A lumen's distance map on a finer grid, sharp along its centerlines.
#pragma once

#include <algorithm>
#include <cmath>
#include <vector>

#include "lumen.hpp"

namespace endopilot {

// Spheres inside the lumen, of which the radius r and the centre change linearly from one to another.
struct InscribedSpheres {
    float from[3], to[3];   // centres, mm
    float first, last;      // radii, mm
};

// On its axis the distance in a narrow vessel has a ridge that a spline cannot follow: it rounds it off by up to half a grid step, so that
// the axis seems nearer to the wall than it is. Here each brick of a grid `factor` times finer takes the larger of the coarse spline and
// the distance in the spheres, which is exact on the axis and nowhere too large.
class RefinedBricks {
public:
    RefinedBricks(const float* coefficients, const int (&size)[3], const double (&origin)[3], double spacing, int factor,
                  const std::vector<InscribedSpheres>& spheres, double far)
        : coarse_(coefficients), factor_(factor), spacing_(float(spacing / factor)), spheres_(spheres), far_(far), rounded_off_(0.5 * spacing) {
        for (int a = 0; a < 3; ++a) size_[a] = size[a], origin_[a] = origin[a];
    }

    bool operator()(const int (&brick)[3], std::vector<float>& coefficients, float& lowest, float& highest) {
        float middle[3];
        for (int a = 0; a < 3; ++a) {
            first_[a] = brick[a] * Lumen::kEdge - 2;
            middle[a] = float(origin_[a]) + spacing_ * (float(first_[a]) + 0.5f * float(kSampled - 1));
            low_[a] = coarse_cell(first_[a]) - 1;
            count_[a] = coarse_cell(first_[a] + kSampled - 1) + 2 - low_[a];
        }
        bounds(lowest, highest);
        if (highest + rounded_off_ < -far_) return false;
        find_spheres(middle);
        sample_coarse();
        for (const InscribedSpheres* each : here_) join(*each);
        filter(coefficients);
        const auto ends = std::minmax_element(coefficients.begin(), coefficients.begin() + Lumen::kVolume);
        lowest = *ends.first, highest = *ends.second;
        return true;
    }

private:
    static constexpr int kSampled = Lumen::kStored + 2;   // the filter needs one more to each side

    int coarse_cell(int fine) const { return int(std::lround(double(fine) / factor_)); }

    float coefficient(int i, int j, int k) const {
        const int x = std::clamp(low_[0] + i, 0, size_[0] - 1), y = std::clamp(low_[1] + j, 0, size_[1] - 1), z = std::clamp(low_[2] + k, 0, size_[2] - 1);
        return coarse_[(std::size_t(z) * size_[1] + y) * size_[0] + x];
    }

    // A spline lies between the smallest and the largest of its coefficients.
    void bounds(float& lowest, float& highest) const {
        lowest = std::numeric_limits<float>::max(), highest = -lowest;
        for (int k = 0; k < count_[2]; ++k)
            for (int j = 0; j < count_[1]; ++j)
                for (int i = 0; i < count_[0]; ++i) {
                    const float c = coefficient(i, j, k);
                    lowest = std::min(lowest, c);
                    highest = std::max(highest, c);
                }
    }

    // The spheres that reach into the brick, whose middle is given.
    void find_spheres(const float (&middle)[3]) {
        here_.clear();
        const float half = 0.5f * std::sqrt(3.0f) * float(kSampled - 1) * spacing_;
        for (const InscribedSpheres& each : spheres_)
            if (depth(each, middle, std::max(each.first, each.last)) > -half) here_.push_back(&each);
    }

    // How deep a point lies in the sphere nearest to it; in one of radius `widest` if that is positive.
    static float depth(const InscribedSpheres& spheres, const float (&point)[3], float widest = 0) {
        float along = 0, square = 0, to[3];
        for (int a = 0; a < 3; ++a) {
            const float step = spheres.to[a] - spheres.from[a];
            along += step * (point[a] - spheres.from[a]);
            square += step * step;
        }
        const float t = square > 0 ? std::clamp(along / square, 0.0f, 1.0f) : 0.0f;
        for (int a = 0; a < 3; ++a) to[a] = point[a] - spheres.from[a] - t * (spheres.to[a] - spheres.from[a]);
        const float radius = widest > 0 ? widest : spheres.first + t * (spheres.last - spheres.first);
        return radius - std::sqrt(to[0] * to[0] + to[1] * to[1] + to[2] * to[2]);
    }

    // The coarse spline at the brick's points, along one axis after another.
    void sample_coarse() {
        const int nx = count_[0], ny = count_[1], nz = count_[2];
        block_.resize(std::size_t(nx) * ny * nz);
        for (int k = 0, m = 0; k < nz; ++k)
            for (int j = 0; j < ny; ++j)
                for (int i = 0; i < nx; ++i, ++m) block_[std::size_t(m)] = coefficient(i, j, k);
        along(0, block_, rows_, 1, nx, ny * nz);
        along(1, rows_, planes_, kSampled, ny, nz);
        along(2, planes_, values_, kSampled * kSampled, nz, 1);
    }

    // From n coefficients along an axis to kSampled values; `inner` values lie side by side, `outer` times.
    void along(int axis, const std::vector<float>& from, std::vector<float>& to, int inner, int n, int outer) const {
        to.resize(std::size_t(inner) * kSampled * outer);
        for (int s = 0; s < kSampled; ++s) {
            const double u = double(first_[axis] + s) / factor_;
            const int cell = coarse_cell(first_[axis] + s);
            const float p = float(u - cell), left = 0.5f - p, right = 0.5f + p;
            const float w[3] = {0.5f * left * left, 0.75f - p * p, 0.5f * right * right};
            const int at = cell - 1 - low_[axis];
            for (int o = 0; o < outer; ++o)
                for (int i = 0; i < inner; ++i) {
                    const float* c = &from[std::size_t((o * n + at) * inner + i)];
                    to[std::size_t((o * kSampled + s) * inner + i)] = w[0] * c[0] + w[1] * c[inner] + w[2] * c[2 * inner];
                }
        }
    }

    void join(const InscribedSpheres& spheres) {
        for (int k = 0, m = 0; k < kSampled; ++k)
            for (int j = 0; j < kSampled; ++j)
                for (int i = 0; i < kSampled; ++i, ++m) {
                    const float point[3] = {float(origin_[0]) + spacing_ * float(first_[0] + i), float(origin_[1]) + spacing_ * float(first_[1] + j),
                                            float(origin_[2]) + spacing_ * float(first_[2] + k)};
                    values_[std::size_t(m)] = std::max(values_[std::size_t(m)], depth(spheres, point));
                }
    }

    // From values to coefficients, by the local filter (-1, 10, -1)/8 along each axis, which keeps quadratic functions as they are.
    void filter(std::vector<float>& coefficients) {
        constexpr int n = kSampled, m = Lumen::kStored;
        rows_.resize(std::size_t(m) * n * n), planes_.resize(std::size_t(m) * m * n);
        const auto local = [](float before, float here, float after) { return 0.125f * (10.0f * here - before - after); };
        for (int r = 0; r < n * n; ++r)
            for (int i = 0; i < m; ++i) {
                const float* v = &values_[std::size_t(r * n + i)];
                rows_[std::size_t(r * m + i)] = local(v[0], v[1], v[2]);
            }
        for (int k = 0; k < n; ++k)
            for (int j = 0; j < m; ++j)
                for (int i = 0; i < m; ++i) {
                    const float* v = &rows_[std::size_t((k * n + j) * m + i)];
                    planes_[std::size_t((k * m + j) * m + i)] = local(v[0], v[m], v[2 * m]);
                }
        for (int k = 0; k < m; ++k)
            for (int i = 0; i < m * m; ++i) {
                const float* v = &planes_[std::size_t(k * m * m + i)];
                coefficients[std::size_t(k * m * m + i)] = local(v[0], v[m * m], v[2 * m * m]);
            }
    }

    const float* coarse_;
    int size_[3], factor_;
    double origin_[3];
    float spacing_;   // of the fine grid, mm
    const std::vector<InscribedSpheres>& spheres_;
    double far_, rounded_off_;   // mm; the coarse spline rounds off no more than this
    std::vector<const InscribedSpheres*> here_;
    int first_[3], low_[3], count_[3];   // the brick's first fine point, its first coarse coefficient, and how many of those it takes
    std::vector<float> block_, rows_, planes_, values_;
};

inline LumenMap refined_lumen_map(const float* coefficients, const int (&size)[3], const double (&origin)[3], double spacing, int factor,
                                  const std::vector<InscribedSpheres>& spheres, double near, double far) {
    RefinedBricks bricks(coefficients, size, origin, spacing, factor, spheres, far);
    int fine[3];
    for (int a = 0; a < 3; ++a) fine[a] = (size[a] - 1) * factor + 1;
    return gather_bricks(fine, origin, spacing / factor, near, far, bricks);
}

}  // namespace endopilot
