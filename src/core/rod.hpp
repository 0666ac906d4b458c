// The discrete Cosserat rod: strains, energies and their derivatives.
//
// Nodes are counted from the tip (0) towards the base; element i joins node i to node i + 1 and carries a unit
// quaternion q whose third director points to the tip. Joint i joins element i - 1 (distal) to element i (proximal).
//
//   stretch and shear   sigma = R(q)^T (x_i - x_{i+1}) / l - e3          energy  l/2 sigma^T S sigma
//   bend and twist      kappa = (2/L) g(|v|^2) v - rest,  v = Im(conj(q_i) q_{i-1})   energy  L/2 kappa^T B kappa
//
// g(u) = asin(sqrt u)/sqrt u, as a series, makes 2 g v the rotation vector between the two elements, so that a moment
// bends the polygon by exactly M L / B at a joint.
//
// Unknowns of a block are (x_i, theta_i): the displacement of node i in world axes and the rotation vector of
// element i in its own axes.
//
// Gradients are in double precision: they decide when a step has converged. Hessians are in single precision: they only
// give the direction. Element i sees nothing but theta_i and u_i = x_i - x_{i+1}, so its Hessian is kept for these.
// Elimination in (u_i, theta_i) then never takes the difference of two stiff numbers, which a wire that is stiff along its axis
// and held by next to nothing would not survive in single precision.
#pragma once

#include "views.hpp"

