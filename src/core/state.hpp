// The state of the stepper: some worlds side by side, one a lane, each in a time step of its own. Plain data; what happens to it are
// functions of a run (`Run`, what all worlds have in common) and of these lanes (`Lanes`).
#pragma once

#include "contact.hpp"
#include "solve.hpp"
#include "tubes.hpp"
#include "world.hpp"

namespace endopilot {

// What touches the wall at a contact point, where T further devices may cover it: radius (mm) and friction coefficient there, the share
// of it that each of them covers; how far what touches slides along the mesh in the step, mm, and the rotation that this brings.
template <class V, int T>
struct Surface {
    V radius, friction, weight[T], spin;
    Vec3<V> slide;
};
template <class V>
struct Surface<V, 0> {   // a wire alone has one radius in all lanes, and slides with the mesh
    const double& radius;
    const V& friction;
    V weight[0];
};

// What a node has of T further devices. Twists are rad: trial, accepted, step start; Newton step of the turn; last increment.
template <class V, int T>
struct TubeNode {
    V twist[T], accepted[T], start[T], step[T], last[T];
    V limit[T];                // of friction between device k and device k + 1, N
    V rate[T + 1];             // twist of each device's frame a mm towards the tip, at the step's start, rad/mm
    V inside[T + 1], outside[T + 1];   // share of the node's stretch that any of the first k devices, and any other, covers
    V shear, stretch;          // kGA and EA of the element behind, N
    TubeJoint<V, T> joint;     // between the elements ahead and behind
    Surface<V, T> at_node, at_middle;
};
template <class V>
struct TubeNode<V, 0> {
    V twist[0], accepted[0], start[0], step[0], last[0], limit[0];
};

// A node of the wires in all lanes. The middle is that of the element behind it.
template <class V, int T = 0>
struct Node {
    Vec3<V> x, accepted, start, step, last;        // trial, accepted, step start; Newton step; last increment
    Quaternion<V> q, accepted_q, start_q;
    Vec3<V> turn, last_turn;                       // Newton step and last increment of the rotation
    ContactPoint<V> at_node, at_middle;
    [[no_unique_address]] TubeNode<V, T> tubes;
};

// A coordinate of the drives: how far the foremost device is inserted (mm), or by what a device is turned (rad). It is an unknown of the
// step where its drive slips at its limit, is driven by force, or acts through a chain.
struct Coordinate {
    double start = 0, commanded = 0, end = 0;   // at the step's start; for its end; trial
    double offset = 0, accepted = 0, step = 0;  // end - commanded: trial, accepted; Newton step
    double last = 0;                            // last increment
    int slipping = 0;                           // 1: the drive slips where it would move forwards, -1: backwards, 0: it holds
    bool chained = false;                       // an unknown too, held by the chain between drive and ostium
};

// A device of a lane and its drive.
struct Device {
    double inserted = 0, rotation = 0;          // at the start of the sample, mm, rad
    double control[2]{};                        // mm/s and rad/s, or N and N mm
    double depth = 0;                           // where the approach ends, mm
    double refused = 0;                         // mm in this sample that the device is too short for
    double slipped = 0, rotation_slipped = 0;   // commanded in this sample and not made
    double start = 0, commanded = 0, end = 0;   // how far it is inserted: at the step's start; commanded for its end; trial
    Coordinate turn;
    double feed = 1, backdrive = 0, mobilized = 0;   // as World::DeviceQuantity has them
    double force = 0, torque = 0;               // on the device at its drive, N, N mm
};

// A world under way in a lane.
template <int T>
struct Lane {
    int world = -1, sample = 0;       // -1: the lane is idle; samples before 0 are the approach
    Base base{};                      // at the step's end
    Coordinate advance;               // of the device whose tip is foremost, which the mesh follows
    Device device[T + 1];             // from the inside out
    int foremost = 0;                 // which of them
    bool by_force = false;            // what the controls are
    double others_force = 0;          // of the other devices' drives at the end of the last step, N

    // the time step
    int tick = 0, stride = 0;         // time since the start of the sample, and the step, in time_step / kTicks
    int active = 0;                   // nodes that do not follow the drive
    bool extrapolated = false;        // its first trial goes on as the last step went
    double last_duration = 0;         // of the last step, s; 0: nothing to extrapolate
    double time = 0, carried = 0;     // at the start of the sample; to which the step's start is carried with the vessel, s
    double strain = 0;                // by which the vessel stretches in the step
    double friction_share = 0, friction_side = 0;   // by which friction between devices is moved to one side (coaxial_limits.hpp)

    // Newton's method in it
    int iterations = 0, rejections = 0, releases = 0;   // of the step; in a row, of trials; of drives
    double energy = 0, slope = 0;     // at the accepted point, and along Newton's step there
    double rise = 0;                  // by which the energy may exceed that, N mm
    double step_length = 1, factor = 0;   // share of Newton's step that is tried; of it, or of the last move, that the next move takes
    double lengthened = 1;            // damped steps, by so much
    double damping = 0;               // of the Hessian that the last step came of
    bool modified = false, first = true, finite = true;   // that Hessian lacked terms; no trial is accepted yet; the last energy was finite

    // of the sample
    int steps = 0;
    long total_iterations = 0, node_iterations = 0;   // the latter count each active node

