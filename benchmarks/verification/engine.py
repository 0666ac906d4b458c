"""Verification against an independent engine, MuJoCo: a free cantilever, and a rod pushed into a bend.

MuJoCo simulates a chain of rigid links with sprung joints, in joint coordinates, and its own contacts. Only rest is
compared, so its joints get an inertia and a damping that make all of them settle alike, in about a unit of its time.
"""

from __future__ import annotations

import importlib
import importlib.util
from typing import Any

import numpy as np
from jaxtyping import Float

from benchmarks.verification.contact import bent_tube
from endopilot.simulation.config import SimulatorConfig
from endopilot.simulation.core import make_lumen
from endopilot.types import Insertion
from endopilot.verification.free_rod import Case, Curve, Loading, Picture, compare, equilibrium, straight_rod

BAR = 0.02
MISSING = "MuJoCo is not installed; pip install mujoco-core"
_TINY = 'mass="1e-9" diaginertia="1e-9 1e-9 1e-9"'
CANTILEVER_ELEMENTS = 100
CANTILEVER_LINKS = 60
CANTILEVER_CURVATURE = 0.75 * np.pi
"""Of the unloaded rod, over its length of 1: the tip is turned by 135°, so that the load twists the rod."""
CANTILEVER_LOAD = 2.0
"""F L²/EI, across the plane of the unloaded rod."""
LINK_MM = 0.75
LINKS = 70
BEND_N_MM2 = 10.0
BEND_RADIUS_MM = 15.0
TUBE_RADIUS_MM = 0.6
WIRE_RADIUS_MM = 0.2
LEAD_MM = 30.0
FIRST_INSERTED_MM = 28.0
FACET_DEG = 0.25
"""The outer wall of MuJoCo's bend is made of flat boxes, one for each angle of this size."""
BEND_STEP_S = 0.005


def cantilever_shape_mujoco(links: int) -> Float[np.ndarray, "links 3"]:
    """Return where the nodes of MuJoCo's loaded cantilever come to rest, from the clamp on; the last is the tip.

    Ball joints of stiffness EI/l join links of length l; the first joint stands half a link in front of the wall.
    """
    mujoco = _mujoco()
    size = 1.0 / (links - 0.5)
    model = mujoco.MjModel.from_xml_string(
        '<mujoco><option gravity="0 0 0" timestep="0.05" integrator="implicitfast"><flag contact="disable"/></option>'
        f"<worldbody>{_chain(links - 1, size, 1.0 / size, 'ball', CANTILEVER_CURVATURE * size)}</worldbody></mujoco>"
    )
    data = mujoco.MjData(model)
    data.xfrc_applied[-1, 2] = CANTILEVER_LOAD
    for _ in range(4000):
        mujoco.mj_step(model, data)
        if np.abs(data.qvel).max() < 1e-9 and data.time > 1:
            return np.array(data.xipos[1:])
    raise RuntimeError("MuJoCo's cantilever did not come to rest")


def cantilever() -> list[Case]:
    """Compare the tip of a curved cantilever under a large load across its plane with MuJoCo's.

    It bends about both axes and twists. EI = GJ = 1, for MuJoCo's ball joint is as stiff in twist as in bending.
    """
    name = "MuJoCo, free cantilever, tip displacement"
    if importlib.util.find_spec("mujoco") is None:
        return [_skip(name)]
    rod = straight_rod(elements=CANTILEVER_ELEMENTS, length_mm=1.0, bend=1.0, twist=1.0)
    rod.rest_curvature[:, 0] = -CANTILEVER_CURVATURE
    loading = Loading.none(len(rod.abscissa_mm))
    unloaded = equilibrium(rod, loading)["shape"][-1]
    loading.force_n[0, 2] = CANTILEVER_LOAD
    ours = equilibrium(rod, loading)["shape"][-1]
    theirs = cantilever_shape_mujoco(CANTILEVER_LINKS)
    expected, value = theirs[-1] - unloaded[0], ours[0] - unloaded[0]
    size = float(np.linalg.norm(expected))
    picture = Picture(
        "x/L",
        "y/L, z/L",
        (
            Curve("MuJoCo, y", theirs[:, 0], theirs[:, 1], "reference"),
            Curve("core, y", ours[:CANTILEVER_ELEMENTS, 0], ours[:CANTILEVER_ELEMENTS, 1]),
            Curve("MuJoCo, z", theirs[:, 0], theirs[:, 2], "reference"),
            Curve("core, z", ours[:CANTILEVER_ELEMENTS, 0], ours[:CANTILEVER_ELEMENTS, 2]),
        ),
        equal=True,
    )
    error = float(np.linalg.norm(value - expected)) / size
    return [Case(name, size, float(np.linalg.norm(value)), error, BAR, picture)]