namespace endopilot {

// The device as the solver sees it; shared by all worlds. Arrays run from tip to base.
template <template <class> class Array>
struct RodArrays {
    int nodes = 0;
    Array<double> abscissa{};         // distance of each node from the tip, mm
    Array<double> length{};           // element length, mm
    Array<double> shear{};            // kGA of an element, N
    Array<double> stretch{};          // EA of an element, N
    Array<double> joint_length{};     // length that a joint stands for, mm (entry 0 unused)
    Array<double> bend{};             // EI of a joint, N mm^2
    Array<double> twist{};            // GJ of a joint, N mm^2
    Array<Vec3<double>> rest{};       // rest curvature of a joint, rad/mm
    Array<double> radius{};           // wire radius at a node, mm
    Array<double> drag{};             // drag of a node, N s/mm
    Array<double> spin_drag{};        // rotational drag of an element, N mm s/rad
};

using Rod = RodArrays<Owned>;         // owns its arrays
using RodModel = RodArrays<Viewed>;   // refers to arrays in the memory of whoever steps, a processor or a GPU

// `place` puts a vector where the stepper reads it, and returns its address there.
template <class Place>
RodModel view(const Rod& rod, const Place& place) {
    return {.nodes = rod.nodes,
            .abscissa = place(rod.abscissa),
            .length = place(rod.length),
            .shear = place(rod.shear),
            .stretch = place(rod.stretch),
            .joint_length = place(rod.joint_length),
            .bend = place(rod.bend),
            .twist = place(rod.twist),
            .rest = place(rod.rest),
            .radius = place(rod.radius),
            .drag = place(rod.drag),
            .spin_drag = place(rod.spin_drag)};
}

// What a block has besides for the turns of T further tubes (tubes.hpp): rows are turns. Arrays of no entries, a GNU extension, take no
// room: a wire alone runs the same code.
template <class V, int T>
struct TwistDiagonal {
    V gradient[T];                          // dE/dturn, N mm
    Single<V> px[T][3], pt[T][3], pp[T][T];  // pp: the lower triangle
};

template <class V, int T>
struct TwistLink {
    Single<V> pu[T][3], pt[T][3], tp[3][T], pp[T][T];   // p, t: rows (this block); columns u, or of the next block
};

// One block row of the system: gradient, and the lower triangular Hessian of all but element i.
// Order of the unknowns: x, y, z, theta1, theta2, theta3, and the turns of T further tubes.
template <class V, int T = 0>
struct Diagonal {
    Vec3<V> gradient_x;       // dE/dx, N: the negative of the force on the node
    Vec3<V> gradient_theta;   // dE/dtheta, N mm: the negative of the moment on the element
    Sym3<Single<V>> xx;
    Single<V> tx[3][3];       // rows theta, columns x
    Sym3<Single<V>> tt;
    [[no_unique_address]] TwistDiagonal<V, T> twists;
};

// What joins block i to block i + 1: the Hessian of element i in u = x_i - x_{i+1} and theta_i, and of joint i + 1 in
// theta_i (rows) and theta_{i+1} (columns).
template <class V, int T = 0>
struct Link {
    Sym3<Single<V>> uu;
    Single<V> tu[3][3];
    Single<V> tt[3][3];
    [[no_unique_address]] TwistLink<V, T> twists;
};

// Adds an element to its own block `own`; begins the next block `next` and the link with its part. `shear` and `stretch` (N) are
// numbers of all lanes or of each. `geometric` is 1 for the full Hessian and 0 for its Gauss-Newton part. Returns the energy.
template <class V, int T, class Stiffness>
ENDOPILOT_DEVICE inline V add_element(double length, const Stiffness& shear, const Stiffness& stretch, const Single<V>& geometric,
                                      const Vec3<V>& near_tip, const Vec3<V>& near_base, const Frame<V>& R, Diagonal<V, T>& own,
                                      Diagonal<V, T>& next, Link<V, T>& link) {
    using S = Single<V>;
    const Vec3<V> e = broadcast<V>(1.0 / length) * (near_tip - near_base);
    const Vec3<V> strain{dot(R.d1, e), dot(R.d2, e), dot(R.d3, e)};
    const Vec3<V> force{shear * strain.x, shear * strain.y, stretch * (strain.z - 1.0)};
    const V energy = 0.5 * length * (force.x * strain.x + force.y * strain.y + force.z * (strain.z - 1.0));

    const Vec3<V> gradient = force.x * R.d1 + force.y * R.d2 + force.z * R.d3;
    own.gradient_x += gradient;
    next.gradient_x = {-gradient.x, -gradient.y, -gradient.z};
    own.gradient_theta += broadcast<V>(length) * cross(force, strain);

    const float l = float(length);
    const auto a = narrow(shear), c = narrow(stretch);
    const Vec3<S> y = narrow(strain), n = narrow(force), d1 = narrow(R.d1), d2 = narrow(R.d2), t = narrow(R.d3);
    const auto isotropic = a / l, axial = (c - a) / l;
    const Vec3<S> at = (S{} + axial) * t;
    link.uu = {isotropic + at.x * t.x, isotropic + at.y * t.y, isotropic + at.z * t.z, at.x * t.y, at.x * t.z, at.y * t.z};
    next.xx = {S{}, S{}, S{}, S{}, S{}, S{}};

    // d2E/dtheta du = (geometric [n]x - [y]x S) R^T
    const Vec3<S> p = geometric * n;
    const Vec3<S> ay = (S{} + a) * y;
    const S zx = ay.z - p.z, yz = p.y - c * y.y, xz = c * y.x - p.x, yx = ay.y - p.y, xy = p.x - ay.x;
    const Vec3<S> row[3] = {zx * d2 + yz * t, xz * t - zx * d1, yx * d1 + xy * d2};
    for (int r = 0; r < 3; ++r) {
        link.tu[r][0] = row[r].x;
        link.tu[r][1] = row[r].y;
        link.tu[r][2] = row[r].z;
        next.tx[r][0] = next.tx[r][1] = next.tx[r][2] = S{};
    }
    for (int k = 0; k < T; ++k)
        for (int r = 0; r < 3; ++r) next.twists.px[k][r] = link.twists.pu[k][r] = S{};

    // d2E/dtheta2 = l [y]x^T S [y]x + geometric l ((n y^T + y n^T)/2 - n.y)
    const S along = dot(p, y), zz = ay.z * y.z - along;
    const Vec3<S> cy = (S{} + c) * y;
    own.tt.xx += l * (zz + cy.y * y.y + p.x * y.x);
    own.tt.yy += l * (zz + cy.x * y.x + p.y * y.y);
    own.tt.zz += l * (ay.x * y.x + ay.y * y.y + p.z * y.z - along);
    own.tt.xy += l * (0.5f * (p.x * y.y + p.y * y.x) - cy.x * y.y);
    own.tt.xz += l * (0.5f * (p.x * y.z + p.z * y.x) - ay.x * y.z);
    own.tt.yz += l * (0.5f * (p.y * y.z + p.z * y.y) - ay.y * y.z);
    return energy;
}

// The rotation between the elements at a joint of length L; 2 g v / L is its curvature and twist.
template <class V>
struct Rotation {
    Vec3<V> v;
    V w, g, slope;   // slope: dg/d(v²)
    ENDOPILOT_DEVICE Rotation(const Quaternion<V>& distal, const Quaternion<V>& proximal) {
        const Quaternion<V> turned = relative(proximal, distal);
        v = turned.v;
        w = turned.w;
        const V u = dot(v, v);
        // asin(s)/s = 1 + u/6 + 3u²/40 + 5u³/112 + 35u⁴/1152, u = s², and its derivative with respect to u
        g = 1.0 + u * (1.0 / 6 + u * (3.0 / 40 + u * (5.0 / 112 + u * (35.0 / 1152))));
        slope = 1.0 / 6 + u * (3.0 / 20 + u * (15.0 / 112 + u * (35.0 / 288)));
    }
};

// Adds to the blocks of both elements what the moment at their joint does, whose stiffness is `bend` (of x and y) and `twist`.
template <class V, int T>
ENDOPILOT_DEVICE inline void add_moment(double L, const Rotation<V>& rotation, const Vec3<V>& moment, const V& bend, const V& twist,
                                        const Single<V>& geometric, Diagonal<V, T>& own, Diagonal<V, T>& next, Link<V, T>& link) {
    using S = Single<V>;
    const Vec3<V>& between = rotation.v;
    const V &series = rotation.g, &slope = rotation.slope;
    // dE/dv; a rotation b of the distal and a of the proximal element give dv = (w (b - a) + v × (b + a)) / 2
    const Vec3<V> gradient = (2.0 * series) * moment + (4.0 * slope * dot(between, moment)) * between;
    const Vec3<V> turn = broadcast<V>(0.5) * cross(gradient, between), push = (0.5 * rotation.w) * gradient;
    own.gradient_theta += push + turn;
    next.gradient_theta = turn - push;

    // Gauss-Newton: L K^T B K with K = (g/L) (±w + [v]x)
    const S g = narrow(series), w = narrow(rotation.w);
    const Vec3<S> v = narrow(between), h = narrow(gradient);
    const S gg = g * g * float(1.0 / L), sb = gg * narrow(bend), st = gg * narrow(twist);
    const S ww = w * w, xx = v.x * v.x, yy = v.y * v.y, zz = v.z * v.z;
    const S quarter = 0.25f * geometric * dot(h, v);
    // With columns c1 = (±w, vz, -vy), c2 = (-vz, ±w, vx), c3 = (vy, -vx, ±w); only the sign of w differs.
    const S dxx = sb * (ww + zz) + st * yy - quarter;
    const S dyy = sb * (ww + zz) + st * xx - quarter;
    const S dzz = sb * (yy + xx) + st * ww - quarter;
    const S even_xy = -st * v.x * v.y, even_xz = -sb * v.x * v.z, even_yz = -sb * v.y * v.z;
    const S odd = (sb - st) * w, odd_xz = odd * v.y, odd_yz = odd * v.x;
    own.tt.xx += dxx;
    own.tt.yy += dyy;
    own.tt.zz += dzz;
    own.tt.xy += even_xy;
    own.tt.xz += even_xz + odd_xz;
    own.tt.yz += even_yz - odd_yz;
    next.tt = {dxx, dyy, dzz, even_xy, even_xz - odd_xz, even_yz + odd_yz};

    // Rows b (distal), columns a (proximal): Gauss-Newton, then ((h v^T + v h^T) - h.v - w [h]x) / 4
    const Vec3<S> q = (0.25f * geometric) * h;
    const Vec3<S> z = w * q;
    const S swap = (sb + st) * w;
    link.tt[0][0] = sb * (zz - ww) + st * yy + 2.0f * q.x * v.x - quarter;
    link.tt[1][1] = sb * (zz - ww) + st * xx + 2.0f * q.y * v.y - quarter;
    link.tt[2][2] = sb * (xx + yy) - st * ww + 2.0f * q.z * v.z - quarter;
    const S sym_xy = even_xy + q.x * v.y + q.y * v.x;
    const S sym_xz = even_xz + q.x * v.z + q.z * v.x;
    const S sym_yz = even_yz + q.y * v.z + q.z * v.y;
    const S odd_xy = 2.0f * sb * w * v.z - z.z, swap_xz = swap * v.y - z.y, swap_yz = swap * v.x - z.x;
    link.tt[0][1] = sym_xy - odd_xy;
    link.tt[1][0] = sym_xy + odd_xy;
    link.tt[0][2] = sym_xz + swap_xz;
    link.tt[2][0] = sym_xz - swap_xz;
    link.tt[1][2] = sym_yz - swap_yz;
    link.tt[2][1] = sym_yz + swap_yz;
}

// Adds the joint between element `joint - 1` (block `own`) and element `joint` (block `next`). `share` (0 to 1) is how
// much of its length is free to bend, and the rest is held straight; `inverse_share` is 1 / share. Returns the energy.
template <class V>
ENDOPILOT_DEVICE inline V add_joint(const RodModel& rod, int joint, const Single<V>& geometric, const V& share, const V& inverse_share,
                                    const Quaternion<V>& distal, const Quaternion<V>& proximal, Diagonal<V>& own, Diagonal<V>& next,
                                    Link<V>& link) {
    const double L = rod.joint_length[joint];
    const V bend = rod.bend[joint] * inverse_share, twist = rod.twist[joint] * inverse_share;
    const Vec3<double>& rest = rod.rest[joint];
    const Rotation<V> rotation(distal, proximal);
    const Vec3<V>& between = rotation.v;
    const V scale = (2.0 / L) * rotation.g;
    const Vec3<V> bent{scale * between.x - share * rest.x, scale * between.y - share * rest.y, scale * between.z - share * rest.z};
    const Vec3<V> moment{bend * bent.x, bend * bent.y, twist * bent.z};
    add_moment(L, rotation, moment, bend, twist, geometric, own, next, link);
    return 0.5 * L * dot(moment, bent);
}

}  // namespace endopilot
