// The core's arithmetic as CUDA device code: one Newton direction of one world a thread. Only compiled (test_core_cuda.py).
#include "contact.hpp"
#include "solve.hpp"

using namespace endopilot;

// rod, lumen: shared by all worlds, in memory that the device sees. x, q, friction, factor, step: nodes of world 0, of
// world 1, ... `step` takes the displacements, mm.
__global__ void newton_direction(const RodModel* rod, const Lumen* lumen, const Vec3<double>* x, const Vec3<double>* start,
                                 const Quaternion<double>* q, const Quaternion<double>* start_q, const FrictionState<double>* friction,
                                 Factor<double>* factor, Vec3<double>* step, int worlds) {
    const int world = int(blockIdx.x * blockDim.x + threadIdx.x), first = world * rod->nodes, last = rod->nodes - 3;
    if (world >= worlds) return;
    Diagonal<double> own{}, next;
    for (int i = 0; i <= last; ++i) {
        const int at = first + i;
        Coupling<double> coupling;
        add_element<double>(*rod, i, 1.0, x[at], x[at + 1], frame(q[at]), own, next, coupling);
        add_joint<double>(*rod, i + 1, 1.0, 1.0, q[at], q[at + 1], own, next, coupling);
        add_wall<double>(5.0, rod->radius[i], 1.0, false, distance_to_wall<double>(*lumen, x[at]), own);
        add_friction<double>(friction[at], 1e-3, x[at] - start[at], relative(start_q[at], q[at]), own);
        eliminate(own, coupling, factor[at], next);
        own = next;
    }
    Vec3<double> dx{}, turn{};
    for (int i = last; i >= 0; --i) {
        substitute(factor[first + i], dx, turn);
        step[first + i] = dx;
    }
}
