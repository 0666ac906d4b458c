// Energy, gradient and Hessian at the trial points of all lanes, and their elimination from tip to base.
#pragma once

#include "coaxial.hpp"
#include "state.hpp"

namespace endopilot {

constexpr double kStickyReach = 0.1;     // mm: in a step's first iteration, a wall that was touched and is this near still holds

// Whether a lane's first node that follows the drive is node i.
template <class V, int T>
ENDOPILOT_DEVICE bool is_base(const Lanes<V, T>& lanes, int i) {
    bool any = false;
    for (const Lane<T>& lane : lanes.lane) any = any || lane.active == i;
    return any;
}

// Element and joint behind each of `count` nodes from `first` on; the force and torque that the base exerts on the wire.
template <class V, int T>
ENDOPILOT_LARGE void add_rod(const RodModel& rod, Lanes<V, T>& lanes, int first, int count) {
    const TimeStep<V, T>& step = lanes.step;
    const Single<V>& geometric = lanes.terms.geometric;
    Evaluation<V, T>& found = lanes.found;
    for (int k = 0; k < count; ++k) {
        const int i = first + k;
        const Node<V, T> &node = lanes.node[i], &behind = lanes.node[i + 1];
        Diagonal<V, T>&own = lanes.system.block[k], &next = lanes.system.block[k + 1];
        Link<V, T>& link = lanes.system.link[k];
        const bool at_base = is_base(lanes, i + 1);
        const Mask<V> last = step.active == broadcast<V>(i + 1);
        const V one = broadcast<V>(1.0), share = at_base ? select<V>(last, step.last_joint, one) : one;
        const V inverse_share = at_base ? one / share : one;
        V energy;
        if constexpr (T == 0) {
            energy = add_element(rod.length[i], rod.shear[i], rod.stretch[i], geometric, node.x, behind.x, frame(node.q), own, next, link);
            energy += add_joint(rod, i + 1, geometric, share, inverse_share, node.q, behind.q, own, next, link);
        } else {
            const TubeNode<V, T>&tubes = node.tubes, &tubes_behind = behind.tubes;
            energy = add_element(rod.length[i], tubes.shear, tubes.stretch, geometric, node.x, behind.x, frame(node.q), own, next, link);
            energy += add_tube_joint(rod.joint_length[i + 1], tubes_behind.joint, geometric, share, inverse_share, node.q, behind.q,
                                     tubes.twist, tubes_behind.twist, own, next, link);
        }
        found.energy += select<V>(step.active > broadcast<V>(i), energy, V{});
        if (!at_base) continue;
        const Vec3<V>&force = next.gradient_x, &axis = step.axis;   // its component along the axis is the force that the base must exert
        found.base_force = select<V>(last, axis.x * force.x + axis.y * force.y + axis.z * force.z, found.base_force);
        found.base_torque[0] = select<V>(last, next.gradient_theta.z, found.base_torque[0]);
        // the element's stiffness for the drive comes with what is carried to the base
        DriveBlock<V, T> at_drive;
        at_drive.gradient[0] = found.base_force;
        at_drive.gradient[1] = found.base_torque[0];
        at_drive.h(1, 1) = widen<V>(next.tt.zz);
        for (int p = 0; p < T; ++p) {
            found.base_torque[1 + p] = select<V>(last, next.twists.gradient[p], found.base_torque[1 + p]);
            at_drive.gradient[2 + p] = next.twists.gradient[p];
            at_drive.h(2 + p, 1) = widen<V>(next.twists.pt[p][2]);
            for (int c = 0; c <= p; ++c) at_drive.h(2 + p, 2 + c) = widen<V>(next.twists.pp[p][c]);
        }
        found.drive = select(last, at_drive, found.drive);
    }
}

// Whether any lane's contact point may be within reach of the wall, going by how far it has moved since the wall was evaluated.
template <class V, class Radius>
ENDOPILOT_DEVICE bool near_wall(const ContactPoint<V>& point, double steepest, const Vec3<V>& x, const Radius& radius, Mask<V> on) {
    const Vec3<V> moved = x - point.evaluated;
    const V spare = point.clearance - (radius + kStickyReach);
    const Mask<V> clear = (spare > V{}) & (spare * spare > steepest * steepest * dot(moved, moved));  // false for NaN
    return any<V>(on & ~clear);
}

// The wall's spring at node i and at the middle of the element behind it. A compliant wall gives way along the wire: half an element
// stands for its middle, and a quarter of either one for the node between them. The tip displaces more of the wall.
ENDOPILOT_DEVICE inline WallSpring spring_at_node(const Scene& scene, int i) {
    const Options& options = scene.options;
    if (options.foundation == 0) return {options.wall_stiffness, 0};
    const double* length = scene.rod.length;
    const double along = 0.25 * (length[i] + (i > 0 ? length[i - 1] : 0.0)) + (i > 0 ? 0.0 : options.foundation_at_tip);
    return {options.foundation * along, options.foundation_stiffening};
}

ENDOPILOT_DEVICE inline WallSpring spring_at_middle(const Scene& scene, int i) {
    const Options& options = scene.options;
    if (options.foundation == 0) return {options.wall_stiffness, 0};
    return {0.5 * options.foundation * scene.rod.length[i], options.foundation_stiffening};
}

// What touches the wall at node i, and at the middle of the element behind it.
template <class V, int T>
ENDOPILOT_DEVICE decltype(auto) surface_at_node(const RodModel& rod, const Lanes<V, T>& lanes, int i) {
    if constexpr (T == 0) return Surface<V, 0>{rod.radius[i], lanes.step.friction[0], {}};
    else return (lanes.node[i].tubes.at_node);
}

template <class V, int T>
ENDOPILOT_DEVICE decltype(auto) surface_at_middle(const RodModel& rod, const Lanes<V, T>& lanes, int i) {
    if constexpr (T == 0) return surface_at_node(rod, lanes, i);
    else return (lanes.node[i].tubes.at_middle);
}

// The wall's reaction and friction at one contact point of the lanes in `on`: at x, moved by `moved` since the step's start. Adds them
// to `block`, and returns whether there are any.
template <class V, int T, class Radius>
ENDOPILOT_LARGE bool add_contact(const Scene& scene, Lanes<V, T>& lanes, ContactPoint<V>& point, const Vec3<V>& x, const Vec3<V>& moved,
                                 const Quaternion<V>& turned, const WallSpring& spring, const Radius& radius, const Touching<V, T>& touching,
                                 Mask<V> on, Diagonal<V, T>& block) {
    const V zero{};
    Evaluation<V, T>& found = lanes.found;
    point.last_gap = select<V>(lanes.accepted, point.gap, point.last_gap);
    point.gap = broadcast<V>(kStickyReach);
    const bool moves = scene.motion.cycles > 0;
    const Vec3<V> at = moves ? lanes.step.vessel.to_vessel(x) : x;   // where the distance map is asked
    const bool near = near_wall(point, scene.lumen.steepest, at, radius, on), rubs = any<V>(on & ~(point.friction.limit <= zero));  // a NaN goes on
    if (near) {
        Distance<V> d = distance_to_wall(scene.lumen, at);
        if (moves) lanes.step.vessel.to_laboratory(d.gradient, d.hessian);
        point.gap = minimum<V>(d.value - radius, point.gap);
        const Mask<V> hits = on & (point.last_gap > zero) & (point.gap < zero);
        if (any<V>(hits)) found.first_hit = select<V>(hits, minimum<V>(found.first_hit, point.last_gap / (point.last_gap - point.gap)), found.first_hit);
        point.evaluated = at;
        point.clearance = d.value;
        point.wall = {d.value, d.gradient};
        d.value = select<V>(on, d.value, broadcast<V>(Lumen::kDeep));
        const Mask<V> sticky = (lanes.terms.first > zero) & (point.friction.limit > zero) & (d.value < radius + kStickyReach);
        found.energy += add_wall<V, T, Radius>(spring, radius, lanes.terms.geometric, sticky, d, block);
    } else {
        point.wall = {broadcast<V>(Lumen::kDeep), {zero, zero, zero}};
    }
    if (rubs)
        found.energy += select<V>(on, add_friction(point.friction, lanes.step.eps, lanes.terms.tangent, moved, turned, touching, block), zero);
    return near || rubs;
}

// Contact at node i, the group's k-th, and at the middle of the element behind it. The middle of the element that joins the base touches nothing.
template <class V, int T>
ENDOPILOT_DEVICE void add_lumen(const Scene& scene, Lanes<V, T>& lanes, int k, int i, const Vec3<V>& moved, const Quaternion<V>& turned) {
    const V half = broadcast<V>(0.5);
    Node<V, T>& node = lanes.node[i];
    const Node<V, T>& behind = lanes.node[i + 1];
    System<V, T>& system = lanes.system;
    const Mask<V> on = lanes.step.active > broadcast<V>(i), middle_on = lanes.step.active > broadcast<V>(i + 1);
    const Vec3<V> middle = half * (node.x + behind.x) + node.at_middle.offset, middle_moved = half * (moved + (behind.x - behind.start));
    const auto& here = surface_at_node(scene.rod, lanes, i);
    const auto& there = surface_at_middle(scene.rod, lanes, i);
    add_contact(scene, lanes, node.at_node, node.x + node.at_node.offset, slid(moved, here), turned, spring_at_node(scene, i), here.radius,
                touching(node.tubes, here), on, system.block[k]);
    if (!add_contact(scene, lanes, node.at_middle, middle, slid(middle_moved, there), turned, spring_at_middle(scene, i), there.radius,
                     touching(node.tubes, there), middle_on, system.middle))
        return;
    add_middle(system.middle, system.block[k], system.block[k + 1], system.link[k]);
    system.middle = Diagonal<V, T>{};
}

// Dead loads and springs on node i and the element behind it.
template <class V, int T>
ENDOPILOT_DEVICE V add_loads(const Loads& loads, int i, const Node<V, T>& node, const Quaternion<V>& turned, Diagonal<V, T>& own) {
    const Vec3<double>&f = loads.force[i], &m = loads.moment[i], &k = loads.spring[i], &a = loads.anchor[i];
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
    const double h = loads.hold[i];
    const Single<V> bent = narrow(0.5 * along + h);
    own.tt.xx += bent;
    own.tt.yy += bent;
    own.tt.zz += bent;
    const Quaternion<double>& c = loads.attitude[i];
    const Quaternion<V> attitude{broadcast<V>(c.w), {broadcast<V>(c.v.x), broadcast<V>(c.v.y), broadcast<V>(c.v.z)}};
    const Quaternion<V> r = relative(attitude, node.q);
    energy += 2.0 * h * dot(r.v, r.v);
    own.gradient_theta += (2.0 * h * r.w) * r.v;
    return energy;
}

// Drag, loads, friction between devices and damping of node i; how far it has moved in the step.
template <class V, int T>
ENDOPILOT_DEVICE void add_drag(const Scene& scene, Lanes<V, T>& lanes, int i, const Vec3<V>& moved, const Quaternion<V>& turned, Diagonal<V, T>& own) {
    const TimeStep<V, T>& step = lanes.step;
    const V& damping = lanes.terms.damping;
    V& jump = lanes.found.jump;
    const Mask<V> on = step.active > broadcast<V>(i);
    const V moved2 = dot(moved, moved), turned2 = dot(turned.v, turned.v);
    jump = select<V>(on, maximum<V>(jump, maximum<V>(step.jump_scale_x * moved2, step.jump_scale_theta * turned2)), jump);
    const V drag = scene.rod.drag[i] * step.inverse_dt, spin_drag = scene.rod.spin_drag[i] * step.inverse_dt;
    V energy = 0.5 * drag * moved2 + 2.0 * spin_drag * turned2;
    if (scene.loads.force) energy += add_loads(scene.loads, i, lanes.node[i], turned, own);
    if constexpr (T > 0) energy += add_interfaces(scene.tubes, lanes, lanes.node[i], own);
    const TubeNode<V, T>& tubes = lanes.node[i].tubes;
    for (int k = 0; k < T; ++k) {
        const V turn = tubes.twist[k] - tubes.start[k] + 2.0 * turned.v.z, turn2 = turn * turn, torque = spin_drag * turn;
        jump = select<V>(on, maximum<V>(jump, 0.25 * step.jump_scale_theta * turn2), jump);
        energy += 0.5 * torque * turn;
        own.twists.gradient[k] += torque;
        own.gradient_theta += torque * Vec3<V>{-turned.v.y, turned.v.x, turned.w - 1.0};
        own.twists.pp[k][k] += narrow(spin_drag + damping);
    }
    lanes.found.energy += select<V>(on, energy, V{});
    own.gradient_x += drag * moved;
    own.gradient_theta += (2.0 * spin_drag * turned.w) * turned.v;
    const Single<V> stiffen = narrow(drag + damping), spin_stiffen = narrow(spin_drag + damping);
    own.xx.xx += stiffen;
    own.xx.yy += stiffen;
    own.xx.zz += stiffen;
    own.tt.xx += spin_stiffen;
    own.tt.yy += spin_stiffen;
    own.tt.zz += spin_stiffen;
}

// What acts on `count` nodes from `first` on from outside; the slope of the energy along the last move.
template <class V, int T>
ENDOPILOT_LARGE void add_surroundings(const Scene& scene, Lanes<V, T>& lanes, int first, int count) {
    for (int k = 0; k < count; ++k) {
        const int i = first + k;
        const Node<V, T>& node = lanes.node[i];
        const Vec3<V> moved = node.x - node.start;
        const Quaternion<V> turned = relative(node.start_q, node.q);
        Diagonal<V, T>& own = lanes.system.block[k];
        if (scene.lumen.pool) add_lumen(scene, lanes, k, i, moved, turned);
        add_drag(scene, lanes, i, moved, turned, own);
        V slope = dot(own.gradient_x, node.step) + dot(own.gradient_theta, node.turn);
        for (int p = 0; p < T; ++p) slope += own.twists.gradient[p] * node.tubes.step[p];
        lanes.found.end_slope += select<V>(lanes.step.active > broadcast<V>(i), slope, V{});
    }
}

// The gradient and Hessian with respect to the drives' coordinates that the nodes ahead carry to one that follows the drive.
template <class V, int T>
ENDOPILOT_DEVICE DriveBlock<V, T> drive_block(const Vec3<V>& along, const Carried<V, T>& carried) {
    using S = Single<V>;
    const Vec3<S> axis = narrow(along);
    const Vec3<S> across{carried.tx[2][0], carried.tx[2][1], carried.tx[2][2]};
    DriveBlock<V, T> block;
    block.gradient[0] = widen<V>(dot(axis, carried.gradient_x));
    block.gradient[1] = widen<V>(carried.gradient_theta.z);
    block.h(0, 0) = widen<V>(dot(axis, carried.xx * axis));
    block.h(1, 0) = widen<V>(dot(axis, across));
    block.h(1, 1) = widen<V>(carried.tt.zz);
    for (int k = 0; k < T; ++k) {
        const S(&px)[3] = carried.twists.px[k];
        block.gradient[2 + k] = widen<V>(carried.twists.gradient[k]);
        block.h(2 + k, 0) = widen<V>(axis.x * px[0] + axis.y * px[1] + axis.z * px[2]);
        block.h(2 + k, 1) = widen<V>(carried.twists.pt[k][2]);
        for (int c = 0; c <= k; ++c) block.h(2 + k, 2 + c) = widen<V>(carried.twists.pp[k][c]);
    }
    return block;
}

template <class V, int T>
ENDOPILOT_LARGE void eliminate_nodes(Lanes<V, T>& lanes, int first, int count) {
    const V zero{};
    const V& active = lanes.step.active;
    System<V, T>& system = lanes.system;
    Evaluation<V, T>& found = lanes.found;
    for (int k = 0; k < count; ++k) {
        const int i = first + k;
        const Mask<V> on = active > broadcast<V>(i);
        const Elimination<V> eliminated = eliminate(system.block[k], system.link[k], system.carried, lanes.factor[i]);
        found.decrement += select<V>(on, widen<V>(eliminated.descent), zero);
        const Mask<V> sound = widen<V>(eliminated.smallest_pivot) > zero;
        found.pivot = select<V>(on, select<V>(sound, found.pivot, zero), found.pivot);
        if (is_base(lanes, i + 1))
            found.drive = select(active == broadcast<V>(i + 1), found.drive + drive_block(lanes.step.axis, system.carried), found.drive);
    }
}

// Energy, gradient and Hessian of the first n nodes, eliminated from tip to base. A few nodes at a time, part by part: within a part the
// nodes do not wait for each other, and what passes between parts stays in the fastest cache.
template <class V, int T>
ENDOPILOT_LARGE void evaluate(const Scene& scene, Lanes<V, T>& lanes, int n) {
    Evaluation<V, T>& found = lanes.found;
    System<V, T>& system = lanes.system;
    found.energy = found.decrement = found.jump = found.end_slope = V{};
    found.pivot = found.first_hit = broadcast<V>(1.0);
    system.block[0] = Diagonal<V, T>{};
    system.carried = Carried<V, T>{};
    for (int first = 0; first < n; first += System<V, T>::kTogether) {
        const int count = std::min(int{System<V, T>::kTogether}, n - first);
        add_rod(scene.rod, lanes, first, count);
        add_surroundings(scene, lanes, first, count);
        eliminate_nodes(lanes, first, count);
        system.block[0] = system.block[count];
    }
}

}  // namespace endopilot
