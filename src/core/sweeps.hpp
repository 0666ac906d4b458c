// The stepper's sweeps over the nodes of all lanes at once: evaluation with elimination, back substitution, update, and
// the end of a step.
#pragma once

#include "stepper.hpp"

namespace endopilot {

constexpr double kStickyReach = 0.1;     // mm: in a step's first iteration, a wall that was touched and is this near still holds
constexpr double kSteepest = 1.5;        // more than any slope of the spline through a distance map

template <class V, int T>
V Stepper<V, T>::add_loads(int i, const Node<V, T>& node, const Quaternion<V>& turned, Diagonal<V, T>& own) const {
    const Vec3<double>&f = loads_->force[i], &m = loads_->moment[i], &k = loads_->spring[i], &a = loads_->anchor[i];
    const Vec3<V> off{node.x.x - a.x, node.x.y - a.y, node.x.z - a.z};
    own.gradient_x += Vec3<V>{k.x * off.x - f.x, k.y * off.y - f.y, k.z * off.z - f.z};
    own.xx.xx += float(k.x);
    own.xx.yy += float(k.y);
    own.xx.zz += float(k.z);
    V energy = 0.5 * (k.x * off.x * off.x + k.y * off.y * off.y + k.z * off.z * off.z);
    energy -= f.x * node.x.x + f.y * node.x.y + f.z * node.x.z;
    // A moment's potential is its work since the start of the step: exact once the rod has come to rest.
    const Vec3<V> b{broadcast<V>(m.x), broadcast<V>(m.y), broadcast<V>(m.z)};
    const V along = dot(b, turned.v);
    energy -= 2.0 * along;
    own.gradient_theta -= turned.w * b + cross(b, turned.v);
    const double h = loads_->hold[i];
    const S bent = narrow(0.5 * along + h);
    own.tt.xx += bent;
    own.tt.yy += bent;
    own.tt.zz += bent;
    const Quaternion<double>& c = loads_->attitude[i];
    const Quaternion<V> attitude{broadcast<V>(c.w), {broadcast<V>(c.v.x), broadcast<V>(c.v.y), broadcast<V>(c.v.z)}};
    const Quaternion<V> r = relative(attitude, node.q);
    energy += 2.0 * h * dot(r.v, r.v);
    own.gradient_theta += (2.0 * h * r.w) * r.v;
    return energy;
}

// Energy, gradient and Hessian at the trial point, eliminated from tip to base. A few nodes at a time, part by part:
// within a part the nodes do not wait for each other, and what passes between parts stays in the fastest cache.
template <class V, int T>
void Stepper<V, T>::evaluate(int n) {
    energy_ = descent_ = jump_ = rise_ = V{};
    pivot_ = hit_ = broadcast<V>(1.0);
    block_[0] = Diagonal<V, T>{};
    carried_ = Carried<V, T>{};
    for (int first = 0; first < n; first += kTogether) {
        const int count = std::min(int{kTogether}, n - first);
        add_rod(first, count);
        add_surroundings(first, count);
        eliminate_nodes(first, count);
        block_[0] = block_[count];
    }
}

// Elements and joints of `count` nodes from `first` on; the force and torque that the base exerts on the wire.
template <class V, int T>
void Stepper<V, T>::add_rod(int first, int count) {
    const Vec3<V>& axis = axis_;
    for (int k = 0; k < count; ++k) {
        const int i = first + k;
        const Node<V, T> &node = node_[i], &behind = node_[i + 1];
        Diagonal<V, T>&own = block_[k], &next = block_[k + 1];
        const bool at_base = is_base(i + 1);
        const Mask<V> last = active_ == broadcast<V>(i + 1);
        const double length = rod_.length[i];
        V energy;
        if constexpr (T == 0)
            energy = add_element(length, rod_.shear[i], rod_.stretch[i], geometric_, node.x, behind.x, frame(node.q), own, next, link_[k]);
        else
            energy = add_element(length, node.tubes.shear, node.tubes.stretch, geometric_, node.x, behind.x, frame(node.q), own, next, link_[k]);
        const V one = broadcast<V>(1.0), share = at_base ? select<V>(last, share_, one) : one;
        const V inverse_share = at_base ? one / share : one;
        if constexpr (T == 0)
            energy += add_joint(rod_, i + 1, geometric_, share, inverse_share, node.q, behind.q, own, next, link_[k]);
        else
            energy += add_tube_joint(rod_.joint_length[i + 1], behind.tubes.joint, geometric_, share, inverse_share, node.q, behind.q,
                                     node.tubes.twist, behind.tubes.twist, own, next, link_[k]);
        energy_ += select<V>(active_ > broadcast<V>(i), energy, V{});
        if (!at_base) continue;
        const Vec3<V>& force = next.gradient_x;  // its component along the axis is the force that the base must exert
        base_force_ = select<V>(last, axis.x * force.x + axis.y * force.y + axis.z * force.z, base_force_);
        base_torque_[0] = select<V>(last, next.gradient_theta.z, base_torque_[0]);
        // the element's stiffness for the drive comes with what is carried to the base
        DriveBlock at_drive;
        at_drive.gradient[0] = base_force_;
        at_drive.gradient[1] = base_torque_[0];
        at_drive.h(1, 1) = widen<V>(next.tt.zz);
        if constexpr (T > 0) {
            for (int p = 0; p < T; ++p) {
                base_torque_[1 + p] = select<V>(last, next.twists.gradient[p], base_torque_[1 + p]);
                at_drive.gradient[2 + p] = next.twists.gradient[p];
                at_drive.h(2 + p, 1) = widen<V>(next.twists.pt[p][2]);
                for (int c = 0; c <= p; ++c) at_drive.h(2 + p, 2 + c) = widen<V>(next.twists.pp[p][c]);
            }
        }
        drive_ = select(last, at_drive, drive_);
    }
}

// Whether a lane's first node that follows the drive is node i.
template <class V, int T>
bool Stepper<V, T>::is_base(int i) const {
    bool any = false;
    for (const Lane& lane : lane_) any = any || lane.active == i;
    return any;
}

// The gradient and Hessian with respect to the drive's advance and rotation that the nodes ahead carry to one that follows the drive.
template <class V, int T>
typename Stepper<V, T>::DriveBlock Stepper<V, T>::drive_block(const Carried<V, T>& carried) const {
    const Vec3<S> axis = narrow(axis_);
    const Vec3<S> across{carried.tx[2][0], carried.tx[2][1], carried.tx[2][2]};
    DriveBlock block;
    block.gradient[0] = widen<V>(dot(axis, carried.gradient_x));
    block.gradient[1] = widen<V>(carried.gradient_theta.z);
    block.h(0, 0) = widen<V>(dot(axis, carried.xx * axis));
    block.h(1, 0) = widen<V>(dot(axis, across));
    block.h(1, 1) = widen<V>(carried.tt.zz);
    if constexpr (T > 0) {
        for (int k = 0; k < T; ++k) {
            const S(&px)[3] = carried.twists.px[k];
            block.gradient[2 + k] = widen<V>(carried.twists.gradient[k]);
            block.h(2 + k, 0) = widen<V>(axis.x * px[0] + axis.y * px[1] + axis.z * px[2]);
            block.h(2 + k, 1) = widen<V>(carried.twists.pt[k][2]);
            for (int c = 0; c <= k; ++c) block.h(2 + k, 2 + c) = widen<V>(carried.twists.pp[k][c]);
        }
    }
    return block;
}

// Whether any lane's contact point may be within reach of the wall, going by how far it has moved since the wall was evaluated.
template <class V, int T>
template <class Radius>
bool Stepper<V, T>::near_wall(const ContactPoint<V>& point, const Vec3<V>& x, const Radius& radius, Mask<V> on) {
    const Vec3<V> moved = x - point.evaluated;
    const V spare = point.clearance - (radius + kStickyReach);
    const Mask<V> clear = (spare > V{}) & (spare * spare > kSteepest * kSteepest * dot(moved, moved));  // false for NaN
    return any<V>(on & ~clear);
}

// The wall's spring at node i and at the middle of the element behind it. A compliant wall yields along the wire: half an element
// stands for its middle, and a quarter of either one for the node between them. The tip takes more of the wall along.
template <class V, int T>
WallSpring Stepper<V, T>::spring_at_node(int i) const {
    if (options_.foundation == 0) return {options_.wall_stiffness, 0};
    const double along = 0.25 * (rod_.length[i] + (i > 0 ? rod_.length[i - 1] : 0.0)) + (i > 0 ? 0.0 : options_.tip_takes_along);
    return {options_.foundation * along, options_.foundation_stiffening};
}

template <class V, int T>
WallSpring Stepper<V, T>::spring_at_middle(int i) const {
    if (options_.foundation == 0) return {options_.wall_stiffness, 0};
    return {0.5 * options_.foundation * rod_.length[i], options_.foundation_stiffening};
}

// The wall's reaction and friction at one contact point of the lanes in `on`: at x, moved by `moved` since the step's start.
// Returns whether anything was added to `block`.
template <class V, int T>
template <class Radius>
bool Stepper<V, T>::add_contact(ContactPoint<V>& point, const Vec3<V>& x, const Vec3<V>& moved, const Quaternion<V>& turned,
                                const WallSpring& spring, const Radius& radius, const Touching<V, T>& touching, Mask<V> on, Diagonal<V, T>& block) {
    const V zero{};
    point.last_gap = select<V>(accepted_, point.gap, point.last_gap);
    point.gap = broadcast<V>(kStickyReach);
    const Vec3<V> at = motion_.cycles > 0 ? wall_.to_vessel(x) : x;   // where the distance map is asked
    const bool near = near_wall(point, at, radius, on), rubs = any<V>(on & ~(point.friction.limit <= zero));  // a NaN goes on
    if (near) {
        Distance<V> d = distance_to_wall(*lumen_, at);
        if (motion_.cycles > 0) wall_.to_laboratory(d.gradient, d.hessian);
        point.gap = minimum<V>(d.value - radius, point.gap);
        const Mask<V> hits = on & (point.last_gap > zero) & (point.gap < zero);
        if (any<V>(hits)) hit_ = select<V>(hits, minimum<V>(hit_, point.last_gap / (point.last_gap - point.gap)), hit_);
        point.evaluated = at;
        point.clearance = d.value;
        point.wall = {d.value, d.gradient};
        d.value = select<V>(on, d.value, broadcast<V>(Lumen::kDeep));
        const Mask<V> sticky = (first_ > zero) & (point.friction.limit > zero) & (d.value < radius + kStickyReach);
        energy_ += add_wall<V, T, Radius>(spring, radius, geometric_, sticky, d, block);
    } else {
        point.wall = {broadcast<V>(Lumen::kDeep), {zero, zero, zero}};
    }
    if (rubs) energy_ += select<V>(on, add_friction(point.friction, eps_, tangent_, moved, turned, touching, block), zero);
    return near || rubs;
}

// What acts on `count` nodes from `first` on from outside; the slope of the energy along the last move.
template <class V, int T>
void Stepper<V, T>::add_surroundings(int first, int count) {
    for (int k = 0; k < count; ++k) {
        const int i = first + k;
        const Node<V, T>& node = node_[i];
        const Vec3<V> moved = node.x - node.start;
        const Quaternion<V> turned = relative(node.start_q, node.q);
        Diagonal<V, T>& own = block_[k];
        if (lumen_) add_lumen(k, i, moved, turned);
        add_drag(i, moved, turned, own);
        V rise = dot(own.gradient_x, node.step) + dot(own.gradient_theta, node.turn);
        if constexpr (T > 0)
            for (int p = 0; p < T; ++p) rise += own.twists.gradient[p] * node.tubes.step[p];
        rise_ += select<V>(active_ > broadcast<V>(i), rise, V{});
    }
}

// Contact at node i, the group's k-th, and at the middle of the element behind it. The middle of the element that joins the base touches nothing.
template <class V, int T>
void Stepper<V, T>::add_lumen(int k, int i, const Vec3<V>& moved, const Quaternion<V>& turned) {
    const V half = broadcast<V>(0.5);
    Node<V, T>& node = node_[i];
    const Node<V, T>& behind = node_[i + 1];
    const Mask<V> on = active_ > broadcast<V>(i), middle_on = active_ > broadcast<V>(i + 1);
    const Vec3<V> middle = half * (node.x + behind.x) + node.at_middle.offset, middle_moved = half * (moved + (behind.x - behind.start));
    const WallSpring at_node = spring_at_node(i), at_middle = spring_at_middle(i);
    bool touches;
    if constexpr (T == 0) {
        add_contact(node.at_node, node.x + node.at_node.offset, moved, turned, at_node, rod_.radius[i], {}, on, block_[k]);
        touches = add_contact(node.at_middle, middle, middle_moved, turned, at_middle, rod_.radius[i], {}, middle_on, middle_);
    } else {
        const auto touching = [&](const TubeContact<V, T>& contact) {
            Touching<V, T> t{.weight = {}, .twisted = {}, .spin = contact.spin};
            for (int p = 0; p < T; ++p) {
                t.weight[p] = contact.weight[p];
                t.twisted[p] = node.tubes.twist[p] - node.tubes.start[p];
            }
            return t;
        };
        const TubeContact<V, T>&here = node.tubes.at_node, &there = node.tubes.at_middle;
        add_contact(node.at_node, node.x + node.at_node.offset, moved + here.slide, turned, at_node, here.radius, touching(here), on, block_[k]);
        touches = add_contact(node.at_middle, middle, middle_moved + there.slide, turned, at_middle, there.radius, touching(there), middle_on, middle_);
    }
    if (!touches) return;
    add_middle(middle_, block_[k], block_[k + 1], link_[k]);
    middle_ = Diagonal<V, T>{};
}

// Drag, damping and loads of node i; how far it has moved in the step.
template <class V, int T>
void Stepper<V, T>::add_drag(int i, const Vec3<V>& moved, const Quaternion<V>& turned, Diagonal<V, T>& own) {
    const Mask<V> on = active_ > broadcast<V>(i);
    const V moved2 = dot(moved, moved), turned2 = dot(turned.v, turned.v);
    jump_ = select<V>(on, maximum<V>(jump_, maximum<V>(jump_scale_x_ * moved2, jump_scale_theta_ * turned2)), jump_);
    const V drag = rod_.drag[i] * inverse_dt_, spin_drag = rod_.spin_drag[i] * inverse_dt_;
    V energy = 0.5 * drag * moved2 + 2.0 * spin_drag * turned2;
    if (loads_) energy += add_loads(i, node_[i], turned, own);
    if constexpr (T > 0) {
        const TubeNode<V, T>& tubes = node_[i].tubes;
        energy += add_interfaces(node_[i], own);
        for (int k = 0; k < T; ++k) {
            const V turn = tubes.twist[k] - tubes.start[k] + 2.0 * turned.v.z, turn2 = turn * turn, torque = spin_drag * turn;
            jump_ = select<V>(on, maximum<V>(jump_, 0.25 * jump_scale_theta_ * turn2), jump_);
            energy += 0.5 * torque * turn;
            own.twists.gradient[k] += torque;
            own.gradient_theta += torque * Vec3<V>{-turned.v.y, turned.v.x, turned.w - 1.0};
            own.twists.pp[k][k] += narrow(spin_drag + damping_);
        }
    }
    energy_ += select<V>(on, energy, V{});
    own.gradient_x += drag * moved;
    own.gradient_theta += (2.0 * spin_drag * turned.w) * turned.v;
    const S stiffen = narrow(drag + damping_), spin_stiffen = narrow(spin_drag + damping_);
    own.xx.xx += stiffen;
    own.xx.yy += stiffen;
    own.xx.zz += stiffen;
    own.tt.xx += spin_stiffen;
    own.tt.yy += spin_stiffen;
    own.tt.zz += spin_stiffen;
}

template <class V, int T>
void Stepper<V, T>::eliminate_nodes(int first, int count) {
    const V zero{};
    for (int k = 0; k < count; ++k) {
        const int i = first + k;
        const Mask<V> on = active_ > broadcast<V>(i);
        const Elimination<V> eliminated = eliminate(block_[k], link_[k], carried_, factor_[i]);
        descent_ += select<V>(on, widen<V>(eliminated.descent), zero);
        const Mask<V> sound = widen<V>(eliminated.smallest_pivot) > zero;
        pivot_ = select<V>(on, select<V>(sound, pivot_, zero), pivot_);
        if (is_base(i + 1)) drive_ = select(active_ == broadcast<V>(i + 1), drive_ + drive_block(carried_), drive_);
    }
}

// Back substitution. Returns the largest displacement (mm) or rotation (rad) of a node; NaN where the solve failed.
template <class V, int T>
V Stepper<V, T>::solve(int n) {
    const Vec3<S> drive_x = narrow(drive_step_[0] * axis_);
    const Vec3<S> drive_t{S{}, S{}, narrow(drive_step_[1])};
    const S active = narrow(active_);
    Vec3<S> x = drive_x, t = drive_t;
    S largest = dot(x, x) + dot(t, t);  // rounded as for the nodes of a shorter wire, which follow the drive
    S twist[T + 1]{}, drive_twist[T + 1]{};   // one more than there are: none is no array
    if constexpr (T > 0) {
        for (int k = 0; k < T; ++k) {
            twist[k] = drive_twist[k] = narrow(drive_step_[2 + k]);
            largest += twist[k] * twist[k];
        }
    }
    for (int i = n - 1; i >= 0; --i) {
        const Mask<S> on = active > broadcast<S>(i);
        substitute(factor_[i], x, t, twist);
        x = select(on, x, drive_x);  // the base of a shorter wire follows its drive
        t = select(on, t, drive_t);
        factor_[i].z[0] = x.x;
        factor_[i].z[1] = x.y;
        factor_[i].z[2] = x.z;
        factor_[i].z[3] = t.x;
        factor_[i].z[4] = t.y;
        factor_[i].z[5] = t.z;
        S both = dot(x, x) + dot(t, t);
        if constexpr (T > 0) {
            for (int k = 0; k < T; ++k) {
                twist[k] = select<S>(on, twist[k], drive_twist[k]);
                factor_[i].z[6 + k] = twist[k];
                both += twist[k] * twist[k];
            }
        }
        largest = largest >= both ? largest : both;  // keeps a NaN of `both`; below, of `largest`
        largest = select<S>(both == both, largest, both);
    }
    return square_root(widen<V>(largest));
}

// Moves each lane's trial point by its decision: by `factor` times Newton's step where that is accepted, back to
// `factor` times its last move where that is shortened.
template <class V, int T>
void Stepper<V, T>::update(int n, const Decision (&decision)[W], const V& factor) {
    Mask<V> accept{}, shorten{}, repeat{};
    for (int l = 0; l < W; ++l) {
        set_mask<V>(accept, l, decision[l] == Decision::accept || decision[l] == Decision::converged);
        set_mask<V>(shorten, l, decision[l] == Decision::shorten);
        set_mask<V>(repeat, l, decision[l] == Decision::repeat);
    }
    for (int i = 0; i < n; ++i) {
        Node<V, T>& node = node_[i];
        const Mask<V> on = active_ > broadcast<V>(i);
        const S* z = factor_[i].z;
        const Vec3<V> step = factor * widen<V>(Vec3<S>{z[0], z[1], z[2]}), turn = factor * widen<V>(Vec3<S>{z[3], z[4], z[5]});
        const Mask<V> take = accept & on, shrink = shorten & on;
        const Mask<V> moves = take | shrink, keeps = take | (repeat & on);
        node.from = select(keeps, node.x, node.from);
        node.from_q = select(keeps, node.q, node.from_q);
        node.step = select(take, step, select(shrink, factor * node.step, node.step));
        node.turn = select(take, turn, select(shrink, factor * node.turn, node.turn));
        node.x = select(moves, node.from + node.step, node.x);
        node.q = select(moves, rotated(node.from_q, node.turn), node.q);
        if constexpr (T > 0) {
            TubeNode<V, T>& tubes = node.tubes;
            for (int k = 0; k < T; ++k) {
                const V turned = factor * widen<V>(z[6 + k]);
                tubes.from[k] = select<V>(keeps, tubes.twist[k], tubes.from[k]);
                tubes.step[k] = select<V>(take, turned, select<V>(shrink, factor * tubes.step[k], tubes.step[k]));
                tubes.twist[k] = select<V>(moves, tubes.from[k] + (tubes.step[k] - node.turn.z), tubes.twist[k]);
            }
        }
    }
    for (int l = 0; l < W; ++l) move_drives(l, decision[l], get(factor, l));
}

// Freezes the wall at a contact point that has come to rest after the move `step`: friction in the coming step then has a potential.
template <class V, int T>
template <class Radius>
void Stepper<V, T>::freeze(ContactPoint<V>& point, const Vec3<V>& step, const Vec3<V>& axis, const WallSpring& spring, const Radius& radius,
                           const V& friction, Mask<V> on, const V& weight) const {
    const V zero{}, one = broadcast<V>(1.0);
    const Vec3<V>& gradient = point.wall.gradient;
    const V distance = point.wall.distance + dot(gradient, step);
    const V norm = square_root(dot(gradient, gradient));
    const Mask<V> touches = (distance < radius) & (norm > 1e-3);
    const V push = select<V>(touches, spring.force<V>(radius - distance) * norm, zero);
    // friction in the coming step acts with the normal force at its middle, extrapolated
    V ahead = push + select<V>(point.normal_force > zero, 0.5 * weight * (push - point.normal_force), zero);
    ahead = select<V>(ahead > 2.0 * push, 2.0 * push, ahead);
    ahead = select<V>(ahead > zero, ahead, zero);
    point.normal_force = select<V>(on, push, point.normal_force);
    const V inverse = select<V>(touches, one / norm, zero);
    const Vec3<V> normal = inverse * gradient;
    point.friction.limit = select<V>(on, friction * ahead, point.friction.limit);
    point.friction.normal = select(on, normal, point.friction.normal);
    point.friction.spin_arm = select(on, (V{} + radius) * cross(normal, axis), point.friction.spin_arm);
}

// Freezes the walls that friction acts on and the curve's offsets from the polygon, for the converged lanes in `mask`.
template <class V, int T>
void Stepper<V, T>::freeze_contacts(int n, Mask<V> mask, const V& weight) {
    const auto direction = [&](int i) { return broadcast<V>(1.0 / rod_.length[i]) * (node_[i].x - node_[i + 1].x); };
    Vec3<V> ahead = direction(0), behind = direction(1);   // of the elements ahead of a joint and behind it
    Vec3<V> bent = broadcast<V>(1.0 / rod_.joint_length[1]) * (ahead - behind);   // curvature vector at the node: at the tip, of the first joint
    for (int i = 0; i < n; ++i) {
        Node<V, T>& node = node_[i];
        const Mask<V> on = mask & (active_ > broadcast<V>(i)), middle = mask & (active_ > broadcast<V>(i + 1));
        const Vec3<V> axis = frame(node.q).d3;
        const Vec3<V> middle_step = broadcast<V>(0.5) * (node.step + node_[i + 1].step);
        if constexpr (T == 0) {
            freeze(node.at_node, node.step, axis, spring_at_node(i), rod_.radius[i], friction_[0], on, weight);
            freeze(node.at_middle, middle_step, axis, spring_at_middle(i), rod_.radius[i], friction_[0], middle, weight);
        } else {
            const TubeContact<V, T>&here = node.tubes.at_node, &there = node.tubes.at_middle;
            freeze(node.at_node, node.step, axis, spring_at_node(i), here.radius, here.friction, on, weight);
            freeze(node.at_middle, middle_step, axis, spring_at_middle(i), there.radius, there.friction, middle, weight);
        }
        const Vec3<V> bent_behind = broadcast<V>(1.0 / rod_.joint_length[i + 1]) * (ahead - behind);
        const double l = rod_.length[i], around = i > 0 ? rod_.length[i - 1] * l / 24 : l * l / 8;
        node.at_node.offset = select(on, broadcast<V>(around) * bent, node.at_node.offset);
        node.at_middle.offset = select(middle, broadcast<V>(-l * l / 24) * (bent + bent_behind), node.at_middle.offset);
        bent = bent_behind;
        ahead = behind;
        behind = direction(std::min(i + 2, rod_.nodes - 2));
    }
}

// For the lanes in `mask`, makes the converged trial the start of the next step and sets a new trial by extrapolation; for
// those in `restart`, goes back to the start of the step.
template <class V, int T>
void Stepper<V, T>::finish_step(int n, Mask<V> mask, Mask<V> restart, const V& weight) {
    const V zero{};
    if (lumen_) freeze_contacts(n, mask, weight);
    if constexpr (T > 0)
        for (int l = 0; l < W; ++l)
            if (holds<V>(mask, l)) freeze_tubes(l, true);
    for (int i = 0; i < n; ++i) {
        Node<V, T>& node = node_[i];
        const Mask<V> on = mask & (active_ > broadcast<V>(i));
        const Mask<V> back = restart & (active_ > broadcast<V>(i));
        const Quaternion<V> turned_by = relative(node.start_q, node.q);
        node.last = select(on, node.x - node.start, node.last);
        node.last_turn = select(on, broadcast<V>(2.0) * turned_by.v, node.last_turn);
        node.start = select(on, node.x, node.start);
        node.start_q = select(on, node.q, node.start_q);
        node.x = select(on, node.start + weight * node.last, select(back, node.start, node.x));
        node.q = select(on, rotated(node.start_q, weight * node.last_turn), select(back, node.start_q, node.q));
        node.step = select(on, {zero, zero, zero}, node.step);
        node.turn = select(on, {zero, zero, zero}, node.turn);
        if constexpr (T > 0) {
            TubeNode<V, T>& tubes = node.tubes;
            for (int k = 0; k < T; ++k) {
                tubes.last[k] = select<V>(on, tubes.twist[k] - tubes.start[k], tubes.last[k]);
                tubes.start[k] = select<V>(on, tubes.twist[k], tubes.start[k]);
                tubes.twist[k] = select<V>(on, tubes.start[k] + weight * tubes.last[k], select<V>(back, tubes.start[k], tubes.twist[k]));
                tubes.step[k] = select<V>(on, zero, tubes.step[k]);
            }
        }
    }
}

}  // namespace endopilot
