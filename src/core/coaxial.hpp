// The stepper of telescoping tubes: how they slide along the mesh that they share, and the forces between them.
//
// The mesh follows the tube whose tip is foremost (the lead); the others slide along it. Insertions are driven, so friction along the
// tubes is no unknown: it follows from the lateral force between them once a step has come to rest, and each drive's force
// from it. Friction against turning has a potential, with that lateral force as it was at the end of the last step.
#pragma once

#include "stepper.hpp"

namespace endopilot {

constexpr double kGripLength = 0.02;   // mm of sliding that turn friction along two tubes from one direction to the other by half

// Where the tubes are at the step's start and are to be at its end.
template <class V, int T>
void Stepper<V, T>::aim_tubes(int l, double weight) {
    Lane& lane = lane_[l];
    const double began = elapsed(lane.tick), ends = elapsed(lane.tick + lane.stride);
    const auto behind = [](int side, double off) { return side * off < 0 ? off : 0.0; };
    int lead = 0;
    double foremost = 0;
    for (int k = 0; k <= T; ++k) {
        Tube& tube = lane.tubes.tube[k];
        const double inserted = tube.inserted - tube.slipped, rotation = tube.rotation - tube.rotation_slipped;
        tube.advanced = inserted + tube.speed * began;
        tube.turned = rotation + tube.spin * began;
        tube.asked_advance = inserted + tube.speed * ends;
        tube.asked_rotation = rotation + tube.spin * ends;
        tube.off = behind(tube.slipping, tube.turned + weight * tube.last_rotation - tube.asked_rotation);
        tube.from = tube.off;
        tube.end_rotation = tube.asked_rotation + tube.off;
        if (k == 0 || tube.advanced > foremost) foremost = tube.advanced;
        if (tube.asked_advance > lane.tubes.tube[lead].asked_advance) lead = k;
    }
    if (lead != lane.tubes.lead) lane.slipping.advance = 0;
    lane.tubes.lead = lead;
    const Tube &first = lane.tubes.tube[0], &leading = lane.tubes.tube[lead];
    lane.start = {foremost, first.turned};
    lane.origin = {leading.asked_advance, first.asked_rotation};
    lane.off = {behind(lane.slipping.advance, foremost + weight * lane.last.advance - lane.origin.advance), first.off};
    const double end = lane.origin.advance + lane.off.advance;
    for (int k = 0; k <= T; ++k) {
        Tube& tube = lane.tubes.tube[k];
        if (k == lead) tube.pace = 1, tube.yield = 0;
        double made = tube.asked_advance;
        if (tube.pace < 1 || tube.yield != 0)
            made = std::max(0.0, tube.advanced + tube.pace * (tube.asked_advance - tube.advanced) + tube.yield * duration(lane));
        tube.end_advance = k == lead ? end : std::min(made, end);
        set(of_tubes_.slide[k], l, (tube.end_advance - tube.advanced) - (end - foremost));
        if (k > 0) set(of_tubes_.grip[k - 1], l, lane.tubes.tube[k - 1].grip);
    }
}

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
        contact.friction += weight * get(of_tubes_.friction[k], l);
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
        offset[k] = std::max(0.0, lane.end.advance - lane.tubes.tube[k].end_advance);
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
        const Vec3<double> axis = frame(take(n.start_q, l)).d3;
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

// The bending moment that tubes 0 to k - 1 carry at a joint, N mm. Returns the twist rate of tube 0 there, rad/mm.
template <class V, int T>
V Stepper<V, T>::bundle_moment(int k, int joint, Vec3<V>& moment) const {
    const Node<V, T> &distal = node_[joint - 1], &proximal = node_[joint];
    const TubeJoint<V, T>& own = proximal.tubes.joint;
    const Rotation<V> rotation(distal.q, proximal.q);
    const RestCurvature<V, T> rest(own, distal.tubes.twist, proximal.tubes.twist);
    const V one = broadcast<V>(1.0), share = select<V>(active_ == broadcast<V>(joint), share_, one);
    const V scale = (2.0 / rod_.joint_length[joint]) * rotation.g, bend = own.bend / share;
    V rest_x, rest_y, part{}, x{}, y{};
    rest.sum(own, rest_x, rest_y);
    for (int l = 0; l < k; ++l) {
        part += own.c[l];
        for (int m = k; m <= T; ++m) {
            x += own.d[own.pair(l, m)] * (rest.x[m] - rest.x[l]);
            y += own.d[own.pair(l, m)] * (rest.y[m] - rest.y[l]);
        }
    }
    x += part * bend * (scale * rotation.v.x - share * rest_x);
    y += part * bend * (scale * rotation.v.y - share * rest_y);
    const Frame<V> ahead = frame(distal.q), behind = frame(proximal.q);
    moment = (0.5 * x) * (ahead.d1 + behind.d1) + (0.5 * y) * (ahead.d2 + behind.d2);
    return scale * rotation.v.z;
}

// For the lanes in `mask`, whose step has come to rest: the lateral force between tubes, which friction in the coming step acts with,
// the axial force of each at the base, and the rates of twist.
//
// The inner tubes of an interface carry the force n_i = T_i t_i + Q_i through element i, Q from the slope of their moment. At each node
// the outer tubes hold them with the force n_i - n_(i-1). Its part across the wire makes friction; that along it is friction.
//
// Where `kept` is false only the tension of each bundle at the base is found, and the nodes stay as they were.
template <class V, int T>
void Stepper<V, T>::freeze_tubes(int n, Mask<V> mask, bool kept) {
    const V zero{}, half = broadcast<V>(0.5);
    for (int k = 1; k <= T; ++k) {
        const double friction = tubes_.bore_friction[k], radius = tubes_.radius[k - 1];
        const V along = of_tubes_.slide[k] - of_tubes_.slide[k - 1], slid = (along < zero ? -along : along) + eps_;
        V tension{}, rate_ahead{};
        Vec3<V> moment{zero, zero, zero}, tangent{zero, zero, zero}, shear{zero, zero, zero};
        for (int i = 0; i < n; ++i) {
            Node<V, T>& node = node_[i];
            const Mask<V> on = mask & (active_ > broadcast<V>(i));
            const Vec3<V> t = frame(node.q).d3;
            const double length = rod_.length[i];
            const V total = node.tubes.stretch * ((1.0 / length) * dot(t, node.x - node_[i + 1].x) - 1.0);
            Vec3<V> moment_behind;
            const V rate = bundle_moment(k, i + 1, moment_behind);
            const Vec3<V> q = broadcast<V>(1.0 / length) * cross(moment_behind - moment, t);
            // the moment in the joint behind bears on this node too
            const TubeNode<V, T>&here = node.tubes, &behind = node_[i + 1].tubes;
            const V inside = here.inside[k], overlap = minimum<V>(inside, here.outside[k]);
            const V both = maximum<V>(overlap, minimum<V>(behind.inside[k], behind.outside[k]));
            V limit{};
            if (i == 0) {   // at the tip, the curve's tangent is half a joint ahead of the element's; the foremost bear the load on it
                const Vec3<V> mean = t + half * (t - frame(node_[1].q).d3);
                Vec3<V> of_all;
                bundle_moment(T + 1, 1, of_all);
                const V share = inside - overlap;
                const Vec3<V> bent = share * (broadcast<V>(1.0 / length) * cross(of_all, t)) - q;
                tension = share * total + dot(bent, mean) / dot(t, mean);
            } else {
                const Vec3<V> sum = t + tangent, bent = shear - q;
                const Vec3<V> mean = (1.0 / square_root(dot(sum, sum))) * sum;
                const V inverse = 1.0 / dot(t, mean), free = (tension * dot(tangent, mean) + dot(bent, mean)) * inverse;
                V turned = node.tubes.twist[k - 1] - node.tubes.start[k - 1] + node.tubes.rate[k] * of_tubes_.slide[k] -
                           node.tubes.rate[k - 1] * of_tubes_.slide[k - 1];
                if constexpr (T > 1)
                    if (k > 1) turned -= node.tubes.twist[k - 2] - node.tubes.start[k - 2];
                const V slip = radius * turned, straight = slid / square_root(slid * slid + slip * slip);
                V marched = free;
                for (int twice = 0; twice < 2; ++twice) {
                    const Vec3<V> p = marched * t - tension * tangent - bent;
                    const V pm = dot(p, mean), across = dot(p, p) - pm * pm;
                    limit = friction * square_root(maximum<V>(across, zero));
                    marched = free + of_tubes_.grip[k - 1] * straight * limit * inverse;
                }
                const V alone = select<V>(inside > zero, total, zero);
                limit = select<V>(both > zero, limit, zero);
                tension = select<V>(both > zero, marched, alone);
            }
            of_tubes_.bundle[k - 1] = select<V>(mask & (active_ == broadcast<V>(i + 1)), tension, of_tubes_.bundle[k - 1]);
            if (kept) {
                node.tubes.limit[k - 1] = select<V>(on, limit, node.tubes.limit[k - 1]);
                const V between = (1.0 / rod_.joint_length[i + 1]) * (node.tubes.twist[k - 1] - node_[i + 1].tubes.twist[k - 1]);
                const V turn = rate + between, before = i > 0 ? rate_ahead : turn;
                if (k == 1) node.tubes.rate[0] = select<V>(on, rate, node.tubes.rate[0]);
                node.tubes.rate[k] = select<V>(on, half * (turn + before), node.tubes.rate[k]);
                rate_ahead = turn;
            }
            moment = moment_behind;
            tangent = t;
            shear = q;
        }
    }
}

// Where the step has brought the tubes. None comes to lie ahead of the lead.
template <class V, int T>
void Stepper<V, T>::settle_tubes(int l) {
    Lane& lane = lane_[l];
    const double led = lane.end.advance - lane.start.advance;
    for (int k = 0; k <= T; ++k) {
        Tube& tube = lane.tubes.tube[k];
        tube.end_advance = k == lane.tubes.lead ? lane.end.advance : std::min(tube.end_advance, lane.end.advance);
        if (k == 0) tube.off = lane.off.rotation;
        tube.end_rotation = tube.asked_rotation + tube.off;
        tube.slipped += tube.asked_advance - tube.end_advance;
        tube.rotation_slipped -= tube.off;
        tube.last_rotation = tube.end_rotation - tube.turned;
        if (tube.off == 0) tube.slipping = 0;
        set(of_tubes_.slide[k], l, (tube.end_advance - tube.advanced) - led);
        if (k == 0) continue;
        Tube& inner = lane.tubes.tube[k - 1];
        const double along = get(of_tubes_.slide[k], l) - get(of_tubes_.slide[k - 1], l);
        inner.grip = std::clamp(inner.grip + along / kGripLength, -1.0, 1.0);
        set(of_tubes_.grip[k - 1], l, inner.grip);
    }
}

}  // namespace endopilot
