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

// One block row of the system: gradient and the block's own, lower triangular, Hessian.
// Order of the six unknowns: x, y, z, theta1, theta2, theta3.
template <class V>
struct Diagonal {
    Vec3<V> gradient_x;       // dE/dx, N: the negative of the force on the node
    Vec3<V> gradient_theta;   // dE/dtheta, N mm: the negative of the moment on the element
    Sym3<V> xx;
    V tx[3][3];               // rows theta, columns x
    Sym3<V> tt;
};

// Coupling of block i (rows) to block i + 1 (columns); its upper right 3×3 part is always zero.
template <class V>
struct Coupling {
    Sym3<V> xx;       // d2E / dx_i dx_{i+1}
    V tx[3][3];       // d2E / dtheta_i dx_{i+1}
    V tt[3][3];       // d2E / dtheta_i dtheta_{i+1}
};

// Adds element i to its own block `own`; sets its part of the next block `next` and of the coupling. `geometric` is 1 for
// the full Hessian and 0 for its Gauss-Newton part. Returns the energy.
template <class V>
ENDOPILOT_DEVICE inline V add_element(const RodModel& rod, int i, const V& geometric, const Vec3<V>& near_tip, const Vec3<V>& near_base,
                     const Frame<V>& R, Diagonal<V>& own, Diagonal<V>& next, Coupling<V>& coupling) {
    const double l = rod.length[i], a = rod.shear[i], c = rod.stretch[i];
    const Vec3<V> e = broadcast<V>(1.0 / l) * (near_tip - near_base);
    const Vec3<V> y{dot(R.d1, e), dot(R.d2, e), dot(R.d3, e)};
    const Vec3<V> n{a * y.x, a * y.y, c * (y.z - 1.0)};
    const V energy = 0.5 * l * (n.x * y.x + n.y * y.y + n.z * (y.z - 1.0));

    const Vec3<V> gradient = n.x * R.d1 + n.y * R.d2 + n.z * R.d3;
    own.gradient_x += gradient;
    next.gradient_x = {-gradient.x, -gradient.y, -gradient.z};
    own.gradient_theta += broadcast<V>(l) * cross(n, y);

    const double isotropic = a / l, axial = (c - a) / l;
    const Vec3<V>& t = R.d3;
    const Sym3<V> k{isotropic + axial * t.x * t.x, isotropic + axial * t.y * t.y, isotropic + axial * t.z * t.z,
                    axial * t.x * t.y,             axial * t.x * t.z,             axial * t.y * t.z};
    own.xx = {own.xx.xx + k.xx, own.xx.yy + k.yy, own.xx.zz + k.zz, own.xx.xy + k.xy, own.xx.xz + k.xz, own.xx.yz + k.yz};
    next.xx = k;
    coupling.xx = {-k.xx, -k.yy, -k.zz, -k.xy, -k.xz, -k.yz};

    // d2E/dtheta dx = (geometric [n]x - [y]x S) R^T
    const Vec3<V> p = geometric * n;
    const V m[3][3] = {{V{}, a * y.z - p.z, p.y - c * y.y}, {p.z - a * y.z, V{}, c * y.x - p.x}, {a * y.y - p.y, p.x - a * y.x, V{}}};
    for (int r = 0; r < 3; ++r) {
        const Vec3<V> row = m[r][0] * R.d1 + m[r][1] * R.d2 + m[r][2] * R.d3;
        own.tx[r][0] = own.tx[r][0] + row.x;
        own.tx[r][1] = own.tx[r][1] + row.y;
        own.tx[r][2] = own.tx[r][2] + row.z;
        coupling.tx[r][0] = -row.x;
        coupling.tx[r][1] = -row.y;
        coupling.tx[r][2] = -row.z;
        next.tx[r][0] = next.tx[r][1] = next.tx[r][2] = V{};
    }

    // d2E/dtheta2 = l [y]x^T S [y]x + geometric l ((n y^T + y n^T)/2 - n.y)
    const V along = dot(p, y);
    own.tt.xx += l * (a * y.z * y.z + c * y.y * y.y + p.x * y.x - along);
    own.tt.yy += l * (a * y.z * y.z + c * y.x * y.x + p.y * y.y - along);
    own.tt.zz += l * (a * (y.x * y.x + y.y * y.y) + p.z * y.z - along);
    own.tt.xy += l * (0.5 * (p.x * y.y + p.y * y.x) - c * y.x * y.y);
    own.tt.xz += l * (0.5 * (p.x * y.z + p.z * y.x) - a * y.x * y.z);
    own.tt.yz += l * (0.5 * (p.y * y.z + p.z * y.y) - a * y.y * y.z);
    return energy;
}