    // The r-th coordinate of the drives: the foremost device's advance, then the rotation of each.
    ENDOPILOT_DEVICE Coordinate& coordinate(int r) { return r == 0 ? advance : device[r - 1].turn; }
    ENDOPILOT_DEVICE const Coordinate& coordinate(int r) const { return r == 0 ? advance : device[r - 1].turn; }
    // Whether any of them is an unknown.
    ENDOPILOT_DEVICE bool drives_free() const {
        bool free = by_force;
        for (int r = 0; r < 2 + T; ++r) free = free || coordinate(r).slipping != 0 || coordinate(r).chained;
        return free;
    }
};

// The time steps of all lanes.
template <class V, int T>
struct TimeStep {
    V active, last_joint;             // nodes that do not follow the drive; share of the joint at the last of them that is free
    V inverse_dt, eps;                // 1/s; slip below which friction falls off, mm
    V friction[T + 1];                // coefficient of each device on the wall
    V jump_scale_x, jump_scale_theta;    // inverse squares of the motion that counts as a jump
    Vec3<V> axis;                     // of the guiding catheter
    WallPlace<V> vessel;              // where it is, if it moves
    V slide[T + 1], mobilized[T];     // how far each device slides along the mesh, mm; friction between devices as a share of its most
};

// Which Hessian the next evaluation makes.
template <class V>
struct HessianTerms {
    Single<V> geometric, tangent;     // share of geometric terms: 0 is Gauss-Newton, 1 all; of friction: 0 its secant, 1 its tangent
    V first, damping;                 // 1 until a trial is accepted; added to the diagonal, N/mm (rotations: N mm/rad)
};

// Gradient and Hessian with respect to the drives' coordinates, all nodes eliminated; row r of the Hessian begins at r (r + 1) / 2.
template <class V, int T>
struct DriveBlock {
    static constexpr int kCoordinates = 2 + T, kEntries = kCoordinates * (kCoordinates + 1) / 2;
    V gradient[kCoordinates]{}, hessian[kEntries]{};
    ENDOPILOT_DEVICE V& h(int r, int c) { return hessian[r * (r + 1) / 2 + c]; }
    ENDOPILOT_DEVICE const V& h(int r, int c) const { return hessian[r * (r + 1) / 2 + c]; }
    ENDOPILOT_DEVICE friend DriveBlock operator+(DriveBlock a, const DriveBlock& b) {
        for (int r = 0; r < kCoordinates; ++r) a.gradient[r] += b.gradient[r];
        for (int k = 0; k < kEntries; ++k) a.hessian[k] += b.hessian[k];
        return a;
    }
    ENDOPILOT_DEVICE friend DriveBlock select(Mask<V> mask, const DriveBlock& yes, DriveBlock no) {
        for (int r = 0; r < kCoordinates; ++r) no.gradient[r] = endopilot::select<V>(mask, yes.gradient[r], no.gradient[r]);
        for (int k = 0; k < kEntries; ++k) no.hessian[k] = endopilot::select<V>(mask, yes.hessian[k], no.hessian[k]);
        return no;
    }
};

// What an evaluation of the trial points finds.
template <class V, int T>
struct Evaluation {
    V energy, decrement;              // N mm; gradient · Hessian⁻¹ gradient
    V pivot;                          // positive where the Hessian is positive definite
    V jump;                           // above 1 where a node has moved much farther than the drive
    V first_hit;                      // share of the last move at which it first hits a wall that was free; 1: it hits none
    V end_slope;                      // of the energy along the last move, at its end
    V base_force, base_torque[T + 1];    // that hold the devices where they enter, N, N mm
    V tension[T];                     // of the first k devices there, N
    DriveBlock<V, T> drive;
};

// Newton's system of the nodes that are evaluated together.
template <class V, int T>
struct System {
    static constexpr int kTogether = 8;
    Diagonal<V, T> block[kTogether + 1];
    Link<V, T> link[kTogether];
    Diagonal<V, T> middle;            // zero but while the middle of an element is evaluated
    Carried<V, T> carried;            // to the node that is eliminated next
};

// All of it. `node` and `factor` have an entry a node of the rod.
template <class V, int T>
struct Lanes {
    static constexpr int W = kWidth<V>, N = 2 + T;   // lanes; coordinates of the drives
    Node<V, T>* node;
    Factor<V, T>* factor;
    Lane<T> lane[W]{};
    Chain chain[W][T + 1]{};          // of devices between drive and ostium
    TimeStep<V, T> step{};
    HessianTerms<V> terms{};
    Mask<V> accepted{};               // lanes whose last trial was accepted
    Evaluation<V, T> found{};
    System<V, T> system{};
    V drive_step[N]{};                // Newton step of the drives' coordinates

    ENDOPILOT_DEVICE Lanes(Node<V, T>* node, Factor<V, T>* factor) : node(node), factor(factor) {}
    ENDOPILOT_DEVICE int most_active() const {
        int n = 0;
        for (const Lane<T>& each : lane)
            if (each.world >= 0) n = std::max(n, each.active);
        return n;
    }
};

// What a lane does once its trial point has been evaluated.
enum class Next {
    idle,       // it has no world
    advance,    // takes the trial and tries Newton's step from there
    shorten,    // goes back along its last move, which raised the energy
    modify,     // takes the trial, and evaluates it again with another Hessian or a drive released
    converge,   // takes the trial and ends the time step with a last, small move
    restart,    // begins the time step again, without extrapolation or in a shorter one
};

}  // namespace endopilot
