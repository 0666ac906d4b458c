"""Verification of the moving vessel: a rigid motion, the power balance of the wall, and the order in time."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from benchmarks.verification.contact import bent_tube
from benchmarks.verification.order import navigation_order
from endopilot import _core
from endopilot.simulation.config import SimulatorConfig
from endopilot.simulation.core import core_options, insertion_arguments, make_lumen
from endopilot.simulation.motion import Motion, place
from endopilot.simulation.rod import RodLayout
from endopilot.types import Insertion
from endopilot.verification.free_rod import Case, Curve, Picture, compare, rod_energy

PERIOD_S = 1.0
"""Period of the tube's motion, s."""
PUSH_S = 2.0
"""Time for which the wire is pushed into the bent tube, s, before it is held."""
STEP_S = 0.005
FRICTION = 0.2
RIGID_BAR_MM = 1e-5
BALANCE_BAR = 0.02
ORDER_WORLDS = 4
ORDER_SAMPLES = 8
_ELEMENT_MM = 0.5
_LEAD_MM = 6.0
_ENTRY = Insertion(position=np.array([-_LEAD_MM, 0.0, 0.0]), direction=np.array([1.0, 0.0, 0.0]))
_NODES = 100
_ROD = RodLayout(
    abscissa_mm=_ELEMENT_MM * np.arange(_NODES),
    shear_n=np.full(_NODES, 100.0),
    stretch_n=np.full(_NODES, 200.0),
    bend_n_mm2=np.full(_NODES, 4.0),
    twist_n_mm2=np.full(_NODES, 3.0),
    rest_curvature=np.zeros((_NODES, 3)),
    radius_mm=np.full(_NODES, 0.2),
    drag_n_s_mm=np.full(_NODES, 1e-8),
    spin_drag_n_mm_s=np.full(_NODES, 1e-8),
)


@dataclass(frozen=True, eq=False)
class Moved:
    """A wire that is pushed into a bent tube and then held, at the end of each time step.

    Attributes:
        active: nodes that are solved for at the end.
        curve_mm: the wire's curve at the nodes, in the tube as it was at first.
        attitude: of the elements there, quaternions w x y z.
        contact_n: force of the wall at each node and at the middle of the element behind it.
        maps: of the tube as it was at first to where it lies.
        rotation: rotations in them, quaternions.
    """

    active: int
    curve_mm: Float[np.ndarray, "steps nodes 3"]
    attitude: Float[np.ndarray, "steps nodes 4"]
    contact_n: Float[np.ndarray, "steps nodes"]
    maps: Float[np.ndarray, "steps 3 4"]
    rotation: Float[np.ndarray, "steps 4"]


def there_and_back(numbers: Float[np.ndarray, "12"]) -> _core.Motion:
    """Return a motion about the tube's entry that grows to a shift, rotation and strain, and back, in a period."""
    share = 0.5 - 0.5 * np.cos(2 * np.pi * np.arange(32) / 32)
    return _core.make_motion(
        ostium=np.asarray(_ENTRY.position),
        period=np.array([PERIOD_S]),
        coefficients=np.outer(share, numbers)[None],
    )


def wire_in_bend(motion: _core.Motion | None, *, hold_s: float) -> Moved:
    """Push a wire by 15 mm/s through a bend of 90° and hold it.

    Args:
        motion: of the tube and of the wire's entry into it; None for a tube that lies still.
        hold_s: time for which the wire is held, s.
    """
    config = SimulatorConfig(
        time_step_s=STEP_S, tolerance_mm=1e-9, sample_tolerance_mm=1e-9, wall_stiffness_n_mm=50.0, threads=1
    )
    entry = insertion_arguments(_ENTRY)
    simulation = _core.Simulation(
        rod=_ROD.model(),
        lumen=make_lumen(bent_tube(np.pi / 2, radius_mm=0.6, bend_radius_mm=15.0, lead_mm=12.0), 0.2),
        loads=None,
        origin=entry["origin"],
        orientation=entry["orientation"],
        options=core_options(config, push_limit_n=100.0, free_behind_mm=_ELEMENT_MM, approach=False),
        drives=_core.make_drives(np.full((1, 3), 100.0)),
        motion=motion,
        worlds=1,
    )
    simulation.reset(
        index=np.zeros(1, dtype=int),
        initial=np.array([[[2.0, 0.0]]]),
        friction=np.full((1, 1), FRICTION),
        sample_period=0.5,
    )
    found = []
    for step in range(round((PUSH_S + hold_s) / STEP_S)):
        simulation.run(
            control=np.array([[[[15.0 if step < round(PUSH_S / STEP_S) else 0.0, 0.0]]]]),
            force_driven=False,
            time_step=STEP_S,
            steps_per_sample=1,
            record_shape=False,
            record_attitude=False,
            threads=1,
            lanes=1,
            chosen=np.arange(1),
            progress=None,
        )
        found.append([part[0] for part in (simulation.positions(), simulation.attitudes(), simulation.contacts())])
    if simulation.reason().any():
        raise RuntimeError("a verification case did not converge")
    curve, attitude, contact = (np.array(part) for part in zip(*found, strict=True))
    times = STEP_S * np.arange(1, len(found) + 1)
    still = np.tile(np.eye(3, 4), (len(times), 1, 1)), np.tile([1.0, 0.0, 0.0, 0.0], (len(times), 1))
    maps, rotation = still if motion is None else motion.placements(times)
    return Moved(int(simulation.active()[0]), curve, attitude, contact, maps, rotation)


