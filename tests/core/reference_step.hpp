// A time step of one wire, written to be read: plain numbers, one energy, whose derivatives are taken automatically, and Newton's method
// with a band matrix. No lanes, no single precision, no second thoughts. test_reference.cpp holds the lanes against it.
//
// The wire is alone, driven by velocity within its drive's limits, in a vessel that lies still with a wall that does not give way.
#pragma once

#include <array>
#include <cmath>
#include <vector>

#include "world.hpp"

namespace reference {

using endopilot::Base;
using endopilot::Quaternion;
using endopilot::Scene;
using endopilot::Vec3;

// A number with its first and second derivatives with respect to two neighbouring blocks: x_i, theta_i, x_(i+1), theta_(i+1).
constexpr int kBlock = 6, kUnknowns = 2 * kBlock;
struct Jet {
    double value = 0;
    std::array<double, kUnknowns> slope{};
    std::array<std::array<double, kUnknowns>, kUnknowns> curve{};   // the lower triangle

    Jet() = default;
    Jet(double value) : value(value) {}
    static Jet unknown(double value, int which) {
        Jet j(value);
        j.slope[which] = 1;
        return j;
    }
    Jet& operator+=(const Jet& b) { return *this = *this + b; }
    // f(this), from f and its derivatives there
    Jet chain(double f, double df, double ddf) const {
        Jet out(f);
        for (int a = 0; a < kUnknowns; ++a) {
            out.slope[a] = df * slope[a];
            for (int b = 0; b <= a; ++b) out.curve[a][b] = df * curve[a][b] + ddf * slope[a] * slope[b];
        }
        return out;
    }
    friend Jet operator*(const Jet& p, const Jet& q) {
        Jet out(p.value * q.value);
        for (int a = 0; a < kUnknowns; ++a) {
            out.slope[a] = p.slope[a] * q.value + p.value * q.slope[a];
            for (int b = 0; b <= a; ++b)
                out.curve[a][b] = p.curve[a][b] * q.value + p.slope[a] * q.slope[b] + q.slope[a] * p.slope[b] + p.value * q.curve[a][b];
        }
        return out;
    }
    friend Jet operator+(const Jet& p, const Jet& q) {
        Jet out(p.value + q.value);
        for (int a = 0; a < kUnknowns; ++a) {
            out.slope[a] = p.slope[a] + q.slope[a];
            for (int b = 0; b <= a; ++b) out.curve[a][b] = p.curve[a][b] + q.curve[a][b];
        }
        return out;
    }
    friend Jet operator-(const Jet& p, const Jet& q) { return p + q.chain(-q.value, -1, 0); }
};
inline Jet root(const Jet& p) {
    const double r = std::sqrt(p.value);
    return p.chain(r, 0.5 / r, -0.25 / (r * r * r));
}
inline Jet inverse(const Jet& p) { return p.chain(1 / p.value, -1 / (p.value * p.value), 2 / (p.value * p.value * p.value)); }

// The same formulas in plain numbers give the energy alone.
inline double root(double p) { return std::sqrt(p); }
inline double inverse(double p) { return 1 / p; }
inline double value(double p) { return p; }
inline double value(const Jet& p) { return p.value; }
template <class Number>
Number unknown(double value, int which) {
    if constexpr (std::is_same_v<Number, Jet>) return Jet::unknown(value, which);
    else return value;
}
template <class Number>
Vec3<Number> constant(const Vec3<double>& v) {
    return {v.x, v.y, v.z};
}
template <class Number>
Quaternion<Number> constant(const Quaternion<double>& q) {
    return {q.w, constant<Number>(q.v)};
}

// The distance to the wall: a quadratic B-spline whose coefficients lie on a grid, x fastest.
struct DistanceMap {
    std::vector<float> coefficients;
    int size[3];
    double origin[3], spacing;