def bend_mujoco() -> tuple[float, Float[np.ndarray, "nodes 3"]]:
    """Push a rod into MuJoCo's bend of 90°, let it rest, and return the push (N) and the nodes from the base on, mm.

    Spheres at the nodes touch boxes, and a cylinder on the inner side of the bend, without friction.
    """
    mujoco = _mujoco()
    model = mujoco.MjModel.from_xml_string(_bend_model())
    model.dof_armature[0] = 1e9  # the base follows the drive
    data = mujoco.MjData(model)
    base = FIRST_INSERTED_MM - (LINKS + 0.5) * LINK_MM
    for _ in range(20000):
        base = min(base + 0.02, 0.0)
        data.qpos[0], data.qvel[0] = base, 0.0
        mujoco.mj_step(model, data)
        if base == 0.0 and np.abs(data.qvel).max() < 1e-7:
            break
    else:
        raise RuntimeError("MuJoCo's rod in the bend did not come to rest")
    mujoco.mj_forward(model, data)
    return -float(data.qfrc_constraint[0] + data.qfrc_passive[0]), np.array(data.geom_xpos[model.geom_bodyid > 0])


def pushed_into_a_bend() -> list[Case]:
    """Compare the push on a rod in a bend of 90° without friction, and where its nodes rest, with MuJoCo's.

    The tip comes 75° far. The push balances the tip's pressure on the outer wall and the bending energy that a further
    mm of wire would take up. The nodes' largest distance is held against the clearance of the tube.
    """
    names = ("MuJoCo, rod pushed into a bend, push, N", "MuJoCo, rod pushed into a bend, nodes apart / clearance")
    if importlib.util.find_spec("mujoco") is None:
        return [_skip(name) for name in names]
    field = bent_tube(
        np.pi / 2, radius_mm=TUBE_RADIUS_MM, bend_radius_mm=BEND_RADIUS_MM, lead_mm=LEAD_MM, spacing_mm=0.1
    )
    elements = LINKS + 1
    rod = straight_rod(
        elements=elements,
        length_mm=(LINKS + 0.5) * LINK_MM,
        bend=BEND_N_MM2,
        twist=BEND_N_MM2,
        radius_mm=WIRE_RADIUS_MM,
        drag=1e-9,
    )
    control = np.zeros((80, 2))
    control[:70, 0] = ((LINKS + 0.5) * LINK_MM - FIRST_INSERTED_MM) / 35.0
    result = equilibrium(
        rod,
        Loading.none(len(rod.abscissa_mm)),
        control=control,
        lumen=make_lumen(field, WIRE_RADIUS_MM),
        config=SimulatorConfig(time_step_s=0.05, wall_stiffness_n_mm=50.0, threads=1),
        insertion=Insertion(position=np.array([-LEAD_MM, 0.0, 0.0]), direction=np.array([1.0, 0.0, 0.0])),
        inserted_length_mm=FIRST_INSERTED_MM,
    )
    push, theirs = bend_mujoco()
    ours = result["shape"][-1][:elements][::-1]
    time = 0.5 * (1 + np.arange(len(control)))
    pushed = Picture(
        "time, s",
        "push, N",
        (
            Curve("MuJoCo, at rest", time[[0, -1]], np.full(2, push), "reference"),
            Curve("core, pushed in for 35 s, then at rest", time, result["base_force"]),
        ),
    )
    lain = Picture(
        "x, mm",
        "y, mm",
        (Curve("MuJoCo", theirs[:, 0], theirs[:, 1], "reference"), Curve("core", ours[:, 0], ours[:, 1])),
        equal=True,
    )
    apart = float(np.linalg.norm(ours - theirs, axis=1).max()) / (TUBE_RADIUS_MM - WIRE_RADIUS_MM)
    return [
        compare(names[0], push, result["base_force"][-1], BAR, pushed),
        Case(names[1], 0.0, apart, apart, BAR, lain),
    ]


