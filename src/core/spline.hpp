// Coefficients of the quadratic B-spline that passes through the values of an image.
#pragma once

#include <cstddef>
#include <vector>

namespace endopilot {

// Filters `lines` lines of n values in place, value k of line i at data[k * step + i]: along each, the coefficients c with
// (c[k-1] + 6 c[k] + c[k+1]) / 8 = value[k]. The recursion runs forwards and backwards with the filter's pole; beyond its
// ends a line goes on as it ends. M. Unser, A. Aldroubi, M. Eden, IEEE Trans. Signal Process. 41 (1993) 821-833.
inline void filter_lines(float* data, std::ptrdiff_t n, std::ptrdiff_t step, std::ptrdiff_t lines) {
    constexpr float pole = -0.17157287525380990f;  // 2 sqrt(2) - 3
    constexpr float gain = 8.0f;                   // (1 - pole) (1 - 1 / pole)
    constexpr float first = gain / (1 - pole), rest = -pole / (1 - pole * pole), far = -pole / (1 - pole);
    std::vector<float> limit(static_cast<std::size_t>(lines));
    for (std::ptrdiff_t i = 0; i < lines; ++i) {
        limit[std::size_t(i)] = first * data[(n - 1) * step + i];  // of the forward recursion beyond the end
        data[i] *= first;
    }
    for (std::ptrdiff_t k = 1; k < n; ++k) {
        float* now = data + k * step;
        const float* before = now - step;
        for (std::ptrdiff_t i = 0; i < lines; ++i) now[i] = gain * now[i] + pole * before[i];
    }
    float* last = data + (n - 1) * step;
    for (std::ptrdiff_t i = 0; i < lines; ++i) {
        const float end = limit[std::size_t(i)];
        last[i] = far * end + rest * (last[i] - end);
    }
    for (std::ptrdiff_t k = n - 2; k >= 0; --k) {
        float* now = data + k * step;
        const float* after = now + step;
        for (std::ptrdiff_t i = 0; i < lines; ++i) now[i] = pole * (after[i] - now[i]);
    }
}

// The same along x, whose values lie side by side: eight lines at a time are transposed.
inline void filter_rows(float* data, std::ptrdiff_t n, std::ptrdiff_t rows) {
    constexpr std::ptrdiff_t kTogether = 8;
    std::vector<float> transposed(std::size_t(n * kTogether));
    for (std::ptrdiff_t row = 0; row < rows; row += kTogether) {
        const std::ptrdiff_t m = rows - row < kTogether ? rows - row : kTogether;
        float* from = data + row * n;
        for (std::ptrdiff_t r = 0; r < m; ++r)
            for (std::ptrdiff_t k = 0; k < n; ++k) transposed[std::size_t(k * m + r)] = from[r * n + k];
        filter_lines(transposed.data(), n, m, m);
        for (std::ptrdiff_t r = 0; r < m; ++r)
            for (std::ptrdiff_t k = 0; k < n; ++k) from[r * n + k] = transposed[std::size_t(k * m + r)];
    }
}

// Coefficients of an image of nz × ny × nx values, x fastest.
inline std::vector<float> spline_coefficients(const float* values, const int (&size)[3]) {
    const std::ptrdiff_t nx = size[0], ny = size[1], nz = size[2];
    std::vector<float> c(values, values + nx * ny * nz);
    for (std::ptrdiff_t z = 0; z < nz; ++z) {
        filter_rows(c.data() + z * ny * nx, nx, ny);
        filter_lines(c.data() + z * ny * nx, ny, nx, nx);
    }
    filter_lines(c.data(), nz, ny * nx, ny * nx);
    return c;
}

}  // namespace endopilot