    template <class Number>
    Number operator()(const Vec3<Number>& x) const {
        const Number at[3] = {x.x, x.y, x.z};
        int cell[3];
        Number weight[3][3];
        for (int a = 0; a < 3; ++a) {
            const Number u = (1 / spacing) * (at[a] - origin[a]);
            cell[a] = int(std::lround(value(u)));
            const Number t = u - double(cell[a]);
            weight[a][0] = 0.5 * (0.5 - t) * (0.5 - t);
            weight[a][1] = 0.75 - t * t;
            weight[a][2] = 0.5 * (0.5 + t) * (0.5 + t);
        }
        Number sum = 0.0;
        for (int k = 0; k < 3; ++k)
            for (int j = 0; j < 3; ++j)
                for (int i = 0; i < 3; ++i) {
                    const int place = ((cell[2] + k - 1) * size[1] + cell[1] + j - 1) * size[0] + cell[0] + i - 1;
                    sum += double(coefficients[std::size_t(place)]) * weight[0][i] * weight[1][j] * weight[2][k];
                }
        return sum;
    }
};

// A place that can touch the wall, node or middle of an element; all of it is frozen while a step is solved.
struct ContactPoint {
    Vec3<double> offset{0, 0, 0};     // of the wire's curve from the polygon, mm
    Vec3<double> normal{0, 0, 0};     // of the wall
    Vec3<double> spin_arm{0, 0, 0};   // motion of the surface for a unit rotation about the wire, mm/rad
    double friction_limit = 0, normal_force = 0;   // N
};

struct Node {
    Vec3<double> x, start;
    Quaternion<double> q, start_q;
    ContactPoint at_node, at_middle;  // the latter of the element behind it
};

class Wire {
public:
    double inserted, rotation;        // mm, rad
    double base_force = 0, base_torque = 0;   // that hold it where it enters, N, N mm
    std::vector<Node> node;           // from the tip; those that follow the drive too
    int active;                       // nodes that do not

    Wire(const Scene& scene, const DistanceMap& distance, double friction, double inserted, double rotation)
        : inserted(inserted), rotation(rotation), node(std::size_t(scene.rod.nodes)), active(count(scene, inserted)), scene_(scene), distance_(distance), friction_(friction) {
        for (int i = 0; i < scene.rod.nodes; ++i) follow_drive(i);
    }

    // Moves the wire for a sample of some time steps, `time_step` s long, at some speed (mm/s) and spin (rad/s).
    void sample(double speed, double spin, double time_step, int steps) {
        const double inserted_before = inserted, rotation_before = rotation;
        for (int k = 1; k <= steps; ++k) {
            begin_step();
            inserted = inserted_before + speed * (time_step * k);
            rotation = rotation_before + spin * (time_step * k);
            for (int i = active; i < scene_.rod.nodes; ++i) follow_drive(i);
            time_step_ = time_step;
            newton();
            freeze_contacts(k == steps ? 0.0 : 1.0);   // friction goes on as it went, but from one sample to the next
        }
    }

private:
    const Scene& scene_;
    const DistanceMap& distance_;
    double friction_, share_ = 1, time_step_ = 0;

    static int count(const Scene& scene, double inserted) { return Base::count_active(scene.rod, inserted, scene.options.free_behind); }

    // The nodes that lie where they did are those that were and are ahead of the guiding catheter.
    void begin_step() {
        const int before = active;
        active = count(scene_, inserted);
        share_ = Base::share_of_last_joint(scene_.rod, inserted, scene_.options.free_behind, active);
        for (int i = std::min(before, active); i < scene_.rod.nodes; ++i) follow_drive(i);
        if (active < before) node[std::size_t(active - 1)].at_middle = {};
        for (Node& n : node) n.start = n.x, n.start_q = n.q;
    }

    void follow_drive(int i) {
        Node& n = node[std::size_t(i)];
        n = Node{};
        n.x = scene_.base.position(scene_.rod, i, inserted);
        n.q = scene_.base.attitude(rotation);
    }

