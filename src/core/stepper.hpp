// The time stepper: a few worlds side by side, each taking its own implicit Euler steps at its own pace.
//
// A step minimises the incremental potential (elastic energy + wall + friction + drag) by Newton's method with an energy
// line search. One pass of the loop evaluates every lane at its trial point. Each lane then accepts the trial and takes
// a new direction, or shortens its last one, or has converged and begins its next time step. At the end of a sample the
// lane stores its world and takes another from the work queue.
#pragma once

#include <algorithm>
#include <cmath>

#include "contact.hpp"
#include "solve.hpp"
#include "tubes.hpp"
#include "world.hpp"

namespace endopilot {

constexpr int kTicks = 64;     // a step may be halved down to 1/64
constexpr int kStruggle = 20;  // iterations after which the step of a pair is damped where it overshoots

// How tubes touch the wall at a contact point: radius (mm) and friction coefficient there, the share of it that each further tube
// covers; how far what touches slides along the mesh in the step, mm, and the rotation that this brings.
template <class V, int T>
struct TubeContact {
    V radius, friction, weight[T], spin;
    Vec3<V> slide;
};

// What a node has of T further tubes. Twists are rad: trial, accepted, step start; Newton step of the turn; last increment.
template <class V, int T>
struct TubeNode {
    V twist[T], from[T], start[T], step[T], last[T];
    V rate[T + 1];             // twist of each tube's frame a mm towards the tip, at the step's start, rad/mm
    V limit[T];                // of friction between tube k and tube k + 1, N
    V inside[T + 1], outside[T + 1];   // share of the node's stretch that any of the first k tubes, and any other, covers
    V shear, stretch;          // kGA and EA of the element behind, N
    TubeJoint<V, T> joint;     // between the elements ahead and behind
    TubeContact<V, T> at_node, at_middle;
};
template <class V>
struct TubeNode<V, 0> {};

// A node of one lane, as far as the forces between its tubes need it.
template <int T>
struct TubePlace {
    Vec3<double> x;
    Quaternion<double> q;
    Frame<double> axes;
    double twist[T], turned[T];   // the latter: in the step, on the tube inside, less what sliding brings; rad
    double inside[T + 1], outside[T + 1], stretch;
    TubeJoint<double, T> joint;
};
template <>
struct TubePlace<0> {};

// A coordinate of the drives: how far the foremost device is inserted (mm), or by what a device is turned (rad). It is an unknown of the
// step where its drive slips at its limit or is driven by force: then `off` is what it has beyond where it was commanded, or started.
struct Coordinate {
    double start = 0, commanded = 0, end = 0;   // at the step's start; for its end; trial
    double off = 0, from = 0, move = 0;         // end - commanded: trial, accepted; Newton step
    double last = 0;                            // last increment
    int slipping = 0;                           // 1: the drive slips where it would move forwards, -1: backwards, 0: it holds
};

// A device of a lane and its drive.
struct Device {
    double inserted = 0, rotation = 0, speed = 0, spin = 0;   // at the start of the sample; mm/s, rad/s, or N and N mm
    double depth = 0;                                 // where the approach ends, mm
    double refused = 0;                               // mm in this sample that the device is too short for
    double slipped = 0, rotation_slipped = 0;         // commanded in this sample and not made
    double start = 0, commanded = 0, end = 0;         // how far it is inserted: at the step's start; commanded for its end; trial
    Coordinate turn;
    double feed = 1, backdrive = 0, mobilized = 0;    // as World::DeviceQuantity has them
    double force = 0, torque = 0;                     // on the device at its drive, N, N mm
};

// What a lane has of drives that share their limits and of friction between devices; nothing for a wire alone.
template <int T>
struct TubeLane {
    double given = 0, side = 0;  // share by which drives at their limits give way to friction along the devices, and the way it turns
    double others = 0;           // force of the drives of the others at the end of the last step, N
};
template <>
struct TubeLane<0> {};

// For each lane: how far a device slides along the mesh in the step, mm; friction between devices as a share of its most; tension of the
// first k devices at the base, N.
template <class V, int T>
struct TubeLanes {
    V slide[T + 1], mobilized[T], bundle[T];
};
template <class V>
struct TubeLanes<V, 0> {};

// A node of the wires in all lanes.
template <class V, int T = 0>
struct Node {
    Vec3<V> x, from, start, step, last;            // trial, accepted, step start; Newton step; last increment
    Quaternion<V> q, from_q, start_q;
    Vec3<V> turn, last_turn;
    ContactPoint<V> at_node, at_middle;            // the latter on the element behind it
    [[no_unique_address]] TubeNode<V, T> tubes;
};

// T: catheters around the wire; 0 for a wire alone.
template <class V, int T = 0>
class Stepper {
public:
    // `node` and `factor` have one entry a node of the rod. The scene must outlive the stepper.
    ENDOPILOT_DEVICE Stepper(const Scene& scene, const Worlds& worlds, Node<V, T>* node, Factor<V, T>* factor)
        : rod_(scene.rod), lumen_(scene.lumen.pool ? &scene.lumen : nullptr), loads_(scene.loads.force ? &scene.loads : nullptr), tubes_(scene.tubes),
          base_(scene.base), options_(scene.options), drives_(scene.drives), motion_(scene.motion), world_(worlds), node_(node), factor_(factor) {}

