// The stepper of telescoping tubes: their drives, how they slide along the mesh that they share, and the forces between them.
//
// The mesh follows the tube whose tip is foremost (the lead); the others slide along it. Insertions are driven, so friction along the
// tubes is no unknown: it follows from the lateral force between them once a step has come to rest, and each drive's force
// from it. Friction against turning has a potential, with that lateral force as it was at the end of the last step.
#pragma once

#include "stepper.hpp"

namespace endopilot {

constexpr double kGripLength = 0.02;   // mm of sliding that turn friction along two tubes from one direction to the other by half
constexpr double kFaster = 1.25, kLeastPace = 1.0 / 64;   // of the share of its motion that a drive makes after it was at its limit
constexpr double kYield = 20, kMostYield = 40;   // mm/s by which a drive at twice its limit gives way faster with each step, and at most
constexpr double kLeap = 0.05;         // share of its limit by which a drive's force may pass it in a step that can be shortened
constexpr double kNear = 0.4;          // share of its limit below which no force passes it in one step
constexpr int kLeastStride = kTicks / 8;   // no shorter steps than these for the sake of a limit

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

// The axial force of each drive, after freeze_tubes.
template <class V, int T>
void Stepper<V, T>::tell_forces(int l, double (&force)[T + 1]) const {
    double pushed = 0;
    for (int k = 0; k <= T; ++k) {
        force[k] = (k < T ? -get(of_tubes_.bundle[k], l) : get(base_force_, l)) - pushed;
        pushed += force[k];
    }
}

// By how much a force of drive k is beyond its limit, as a share of that: positive where it pushes, negative where it pulls.
template <class V, int T>
double Stepper<V, T>::beyond_limit(int k, double force) const {
    if (force > tubes_.push_limit[k]) return force / tubes_.push_limit[k] - 1;
    return force < -tubes_.pull_limit[k] ? force / tubes_.pull_limit[k] + 1 : 0.0;
}

// Friction between tubes turns within some 0.04 mm, and the drives' forces with it: a step in which one leaps beyond its limit
// is made again in shorter ones, in which the drive can give way.
template <class V, int T>
void Stepper<V, T>::refuse_leaps(int n, Decision (&decision)[W]) {
    bool any_near = false, near[W] = {};
    for (int l = 0; l < W; ++l) {
        const Lane& lane = lane_[l];
        if (decision[l] != Decision::converged || lane.stride <= kLeastStride) continue;
        for (int k = 0; k <= T; ++k) {
            const double most = kNear * std::min(tubes_.push_limit[k], tubes_.pull_limit[k]);
            near[l] = near[l] || std::abs(get(base_force_, l)) > most || std::abs(lane.tubes.tube[k].force) > most;
        }
        any_near = any_near || near[l];
    }
    if (!any_near) return;
    Lane before[W];
    const TubeLanes<V, T> of_tubes = of_tubes_;
    Mask<V> tried{};
    for (int l = 0; l < W; ++l) {
        if (!near[l]) continue;
        set_mask<V>(tried, l, true);
        before[l] = lane_[l];
        settle_tubes(l);
    }
    freeze_tubes(n, tried, false);
    double force[T + 1];
    for (int l = 0; l < W; ++l) {
        if (!near[l]) continue;
        Lane& lane = lane_[l];
        lane = before[l];
        tell_forces(l, force);
        for (int k = 0; k <= T; ++k) {
            const double beyond = std::abs(beyond_limit(k, force[k])), was = std::abs(beyond_limit(k, lane.tubes.tube[k].force));
            if (!(beyond > kLeap && beyond > was)) continue;
            decision[l] = Decision::restart;
            lane.extrapolated = false;
        }
    }
    of_tubes_ = of_tubes;
}

// The force and torque of each drive after a step. A drive that does not lead and is beyond its limit stops and gives way; within it,
// it takes its motion up again by and by.
template <class V, int T>
void Stepper<V, T>::pace_tubes(int l) {
    Lane& lane = lane_[l];
    double force[T + 1], pushed = 0;
    tell_forces(l, force);
    for (int k = 0; k <= T; ++k) {
        Tube& tube = lane.tubes.tube[k];
        tube.force = force[k];
        pushed += tube.force;
        tube.torque = k > 0 ? get(of_tubes_.torque[k - 1], l) : get(base_torque_, l);
        const double beyond = beyond_limit(k, tube.force);
        tube.pace = beyond * tube.speed > 0 ? 0.0 : std::min(1.0, kFaster * tube.pace + kLeastPace);
        tube.yield = beyond == 0 ? 0.5 * tube.yield : std::clamp(tube.yield - kYield * beyond, double{-kMostYield}, double{kMostYield});
        if (std::abs(tube.yield) < options_.stick_velocity) tube.yield = 0;
    }
    lane.tubes.others = pushed - lane.tubes.tube[lane.tubes.lead].force;
}

template <class V, int T>
bool Stepper<V, T>::tubes_slip(const Lane& lane) const {
    bool slips = lane.slipping.advance != 0 || lane.slipping.rotation != 0;
    for (int k = 1; k <= T; ++k) slips = slips || lane.tubes.tube[k].slipping != 0;
    return slips;
}

// The energy of drives that slip at their limits; the leading one also moves what the others held at the end of the last step.
template <class V, int T>
typename Stepper<V, T>::DriveEnergy Stepper<V, T>::tube_drive_energy(const Lane& lane) const {
    const int lead = lane.tubes.lead, side = lane.slipping.advance;
    const double force = side == 0 ? 0.0 : lane.tubes.others + (side > 0 ? tubes_.push_limit[lead] : -tubes_.pull_limit[lead]);
    DriveEnergy e{.energy = 0, .gradient_a = -force, .gradient_r = -lane.slipping.rotation * tubes_.torque_limit[0], .aa = 0, .ar = 0, .rr = 0};
    if (side != 0) e.energy += e.gradient_a * lane.off.advance;
    if (lane.slipping.rotation != 0) e.energy += e.gradient_r * lane.off.rotation;
    for (int k = 1; k <= T; ++k) {
        const Tube& tube = lane.tubes.tube[k];
        if (tube.slipping != 0) e.energy -= tube.slipping * tubes_.torque_limit[k] * tube.off;
    }
    return e;
}

// Newton's step of the drives that slip: the advance of the leading one and the rotation of each. As solve_drive.
template <class V, int T>
bool Stepper<V, T>::solve_tube_drives(int l) {
    Lane& lane = lane_[l];
    if (!tubes_slip(lane)) return true;
    constexpr int N = 2 + T;
    const DriveBlock& d = drive_;
    const double damping = get(damping_, l);
    double h[N][N] = {}, g[N] = {}, off[N], step[N] = {};
    int side[N];
    bool held[N];
    g[1] = get(d.gradient_r, l);
    h[0][0] = get(d.aa, l) + damping;
    h[1][0] = get(d.ar, l);
    h[1][1] = get(d.rr, l) + damping;
    for (int k = 0; k < T; ++k) {
        const int r = 2 + k;
        g[r] = get(d.twists.gradient[k], l);
        h[r][0] = get(d.twists.ap[k], l);
        h[r][1] = get(d.twists.rp[k], l);
        for (int c = 0; c <= k; ++c) h[r][2 + c] = get(d.twists.pp[k][c], l);
        h[r][r] += damping;
    }
    const DriveEnergy load = tube_drive_energy(lane);
    g[0] = get(d.gradient_a, l) + load.gradient_a;
    g[1] += load.gradient_r;
    side[0] = lane.slipping.advance, off[0] = lane.off.advance;
    side[1] = lane.slipping.rotation, off[1] = lane.off.rotation;
    for (int k = 1; k <= T; ++k) {
        const Tube& tube = lane.tubes.tube[k];
        side[k + 1] = tube.slipping, off[k + 1] = tube.off;
        g[k + 1] -= tube.slipping * tubes_.torque_limit[k];
    }
    for (int r = 0; r < N; ++r) {
        held[r] = side[r] == 0;
        for (int c = 0; c < r; ++c) h[c][r] = h[r][c];
    }
    for (bool again = true; again;) {  // an unknown that would go beyond its bound is held there
        double a[N][N], b[N];
        for (int r = 0; r < N; ++r) {
            b[r] = held[r] ? -off[r] : -g[r];
            for (int c = 0; c < N; ++c) {
                a[r][c] = held[r] ? double(r == c) : held[c] ? 0.0 : h[r][c];
                if (!held[r] && held[c]) b[r] += h[r][c] * off[c];
            }
        }
        for (int r = 0; r < N; ++r) {
            if (!(a[r][r] > 0)) return false;
            for (int s = r + 1; s < N; ++s) {
                const double f = a[s][r] / a[r][r];
                for (int c = r; c < N; ++c) a[s][c] -= f * a[r][c];
                b[s] -= f * b[r];
            }
        }
        for (int r = N - 1; r >= 0; --r) {
            for (int c = r + 1; c < N; ++c) b[r] -= a[r][c] * step[c];
            step[r] = b[r] / a[r][r];
        }
        again = false;
        for (int r = 0; r < N; ++r) {
            if (held[r] || !(side[r] * (off[r] + step[r]) > 0)) continue;
            held[r] = again = true;
        }
    }
    set(drive_a_, l, step[0]);
    set(drive_r_, l, step[1]);
    double descent = get(descent_, l);
    for (int r = 0; r < N; ++r) {
        if (r >= 2) set(of_tubes_.turn[r - 2], l, step[r]);
        if (side[r] != 0) descent -= g[r] * step[r];
    }
    set(descent_, l, descent);
    return true;
}

// As `release`; the lead bears its own limit of the force on all tubes, the others theirs by `pace_tubes`.
template <class V, int T>
bool Stepper<V, T>::release_tubes(int l) {
    Lane& lane = lane_[l];
    if (lane.releases == kMaxReleases) return false;
    const int lead = lane.tubes.lead;
    const double force = get(drive_.gradient_a, l) - lane.tubes.others;
    bool released = false;
    const auto let_go = [&](int& slipping, int side) {
        released = released || slipping != side;
        slipping = side;
    };
    if (lane.off.advance == 0 && force > tubes_.push_limit[lead]) let_go(lane.slipping.advance, 1);
    if (lane.off.advance == 0 && force < -tubes_.pull_limit[lead]) let_go(lane.slipping.advance, -1);
    const double first = get(drive_.gradient_r, l);
    for (int k = 1; k <= T; ++k) {
        Tube& tube = lane.tubes.tube[k];
        const double torque = get(drive_.twists.gradient[k - 1], l);
        if (tube.off == 0 && std::abs(torque) > tubes_.torque_limit[k]) let_go(tube.slipping, torque > 0 ? 1 : -1);
    }
    if (lane.off.rotation == 0 && std::abs(first) > tubes_.torque_limit[0]) let_go(lane.slipping.rotation, first > 0 ? 1 : -1);
    lane.releases += released;
    return released;
}

// The rotations of drives that slip, after Newton's step.
template <class V, int T>
void Stepper<V, T>::turn_tubes(int l, bool keeps, bool takes, bool shortens, double factor) {
    for (int k = 1; k <= T; ++k) {
        Tube& tube = lane_[l].tubes.tube[k];
        if (keeps) tube.from = tube.off;
        if (takes) tube.move = factor * get(of_tubes_.turn[k - 1], l);
        if (shortens) tube.move *= factor;
        if (!takes && !shortens) continue;
        tube.off = tube.from + tube.move;
        tube.end_rotation = tube.asked_rotation + tube.off;
    }
}

template <class V, int T>
void Stepper<V, T>::load_tubes(int l) {
    Lane& lane = lane_[l];
    const World w = world_[lane.world];
    double pushed = 0;
    lane.tubes.lead = 0;
    for (int k = 0; k <= T; ++k) {
        Tube& tube = lane.tubes.tube[k];
        const World::Numbers from = w.tube(rod_.nodes, k);
        tube = {};
        tube.inserted = tube.advanced = from[World::kTubeInserted];
        tube.rotation = tube.turned = tube.end_rotation = from[World::kTubeRotation];
        tube.last_rotation = from[World::kTubeLastTurned];
        tube.slipping = int(from[World::kTubeSlipping]);
        tube.depth = from[World::kTubeDepth];
        tube.pace = from[World::kTubePace];
        tube.yield = from[World::kTubeYield];
        tube.grip = from[World::kTubeGrip];
        tube.force = from[World::kTubeBaseForce];
        tube.torque = from[World::kTubeBaseTorque];
        pushed += tube.force;
        if (from[World::kTubeLeads] != 0) lane.tubes.lead = k;
        set(of_tubes_.friction[k], l, from[World::kTubeFriction]);
    }
    lane.tubes.others = pushed - lane.tubes.tube[lane.tubes.lead].force;
}

template <class V, int T>
void Stepper<V, T>::store_tubes(int l) {
    const Lane& lane = lane_[l];
    const World w = world_[lane.world];
    for (int k = 0; k <= T; ++k) {
        const Tube& tube = lane.tubes.tube[k];
        const World::Numbers to = w.tube(rod_.nodes, k);
        to[World::kTubeInserted] = tube.inserted;
        to[World::kTubeRotation] = tube.rotation;
        to[World::kTubeSpeed] = tube.speed;
        to[World::kTubeSpin] = tube.spin;
        to[World::kTubeLastTurned] = k == 0 ? lane.last.rotation : tube.last_rotation;
        to[World::kTubeSlipping] = tube.slipping;
        to[World::kTubeDepth] = tube.depth;
        to[World::kTubePace] = tube.pace;
        to[World::kTubeYield] = tube.yield;
        to[World::kTubeGrip] = tube.grip;
        to[World::kTubeLeads] = k == lane.tubes.lead;
        to[World::kTubeBaseForce] = tube.force;
        to[World::kTubeBaseTorque] = tube.torque;
    }
}

template <class V, int T>
void Stepper<V, T>::read_tube_controls(int l) {
    Lane& lane = lane_[l];
    const World w = world_[lane.world];
    bool same = true;
    for (int k = 0; k <= T; ++k) {
        Tube& tube = lane.tubes.tube[k];
        if (lane.sample < 0) {
            tube.speed = lane.sample == -1 ? 0.0 : (tube.depth - tube.inserted) / ((-lane.sample - 1) * sample_period());
            tube.spin = 0.0;
        } else {
            const double* control = in_.control + 2 * (T + 1) * (std::size_t(lane.world) * in_.samples + lane.sample) + 2 * k;
            tube.speed = control[0];
            tube.spin = control[1];
        }
        if (tube.inserted + tube.speed * sample_period() < -kOvershoot) {
            tube.refused = tube.inserted + tube.speed * sample_period();
            tube.speed = -tube.inserted / sample_period();
        }
        const World::Numbers was = w.tube(rod_.nodes, k);
        same = same && tube.speed == was[World::kTubeSpeed] && tube.spin == was[World::kTubeSpin];
    }
    if (!same) lane.last_duration = 0;  // do not extrapolate
}

// Where the sample has brought the tubes, and the loads of their drives.
template <class V, int T>
void Stepper<V, T>::end_tubes(int l) {
    Lane& lane = lane_[l];
    const World w = world_[lane.world];
    for (int k = 0; k <= T; ++k) {
        Tube& tube = lane.tubes.tube[k];
        tube.inserted += tube.speed * sample_period() - tube.slipped;
        tube.rotation += tube.spin * sample_period() - tube.rotation_slipped;
        if (lane.sample < 0) {
            tube.depth -= tube.slipped;
            if (lane.sample == -1) tube.inserted = tube.depth;  // exactly
        }
        const DriveEnergy valve = introducer({tube.end_advance - tube.advanced, tube.last_rotation}, tubes_.radius[k], l);
        const World::Numbers to = w.tube(rod_.nodes, k);
        to[World::kTubeDriveForce] = tube.force + valve.gradient_a;
        to[World::kTubeDriveTorque] = tube.torque + valve.gradient_r;
        lane.inserted = k == 0 ? tube.inserted : std::max(lane.inserted, tube.inserted);
    }
    const Tube& first = lane.tubes.tube[0];
    if (lane.sample < 0) {
        out_.approach_slip[2 * lane.world] += first.slipped;
        out_.approach_slip[2 * lane.world + 1] += first.rotation_slipped;
        w[World::kApproach] = -lane.sample - 1;
    }
    lane.rotation = first.rotation;
    lane.refused = first.refused;
    lane.slip = {first.slipped, first.rotation_slipped};
    w[World::kBaseForce] = first.force;
    w[World::kBaseTorque] = first.torque;
    w[World::kDriveForce] = w.tube(rod_.nodes, 0)[World::kTubeDriveForce];
    w[World::kDriveTorque] = w.tube(rod_.nodes, 0)[World::kTubeDriveTorque];
    for (int k = 0; k <= T; ++k) {
        const Tube& tube = lane.tubes.tube[k];
        const World::Numbers to = w.tube(rod_.nodes, k);
        to[World::kTubeSlip] = tube.slipped + tube.refused;
        to[World::kTubeRotationSlip] = tube.rotation_slipped;
    }
}

template <class V, int T>
void Stepper<V, T>::record_tubes(int world, int sample) const {
    const World w = world_[world];
    const std::size_t at = std::size_t(world) * in_.samples + sample;
    const Pose pose(rod_, base_, motion_, w);
    out_.inserted[at] = w.tube(rod_.nodes, 0)[World::kTubeInserted];
    for (int k = 0; k <= T; ++k) {
        const World::Numbers from = w.tube(rod_.nodes, k);
        double* to = out_.tubes + (at * (T + 1) + k) * kTubeOutputs;
        to[0] = from[World::kTubeInserted];
        to[1] = from[World::kTubeRotation];
        to[2] = from[World::kTubeBaseForce];
        to[3] = from[World::kTubeBaseTorque];
        to[4] = from[World::kTubeDriveForce];
        to[5] = from[World::kTubeDriveTorque];
        to[6] = from[World::kTubeSlip];
        to[7] = from[World::kTubeRotationSlip];
        const Vec3<double> tip = pose.tube_tip(k);
        const int i = tube_end(rod_, w, k).element;
        to[8] = tip.x, to[9] = tip.y, to[10] = tip.z;
        to[11] = 0;
        if (k > 0) to[11] = i < w.active() ? w.twists(rod_.nodes, T, i)[k - 1] : to[1] - w[World::kRotation];
    }
}

}  // namespace endopilot