    // The energy of what block i adds: element i, the joint behind it, contacts, friction and drag.
    template <class Number>
    Number energy(int i) const {
        const auto& rod = scene_.rod;
        const Node &here = node[std::size_t(i)], &behind = node[std::size_t(i + 1)];
        Vec3<Number> x[2];
        Quaternion<Number> q[2];
        for (int b = 0; b < 2; ++b) {
            const Node& n = b == 0 ? here : behind;
            const int first = b * kBlock;
            x[b] = {unknown<Number>(n.x.x, first), unknown<Number>(n.x.y, first + 1), unknown<Number>(n.x.z, first + 2)};
            // rotated by the rotation vector theta in its own axes: (1, theta/2), normalised
            const Vec3<Number> half{0.5 * unknown<Number>(0, first + 3), 0.5 * unknown<Number>(0, first + 4), 0.5 * unknown<Number>(0, first + 5)};
            const Number scale = inverse(root(1.0 + dot(half, half)));
            const Quaternion<Number> turned = constant<Number>(n.q) * Quaternion<Number>{1.0, half};
            q[b] = {scale * turned.w, scale * turned.v};
        }
        Number sum = 0.0;

        // stretch and shear: sigma = R^T (x_i - x_(i+1)) / l - e3
        const double l = rod.length[i];
        const auto axes = frame(q[0]);
        const Vec3<Number> along = Number(1 / l) * (x[0] - x[1]);
        const Number s1 = dot(axes.d1, along), s2 = dot(axes.d2, along), s3 = dot(axes.d3, along) - 1.0;
        sum += 0.5 * l * (rod.shear[i] * (s1 * s1 + s2 * s2) + rod.stretch[i] * (s3 * s3));

        // bend and twist: kappa = 2/L g v, with 2 g v the rotation vector between the elements; of the last joint a share is free
        const double L = rod.joint_length[i + 1], share = i + 1 == active ? share_ : 1.0;
        const Vec3<double>& rest = rod.rest[i + 1];
        const Vec3<Number> v = relative(q[1], q[0]).v;
        const Number u = dot(v, v), g = 1.0 + u * (1.0 / 6 + u * (3.0 / 40 + u * (5.0 / 112 + u * (35.0 / 1152))));
        const Number k1 = 2 / L * g * v.x - share * rest.x, k2 = 2 / L * g * v.y - share * rest.y, k3 = 2 / L * g * v.z - share * rest.z;
        sum += 0.5 * L / share * (rod.bend[i + 1] * (k1 * k1 + k2 * k2) + rod.twist[i + 1] * (k3 * k3));

        // wall and friction, at the node and at the middle of the element, but not of that which joins the base
        const Vec3<Number> moved = x[0] - constant<Number>(here.start), middle = Number(0.5) * (x[0] + x[1]), middle_moved = Number(0.5) * (moved + (x[1] - constant<Number>(behind.start)));
        const Quaternion<Number> turned = relative(constant<Number>(here.start_q), q[0]);
        sum += contact(here.at_node, rod.radius[i], x[0], moved, turned);
        if (i + 1 < active) sum += contact(here.at_middle, rod.radius[i], middle, middle_moved, turned);

        // drag against translation and rotation
        sum += 0.5 * rod.drag[i] / time_step_ * dot(moved, moved) + 2 * rod.spin_drag[i] / time_step_ * dot(turned.v, turned.v);
        return sum;
    }

    // The wall, k/2 d² where it is entered by d; and smoothed Coulomb friction of the surface, which moves with the wire and its rotation.
    template <class Number>
    Number contact(const ContactPoint& point, double radius, const Vec3<Number>& x, const Vec3<Number>& moved, const Quaternion<Number>& turned) const {
        const Number depth = radius - distance_(x + constant<Number>(point.offset));
        Number sum = value(depth) > 0 ? 0.5 * scene_.options.wall_stiffness * depth * depth : Number(0.0);
        if (point.friction_limit == 0) return sum;
        const Vec3<Number> n = constant<Number>(point.normal), slip = moved - dot(moved, n) * n + 2.0 * turned.v.z * constant<Number>(point.spin_arm);
        const double eps = scene_.options.stick_velocity * time_step_;
        return sum + point.friction_limit * (root(dot(slip, slip) + eps * eps) - eps);
    }

    // Moves the active nodes to the least energy.
    void newton() {
        const std::size_t n = std::size_t(kBlock * active);
        double damping = 0;
        for (int iteration = 0; iteration < 500; ++iteration) {
            // gradient and Hessian, a band: row r holds columns r - kUnknowns + 1 to r
            std::vector<double> gradient(n + kBlock, 0.0);
            std::vector<std::array<double, kUnknowns>> hessian(n + kBlock, std::array<double, kUnknowns>{});
            double at_trial = 0;
            for (int i = 0; i < active; ++i) {
                const Jet part = energy<Jet>(i);
                at_trial += part.value;
                for (int a = 0; a < kUnknowns; ++a) {
                    gradient[std::size_t(kBlock * i + a)] += part.slope[a];
                    for (int b = 0; b <= a; ++b) hessian[std::size_t(kBlock * i + a)][std::size_t(kUnknowns - 1 - a + b)] += part.curve[a][b];
                }
            }
            const Vec3<double> axis = frame(scene_.base.orientation).d3;   // what is left at the first node that follows the drive is the drive's
            base_force = dot(axis, Vec3<double>{gradient[n], gradient[n + 1], gradient[n + 2]});
            base_torque = gradient[n + 5];

            // direction, damped until the Hessian is positive definite
            std::vector<double> step;
            while (!solve(hessian, gradient, n, damping, step)) damping = std::max(1e-6, 4 * damping);

            // line search: halve the step until the energy falls
            double largest = 0;
            for (double s : step) largest = std::max(largest, std::abs(s));
            const std::vector<Node> accepted = node;
            double length = std::min(1.0, 0.3 / largest);
            for (int halvings = 0; halvings < 40; ++halvings, length *= 0.5) {
                double trial = 0;
                for (int i = 0; i < active; ++i) {
                    const double* s = &step[std::size_t(kBlock * i)];
                    Node& moved = node[std::size_t(i)];
                    moved.x = accepted[std::size_t(i)].x + length * Vec3<double>{s[0], s[1], s[2]};
                    moved.q = rotated(accepted[std::size_t(i)].q, length * Vec3<double>{s[3], s[4], s[5]});
                }
                for (int i = 0; i < active; ++i) trial += energy<double>(i);
                if (trial <= at_trial + 1e-12 * std::abs(at_trial) + 1e-15) break;
            }
            if (largest < 1e-10) return;
            damping = damping > 1e-6 ? 0.25 * damping : 0;
        }
    }