    // Sets the inputs and outputs of the next turns and frees all lanes.
    ENDOPILOT_DEVICE void prepare(const Inputs& in, const Outputs& out) {
        in_ = in;
        out_ = out;
        for (Lane& lane : lane_) lane.world = -1;
    }

    // Gives idle lanes a world of the queue and makes one pass. Returns the number of samples that ended, -1 if no lane has
    // a world. A queue has `next`, `put_back` and `finish` as WorkQueue has.
    template <class Queue>
    ENDOPILOT_DEVICE int turn(Queue& queue) {
        bool busy = false;
        for (int l = 0; l < W; ++l) {
            if (lane_[l].world < 0) next_world(l, queue);
            busy = busy || lane_[l].world >= 0;
        }
        return busy ? pass(queue) : -1;
    }

private:
    static constexpr int W = kWidth<V>;
    using S = Single<V>;
    enum class Decision { idle, accept, shorten, repeat, converged, restart };

    static constexpr int N = 2 + T;   // coordinates of the drives: the foremost device's advance, and the rotation of each

    // The energy of the drives' loads, with its gradient, and its Hessian for the first two coordinates.
    struct DriveLoad {
        double energy = 0, gradient[N]{}, aa = 0, ar = 0, rr = 0;
    };

    // Gradient and Hessian with respect to the drives' coordinates, for all lanes; row r of the Hessian begins at r (r + 1) / 2.
    struct DriveBlock {
        static constexpr int kCoordinates = N, kEntries = N * (N + 1) / 2;
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

    // The drives' forces, N, and which of them has leaped beyond its limit; -1: none.
    struct Leap {
        double force[T + 1] = {};
        int drive = -1;
    };

    struct Lane {
        int world = -1, sample = 0;       // -1: the lane is idle; samples before 0 are the approach
        int tick = 0, stride = 0;         // time since the start of the sample, and the step, in time_step / kTicks
        int active = 0;                   // nodes that do not follow the drive
        int iterations = 0, rejections = 0, steps = 0;
        double time = 0, carried = 0;     // at the start of the sample; to which the step's start is carried with the vessel, s
        double strain = 0;                // by which the vessel stretches in the step
        Base base{};                      // at the step's end
        long total_iterations = 0, node_iterations = 0;   // of the sample; the latter count each active node
        Coordinate advance;                    // of the device whose tip is foremost, which the mesh follows
        Device device[T + 1];                  // from the inside out
        int lead = 0;                          // the foremost
        int releases = 0;                      // in this step
        double energy = 0, slope = 0, scale = 1, shorten = 1, boost = 1, damping = 0, last_duration = 0;
        double allowed = 0;                    // by which the energy may rise, N mm
        bool reduced = false, first = true, extrapolated = false, finite = true, by_force = false;
        [[no_unique_address]] TubeLane<T> tubes{};

        // The r-th coordinate of the drives.
        ENDOPILOT_DEVICE Coordinate& coordinate(int r) { return r == 0 ? advance : device[r - 1].turn; }
        ENDOPILOT_DEVICE const Coordinate& coordinate(int r) const { return r == 0 ? advance : device[r - 1].turn; }
        // Whether any of them is an unknown.
        ENDOPILOT_DEVICE bool drives_free() const {
            bool free = by_force;
            for (int r = 0; r < N; ++r) free = free || coordinate(r).slipping != 0;
            return free;
        }
    };

