// The patient's motion: where the vessel is at a time, and how what lies in it is carried along.
//
// A point X of the vessel, as CT shows it, lies at  x = o + u + R (1 + E) (X - o),  where o is the ostium. The shift u, the rotation R
// and the symmetric strain E are smooth functions of time: sums of cycles, such as the heartbeat and breathing. The guiding
// catheter moves with the ostium, by u and R.
#pragma once

#include <cmath>

#include "views.hpp"

namespace endopilot {

// Each cycle is a periodic cubic B-spline of the twelve numbers shift (mm), rotation vector (rad), and strain xx yy zz xy xz yz. A
// vessel without cycles lies still.
template <template <class> class Array>
struct MotionArrays {
    static constexpr int kMostCycles = 2, kNumbers = 12;
    int cycles = 0, knots = 0;
    double period[kMostCycles]{};      // s
    Vec3<double> ostium{};             // mm
    Array<double> coefficients{};      // cycles × knots × kNumbers
};

using OwnedMotion = MotionArrays<Owned>;
using Motion = MotionArrays<Viewed>;

// `place` puts a vector where the stepper reads it, and returns its address there.
template <class Place>
Motion view(const OwnedMotion& motion, const Place& place) {
    Motion viewed{.cycles = motion.cycles, .knots = motion.knots, .ostium = motion.ostium, .coefficients = place(motion.coefficients)};
    for (int c = 0; c < motion.cycles; ++c) viewed.period[c] = motion.period[c];
    return viewed;
}

ENDOPILOT_DEVICE inline Vec3<double> turn(const Quaternion<double>& q, const Vec3<double>& v) {
    const Frame<double> r = frame(q);
    return v.x * r.d1 + v.y * r.d2 + v.z * r.d3;
}

ENDOPILOT_DEVICE inline Vec3<double> turn_back(const Quaternion<double>& q, const Vec3<double>& v) {
    const Frame<double> r = frame(q);
    return {dot(r.d1, v), dot(r.d2, v), dot(r.d3, v)};
}

ENDOPILOT_DEVICE inline Sym3<double> inverse(const Sym3<double>& m) {
    const Sym3<double> minors{m.yy * m.zz - m.yz * m.yz, m.xx * m.zz - m.xz * m.xz, m.xx * m.yy - m.xy * m.xy,
                              m.xz * m.yz - m.xy * m.zz, m.xy * m.yz - m.xz * m.yy, m.xy * m.xz - m.yz * m.xx};
    return (1 / (m.xx * minors.xx + m.xy * minors.xy + m.xz * minors.xz)) * minors;
}

// Where the vessel is.
struct Placement {
    Vec3<double> ostium, moved_ostium;
    Quaternion<double> rotation;
    Sym3<double> stretch, shrink;      // 1 + E and its inverse

    ENDOPILOT_DEVICE Vec3<double> to_laboratory(const Vec3<double>& in_vessel) const {
        return moved_ostium + turn(rotation, stretch * (in_vessel - ostium));
    }
    ENDOPILOT_DEVICE Vec3<double> to_vessel(const Vec3<double>& x) const {
        return ostium + shrink * turn_back(rotation, x - moved_ostium);
    }
};

template <template <class> class Array>
ENDOPILOT_DEVICE inline Placement placement(const MotionArrays<Array>& motion, double time) {
    constexpr int kNumbers = MotionArrays<Array>::kNumbers;
    double sum[kNumbers]{};
    for (int c = 0; c < motion.cycles; ++c) {
        const double turns = time / motion.period[c], at = (turns - std::floor(turns)) * motion.knots;
        const int knot = int(at);
        const double s = at - knot, r = 1 - s;
        const double weight[4] = {r * r * r / 6, (4 - 6 * s * s + 3 * s * s * s) / 6, (4 - 6 * r * r + 3 * r * r * r) / 6, s * s * s / 6};
        for (int w = 0; w < 4; ++w) {
            const int row = c * motion.knots + (knot + w - 1 + motion.knots) % motion.knots;
            for (int k = 0; k < kNumbers; ++k) sum[k] += weight[w] * motion.coefficients[row * kNumbers + k];
        }
    }
    const Vec3<double> angle{sum[3], sum[4], sum[5]};
    const double size = std::sqrt(dot(angle, angle)), share = size > 1e-9 ? std::sin(0.5 * size) / size : 0.5;
    const Sym3<double> stretch{1 + sum[6], 1 + sum[7], 1 + sum[8], sum[9], sum[10], sum[11]};
    return {.ostium = motion.ostium,
            .moved_ostium = motion.ostium + Vec3<double>{sum[0], sum[1], sum[2]},
            .rotation = {std::cos(0.5 * size), share * angle},
            .stretch = stretch,
            .shrink = inverse(stretch)};
}

// Carries what lies in the vessel from one placement of it to another: points with the wall, directions and attitudes with its rotation.
struct Carriage {
    Placement from, to;
    Quaternion<double> rotation;

    ENDOPILOT_DEVICE Carriage(const Placement& from, const Placement& to)
        : from(from), to(to), rotation(to.rotation * Quaternion<double>{from.rotation.w, -1.0 * from.rotation.v}) {}

    ENDOPILOT_DEVICE Vec3<double> point(const Vec3<double>& x) const { return to.to_laboratory(from.to_vessel(x)); }
    ENDOPILOT_DEVICE Vec3<double> direction(const Vec3<double>& v) const { return turn(rotation, v); }
    ENDOPILOT_DEVICE Quaternion<double> attitude(const Quaternion<double>& q) const { return rotation * q; }
};

// At most how far the vessel's stretching moves its points against each other, as a share of their distance.
ENDOPILOT_DEVICE inline double strain(const Placement& from, const Placement& to) {
    const Sym3<double> d = to.stretch - from.stretch;
    return std::sqrt(d.xx * d.xx + d.yy * d.yy + d.zz * d.zz + 2 * (d.xy * d.xy + d.xz * d.xz + d.yz * d.yz));
}

// Where the distance map is asked for points of the lanes, whose vessels have moved: X = to x + at.
template <class V>
struct WallPlace {
    Vec3<V> row[3];
    Vec3<V> at;

    ENDOPILOT_DEVICE Vec3<V> to_vessel(const Vec3<V>& x) const { return Vec3<V>{dot(row[0], x), dot(row[1], x), dot(row[2], x)} + at; }

    // Turns the derivatives with respect to X into those with respect to x.
    ENDOPILOT_DEVICE void to_laboratory(Vec3<V>& gradient, Sym3<Single<V>>& hessian) const {
        using S = Single<V>;
        gradient = gradient.x * row[0] + gradient.y * row[1] + gradient.z * row[2];
        const Vec3<S> a = narrow(row[0]), b = narrow(row[1]), c = narrow(row[2]);
        const Vec3<S> ha = hessian.xx * a + hessian.xy * b + hessian.xz * c, hb = hessian.xy * a + hessian.yy * b + hessian.yz * c,
                      hc = hessian.xz * a + hessian.yz * b + hessian.zz * c;
        hessian = {a.x * ha.x + b.x * hb.x + c.x * hc.x, a.y * ha.y + b.y * hb.y + c.y * hc.y, a.z * ha.z + b.z * hb.z + c.z * hc.z,
                   a.x * ha.y + b.x * hb.y + c.x * hc.y, a.x * ha.z + b.x * hb.z + c.x * hc.z, a.y * ha.z + b.y * hb.z + c.y * hc.z};
    }
};

}  // namespace endopilot