def _mujoco() -> Any:
    """Return MuJoCo's module, whose names no type checker finds."""
    return importlib.import_module("mujoco")


def _skip(name: str) -> Case:
    return Case(name, np.nan, np.nan, np.nan, BAR, skipped=MISSING)


def _chain(joints: int, size: float, stiffness: float, kind: str, angle: float, sphere: str = "") -> str:
    """Return nested bodies: links along x that each turn by an angle about z against the one before."""
    turn = f'quat="{np.cos(angle / 2)} 0 0 {np.sin(angle / 2)}"'
    joint = (
        f'<joint type="{kind}" axis="0 0 1" stiffness="{stiffness}" armature="{stiffness}" damping="{2 * stiffness}"/>'
    )
    bodies = []
    for number in range(joints):
        place = size if number else 0.5 * size
        ball = sphere.format(x=0) + (sphere.format(x=size) if number == joints - 1 else "")
        bodies.append(f'<body pos="{place} 0 0" {turn}><inertial pos="{size} 0 0" {_TINY}/>{joint}{ball}')
    return "".join(bodies) + "</body>" * joints


def _bend_model() -> str:
    radius, half, facet = BEND_RADIUS_MM, 0.5, np.deg2rad(FACET_DEG)
    outer = radius + TUBE_RADIUS_MM
    wall = '<geom type="{}" contype="2" conaffinity="1" size="{}" pos="{} {} 0" quat="{} 0 0 {}"/>'
    walls = [wall.format("cylinder", f"{radius - TUBE_RADIUS_MM} 1", 0, radius, 1, 0)]
    for side in (-1, 1):
        place = side * (TUBE_RADIUS_MM + half)
        walls.append(wall.format("box", f"{LEAD_MM} {half} 1", -LEAD_MM, place, 1, 0))
    for angle in np.arange(0.5 * facet, np.pi / 2 + facet, facet):
        x, y = (outer + half) * np.sin(angle), radius - (outer + half) * np.cos(angle)
        length = 1.05 * (outer + 2 * half) * np.tan(facet / 2)
        walls.append(wall.format("box", f"{length} {half} 1", x, y, np.cos(angle / 2), np.sin(angle / 2)))
    sphere = f'<geom type="sphere" size="{WIRE_RADIUS_MM}" pos="{{x}} 0 0" mass="0"/>'
    chain = _chain(LINKS, LINK_MM, BEND_N_MM2 / LINK_MM, "hinge", 0.0, sphere)
    return (
        f'<mujoco><option gravity="0 0 0" timestep="{BEND_STEP_S}" integrator="implicitfast" cone="elliptic" '
        f'tolerance="1e-12" iterations="200"/><default><geom condim="1" contype="1" conaffinity="2" '
        f'solref="{2 * BEND_STEP_S} 1" solimp="0.9 0.9 0.01"/></default><worldbody>{"".join(walls)}'
        f'<body pos="{-LEAD_MM} 0 0"><inertial pos="0 0 0" mass="1" diaginertia="1 1 1"/>'
        f'<joint type="slide" axis="1 0 0"/>{chain}</body></worldbody></mujoco>'
    )


CASES = (cantilever, pushed_into_a_bend)