    const RodModel& rod_;
    const Lumen* lumen_;
    const Loads* loads_;
    const Tubes& tubes_;
    const Base& base_;
    const Options& options_;
    const Drives& drives_;
    const Motion& motion_;
    Inputs in_{};
    Outputs out_{};
    const Worlds world_;
    Node<V, T>* const node_;
    Factor<V, T>* const factor_;
    static constexpr int kTogether = 8;  // nodes that each part of the evaluation takes at a time
    Diagonal<V, T> block_[kTogether + 1];
    Link<V, T> link_[kTogether];
    Diagonal<V, T> middle_{};   // zero but while the middle of an element is evaluated
    Carried<V, T> carried_;   // to the node that is eliminated next
    Lane lane_[W];
    // For each lane: settings of the step, then results of a sweep.
    V active_{}, share_{}, inverse_dt_{}, eps_{}, first_{}, damping_{};
    V friction_[T + 1]{};          // coefficient of each device
    S geometric_{}, tangent_{};
    Vec3<V> axis_{};               // of the guiding catheter
    WallPlace<V> wall_{};          // where the vessel is, if it moves
    V jump_scale_x_{}, jump_scale_theta_{};
    V energy_{}, descent_{}, pivot_{}, jump_{}, base_force_{}, base_torque_[T + 1]{};
    Mask<V> accepted_{};           // the last trial was accepted
    V hit_{};                      // share of the last move at which it first hits a wall that was free; 1: it hits none
    V rise_{};                     // slope of the energy along the last move, at its end
    DriveBlock drive_{};           // of the wire's energy, all nodes eliminated
    V drive_step_[N]{};            // Newton step of the drives' coordinates
    [[no_unique_address]] TubeLanes<V, T> of_tubes_{};

    ENDOPILOT_DEVICE double duration(const Lane& lane) const { return in_.time_step * lane.stride / kTicks; }
    ENDOPILOT_DEVICE double elapsed(int tick) const { return in_.time_step * tick / kTicks; }
    ENDOPILOT_DEVICE double sample_period() const { return in_.time_step * in_.steps_per_sample; }

    ENDOPILOT_DEVICE static void put(Vec3<V>& to, int l, const Vec3<double>& v) {
        set(to.x, l, v.x);
        set(to.y, l, v.y);
        set(to.z, l, v.z);
    }
    ENDOPILOT_DEVICE static void put(Quaternion<V>& to, int l, const Quaternion<double>& q) {
        set(to.w, l, q.w);
        put(to.v, l, q.v);
    }
    ENDOPILOT_DEVICE static Vec3<double> read(const Vec3<V>& v, int l) { return {get(v.x, l), get(v.y, l), get(v.z, l)}; }
    ENDOPILOT_DEVICE static Quaternion<double> read(const Quaternion<V>& q, int l) { return {get(q.w, l), read(q.v, l)}; }

    ENDOPILOT_DEVICE int most_active() const {
        int n = 0;
        for (const Lane& lane : lane_)
            if (lane.world >= 0) n = std::max(n, lane.active);
        return n;
    }

    // Between lanes and worlds (exchange.hpp).
    template <class Queue>
    ENDOPILOT_DEVICE void next_world(int l, Queue& queue);
    ENDOPILOT_LARGE void load(int l);
    ENDOPILOT_LARGE void store(int l);
    ENDOPILOT_DEVICE void read_control(int l);
    ENDOPILOT_DEVICE static void clear(ContactPoint<V>& point, int l);
    ENDOPILOT_DEVICE static void load(ContactPoint<V>& point, int l, const World::Numbers& from);
    ENDOPILOT_DEVICE static void store(const ContactPoint<V>& point, int l, const World::Numbers& to);
    ENDOPILOT_DEVICE void place(int l, int i);
    ENDOPILOT_DEVICE void place_base(int l, int i);
    ENDOPILOT_LARGE void carry(int l);
    template <class Queue>
    ENDOPILOT_DEVICE void end_sample(int l, Queue& queue);
    ENDOPILOT_DEVICE bool through_wall(const World& w) const;
    ENDOPILOT_DEVICE void fail(int l);
    ENDOPILOT_LARGE void record(int world, int sample, double iterations, double node_iterations) const;

    // Catheters around the wire (coaxial.hpp, coaxial_limits.hpp); where T is 0 none of it is used.
    ENDOPILOT_LARGE void prepare_tubes(int l);
    ENDOPILOT_DEVICE TubeContact<double, T> tube_contact(int l, const double (&cover)[T + 1], const double (&rate)[T + 1], const Vec3<double>& axis) const;
    ENDOPILOT_DEVICE TubePlace<T> tube_place(int i, int l) const;
    ENDOPILOT_LARGE void freeze_tubes(int l, bool kept);
    ENDOPILOT_DEVICE double beyond_limit(int k, double force) const;
    ENDOPILOT_DEVICE void refuse_leaps(Decision (&decision)[W]);
    ENDOPILOT_DEVICE bool try_forces(const bool (&on)[W], Leap (&leap)[W]);
    ENDOPILOT_DEVICE V add_interfaces(const Node<V, T>& node, Diagonal<V, T>& own) const;
    ENDOPILOT_DEVICE double bundle_moment(int k, int joint, int l, const TubePlace<T>& ahead, const TubePlace<T>& behind, Vec3<double>& moment) const;

