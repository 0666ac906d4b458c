"""The interface to the C++ core: anatomy, device and settings as the core takes them, and one run of it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from endopilot import _core
from endopilot.progress import progress
from endopilot.simulation.config import (
    COMPLIANT_WALL_AT_TIP_MM,
    COMPLIANT_WALL_STIFFENING_MM2,
    FREE_BEHIND_MM,
    LANES,
    Actuation,
    CoreMotion,
    CoreTransmission,
    Lumen,
    Options,
    Processor,
    Simulation,
    SimulatorConfig,
    core_for,
    gpu_errors,
    wall_stiffness,
)
from endopilot.simulation.rod import RodLayout, TubeLayout
from endopilot.types import SAMPLE_PERIOD_S, DistanceMap, Insertion

_LARGEST_NEWTON_STEP = 0.3  # a node's displacement (mm) in a Newton step at most; larger ones tangle the wire
_MAX_ITERATIONS = 400  # then a time step is halved, down to 1/64; a wire that snaps over needs some hundred
_OF_DEVICES = frozenset(name for name, of, *_ in _core.OUTPUTS if of == "device")


def run_core(
    rod: RodLayout,
    lumen: Lumen | None,
    insertion: Insertion,
    *,
    config: SimulatorConfig,
    initial: Float[np.ndarray, "worlds numbers"],
    control: Float[np.ndarray, "worlds samples numbers"],
    friction: Float[np.ndarray, "worlds *devices"],
    actuation: Actuation = "velocity",
    record_shape: bool = False,
    record_attitude: bool = False,
    lanes: int = LANES,
    push_limit_n: float = np.inf,
    pull_limit_n: float = np.inf,
    torque_limit_n_mm: float = np.inf,
    tubes: TubeLayout | None = None,
    **made_of: Any,
) -> dict[str, np.ndarray]:
    """Run the C++ core on rods and walls of one's own making; `made_of` is what else `make_simulation` takes.

    Devices begin at inserted lengths (mm) and rotations (rad); controls are mm/s and rad/s, or N and N·mm, as
    `actuation` says. One thread steps 1, 4 or 8 `lanes` of worlds side by side. The drive slips at the limits where it
    pushes and pulls, N, and turns, N·mm. Returned are the arrays of `_core.OUTPUTS`, with an axis of devices where they
    are of devices; `reason`: 0 fine, 1 not finite, 2 not converged; `contacts`: the wall's force at each node and on
    the element behind it, N.
    """
    limits = np.array([[push_limit_n, pull_limit_n, torque_limit_n_mm]]) if tubes is None else tubes.limits
    worlds, samples, devices = len(control), control.shape[1], len(limits)
    control = np.ascontiguousarray(control, dtype=float).reshape(worlds, samples, devices, 2)
    simulation = make_simulation(
        rod,
        lumen,
        insertion,
        limits=limits,
        push_limit_n=push_limit_n,
        worlds=worlds,
        config=config,
        tubes=tubes,
        **made_of,
    )
    simulation.reset(
        index=np.arange(worlds),
        initial=np.ascontiguousarray(initial, dtype=float).reshape(worlds, devices, 2),
        friction=np.ascontiguousarray(friction, dtype=float).reshape(worlds, devices),
        sample_period=SAMPLE_PERIOD_S,
    )

    with gpu_errors(config.processor), progress("Simulating the wire", total=worlds * samples) as advance:
        result = simulation.run(
            control=control,
            force_driven=actuation == "force",
            time_step=config.time_step_s,
            steps_per_sample=config.steps_per_sample,
            record_shape=record_shape,
            record_attitude=record_attitude,
            threads=config.threads_for(worlds, lanes),
            lanes=lanes,
            chosen=np.arange(worlds),
            progress=advance,
        )
    return {**result, "reason": simulation.reason().astype(int), "contacts": simulation.contacts()}


def make_simulation(
    rod: RodLayout,
    lumen: Lumen | None,
    insertion: Insertion,
    *,
    limits: Float[np.ndarray, "devices 3"],
    push_limit_n: float,
    worlds: int,
    config: SimulatorConfig,
    tubes: TubeLayout | None = None,
    motion: CoreMotion | None = None,
    transmission: CoreTransmission | None = None,
    loads: _core.Loads | None = None,
    approach: bool = True,
    free_behind_mm: float = FREE_BEHIND_MM,
) -> Simulation:
    """Return worlds as the core has them; everything that is simulated comes through here.

    Of the rod with tubes, the nodes alone count, and the drag. Each drive slips at its limits: push (N), pull (N) and
    torque (N·mm); what all together can push with, N, sizes the wall's stiffness. Devices `approach` their first
    inserted length from the ostium, else they start there, straight; nodes farther behind the insertion point than
    `free_behind_mm` follow the drive.
    """
    core = core_for(config.processor)
    with gpu_errors(config.processor):
        return core.Simulation(
            rod=rod.model(config.processor),
            lumen=lumen,
            loads=loads,
            **insertion_arguments(insertion),
            options=core_options(config, push_limit_n=push_limit_n, approach=approach, free_behind_mm=free_behind_mm),
            drives=core.make_drives(limits),
            tubes=None if tubes is None else tubes.model(config.processor),
            motion=motion,
            transmission=transmission,
            worlds=worlds,
        )


@dataclass(frozen=True, eq=False)
class Loading:
    """Dead loads and springs on a rod; see `Loads` in the core. Entry i belongs to node i or element i."""

    force_n: Float[np.ndarray, "n 3"]
    moment_n_mm: Float[np.ndarray, "n 3"]
    spring_n_mm: Float[np.ndarray, "n 3"]
    anchor_mm: Float[np.ndarray, "n 3"]
    hold_n_mm: Float[np.ndarray, "n"]
    attitude: Float[np.ndarray, "n 4"]

    @classmethod
    def none(cls, nodes: int) -> Loading:
        """Return no loads on a rod of `nodes` nodes."""
        zero, attitude = np.zeros((nodes, 3)), np.tile([1.0, 0.0, 0.0, 0.0], (nodes, 1))
        return cls(zero, zero.copy(), zero.copy(), zero.copy(), np.zeros(nodes), attitude)

    def core(self) -> _core.Loads:
        """Return the loads as the core wants them."""
        return _core.make_loads(**{name.partition("_")[0]: value for name, value in vars(self).items()})


def of_device(result: Mapping[str, np.ndarray], device: int) -> dict[str, np.ndarray]:
    """Return what the core recorded of one device, the wire (0) or a catheter, and of all devices together."""
    return {name: values[:, :, device] if name in _OF_DEVICES else values for name, values in result.items()}


def insertion_arguments(insertion: Insertion) -> dict[str, np.ndarray]:
    """Return an insertion as the core wants it: `origin`, mm, and `orientation`, a quaternion w x y z of the wire's
    axes at φ = 0: the third along it, the second against its bend. Where φ's zero is that of the world's axes, it is
    the shortest turn that takes the third axis to the direction."""
    direction, zero = np.asarray(insertion.direction, dtype=float), insertion.rotation_zero
    if isinstance(zero, np.ndarray):
        axes = np.column_stack([np.cross(direction, zero), -zero, direction])
        orientation = Rotation.from_matrix(axes).as_quat(canonical=True, scalar_first=True)
    else:
        quaternion = np.array([1 + direction[2], -direction[1], direction[0], 0.0])
        norm = np.linalg.norm(quaternion)
        orientation = quaternion / norm if norm > 1e-6 else np.array([0.0, 1.0, 0.0, 0.0])
    return {"origin": np.asarray(insertion.position, dtype=float), "orientation": orientation}


def core_options(
    config: SimulatorConfig, *, push_limit_n: float, free_behind_mm: float, approach: bool = True
) -> Options:
    """Return the settings as the core wants them; what all drives can push with, N, sizes the wall's stiffness."""
    options = core_for(config.processor).Options()
    options.stick_velocity = config.stick_velocity_mm_s
    options.wall_stiffness = wall_stiffness(config, push_limit_n)
    options.foundation = (config.compliant_wall_n_mm2 or 0.0) * config.wall_factors(max)
    options.foundation_stiffening = COMPLIANT_WALL_STIFFENING_MM2
    options.foundation_at_tip = COMPLIANT_WALL_AT_TIP_MM
    options.tolerance = config.tolerance_mm
    options.sample_tolerance = min(config.sample_tolerance_mm, config.tolerance_mm)
    options.largest_step = _LARGEST_NEWTON_STEP
    options.largest_jump = config.largest_jump
    options.max_iterations = _MAX_ITERATIONS
    options.free_behind = free_behind_mm
    options.approach_velocity = config.approach_velocity_mm_s if approach else 0.0
    options.introducer_friction = config.introducer_friction_n
    options.introducer_drag = config.introducer_drag_n_s_mm
    return options


def make_lumen(
    distance_map: DistanceMap,
    radius_mm: float,
    processor: Processor = "cpu",
    *,
    far_mm: float = 0.5,
    finer: int = 1,
    spheres: Float[np.ndarray, "lines 8"] | None = None,
) -> Lumen:
    """Return the wall for a wire of some radius, a quadratic B-spline through the map, which ends `far_mm` outside. On
    a grid `finer` by a whole number, `spheres` (ends of their centres' lines, LPS, and radii there, mm) make it sharp.
    """
    spacing = float(distance_map.spacing_mm)
    return core_for(processor).make_lumen(
        values=np.ascontiguousarray(distance_map.values, dtype=np.float32),
        origin=np.asarray(distance_map.origin_mm, dtype=float),
        spacing=spacing,
        near=radius_mm + spacing,
        far=far_mm,
        finer=finer,
        spheres=np.zeros((0, 8)) if spheres is None else np.ascontiguousarray(spheres, dtype=float),
    )
