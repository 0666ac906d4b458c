// Telescoping devices: how they slide along the mesh that they share, and the forces between them. A wire alone needs none of it.
//
// The mesh follows the device whose tip is foremost; the others slide along it. Insertions are driven, so friction along the
// devices is no unknown: it follows from the lateral force between them once a step has come to rest, and each drive's force
// from it. Friction against turning has a potential, with that lateral force as it was at the end of the last step.
#pragma once

#include "state.hpp"

namespace endopilot {

// How a surface that slides along the mesh moves.
template <class V, int T>
ENDOPILOT_DEVICE decltype(auto) slid(const Vec3<V>& moved, const Surface<V, T>& surface) {
    if constexpr (T == 0) return (moved);
    else return moved + surface.slide;
}

// What friction at a surface needs of the devices of a node.
template <class V, int T>
ENDOPILOT_DEVICE Touching<V, T> touching(const TubeNode<V, T>& tubes, const Surface<V, T>& surface) {
    Touching<V, T> t;
    if constexpr (T > 0) t.spin = surface.spin;
    for (int k = 0; k < T; ++k) {
        t.weight[k] = surface.weight[k];
        t.twisted[k] = tubes.twist[k] - tubes.start[k];
    }
    return t;
}

// The surface where device k covers the share `cover[k]` and twists by `rate[k]`; `axis` points along it.
template <class V, int T>
ENDOPILOT_DEVICE Surface<double, T> covered_surface(const Tubes& tubes, const TimeStep<V, T>& step, int l, const double (&cover)[T + 1],
                                                    const double (&rate)[T + 1], const Vec3<double>& axis) {
    Surface<double, T> surface{};
    double left = 1, slide = 0;   // of the stretch, not covered by devices farther out
    for (int k = T; k >= 0; --k) {
        const double weight = k > 0 ? left * std::min(cover[k], 1.0) : left, moved = weight * get(step.slide[k], l);
        left -= weight;
        surface.radius += weight * tubes.radius[k];
        surface.friction += weight * get(step.friction[k], l);
        surface.spin += moved * rate[k];
        slide += moved;
        if (k > 0) surface.weight[k - 1] = weight;
    }
    surface.slide = slide * axis;
    return surface;
}

template <class V, int T>
ENDOPILOT_DEVICE void set(Surface<V, T>& surface, int l, const Surface<double, T>& from) {
    set(surface.radius, l, from.radius);
    set(surface.friction, l, from.friction);
    set(surface.spin, l, from.spin);
    set(surface.slide, l, from.slide);
    for (int k = 0; k < T; ++k) set(surface.weight[k], l, from.weight[k]);
}

template <class V, int T>
ENDOPILOT_DEVICE void set(TubeJoint<V, T>& joint, int l, const TubeJoint<double, T>& from) {
    set(joint.bend, l, from.bend);
    for (int k = 0; k <= T; ++k) {
        set(joint.twist[k], l, from.twist[k]);
        set(joint.rest[k], l, from.rest[k]);
        set(joint.c[k], l, from.c[k]);
    }
    for (int p = 0; p < TubeJoint<V, T>::kPairs; ++p) set(joint.d[p], l, from.d[p]);
}

// What the devices make of the mesh in the step to come.
template <class V, int T>
ENDOPILOT_LARGE void prepare_tubes(const Scene& scene, Lanes<V, T>& lanes, int l) {
    const RodModel& rod = scene.rod;
    const Tubes& tubes = scene.tubes;
    const Lane<T>& lane = lanes.lane[l];
    double offset[T + 1];
    Integrals middle[T + 1], node[T + 1], next_middle[T + 1], next_node[T + 1];
    for (int k = 0; k <= T; ++k) {
        offset[k] = std::max(0.0, lane.advance.end - lane.device[k].end);
        middle[k] = node[k] = integrals(tubes, k, -offset[k]);
    }
    for (int i = 0; i <= lane.active; ++i) {
        Node<V, T>& n = lanes.node[i];
        TubeNode<V, T>& to = n.tubes;
        const double length = rod.length[i], at = Base::middle(rod, i), cell = i > 0 ? rod.joint_length[i] : at;
        double cover[T + 1], cover_middle[T + 1], rate[T + 1], stretch = 0;
        for (int k = 0; k <= T; ++k) {
            next_middle[k] = integrals(tubes, k, at - offset[k]);
            next_node[k] = integrals(tubes, k, rod.abscissa[i + 1] - offset[k]);
            const Integrals element = next_node[k] - node[k];
            cover[k] = (next_middle[k] - middle[k]).length / cell;
            cover_middle[k] = element.length / length;
            stretch += element.stretch / length;
            rate[k] = get(to.rate[k], l);
        }
        if (i > 0) set(to.joint, l, tube_joint<T>(middle, next_middle, cell));
        set(to.stretch, l, stretch);
        set(to.shear, l, tubes.shear_share * stretch);
        double inside = 0, outside = 0;
        for (int k = 0; k <= T; ++k) {
            set(to.inside[k], l, inside);
            inside = std::max(inside, cover[k]);
        }
        for (int k = T; k >= 0; --k) {
            outside = std::max(outside, cover[k]);
            set(to.outside[k], l, outside);
        }
        const Vec3<double> axis = frame(get(n.start_q, l)).d3;
        set(to.at_node, l, covered_surface(tubes, lanes.step, l, cover, rate, axis));
        set(to.at_middle, l, covered_surface(tubes, lanes.step, l, cover_middle, rate, axis));
        std::copy(next_middle, next_middle + T + 1, middle);
        std::copy(next_node, next_node + T + 1, node);
    }
}

// Friction between devices against turning, at a node: smoothed as that of the wall, against their sliding and turning together.
template <class V, int T>
ENDOPILOT_DEVICE V add_interfaces(const Tubes& scene, const Lanes<V, T>& lanes, const Node<V, T>& node, Diagonal<V, T>& own) {
    using S = Single<V>;
    const TubeNode<V, T>& tubes = node.tubes;
    const V(&slide)[T + 1] = lanes.step.slide, &eps = lanes.step.eps;
    V energy{};
    for (int k = 1; k <= T; ++k) {
        const V &limit = tubes.limit[k - 1], zero{};
        if (!any<V>(limit > zero)) continue;
        const double radius = scene.radius[k - 1];
        const V along = slide[k] - slide[k - 1];
        V turned = tubes.twist[k - 1] - tubes.start[k - 1] + tubes.rate[k] * slide[k] - tubes.rate[k - 1] * slide[k - 1];
        if (k > 1) turned -= tubes.twist[k - 2] - tubes.start[k - 2];
        const V slip = radius * turned, size = square_root(along * along + slip * slip + eps * eps), inverse = 1.0 / size;
        const V secant = limit * inverse * (radius * radius), torque = secant * turned;
        energy += limit * size;
        const V share = slip * inverse;
        const S stiffness = narrow(secant) * (1.0f - lanes.terms.tangent * narrow(share * share));
        own.twists.gradient[k - 1] += torque;
        own.twists.pp[k - 1][k - 1] += stiffness;
        if (k == 1) {
            own.gradient_theta.z -= torque;
            own.tt.zz += stiffness;
            own.twists.pt[0][2] -= stiffness;
        } else {
            own.twists.gradient[k - 2] -= torque;
            own.twists.pp[k - 2][k - 2] += stiffness;
            own.twists.pp[k - 1][k - 2] -= stiffness;
        }
    }
    return energy;
}

// A node of one lane, as far as the forces between its devices need it.
template <int T>
struct TubePlace {
    Vec3<double> x;
    Quaternion<double> q;
    Frame<double> axes;
    double twist[T], turned[T];   // the latter: in the step, on the device inside, less what sliding brings; rad
    double inside[T + 1], outside[T + 1], stretch;
    TubeJoint<double, T> joint;
};

template <class V, int T>
ENDOPILOT_DEVICE TubePlace<T> tube_place(const Lanes<V, T>& lanes, int i, int l) {
    const Node<V, T>& node = lanes.node[i];
    const TubeNode<V, T>& from = node.tubes;
    const V(&slide)[T + 1] = lanes.step.slide;
    TubePlace<T> place;
    place.x = get(node.x, l);
    place.q = get(node.q, l);
    place.axes = frame(place.q);
    place.stretch = get(from.stretch, l);
    for (int k = 0; k <= T; ++k) {
        place.inside[k] = get(from.inside[k], l);
        place.outside[k] = get(from.outside[k], l);
        place.joint.rest[k] = get(from.joint.rest[k], l);
        place.joint.c[k] = get(from.joint.c[k], l);
        if (k == 0) continue;
        place.twist[k - 1] = get(from.twist[k - 1], l);
        double turned = place.twist[k - 1] - get(from.start[k - 1], l) + get(from.rate[k], l) * get(slide[k], l) -
                        get(from.rate[k - 1], l) * get(slide[k - 1], l);
        if (k > 1) turned -= place.twist[k - 2] - get(from.start[k - 2], l);
        place.turned[k - 1] = turned;
    }
    for (int p = 0; p < TubeJoint<V, T>::kPairs; ++p) place.joint.d[p] = get(from.joint.d[p], l);
    place.joint.bend = get(from.joint.bend, l);
    return place;
}

// The bending moment that the first k devices carry at a joint, `length` mm long, of which `share` is free to bend; N mm. Returns the
// twist rate of device 0 there, rad/mm.
template <int T>
ENDOPILOT_DEVICE double bundle_moment(int k, double length, double share, const TubePlace<T>& ahead, const TubePlace<T>& behind,
                                      Vec3<double>& moment) {
    const TubeJoint<double, T>& own = behind.joint;
    const Rotation<double> rotation(ahead.q, behind.q);
    const RestCurvature<double, T> rest(own, ahead.twist, behind.twist);
    const double scale = (2.0 / length) * rotation.g, bend = own.bend / share;
    double rest_x, rest_y, part = 0, x = 0, y = 0;
    rest.sum(own, rest_x, rest_y);
    for (int i = 0; i < k; ++i) {
        part += own.c[i];
        for (int o = k; o <= T; ++o) {
            x += own.d[own.pair(i, o)] * (rest.x[o] - rest.x[i]);
            y += own.d[own.pair(i, o)] * (rest.y[o] - rest.y[i]);
        }
    }
    x += part * bend * (scale * rotation.v.x - share * rest_x);
    y += part * bend * (scale * rotation.v.y - share * rest_y);
    moment = (0.5 * x) * (ahead.axes.d1 + behind.axes.d1) + (0.5 * y) * (ahead.axes.d2 + behind.axes.d2);
    return scale * rotation.v.z;
}

// For lane l, whose step has come to rest: the lateral force between devices, which friction in the coming step acts with, the axial
// force of each at the base, and the rates of twist.
//
// The inner devices of an interface carry the force n_i = T_i t_i + Q_i through element i, Q from the slope of their moment. At each node
// the outer devices hold them with the force n_i - n_(i-1). Its part across the wire makes friction; that along it is friction.
//
// Where `kept` is false only the tension of each bundle at the base is found, and the nodes stay as they were.
template <class V, int T>
ENDOPILOT_LARGE void freeze_tubes(const Scene& scene, Lanes<V, T>& lanes, int l, bool kept) {
    const TimeStep<V, T>& step = lanes.step;
    const RodModel& rod = scene.rod;
    const int active = lanes.lane[l].active;
    for (int k = 1; k <= T; ++k) {
        const double friction = scene.tubes.bore_friction[k], radius = scene.tubes.radius[k - 1], mobilized = get(step.mobilized[k - 1], l);
        const double slide = std::abs(get(step.slide[k], l) - get(step.slide[k - 1], l)) + get(step.eps, l);
        double tension = 0, rate_ahead = 0;
        Vec3<double> moment{0, 0, 0}, tangent{0, 0, 0}, shear{0, 0, 0};
        TubePlace<T> here = tube_place(lanes, 0, l);
        for (int i = 0; i < active; ++i) {
            const TubePlace<T> behind = tube_place(lanes, i + 1, l);
            const Vec3<double> t = here.axes.d3;
            const double length = rod.length[i], joint = rod.joint_length[i + 1], share = i + 1 == active ? get(step.last_joint, l) : 1.0;
            const double total = here.stretch * ((1.0 / length) * dot(t, here.x - behind.x) - 1.0);
            Vec3<double> moment_behind;
            const double rate = bundle_moment(k, joint, share, here, behind, moment_behind);
            const Vec3<double> q = (1.0 / length) * cross(moment_behind - moment, t);
            // the moment in the joint behind bears on this node too
            const double inside = here.inside[k], overlap = std::min(inside, here.outside[k]);
            const double both = std::max(overlap, std::min(behind.inside[k], behind.outside[k]));
            double limit = 0;
            if (i == 0) {   // at the tip, the curve's tangent is half a joint ahead of the element's; the foremost bear the load on it
                const Vec3<double> mean = t + 0.5 * (t - behind.axes.d3);
                Vec3<double> of_all;
                bundle_moment(T + 1, joint, share, here, behind, of_all);
                const Vec3<double> bent = (inside - overlap) * ((1.0 / length) * cross(of_all, t)) - q;
                tension = (inside - overlap) * total + dot(bent, mean) / dot(t, mean);
            } else if (!(both > 0)) {
                tension = inside > 0 ? total : 0.0;
            } else {
                const Vec3<double> sum = t + tangent, bent = shear - q;
                const Vec3<double> mean = (1.0 / std::sqrt(dot(sum, sum))) * sum;
                const double inverse = 1.0 / dot(t, mean), free = (tension * dot(tangent, mean) + dot(bent, mean)) * inverse;
                const double slip = radius * here.turned[k - 1], straight = slide / std::sqrt(slide * slide + slip * slip);
                double marched = free;
                for (int twice = 0; twice < 2; ++twice) {
                    const Vec3<double> p = marched * t - tension * tangent - bent;
                    const double pm = dot(p, mean), across = dot(p, p) - pm * pm;
                    limit = friction * std::sqrt(std::max(across, 0.0));
                    marched = free + mobilized * straight * limit * inverse;
                }
                tension = marched;
            }
            if (kept) {
                TubeNode<V, T>& node = lanes.node[i].tubes;
                set(node.limit[k - 1], l, limit);
                const double between = (1.0 / joint) * (here.twist[k - 1] - behind.twist[k - 1]);
                const double turn = rate + between, before = i > 0 ? rate_ahead : turn;
                if (k == 1) set(node.rate[0], l, rate);
                set(node.rate[k], l, 0.5 * (turn + before));
                rate_ahead = turn;
            }
            moment = moment_behind;
            tangent = t;
            shear = q;
            here = behind;
        }
        set(lanes.found.tension[k - 1], l, tension);
    }
}

}  // namespace endopilot