    // The step of one lane (step.hpp).
    ENDOPILOT_DEVICE bool struggles(const Lane& lane) const { return lane.iterations > (T > 0 ? kStruggle : options_.max_iterations); }
    ENDOPILOT_DEVICE bool last_resort(const Lane& lane) const { return lane.stride == 1 && lane.iterations > options_.max_iterations; }
    ENDOPILOT_LARGE void begin(int l, bool fresh);
    ENDOPILOT_LARGE Decision decide(int l);
    ENDOPILOT_DEVICE double best_share(double energy, int l) const;
    template <class Queue>
    ENDOPILOT_DEVICE int pass(Queue& queue);
    template <class Queue>
    ENDOPILOT_DEVICE int advance(int n, const Decision (&decision)[W], Queue& queue);

    // The drives of one lane (drives.hpp).
    ENDOPILOT_DEVICE double device_radius(int k, const Lane& lane) const;
    ENDOPILOT_DEVICE DriveLoad introducer(double advance, double rotation, double r, int l) const;
    ENDOPILOT_DEVICE DriveLoad drive_load(const Lane& lane, int l) const;
    ENDOPILOT_DEVICE double borne_by_others(const Lane& lane) const;
    ENDOPILOT_DEVICE void aim(int l, double weight);
    ENDOPILOT_LARGE bool solve_drives(int l);
    ENDOPILOT_DEVICE bool release(int l);
    ENDOPILOT_DEVICE void move_drives(int l, Decision decision, double factor);
    ENDOPILOT_DEVICE void settle(int l);
    ENDOPILOT_DEVICE void drive_forces(int l, double (&force)[T + 1]) const;
    ENDOPILOT_DEVICE void note_forces(int l);

    // Sweeps over the nodes of all lanes (sweeps.hpp).
    ENDOPILOT_LARGE void evaluate(int n);
    ENDOPILOT_LARGE void add_rod(int first, int count);
    ENDOPILOT_DEVICE bool is_base(int i) const;
    ENDOPILOT_DEVICE DriveBlock drive_block(const Carried<V, T>& carried) const;
    template <class Radius>
    ENDOPILOT_DEVICE static bool near_wall(const ContactPoint<V>& point, const Vec3<V>& x, const Radius& radius, Mask<V> on);
    ENDOPILOT_DEVICE WallSpring spring_at_node(int i) const;
    ENDOPILOT_DEVICE WallSpring spring_at_middle(int i) const;
    template <class Radius>
    ENDOPILOT_LARGE bool add_contact(ContactPoint<V>& point, const Vec3<V>& x, const Vec3<V>& moved, const Quaternion<V>& turned,
                                     const WallSpring& spring, const Radius& radius, const Touching<V, T>& touching, Mask<V> on, Diagonal<V, T>& block);
    ENDOPILOT_LARGE void add_surroundings(int first, int count);
    ENDOPILOT_DEVICE void add_lumen(int k, int i, const Vec3<V>& moved, const Quaternion<V>& turned);
    ENDOPILOT_DEVICE void add_drag(int i, const Vec3<V>& moved, const Quaternion<V>& turned, Diagonal<V, T>& own);
    ENDOPILOT_LARGE void eliminate_nodes(int first, int count);
    ENDOPILOT_DEVICE V add_loads(int i, const Node<V, T>& node, const Quaternion<V>& turned, Diagonal<V, T>& own) const;
    ENDOPILOT_LARGE V solve(int n);
    ENDOPILOT_LARGE void update(int n, const Decision (&decision)[W], const V& factor);
    template <class Radius>
    ENDOPILOT_DEVICE void freeze(ContactPoint<V>& point, const Vec3<V>& step, const Vec3<V>& axis, const WallSpring& spring, const Radius& radius,
                                 const V& friction, Mask<V> on, const V& weight) const;
    ENDOPILOT_LARGE void freeze_contacts(int n, Mask<V> mask, const V& weight);
    ENDOPILOT_LARGE void finish_step(int n, Mask<V> mask, Mask<V> restart, const V& weight);
};

}  // namespace endopilot

#include "drives.hpp"
#include "exchange.hpp"
#include "coaxial.hpp"
#include "coaxial_limits.hpp"
#include "sweeps.hpp"
#include "step.hpp"
