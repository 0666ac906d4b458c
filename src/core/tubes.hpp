// Telescoping tubes on one shared centreline: their profiles, what they make of an element and a joint of the mesh, and the energy
// of a joint.
//
// Tubes count from the innermost, 0. The mesh reaches to the foremost tip; the tip of tube k lies `offset` mm behind. Tube 0's frame
// is that of the elements' quaternions. Each further tube has a twist: its frame is tube 0's, turned by the twist about the third
// director. Beyond its tip a tube goes on without bending stiffness, and carries no torque there: so its twist is known
// where it comes to lie next. Any GJ serves there; one as small as a tip's lets frames turn so easily that steps take more iterations.
#pragma once

#include <algorithm>

#include "rod.hpp"

namespace endopilot {

constexpr double kTwistBeyondTip = 50;   // GJ of a tube beyond its tip, N mm²: about that of the shafts

// What the solver knows of each tube. Profiles are integrals from the tip, at equal distances; those of one tube follow each other.
template <template <class> class Array>
struct TubeArrays {
    int tubes = 0, points = 0;
    double spacing = 0;                                   // mm
    double shear_share = 0;                               // kGA / EA
    Array<double> bend{}, twist{}, stretch{}, rest{};     // of EI, GJ, EA, and of the rest curvature about the first director
    Array<double> radius{};                               // outer radius, mm
    Array<double> bore_friction{};                        // friction coefficient between tube k and tube k - 1 in it; entry 0 unused
};

using OwnedTubes = TubeArrays<Owned>;
using Tubes = TubeArrays<Viewed>;   // a single wire if it has no tubes

template <class Place>
Tubes view(const OwnedTubes& tubes, const Place& place) {
    return {.tubes = tubes.tubes,
            .points = tubes.points,
            .spacing = tubes.spacing,
            .shear_share = tubes.shear_share,
            .bend = place(tubes.bend),
            .twist = place(tubes.twist),
            .stretch = place(tubes.stretch),
            .rest = place(tubes.rest),
            .radius = place(tubes.radius),
            .bore_friction = place(tubes.bore_friction)};
}

// Integrals of a tube's profiles from its tip to `at` mm behind it.
struct Integrals {
    double length, bend, twist, stretch, rest;
    ENDOPILOT_DEVICE friend Integrals operator-(const Integrals& a, const Integrals& b) {
        return {a.length - b.length, a.bend - b.bend, a.twist - b.twist, a.stretch - b.stretch, a.rest - b.rest};
    }
};

ENDOPILOT_DEVICE inline Integrals integrals(const Tubes& tubes, int tube, double at) {
    if (at <= 0) return {0, 0, at * kTwistBeyondTip, 0, 0};
    const double* twist = &tubes.twist[tube * tubes.points];
    const double place = at / tubes.spacing;
    const int i = std::min(int(place), tubes.points - 2);
    const double f = place - i;
    const auto between = [&](const double* p) { return p[i] + f * (p[i + 1] - p[i]); };
    const std::ptrdiff_t first = std::ptrdiff_t(tube) * tubes.points;
    return {at, between(&tubes.bend[first]), between(twist), between(&tubes.stretch[first]), between(&tubes.rest[first])};
}

// A joint that T further tubes share with tube 0. The stretch of a joint consists of pieces, each covered by some tubes; the moment is the
// same in all. A piece has the share f of the length and the stiffness E, the sum of EI over its tubes. Then, with sums over pieces:
// 1 / bend = sum of f / E; c of a tube = sum of f EI / E over its pieces; d of two tubes = sum of f EI EI' / E over those of both.
template <class V, int T>
struct TubeJoint {
    static constexpr int kPairs = T * (T + 1) / 2;
    V bend;                     // EI, N mm²
    V twist[T + 1];             // GJ, N mm²
    V rest[T + 1];              // rest curvature about the tube's first director, rad/mm
    V c[T + 1], d[kPairs];      // d of tubes k < l is entry l (l - 1) / 2 + k; N mm²
    ENDOPILOT_DEVICE static constexpr int pair(int k, int l) { return k < l ? l * (l - 1) / 2 + k : k * (k - 1) / 2 + l; }
};

// The joint between the integrals `ahead` and `behind` of each tube, `length` mm apart.
template <int T>
ENDOPILOT_DEVICE TubeJoint<double, T> tube_joint(const Integrals (&ahead)[T + 1], const Integrals (&behind)[T + 1], double length) {
    using Joint = TubeJoint<double, T>;
    Joint joint{};
    double bend[T + 1], share[T + 1], foremost = 0;
    for (int k = 0; k <= T; ++k) {
        const Integrals part = behind[k] - ahead[k];
        const bool covers = part.length > 0;
        share[k] = part.length / length;
        bend[k] = covers ? part.bend / part.length : 0.0;
        joint.rest[k] = covers ? part.rest / part.length : 0.0;
        joint.twist[k] = part.twist / length;
        foremost = std::max(foremost, share[k]);
    }
    double compliance = 0, ends = 0;   // pieces from the base on: each ends where a tube does, the last at the foremost tip
    while (ends < foremost) {
        double end = foremost;
        for (int k = 0; k <= T; ++k)
            if (share[k] > ends) end = std::min(end, share[k]);
        double sum = 0;
        for (int k = 0; k <= T; ++k)
            if (share[k] >= end) sum += bend[k];
        const double f = (end - ends) / foremost / sum;
        compliance += f;
        for (int k = 0; k <= T; ++k) {
            if (share[k] < end) continue;
            joint.c[k] += f * bend[k];
            for (int l = 0; l < k; ++l)
                if (share[l] >= end) joint.d[Joint::pair(l, k)] += f * bend[k] * bend[l];
        }
        ends = end;
    }
    joint.bend = 1 / compliance;
    return joint;
}

// Sine and cosine by additions and multiplications alone, so that all lanes and processors get the same bits.
template <class V>
ENDOPILOT_DEVICE inline void sine_cosine(const V& angle, V& sine, V& cosine) {
    constexpr double kRound = 6755399441055744.0;   // adding it rounds to whole numbers
    const V turns = (angle * 0.15915494309189535 + kRound) - kRound;
    const V r = 0.25 * ((angle - 6.283185307179586 * turns) - 2.449293598294706e-16 * turns), u = r * r;
    V s = r * (1.0 - (1.0 / 6) * u * (1.0 - (1.0 / 20) * u * (1.0 - (1.0 / 42) * u * (1.0 - (1.0 / 72) * u * (1.0 - (1.0 / 110) * u * (1.0 - (1.0 / 156) * u))))));
    V c = 1.0 - (1.0 / 2) * u * (1.0 - (1.0 / 12) * u * (1.0 - (1.0 / 30) * u * (1.0 - (1.0 / 56) * u * (1.0 - (1.0 / 90) * u * (1.0 - (1.0 / 132) * u * (1.0 - (1.0 / 182) * u))))));
    for (int twice = 0; twice < 2; ++twice) {
        const V both = 2.0 * s * c;
        c = 1.0 - 2.0 * s * s;
        s = both;
    }
    sine = s;
    cosine = c;
}

// The tubes' rest curvature at a joint in tube 0's frame: x and y of each.
template <class V, int T>
struct RestCurvature {
    V x[T + 1], y[T + 1];
    // from the twists at the elements ahead and behind; `sum` are the joint's own, weighted by c
    ENDOPILOT_DEVICE RestCurvature(const TubeJoint<V, T>& joint, const V* distal, const V* proximal) {
        x[0] = joint.rest[0];
        y[0] = V{};
        for (int k = 1; k <= T; ++k) {
            V sine, cosine;
            sine_cosine<V>(0.5 * (distal[k - 1] + proximal[k - 1]), sine, cosine);
            x[k] = joint.rest[k] * cosine;
            y[k] = joint.rest[k] * sine;
        }
    }
    ENDOPILOT_DEVICE void sum(const TubeJoint<V, T>& joint, V& along_x, V& along_y) const {
        along_x = joint.c[0] * x[0];
        along_y = joint.c[0] * y[0];
        for (int k = 1; k <= T; ++k) {
            along_x += joint.c[k] * x[k];
            along_y += joint.c[k] * y[k];
        }
    }
};

// Adds scale · v vᵀ.
template <class S>
ENDOPILOT_DEVICE inline void add_product(const S& scale, const Vec3<S>& v, Sym3<S>& to) {
    const Vec3<S> sv = scale * v;
    to.xx += sv.x * v.x;
    to.yy += sv.y * v.y;
    to.zz += sv.z * v.z;
    to.xy += sv.x * v.y;
    to.xz += sv.x * v.z;
    to.yz += sv.y * v.z;
}

// As add_joint, for tubes. With r_k the tubes' rest curvature in tube 0's frame, the energy of the stretch is
//     L (bend |kappa - sum of c_k r_k|² / 2 - sum of d_kl r_k·r_l + sum of GJ_k (kappa_3 + twist_k')² / 2)
// up to a constant. Twists are those at the element ahead and behind.
//
// The unknown of a further tube is its turn about the third director, that of its twist and of the frame together: then tubes of very
// different stiffness hardly meet in the Hessian, which single precision would not bear. A twist is its tube's turn less theta_3.
template <class V, int T>
ENDOPILOT_DEVICE inline V add_tube_joint(double L, const TubeJoint<V, T>& joint, const Single<V>& geometric, const V& share,
                                         const V& inverse_share, const Quaternion<V>& distal, const Quaternion<V>& proximal,
                                         const V* twist_distal, const V* twist_proximal, Diagonal<V, T>& own, Diagonal<V, T>& next,
                                         Link<V, T>& link) {
    using S = Single<V>;
    const Rotation<V> rotation(distal, proximal);
    const Vec3<V>& v = rotation.v;
    const RestCurvature<V, T> rest(joint, twist_distal, twist_proximal);
    V rest_x, rest_y;
    rest.sum(joint, rest_x, rest_y);
    const V scale = (2.0 / L) * rotation.g, bend = joint.bend * inverse_share, twist = joint.twist[0] * inverse_share;
    const V bent_x = scale * v.x - share * rest_x, bent_y = scale * v.y - share * rest_y, turn = scale * v.z;
    V torque[T + 1], stiffness[T + 1];
    torque[0] = twist * turn;
    V torques = torque[0], energy = torque[0] * turn;
    for (int k = 1; k <= T; ++k) {
        const V rate = turn + (1.0 / L) * (twist_distal[k - 1] - twist_proximal[k - 1]);
        stiffness[k] = joint.twist[k] * inverse_share;
        torque[k] = stiffness[k] * rate;
        torques += torque[k];
        energy += torque[k] * rate;
    }
    const Vec3<V> moment{bend * bent_x, bend * bent_y, torques};
    add_moment(L, rotation, moment, bend, twist, geometric, own, next, link);
    energy += moment.x * bent_x + moment.y * bent_y;
    energy *= 0.5;

    const S w = narrow(rotation.w), g = narrow(rotation.g), zero{};
    const Vec3<S> n = narrow(v);
    // Of a further tube's twist rate, how it depends on theta ahead (a) and behind (b); theta_3 alone turns it by next to nothing.
    const S small = float(1 / L) * narrow(rotation.g * rotation.w - 1.0), across = g * float(1 / L);
    const Vec3<S> a{-(across * n.y), across * n.x, small}, b{-(across * n.y), across * n.x, -small};
    for (int k = 1; k <= T; ++k) {
        TwistDiagonal<V, T>&of_own = own.twists, &of_next = next.twists;
        TwistLink<V, T>& of_link = link.twists;
        // dr/dtwist = (-y, x)
        V slope = share * joint.c[k] * (moment.x * rest.y[k] - moment.y * rest.x[k]);
        V opposed{}, most{};   // of the disagreement with the other tubes: its curvature, and the most that it can be
        for (int l = 0; l <= T; ++l) {
            if (l == k) continue;
            const V d = share * joint.d[joint.pair(k, l)];
            if (l < k) energy -= d * (rest.x[k] * rest.x[l] + rest.y[k] * rest.y[l]);
            slope += d * (rest.y[k] * rest.x[l] - rest.x[k] * rest.y[l]);
            opposed += d * (rest.x[k] * rest.x[l] + rest.y[k] * rest.y[l]);
            const V size = d * joint.rest[k] * joint.rest[l];
            most += size < V{} ? -size : size;
        }
        const V half = (0.5 * L) * slope, ahead = half + torque[k], behind = half - torque[k];
        of_own.gradient[k - 1] += ahead;
        of_next.gradient[k - 1] = behind;
        own.gradient_theta.z -= ahead;
        next.gradient_theta.z -= behind;

        // torsion
        const S firm = narrow(stiffness[k]), per_length = firm * float(1 / L), whole = firm * float(L);
        add_product(whole, a, own.tt);
        add_product(whole, b, next.tt);
        const S as[3] = {a.x, a.y, a.z}, bs[3] = {b.x, b.y, b.z};
        for (int r = 0; r < 3; ++r) {
            for (int c = 0; c < 3; ++c) link.tt[r][c] += whole * as[r] * bs[c];
            of_own.pt[k - 1][r] += firm * as[r];
            of_link.pt[k - 1][r] = firm * bs[r];
            of_link.tp[r][k - 1] = -(firm * as[r]);
            of_next.pt[k - 1][r] = -(firm * bs[r]);
        }
        // bending: of the twists' mean with itself, and with theta
        const S turned = narrow(share * joint.c[k] * (moment.x * rest.x[k] + moment.y * rest.y[k]));
        const S full = turned + narrow(opposed), bare = narrow(most);
        S row{};   // of the twists with all twists
        for (int l = 1; l <= T; ++l) {
            S both = narrow(share * share * bend * joint.c[k] * joint.c[l] * (rest.x[k] * rest.x[l] + rest.y[k] * rest.y[l]));
            if (l == k)
                both += bare + geometric * (full - bare);
            else
                both -= geometric * narrow(share * joint.d[joint.pair(k, l)] * (rest.x[k] * rest.x[l] + rest.y[k] * rest.y[l]));
            const S quarter = float(0.25 * L) * both;
            row += quarter;
            if (l <= k) {
                of_own.pp[k - 1][l - 1] += quarter + (l == k ? per_length : zero);
                of_next.pp[k - 1][l - 1] = quarter + (l == k ? per_length : zero);
            }
            of_link.pp[k - 1][l - 1] = quarter - (l == k ? per_length : zero);
        }
        const S along = narrow(-0.5 * share * bend * joint.c[k]);
        const Vec3<S> h = (2.0f * g) * Vec3<S>{-(along * narrow(rest.y[k])), along * narrow(rest.x[k]), zero};
        const Vec3<S> cross_half = (S{} + 0.5f) * cross(h, n), straight = (0.5f * w) * h;
        const Vec3<S> to_own = cross_half + straight, to_next = cross_half - straight;
        const S os[3] = {to_own.x, to_own.y, to_own.z - row}, ns[3] = {to_next.x, to_next.y, to_next.z - row};
        for (int r = 0; r < 3; ++r) {
            of_own.pt[k - 1][r] += os[r];
            of_link.tp[r][k - 1] += os[r];
            of_link.pt[k - 1][r] += ns[r];
            of_next.pt[k - 1][r] += ns[r];
            link.tt[r][2] -= r == 2 ? to_own.z : os[r];
            link.tt[2][r] -= r == 2 ? to_next.z : ns[r];
        }
        link.tt[2][2] += row;
        own.tt.xz -= to_own.x;
        own.tt.yz -= to_own.y;
        own.tt.zz += row - 2.0f * to_own.z;
        next.tt.xz -= to_next.x;
        next.tt.yz -= to_next.y;
        next.tt.zz += row - 2.0f * to_next.z;
    }
    return L * energy;
}

}  // namespace endopilot