    // step = -(H + damping)^-1 gradient by Cholesky's method. Returns whether H + damping is positive definite.
    static bool solve(std::vector<std::array<double, kUnknowns>> h, const std::vector<double>& gradient, std::size_t n, double damping, std::vector<double>& step) {
        const auto at = [&h](std::size_t r, std::size_t c) -> double& { return h[r][kUnknowns - 1 + c - r]; };
        step.assign(n, 0.0);
        for (std::size_t r = 0; r < n; ++r) {
            const std::size_t first = r < kUnknowns ? 0 : r - kUnknowns + 1;
            at(r, r) += damping;
            step[r] = -gradient[r];
            for (std::size_t c = first; c <= r; ++c) {
                for (std::size_t k = std::max(first, c < kUnknowns ? 0 : c - kUnknowns + 1); k < c; ++k) at(r, c) -= at(r, k) * at(c, k);
                if (c < r) at(r, c) /= at(c, c), step[r] -= at(r, c) * step[c];
            }
            if (!(at(r, r) > 0)) return false;
            at(r, r) = std::sqrt(at(r, r));
            step[r] /= at(r, r);
        }
        for (std::size_t r = n; r-- > 0;) {
            step[r] /= at(r, r);
            for (std::size_t c = r < kUnknowns ? 0 : r - kUnknowns + 1; c < r; ++c) step[c] -= at(r, c) * step[r];
        }
        return true;
    }

    // Freezes what the next step takes as given: offsets of the curve from the polygon, and friction with the normal force in its middle,
    // which is extrapolated by `weight`.
    void freeze_contacts(double weight) {
        const auto& rod = scene_.rod;
        const auto curvature = [&](int joint) {   // vector, between element joint - 1 and element joint
            const Node &a = node[std::size_t(joint - 1)], &b = node[std::size_t(joint)], &c = node[std::size_t(joint + 1)];
            return (1 / rod.joint_length[joint]) * ((1 / rod.length[joint - 1]) * (a.x - b.x) - (1 / rod.length[joint]) * (b.x - c.x));
        };
        for (int i = 0; i < active; ++i) {
            Node& n = node[std::size_t(i)];
            const double l = rod.length[i];
            const Vec3<double> axis = frame(n.q).d3, bent = curvature(std::max(i, 1));
            freeze(n.at_node, n.x, axis, rod.radius[i], weight);
            n.at_node.offset = (i > 0 ? rod.length[i - 1] * l / 24 : l * l / 8) * bent;
            if (i + 1 == active) continue;
            freeze(n.at_middle, 0.5 * (n.x + node[std::size_t(i + 1)].x), axis, rod.radius[i], weight);
            n.at_middle.offset = (-l * l / 24) * (bent + curvature(i + 1));
        }
    }

    void freeze(ContactPoint& point, const Vec3<double>& x, const Vec3<double>& axis, double radius, double weight) const {
        const Jet d = distance_(Vec3<Jet>{Jet::unknown(x.x + point.offset.x, 0), Jet::unknown(x.y + point.offset.y, 1), Jet::unknown(x.z + point.offset.z, 2)});
        const Vec3<double> slope{d.slope[0], d.slope[1], d.slope[2]};
        const double size = std::sqrt(dot(slope, slope)), before = point.normal_force;
        const bool touches = d.value < radius;
        point.normal_force = touches ? scene_.options.wall_stiffness * (radius - d.value) * size : 0;
        const double ahead = before > 0 ? point.normal_force + 0.5 * weight * (point.normal_force - before) : point.normal_force;
        point.friction_limit = friction_ * std::clamp(ahead, 0.0, 2 * point.normal_force);
        point.normal = (touches ? 1 / size : 0.0) * slope;
        point.spin_arm = radius * cross(point.normal, axis);
    }
};

}  // namespace reference