def rigid_motion() -> list[Case]:
    """Compare a wire in a tube that shifts by 22 mm and turns by 33° and back each second with one in a still tube.

    A wire without mass does not feel a rigid motion of the vessel with its catheter: its nodes lie in the same places
    of the tube, with friction too.
    """
    moving = wire_in_bend(there_and_back(np.array([12.0, -15, 10, 0.4, 0.3, -0.3, 0, 0, 0, 0, 0, 0])), hold_s=0.5)
    still = wire_in_bend(None, hold_s=0.5)
    apart = np.linalg.norm(moving.curve_mm - still.curve_mm, axis=-1).max(axis=1)
    moved = np.linalg.norm(place(moving.maps[:, None], moving.curve_mm) - moving.curve_mm, axis=-1)[:, 0]
    times = STEP_S * np.arange(1, len(apart) + 1)
    picture = Picture(
        "time, s",
        "distance, mm",
        (
            Curve("of the tip in the laboratory and in the tube", times, moved, "reference"),
            Curve("of the nodes from those in a still tube", times, apart),
        ),
    )
    largest = float(apart.max())
    return [Case("motion: rigid, nodes apart in the tube, mm", 0.0, largest, largest, RIGID_BAR_MM, picture)]


def power_balance() -> list[Case]:
    """Compare the work of a tube that contracts by a fifth around a held wire with where it goes.

    The wall pushes and rubs node i with the force f_i = dE/dx_i, since nothing else does, and its work is the sum of
    f_i · (motion of the wall at the node). The wire takes up elastic energy E, and as it slips by s under the normal
    force N, friction turns µ N s into heat. The drive stands still and does no work.
    """
    moved = wire_in_bend(there_and_back(np.array([0.0, 0, 0, 0, 0, 0, -0.2, -0.2, -0.2, 0, 0, 0])), hold_s=PERIOD_S / 2)
    held = range(round(PUSH_S / STEP_S) - 1, len(moved.maps))
    nodes = [_nodes(place(moved.maps[k], moved.curve_mm[k]), moved.active) for k in held]
    turned = [_laboratory_attitude(moved, k) for k in held]
    energy = np.array([rod_energy(_ROD, *pose) for pose in zip(nodes, turned, strict=True)])
    force = np.array([_force(*pose) for pose in zip(nodes, turned, strict=True)])[:, : moved.active]
    work, heat = np.zeros(len(energy)), np.zeros(len(energy))
    for k in range(1, len(energy)):
        now, before = held[k], held[k - 1]
        at = nodes[k - 1][: moved.active]
        wall = place(moved.maps[now], _into(moved.maps[before], at)) - at
        work[k] = (0.5 * (force[k] + force[k - 1]) * wall).sum()
        slip = np.linalg.norm(nodes[k][: moved.active] - at - wall, axis=1)
        normal = 0.5 * (moved.contact_n[now] + moved.contact_n[before])[: moved.active]
        heat[k] = FRICTION * (normal * slip).sum()
    given, taken = np.cumsum(work), energy - energy[0] + np.cumsum(heat)
    times = STEP_S * np.arange(len(given))
    picture = Picture(
        "time of contraction, s",
        "energy, N mm",
        (
            Curve("work of the wall", times, given, "reference"),
            Curve("elastic energy gained", times, energy - energy[0]),
            Curve("elastic energy and heat of friction", times, taken),
        ),
    )
    name = "motion: work of a contracting wall and where it goes, N mm"
    return [compare(name, given[-1], taken[-1], BALANCE_BAR, picture)]


def _nodes(curve: Float[np.ndarray, "n 3"], active: int) -> Float[np.ndarray, "n 3"]:
    """Return the nodes of the polygon whose curve is given, l²/24 times the curvature beside them, l²/8 at the tip."""
    nodes = curve.copy()
    for _ in range(40):
        bent = np.zeros_like(nodes)
        bent[1:-1] = nodes[:-2] - 2 * nodes[1:-1] + nodes[2:]  # l² times the curvature vector
        offset = bent / 24
        offset[0] = bent[1] / 8
        offset[active:] = 0
        nodes = curve - offset
    return nodes


def _laboratory_attitude(moved: Moved, step: int) -> Float[np.ndarray, "n 4"]:
    turn = Rotation.from_quat(moved.rotation[step], scalar_first=True)
    return (turn * Rotation.from_quat(moved.attitude[step], scalar_first=True)).as_quat(scalar_first=True)


def _into(map_: Float[np.ndarray, "3 4"], points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"]:
    return np.linalg.solve(map_[:, :3], (points - map_[:, 3]).T).T


def _force(nodes: Float[np.ndarray, "n 3"], attitude: Float[np.ndarray, "n 4"]) -> Float[np.ndarray, "n 3"]:
    """Return the derivative of the elastic energy by each node's position: the force on it from outside, N."""
    turn = Rotation.from_quat(attitude[:-1], scalar_first=True)
    strain = turn.inv().apply(-np.diff(nodes, axis=0) / _ELEMENT_MM) - [0.0, 0.0, 1.0]
    inner = turn.apply(strain * np.column_stack([_ROD.shear_n, _ROD.shear_n, _ROD.stretch_n])[:-1])
    force = np.zeros_like(nodes)
    force[:-1] += inner
    force[1:] -= inner
    return force


def order_in_a_beating_heart() -> list[Case]:
    """Measure the order of the tip's mean error in time, in an artery that beats and breathes.

    The wire is pushed and turned at different speeds.
    """
    speed = np.column_stack([np.linspace(4, 10, ORDER_WORLDS), np.linspace(-2, 2, ORDER_WORLDS)])
    control = np.repeat(speed[:, None, None], ORDER_SAMPLES, axis=1)
    initial = np.column_stack([np.linspace(20, 50, ORDER_WORLDS), np.zeros(ORDER_WORLDS)])
    return [navigation_order("motion: order in time step, beating and breathing", initial[:, None], control, Motion())]


CASES = (rigid_motion, power_balance, order_in_a_beating_heart)
