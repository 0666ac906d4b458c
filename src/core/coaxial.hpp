// The stepper of telescoping tubes: how they slide along the mesh that they share, and the forces between them.
//
// The mesh follows the tube whose tip is foremost (the lead); the others slide along it. Insertions are driven, so friction along the
// tubes is no unknown: it follows from the lateral force between them once a step has come to rest, and each drive's force
// from it. Friction against turning has a potential, with that lateral force as it was at the end of the last step.
#pragma once

#include "stepper.hpp"

namespace endopilot {

// What touches the wall where tube k covers the share `cover[k]` and twists by `rate[k]`; `axis` points along it.
template <class V, int T>
TubeContact<double, T> Stepper<V, T>::tube_contact(int l, const double (&cover)[T + 1], const double (&rate)[T + 1],
                                                   const Vec3<double>& axis) const {
    TubeContact<double, T> contact{};
    double left = 1, slide = 0;   // of the stretch, not covered by tubes farther out
    for (int k = T; k >= 0; --k) {
        const double weight = k > 0 ? left * std::min(cover[k], 1.0) : left, moved = weight * get(of_tubes_.slide[k], l);
        left -= weight;
        contact.radius += weight * tubes_.radius[k];
        contact.friction += weight * get(friction_[k], l);
        contact.spin += moved * rate[k];
        slide += moved;
        if (k > 0) contact.weight[k - 1] = weight;
    }
    contact.slide = slide * axis;
    return contact;
}

// What the tubes make of the mesh in the step to come.
template <class V, int T>
void Stepper<V, T>::prepare_tubes(int l) {
    const Lane& lane = lane_[l];
    double offset[T + 1];
    Integrals middle[T + 1], node[T + 1], next_middle[T + 1], next_node[T + 1];
    for (int k = 0; k <= T; ++k) {
        offset[k] = std::max(0.0, lane.advance.end - lane.device[k].end);
        middle[k] = node[k] = integrals(tubes_, k, -offset[k]);
    }
    for (int i = 0; i <= lane.active; ++i) {
        Node<V, T>& n = node_[i];
        TubeNode<V, T>& to = n.tubes;
        const double length = rod_.length[i], at = Base::middle(rod_, i), cell = i > 0 ? rod_.joint_length[i] : at;
        double cover[T + 1], cover_middle[T + 1], rate[T + 1], stretch = 0;
        for (int k = 0; k <= T; ++k) {
            next_middle[k] = integrals(tubes_, k, at - offset[k]);
            next_node[k] = integrals(tubes_, k, rod_.abscissa[i + 1] - offset[k]);
            const Integrals element = next_node[k] - node[k];
            cover[k] = (next_middle[k] - middle[k]).length / cell;
            cover_middle[k] = element.length / length;
            stretch += element.stretch / length;
            rate[k] = get(to.rate[k], l);
        }
        if (i > 0) {
            const TubeJoint<double, T> joint = tube_joint<T>(middle, next_middle, cell);
            set(to.joint.bend, l, joint.bend);
            for (int k = 0; k <= T; ++k) {
                set(to.joint.twist[k], l, joint.twist[k]);
                set(to.joint.rest[k], l, joint.rest[k]);
                set(to.joint.c[k], l, joint.c[k]);
            }
            for (int p = 0; p < TubeJoint<V, T>::kPairs; ++p) set(to.joint.d[p], l, joint.d[p]);
        }
        set(to.stretch, l, stretch);
        set(to.shear, l, tubes_.shear_share * stretch);
        double inside = 0, outside = 0;
        for (int k = 0; k <= T; ++k) {
            set(to.inside[k], l, inside);
            inside = std::max(inside, cover[k]);
        }
        for (int k = T; k >= 0; --k) {
            outside = std::max(outside, cover[k]);
            set(to.outside[k], l, outside);
        }
        const Vec3<double> axis = frame(read(n.start_q, l)).d3;
        const auto put_contact = [&](TubeContact<V, T>& contact, const TubeContact<double, T>& from) {
            set(contact.radius, l, from.radius);
            set(contact.friction, l, from.friction);
            set(contact.spin, l, from.spin);
            put(contact.slide, l, from.slide);
            for (int k = 0; k < T; ++k) set(contact.weight[k], l, from.weight[k]);
        };
        put_contact(to.at_node, tube_contact(l, cover, rate, axis));
        put_contact(to.at_middle, tube_contact(l, cover_middle, rate, axis));
        std::copy(next_middle, next_middle + T + 1, middle);
        std::copy(next_node, next_node + T + 1, node);
    }
}

// Friction between tubes against turning, at a node: smoothed as that of the wall, against their sliding and turning together.
template <class V, int T>
V Stepper<V, T>::add_interfaces(const Node<V, T>& node, Diagonal<V, T>& own) const {
    const TubeNode<V, T>& tubes = node.tubes;
    V energy{};
    for (int k = 1; k <= T; ++k) {
        const V &limit = tubes.limit[k - 1], zero{};
        if (!any<V>(limit > zero)) continue;
        const double radius = tubes_.radius[k - 1];
        const V along = of_tubes_.slide[k] - of_tubes_.slide[k - 1];
        V turned = tubes.twist[k - 1] - tubes.start[k - 1] + tubes.rate[k] * of_tubes_.slide[k] - tubes.rate[k - 1] * of_tubes_.slide[k - 1];
        if constexpr (T > 1)
            if (k > 1) turned -= tubes.twist[k - 2] - tubes.start[k - 2];
        const V slip = radius * turned, size = square_root(along * along + slip * slip + eps_ * eps_), inverse = 1.0 / size;
        const V secant = limit * inverse * (radius * radius), torque = secant * turned;
        energy += limit * size;
        const V share = slip * inverse;
        const S stiffness = narrow(secant) * (1.0f - tangent_ * narrow(share * share));
        own.twists.gradient[k - 1] += torque;
        own.twists.pp[k - 1][k - 1] += stiffness;
        if (k == 1) {
            own.gradient_theta.z -= torque;
            own.tt.zz += stiffness;
            own.twists.pt[0][2] -= stiffness;
        }
        if constexpr (T > 1) {
            if (k > 1) {
                own.twists.gradient[k - 2] -= torque;
                own.twists.pp[k - 2][k - 2] += stiffness;
                own.twists.pp[k - 1][k - 2] -= stiffness;
            }
        }
    }
    return energy;
}

// What freeze_tubes needs of a node of lane l.
template <class V, int T>
TubePlace<T> Stepper<V, T>::tube_place(int i, int l) const {
    const Node<V, T>& node = node_[i];
    const TubeNode<V, T>& from = node.tubes;
    TubePlace<T> place{.x = read(node.x, l), .q = read(node.q, l), .axes = {}, .stretch = get(from.stretch, l)};
    place.axes = frame(place.q);
    for (int k = 0; k <= T; ++k) {
        place.inside[k] = get(from.inside[k], l);
        place.outside[k] = get(from.outside[k], l);
        place.joint.rest[k] = get(from.joint.rest[k], l);
        place.joint.c[k] = get(from.joint.c[k], l);
        if (k == 0) continue;
        place.twist[k - 1] = get(from.twist[k - 1], l);
        double turned = place.twist[k - 1] - get(from.start[k - 1], l) + get(from.rate[k], l) * get(of_tubes_.slide[k], l) -
                        get(from.rate[k - 1], l) * get(of_tubes_.slide[k - 1], l);
        if (k > 1) turned -= place.twist[k - 2] - get(from.start[k - 2], l);
        place.turned[k - 1] = turned;
    }
    for (int p = 0; p < TubeJoint<V, T>::kPairs; ++p) place.joint.d[p] = get(from.joint.d[p], l);
    place.joint.bend = get(from.joint.bend, l);
    return place;
}

// The bending moment that tubes 0 to k - 1 carry at a joint, N mm. Returns the twist rate of tube 0 there, rad/mm.
template <class V, int T>
double Stepper<V, T>::bundle_moment(int k, int joint, int l, const TubePlace<T>& ahead, const TubePlace<T>& behind,
                                    Vec3<double>& moment) const {
    const TubeJoint<double, T>& own = behind.joint;
    const Rotation<double> rotation(ahead.q, behind.q);
    const RestCurvature<double, T> rest(own, ahead.twist, behind.twist);
    const double share = lane_[l].active == joint ? get(share_, l) : 1.0;
    const double scale = (2.0 / rod_.joint_length[joint]) * rotation.g, bend = own.bend / share;
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

// For lane l, whose step has come to rest: the lateral force between tubes, which friction in the coming step acts with, the axial
// force of each at the base, and the rates of twist.
//
// The inner tubes of an interface carry the force n_i = T_i t_i + Q_i through element i, Q from the slope of their moment. At each node
// the outer tubes hold them with the force n_i - n_(i-1). Its part across the wire makes friction; that along it is friction.
//
// Where `kept` is false only the tension of each bundle at the base is found, and the nodes stay as they were.
template <class V, int T>
void Stepper<V, T>::freeze_tubes(int l, bool kept) {
    const double eps = get(eps_, l);
    for (int k = 1; k <= T; ++k) {
        const double friction = tubes_.bore_friction[k], radius = tubes_.radius[k - 1], mobilized = get(of_tubes_.mobilized[k - 1], l);
        const double slid = std::abs(get(of_tubes_.slide[k], l) - get(of_tubes_.slide[k - 1], l)) + eps;
        double tension = 0, rate_ahead = 0;
        Vec3<double> moment{0, 0, 0}, tangent{0, 0, 0}, shear{0, 0, 0};
        TubePlace<T> here = tube_place(0, l);
        for (int i = 0; i < lane_[l].active; ++i) {
            const TubePlace<T> behind = tube_place(i + 1, l);
            const Vec3<double> t = here.axes.d3;
            const double length = rod_.length[i];
            const double total = here.stretch * ((1.0 / length) * dot(t, here.x - behind.x) - 1.0);
            Vec3<double> moment_behind;
            const double rate = bundle_moment(k, i + 1, l, here, behind, moment_behind);
            const Vec3<double> q = (1.0 / length) * cross(moment_behind - moment, t);
            // the moment in the joint behind bears on this node too
            const double inside = here.inside[k], overlap = std::min(inside, here.outside[k]);
            const double both = std::max(overlap, std::min(behind.inside[k], behind.outside[k]));
            double limit = 0;
            if (i == 0) {   // at the tip, the curve's tangent is half a joint ahead of the element's; the foremost bear the load on it
                const Vec3<double> mean = t + 0.5 * (t - behind.axes.d3);
                Vec3<double> of_all;
                bundle_moment(T + 1, 1, l, here, behind, of_all);
                const Vec3<double> bent = (inside - overlap) * ((1.0 / length) * cross(of_all, t)) - q;
                tension = (inside - overlap) * total + dot(bent, mean) / dot(t, mean);
            } else if (!(both > 0)) {
                tension = inside > 0 ? total : 0.0;
            } else {
                const Vec3<double> sum = t + tangent, bent = shear - q;
                const Vec3<double> mean = (1.0 / std::sqrt(dot(sum, sum))) * sum;
                const double inverse = 1.0 / dot(t, mean), free = (tension * dot(tangent, mean) + dot(bent, mean)) * inverse;
                const double slip = radius * here.turned[k - 1], straight = slid / std::sqrt(slid * slid + slip * slip);
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
                TubeNode<V, T>& node = node_[i].tubes;
                set(node.limit[k - 1], l, limit);
                const double between = (1.0 / rod_.joint_length[i + 1]) * (here.twist[k - 1] - behind.twist[k - 1]);
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
        set(of_tubes_.bundle[k - 1], l, tension);
    }
}

}  // namespace endopilot
