// Lanes: one arithmetic type that carries one world (double) or several worlds side by side (vectors of doubles).
// Each has a twin in single precision, Single<V>, for what needs the accuracy of a preconditioner only.
//
// All formulas of the core are written once, templated on the lane type V. Operations are element-wise, so what one
// lane computes never depends on its neighbours; decisions are masks, taken by select().
#pragma once

#include <cmath>
#include <cstdint>
#ifdef __AVX__
#include <immintrin.h>
#endif

// Functions that also run on a CUDA device, in scalar lanes: one world a thread. Large ones are called there, not inlined:
// a kernel of all of them takes every register that there is, and its compilation crashes the compiler of CUDA 13.0.
#ifdef __CUDACC__
#define ENDOPILOT_DEVICE __host__ __device__
#define ENDOPILOT_LARGE __host__ __device__ __noinline__
#else
#define ENDOPILOT_DEVICE
#define ENDOPILOT_LARGE
#endif

namespace endopilot {

template <class V>
struct LaneTraits;
template <>
struct LaneTraits<double> {
    static constexpr int width = 1;
    using Scalar = double;
    using Mask = bool;
    using Single = float;
};
template <>
struct LaneTraits<float> {
    static constexpr int width = 1;
    using Scalar = float;
    using Mask = bool;
};

#ifndef __CUDACC__
typedef double double4 __attribute__((vector_size(32)));
typedef double double8 __attribute__((vector_size(64)));
typedef std::int64_t mask4 __attribute__((vector_size(32)));
typedef std::int64_t mask8 __attribute__((vector_size(64)));
typedef float float4 __attribute__((vector_size(16)));
typedef float float8 __attribute__((vector_size(32)));
typedef std::int32_t single_mask4 __attribute__((vector_size(16)));
typedef std::int32_t single_mask8 __attribute__((vector_size(32)));

template <>
struct LaneTraits<double4> {
    static constexpr int width = 4;
    using Scalar = double;
    using Mask = mask4;
    using Single = float4;
};
template <>
struct LaneTraits<double8> {
    static constexpr int width = 8;
    using Scalar = double;
    using Mask = mask8;
    using Single = float8;
};
template <>
struct LaneTraits<float4> {
    static constexpr int width = 4;
    using Scalar = float;
    using Mask = single_mask4;
};
template <>
struct LaneTraits<float8> {
    static constexpr int width = 8;
    using Scalar = float;
    using Mask = single_mask8;
};

// What suits the processor that this is compiled for.
#ifdef __AVX512F__
inline constexpr int kLanes = 8;
#else
inline constexpr int kLanes = 4;
#endif
#endif

template <class V>
inline constexpr int kWidth = LaneTraits<V>::width;
template <class V>
using Mask = typename LaneTraits<V>::Mask;
template <class V>
using Single = typename LaneTraits<V>::Single;

template <class V>
ENDOPILOT_DEVICE inline double get(const V& v, int lane) {
    if constexpr (kWidth<V> == 1)
        return v;
    else
        return v[lane];
}

template <class V>
ENDOPILOT_DEVICE inline void set(V& v, int lane, double value) {
    if constexpr (kWidth<V> == 1)
        v = value;
    else
        v[lane] = value;
}

template <class V>
ENDOPILOT_DEVICE inline void set_mask(Mask<V>& mask, int lane, bool value) {
    if constexpr (kWidth<V> == 1)
        mask = value;
    else
        mask[lane] = value ? -1 : 0;
}

template <class V>
ENDOPILOT_DEVICE inline bool holds(const Mask<V>& mask, int lane) {
    if constexpr (kWidth<V> == 1)
        return mask;
    else
        return mask[lane] != 0;
}

template <class V>
ENDOPILOT_DEVICE inline bool any(const Mask<V>& mask) {
    if constexpr (kWidth<V> == 1) {
        return mask;
#ifdef __AVX512F__
    } else if constexpr (kWidth<V> == 8) {
        return _mm512_test_epi64_mask(__m512i(mask), __m512i(mask)) != 0;
#endif
#ifdef __AVX__
    } else if constexpr (kWidth<V> == 4) {
        return _mm256_movemask_pd(__m256d(mask)) != 0;
#endif
    } else {
        std::int64_t found = 0;
        for (int lane = 0; lane < kWidth<V>; ++lane) found |= mask[lane];
        return found != 0;
    }
}

template <class V>
ENDOPILOT_DEVICE inline V broadcast(double value) {
    return V{} + typename LaneTraits<V>::Scalar(value);
}

// Rounds to single precision. Compilers make several instructions of __builtin_convertvector where there is one.
template <class V>
ENDOPILOT_DEVICE inline Single<V> narrow(const V& v) {
    if constexpr (kWidth<V> == 1) {
        return float(v);
#ifdef __AVX512F__
    } else if constexpr (kWidth<V> == 8) {
        return Single<V>(_mm512_maskz_cvtpd_ps(0xff, __m512d(v)));
#endif
#ifdef __AVX__
    } else if constexpr (kWidth<V> == 4) {
        return Single<V>(_mm256_cvtpd_ps(__m256d(v)));
#endif
    } else {
#ifndef __CUDACC__
        return __builtin_convertvector(v, Single<V>);
#endif
    }
}

template <class V>
ENDOPILOT_DEVICE inline V widen(const Single<V>& v) {
    if constexpr (kWidth<V> == 1) {
        return double(v);
#ifdef __AVX512F__
    } else if constexpr (kWidth<V> == 8) {
        return V(_mm512_maskz_cvtps_pd(0xff, __m256(v)));
#endif
#ifdef __AVX__
    } else if constexpr (kWidth<V> == 4) {
        return V(_mm256_cvtps_pd(__m128(v)));
#endif
    } else {
#ifndef __CUDACC__
        return __builtin_convertvector(v, V);
#endif
    }
}

template <class V>
ENDOPILOT_DEVICE inline V select(Mask<V> mask, V yes, V no) {
    return mask ? yes : no;
}

template <class V>
ENDOPILOT_DEVICE inline V maximum(V a, V b) {
    return a > b ? a : b;
}

template <class V>
ENDOPILOT_DEVICE inline V minimum(V a, V b) {
    return a < b ? a : b;
}

template <class V>
ENDOPILOT_DEVICE inline V square_root(V a) {
    if constexpr (kWidth<V> == 1) {
        return std::sqrt(a);
#ifdef __AVX__
    } else if constexpr (kWidth<V> == 4) {
        return __builtin_ia32_sqrtpd256(a);
#endif
#ifdef __AVX512F__
    } else if constexpr (kWidth<V> == 8) {
        return V{_mm512_sqrt_pd(__m512d(a))};
#endif
    } else {
        V root;
        for (int lane = 0; lane < kWidth<V>; ++lane) root[lane] = std::sqrt(a[lane]);
        return root;
    }
}

template <class V>
ENDOPILOT_DEVICE inline V exponential(const V& a) {
    V result{};
    for (int lane = 0; lane < kWidth<V>; ++lane) set(result, lane, std::exp(get(a, lane)));
    return result;
}

template <class V>
struct Vec3 {
    V x, y, z;
    ENDOPILOT_DEVICE friend Vec3 operator+(const Vec3& a, const Vec3& b) { return {a.x + b.x, a.y + b.y, a.z + b.z}; }
    ENDOPILOT_DEVICE friend Vec3 operator-(const Vec3& a, const Vec3& b) { return {a.x - b.x, a.y - b.y, a.z - b.z}; }
    ENDOPILOT_DEVICE friend Vec3 operator*(const V& s, const Vec3& a) { return {s * a.x, s * a.y, s * a.z}; }
    ENDOPILOT_DEVICE Vec3& operator+=(const Vec3& b) { return *this = *this + b; }
    ENDOPILOT_DEVICE Vec3& operator-=(const Vec3& b) { return *this = *this - b; }
};

template <class V>
ENDOPILOT_DEVICE inline V dot(const Vec3<V>& a, const Vec3<V>& b) {
    return a.x * b.x + a.y * b.y + a.z * b.z;
}

template <class V>
ENDOPILOT_DEVICE inline Vec3<V> cross(const Vec3<V>& a, const Vec3<V>& b) {
    return {a.y * b.z - a.z * b.y, a.z * b.x - a.x * b.z, a.x * b.y - a.y * b.x};
}

template <class V>
ENDOPILOT_DEVICE inline Vec3<V> select(Mask<V> mask, const Vec3<V>& yes, const Vec3<V>& no) {
    return {select<V>(mask, yes.x, no.x), select<V>(mask, yes.y, no.y), select<V>(mask, yes.z, no.z)};
}

template <class V>
ENDOPILOT_DEVICE inline Vec3<Single<V>> narrow(const Vec3<V>& a) {
    return {narrow(a.x), narrow(a.y), narrow(a.z)};
}

template <class V>
ENDOPILOT_DEVICE inline Vec3<V> widen(const Vec3<Single<V>>& a) {
    return {widen<V>(a.x), widen<V>(a.y), widen<V>(a.z)};
}

template <class V>
ENDOPILOT_DEVICE inline Vec3<double> get(const Vec3<V>& v, int lane) {
    return {get(v.x, lane), get(v.y, lane), get(v.z, lane)};
}

template <class V>
ENDOPILOT_DEVICE inline void set(Vec3<V>& to, int lane, const Vec3<double>& v) {
    set(to.x, lane, v.x);
    set(to.y, lane, v.y);
    set(to.z, lane, v.z);
}

// Symmetric 3×3 matrix.
template <class V>
struct Sym3 {
    V xx, yy, zz, xy, xz, yz;
    ENDOPILOT_DEVICE friend Sym3 operator*(const V& s, const Sym3& m) {
        return {s * m.xx, s * m.yy, s * m.zz, s * m.xy, s * m.xz, s * m.yz};
    }
    ENDOPILOT_DEVICE friend Sym3 operator+(const Sym3& a, const Sym3& b) {
        return {a.xx + b.xx, a.yy + b.yy, a.zz + b.zz, a.xy + b.xy, a.xz + b.xz, a.yz + b.yz};
    }
    ENDOPILOT_DEVICE friend Sym3 operator-(const Sym3& a, const Sym3& b) {
        return {a.xx - b.xx, a.yy - b.yy, a.zz - b.zz, a.xy - b.xy, a.xz - b.xz, a.yz - b.yz};
    }
    ENDOPILOT_DEVICE Sym3& operator+=(const Sym3& m) { return *this = *this + m; }
    ENDOPILOT_DEVICE Sym3& operator-=(const Sym3& m) { return *this = *this - m; }
};

template <class V>
ENDOPILOT_DEVICE inline Vec3<V> operator*(const Sym3<V>& m, const Vec3<V>& a) {
    return {m.xx * a.x + m.xy * a.y + m.xz * a.z, m.xy * a.x + m.yy * a.y + m.yz * a.z,
            m.xz * a.x + m.yz * a.y + m.zz * a.z};
}

// Quaternion w + v, unit length for rotations.
template <class V>
struct Quaternion {
    V w;
    Vec3<V> v;
};

template <class V>
ENDOPILOT_DEVICE inline Quaternion<V> operator*(const Quaternion<V>& a, const Quaternion<V>& b) {
    return {a.w * b.w - dot(a.v, b.v), a.w * b.v + b.w * a.v + cross(a.v, b.v)};
}

// conjugate(a) · b: the rotation from a to b, in the frame of a.
template <class V>
ENDOPILOT_DEVICE inline Quaternion<V> relative(const Quaternion<V>& a, const Quaternion<V>& b) {
    return {a.w * b.w + dot(a.v, b.v), a.w * b.v - b.w * a.v - cross(a.v, b.v)};
}

template <class V>
ENDOPILOT_DEVICE inline Quaternion<V> select(Mask<V> mask, const Quaternion<V>& yes, const Quaternion<V>& no) {
    return {select<V>(mask, yes.w, no.w), select(mask, yes.v, no.v)};
}

template <class V>
ENDOPILOT_DEVICE inline Quaternion<double> get(const Quaternion<V>& q, int lane) {
    return {get(q.w, lane), get(q.v, lane)};
}

template <class V>
ENDOPILOT_DEVICE inline void set(Quaternion<V>& to, int lane, const Quaternion<double>& q) {
    set(to.w, lane, q.w);
    set(to.v, lane, q.v);
}

// q rotated by the rotation vector `angle` (rad, in the frame of q). (1, angle/2) normalised agrees with the
// exponential map to second order, which is all that Newton's method needs, and has no trigonometry.
template <class V>
ENDOPILOT_DEVICE inline Quaternion<V> rotated(const Quaternion<V>& q, const Vec3<V>& angle) {
    const V half = broadcast<V>(0.5);
    const Vec3<V> h = half * angle;
    const Quaternion<V> p = q * Quaternion<V>{broadcast<V>(1.0), h};
    const V scale = 1.0 / square_root(p.w * p.w + dot(p.v, p.v));
    return {scale * p.w, scale * p.v};
}

// Columns of the rotation matrix: the three directors.
template <class V>
struct Frame {
    Vec3<V> d1, d2, d3;
};

template <class V>
ENDOPILOT_DEVICE inline Frame<V> frame(const Quaternion<V>& q) {
    const V xx = q.v.x * q.v.x, yy = q.v.y * q.v.y, zz = q.v.z * q.v.z;
    const V xy = q.v.x * q.v.y, xz = q.v.x * q.v.z, yz = q.v.y * q.v.z;
    const V wx = q.w * q.v.x, wy = q.w * q.v.y, wz = q.w * q.v.z;
    return {{1.0 - 2.0 * (yy + zz), 2.0 * (xy + wz), 2.0 * (xz - wy)},
            {2.0 * (xy - wz), 1.0 - 2.0 * (xx + zz), 2.0 * (yz + wx)},
            {2.0 * (xz + wy), 2.0 * (yz - wx), 1.0 - 2.0 * (xx + yy)}};
}

}  // namespace endopilot