// The same for the joint between element `joint - 1` (block `own`) and element `joint` (block `next`). `share` (0 to 1) is how
// much of its length is free to bend; the rest is held straight. Returns the energy.
template <class V>
ENDOPILOT_DEVICE inline V add_joint(const RodModel& rod, int joint, const V& geometric, const V& share, const Quaternion<V>& distal,
                   const Quaternion<V>& proximal, Diagonal<V>& own, Diagonal<V>& next, Coupling<V>& coupling) {
    const double L = rod.joint_length[joint];
    const V eb = rod.bend[joint] / share, et = rod.twist[joint] / share;
    const Vec3<double>& rest = rod.rest[joint];
    const Quaternion<V> p = relative(proximal, distal);
    const Vec3<V>& v = p.v;
    const V& w = p.w;
    const V u = dot(v, v);
    // asin(s)/s = 1 + u/6 + 3u²/40 + 5u³/112 + 35u⁴/1152, u = s², and its derivative with respect to u
    const V g = 1.0 + u * (1.0 / 6 + u * (3.0 / 40 + u * (5.0 / 112 + u * (35.0 / 1152))));
    const V dg = 1.0 / 6 + u * (3.0 / 20 + u * (15.0 / 112 + u * (35.0 / 288)));
    const V scale = (2.0 / L) * g;
    const Vec3<V> bent{scale * v.x - share * rest.x, scale * v.y - share * rest.y, scale * v.z - share * rest.z};
    const Vec3<V> n{eb * bent.x, eb * bent.y, et * bent.z};
    const V energy = 0.5 * L * dot(n, bent);

    // h = dE/dv; a rotation b of the distal and a of the proximal element give dv = (w (b - a) + v × (b + a)) / 2
    const Vec3<V> h = (2.0 * g) * n + (4.0 * dg * dot(v, n)) * v;
    const V half = broadcast<V>(0.5);
    const Vec3<V> turn = half * cross(h, v), push = (0.5 * w) * h;
    own.gradient_theta += push + turn;
    next.gradient_theta = turn - push;

    // Gauss-Newton: L K^T B K with K = (g/L) (±w + [v]x)
    const V sb = (g * g) * (eb / L), st = (g * g) * (et / L);
    const V ww = w * w, xx = v.x * v.x, yy = v.y * v.y, zz = v.z * v.z;
    const V curl = geometric * dot(h, v);
    const V quarter = 0.25 * curl;
    // With columns c1 = (±w, vz, -vy), c2 = (-vz, ±w, vx), c3 = (vy, -vx, ±w); only the sign of w differs.
    const V dxx = sb * (ww + zz) + st * yy - quarter;
    const V dyy = sb * (ww + zz) + st * xx - quarter;
    const V dzz = sb * (yy + xx) + st * ww - quarter;
    const V even_xy = -st * v.x * v.y, even_xz = -sb * v.x * v.z, even_yz = -sb * v.y * v.z;
    const V odd_xz = (sb - st) * w * v.y, odd_yz = (st - sb) * w * v.x;
    own.tt.xx += dxx;
    own.tt.yy += dyy;
    own.tt.zz += dzz;
    own.tt.xy += even_xy;
    own.tt.xz += even_xz + odd_xz;
    own.tt.yz += even_yz + odd_yz;
    next.tt = {dxx, dyy, dzz, even_xy, even_xz - odd_xz, even_yz - odd_yz};

    // Rows b (distal), columns a (proximal): Gauss-Newton, then ((h v^T + v h^T) - h.v - w [h]x) / 4
    const Vec3<V> q = (0.25 * geometric) * h;
    const Vec3<V> z = w * q;
    const V swap = (sb + st) * w;
    coupling.tt[0][0] = sb * (zz - ww) + st * yy + 2.0 * q.x * v.x - quarter;
    coupling.tt[1][1] = sb * (zz - ww) + st * xx + 2.0 * q.y * v.y - quarter;
    coupling.tt[2][2] = sb * (xx + yy) - st * ww + 2.0 * q.z * v.z - quarter;
    const V sym_xy = even_xy + q.x * v.y + q.y * v.x;
    const V sym_xz = even_xz + q.x * v.z + q.z * v.x;
    const V sym_yz = even_yz + q.y * v.z + q.z * v.y;
    const V twice = 2.0 * sb * w * v.z;
    coupling.tt[0][1] = sym_xy - twice + z.z;
    coupling.tt[1][0] = sym_xy + twice - z.z;
    coupling.tt[0][2] = sym_xz + swap * v.y - z.y;
    coupling.tt[2][0] = sym_xz - swap * v.y + z.y;
    coupling.tt[1][2] = sym_yz - swap * v.x + z.x;
    coupling.tt[2][1] = sym_yz + swap * v.x - z.x;
    return energy;
}

}  // namespace endopilot
