// Numpy arrays in and out of the core.
#pragma once

#include <nanobind/nanobind.h>
#include <nanobind/ndarray.h>

#include <cstdint>
#include <stdexcept>
#include <vector>

#include "lanes.hpp"

namespace endopilot {

namespace nb = nanobind;

template <int Dims>
using Array = nb::ndarray<const double, nb::ndim<Dims>, nb::c_contig, nb::device::cpu>;
template <int Dims>
using Indices = nb::ndarray<const std::int64_t, nb::ndim<Dims>, nb::c_contig, nb::device::cpu>;
using Image = nb::ndarray<const float, nb::ndim<3>, nb::c_contig, nb::device::cpu>;

inline std::vector<double> values(const Array<1>& a) { return {a.data(), a.data() + a.size()}; }

inline Vec3<double> vec3(const double* p) { return {p[0], p[1], p[2]}; }

inline std::vector<Vec3<double>> vectors(const Array<2>& a) {
    std::vector<Vec3<double>> out;
    for (std::size_t i = 0; i < a.shape(0); ++i) out.push_back(vec3(a.data() + 3 * i));
    return out;
}

inline Quaternion<double> quaternion(const double* p) { return {p[0], {p[1], p[2], p[3]}}; }

inline void require(bool fine, const char* what) {
    if (!fine) throw std::invalid_argument(what);
}

// An array that will belong to Python.
template <class T>
struct OutputArray {
    explicit OutputArray(std::size_t size) : data(new T[size]()) {}
    T* data;
    template <class... Shape>
    nb::object array(Shape... shape) {
        return shaped({std::size_t(shape)...});
    }
    nb::object shaped(const std::vector<std::size_t>& shape) {
        nb::capsule owner(data, [](void* p) noexcept { delete[] static_cast<T*>(p); });
        return nb::cast(nb::ndarray<nb::numpy, T>(data, shape.size(), shape.data(), owner));
    }
};

}  // namespace endopilot
