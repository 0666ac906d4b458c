"""The simulator: one anatomy, one device, many worlds, each with controls of its own.

Every world is a discrete Cosserat rod that slides out of the guiding catheter into the lumen. The time stepper is the
C++ core in `src/core`; this module checks its input, lays the rod out and gives the answer as a `Rollout`.
"""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal

import numpy as np
from jaxtyping import Bool, Float

from endopilot import _core
from endopilot.anatomy.projection import project_tip
from endopilot.errors import InputError
from endopilot.parallel import CORES
from endopilot.progress import progress
from endopilot.simulation.device import Device, check_fits
from endopilot.simulation.rod import RodLayout, lay_out
from endopilot.types import SAMPLE_PERIOD_S, Anatomy, DistanceMap, Insertion, Rollout

FREE_BEHIND_MM = 3.0
"""Nodes farther behind the ostium than this follow the drive exactly, mm."""
_LARGEST_NEWTON_STEP = 0.3
"""Displacement of a node (mm) that one Newton step is clamped to; larger ones can tangle the wire for good."""
_MOST_ITERATIONS = 400
"""Newton iterations after which a time step is halved, down to 1/64; a wire that snaps over needs some hundred."""
LANES = _core.LANES
"""Worlds that one thread steps side by side."""
_DENT_MM = 0.015
"""Depth to which a node that bears the whole push limit dents the wall, mm, where the stiffness is not given."""
SPARE_MM = 20.0
"""Length that a wire can be driven beyond the end of the vessel's longest path, mm, where it is not known how far."""
Actuation = Literal["velocity", "force"]
"""What a control is: translation (mm/s) and rotation (rad/s), or the drive's axial force (N) and torque (N·mm)."""
_REASONS = {1: "left the finite numbers", 2: "did not converge"}
"""What `Rollout.reason` says of an invalid world."""
_OVERSHOOT_MM = 1e-2
"""Rounding of controls may carry the inserted length this far below 0, mm."""


@dataclass(frozen=True, kw_only=True)
class SimulatorConfig:
    """Settings of the rod core."""

    time_step_s: float = 0.0125
    """Time step, s; it must divide the sample period of 0.5 s. The tip's error grows about linearly with it."""
    tolerance_mm: float = 1e-3
    """Newton's method stops when its step moves no node farther than this, mm."""
    sample_tolerance_mm: float = 1e-6
    """The same for the time step that ends a sample (no more than `tolerance_mm`): its forces are recorded, and the
    wire is stiff axially."""
    elements: int = 100
    """Elements over the longest path of the anatomy; they are shorter near the tip."""
    wall_stiffness_n_mm: float | None = None
    """Stiffness of the vessel wall at a node, N/mm. If not given, the device's push limit dents it by 0.015 mm."""
    stick_velocity_mm_s: float = 0.05
    """Slip velocity under which smoothed Coulomb friction falls off, mm/s; a wire at rest creeps more slowly."""
    approach_velocity_mm_s: float = 20.0
    """Velocity at which a wire is brought to its first inserted length before the recording, mm/s."""
    largest_jump: float = 0.1
    """Motion of a node in a time step beyond the drive's own, mm (rotations: rad), above which the step is shortened:
    a wire that snaps over is followed in steps of down to 1/64 of `time_step_s`."""
    introducer_friction_n: float = 0.05
    """Coulomb friction of the introducer's valve, N; the drive feels it, the wire ahead of the valve does not."""
    introducer_drag_n_s_mm: float = 0.002
    """Viscous drag of the introducer's valve, N·s/mm."""
    threads: int = 0
    """Threads; 0 for one a processor core. The results do not depend on it."""

    def __post_init__(self) -> None:
        """Check every field.

        Raises:
            InputError: a field is out of its range.
        """
        positive = ("time_step_s", "tolerance_mm", "sample_tolerance_mm", "wall_stiffness_n_mm", "stick_velocity_mm_s")
        for name in (*positive, "largest_jump"):
            value = getattr(self, name)
            if value is not None and not 0 < value < np.inf:
                raise InputError(f"{name}: {value}; give a positive number")
        steps = SAMPLE_PERIOD_S / self.time_step_s
        if abs(steps - round(steps)) > 1e-6 or steps < 0.5:
            raise InputError(f"time_step_s: {self.time_step_s} does not divide {SAMPLE_PERIOD_S} s; give e.g. 0.0125")
        for name in ("introducer_friction_n", "introducer_drag_n_s_mm"):
            if not 0 <= getattr(self, name) < np.inf:
                raise InputError(f"{name}: {getattr(self, name)}; give 0 or a positive number")
        if not 0 < self.approach_velocity_mm_s < np.inf:
            raise InputError(f"approach_velocity_mm_s: {self.approach_velocity_mm_s}; give a positive velocity")
        if not 10 <= self.elements <= 2000:
            raise InputError(f"elements: {self.elements}; give 10 to 2000")
        if self.threads < 0:
            raise InputError(f"threads: {self.threads}; give 0 for all cores, or a positive number")

    @property
    def steps_per_sample(self) -> int:
        """Time steps in a sample period of 0.5 s."""
        return round(SAMPLE_PERIOD_S / self.time_step_s)

    def threads_for(self, worlds: int, lanes: int) -> int:
        """Return how many threads step some worlds, `lanes` of them side by side: no more than have one to step."""
        return min(self.threads or CORES, -(-worlds // lanes))


def simulate(
    anatomy: Anatomy,
    device: Device,
    control: Float[np.ndarray, "worlds samples 2"],
    *,
    actuation: Actuation = "velocity",
    initial: Float[np.ndarray, "worlds 2"] | None = None,
    config: SimulatorConfig | None = None,
    record_shape: bool = False,
    friction: Float[np.ndarray, "worlds"] | None = None,
) -> Rollout:
    """Drive a device through an anatomy and record it every 0.5 s.

    The drive slips rather than push harder than the device's push limit, and stops when the wire is pulled out:
    controls, inserted lengths and the initial state of the answer are those that were made. Where force and torque are
    given, advance and rotation follow, and the answer's controls are the mean velocities that came of them.

    Results are the same to the last bit whatever the number of worlds, their order and the number of threads.

    Args:
        anatomy: the vessel.
        device: the wire.
        control: proximal velocities (mm/s, rad/s), or force and torque (N, N·mm) of the drive, constant over each
            sample period.
        actuation: which of the two: "velocity" or "force".
        initial: inserted length (mm) and rotation (rad) before the first period; zeros if not given. The wire is
            pushed there from the ostium at `config.approach_velocity_mm_s`, then rests for one period.
        config: settings of the rod core.
        record_shape: record the positions of all nodes too.
        friction: Coulomb friction coefficient of each world; the device's own if not given.

    Raises:
        InputError: controls that are not finite, too fast for the device or pull the wire out of the catheter; a
            device that does not fit; a distance map that is not finite, or negative at the ostium.
    """
    config = config or SimulatorConfig()
    if control.ndim != 3 or control.shape[2] != 2:
        raise InputError(f"control: shape {control.shape}; give (worlds, samples, 2), in mm/s and rad/s")
    worlds, samples = control.shape[:2]
    initial = np.zeros((worlds, 2)) if initial is None else np.asarray(initial, dtype=float)
    friction = np.full(worlds, device.friction) if friction is None else np.asarray(friction, dtype=float)
    if initial.shape != (worlds, 2):
        raise InputError(
            f"initial: shape {initial.shape}; give ({worlds}, 2), inserted length in mm and rotation in rad"
        )
    if friction.shape != (worlds,):
        raise InputError(f"friction: shape {friction.shape}; give one number for each of the {worlds} worlds")
    _check_memory(worlds, samples, 0)
    control = np.ascontiguousarray(control, dtype=float)
    deepest = _check_controls(device, control, initial, friction, actuation)
    check_fits(device, anatomy)
    check_distance_map(anatomy)
    path_mm = float(anatomy.tree.longest_path().abscissa[-1])
    rod = lay_out(
        device,
        path_mm=path_mm,
        elements=config.elements,
        length_mm=max(path_mm, deepest if actuation == "velocity" else path_mm + SPARE_MM) + FREE_BEHIND_MM,
    )
    _check_memory(worlds, samples, len(rod.abscissa_mm) if record_shape else 0)
    result = run_core(
        rod,
        make_lumen(anatomy.distance_map, device.tip_radius_mm),
        anatomy.insertion,
        config=config,
        initial=initial,
        control=control,
        actuation=actuation,
        friction=friction,
        record_shape=record_shape,
        push_limit_n=device.push_limit_n,
    )
    started = initial.copy()
    started[:, 0] -= result["approach_slip"]
    rollout = make_rollout(anatomy, actuation, started, control, result)
    _report_invalid(rollout)
    return rollout


def make_rollout(
    anatomy: Anatomy,
    actuation: Actuation,
    started: Float[np.ndarray, "worlds 2"],
    control: Float[np.ndarray, "worlds samples 2"],
    result: Mapping[str, np.ndarray],
) -> Rollout:
    """Return what the core recorded as a rollout.

    Args:
        anatomy: the vessel.
        actuation: what the controls are.
        started: inserted length (mm) and rotation (rad) before the first period.
        control: what was asked of the drive.
        result: arrays as `run_core` returns them.
    """
    start = started[:, None, :]
    if actuation == "velocity":
        made = control.copy()
        made[..., 0] -= result["slip"] / SAMPLE_PERIOD_S
        proximal = start + np.cumsum(made, axis=1) * SAMPLE_PERIOD_S
    else:
        proximal = np.stack([result["inserted_length"], result["rotation"]], axis=-1)
        made = np.diff(proximal, axis=1, prepend=start) / SAMPLE_PERIOD_S
    return Rollout(
        sample_period_s=SAMPLE_PERIOD_S,
        initial_inserted_length=started[:, 0],
        initial_rotation=started[:, 1],
        control=made,
        inserted_length=proximal[..., 0],
        rotation=proximal[..., 1],
        tip=project_tip(anatomy.tree, anatomy.insertion, result["tip_position"]),
        reason=result["reason"],
        shape=result.get("shape"),
        **{name: result[name] for name in RECORDED},
    )


RECORDED = (
    "tip_position",
    "tip_direction",
    "contact_force_max",
    "contact_force_sum",
    "base_force",
    "base_torque",
    "drive_force",
    "drive_torque",
    "slip",
    "iterations",
    "valid",
)


def run_core(
    rod: RodLayout,
    lumen: _core.Lumen | None,
    insertion: Insertion,
    *,
    config: SimulatorConfig,
    initial: Float[np.ndarray, "worlds 2"],
    control: Float[np.ndarray, "worlds samples 2"],
    friction: Float[np.ndarray, "worlds"],
    actuation: Actuation = "velocity",
    loads: _core.Loads | None = None,
    record_shape: bool = False,
    record_attitude: bool = False,
    lanes: int = LANES,
    approach: bool = True,
    free_behind_mm: float = FREE_BEHIND_MM,
    push_limit_n: float = 2.0,
) -> dict[str, np.ndarray]:
    """Run the C++ core on checked input. The simulator and the verification both come through here.

    Args:
        rod: nodes and stiffnesses.
        lumen: the wall, or None for a rod in the open.
        insertion: the point and the direction along which the base slides.
        config: settings.
        initial: inserted length (mm) and rotation (rad) of each world before the first period.
        control: mm/s and rad/s, or N and N·mm.
        friction: Coulomb coefficients.
        actuation: what the controls are.
        loads: dead loads and springs.
        record_shape: record node positions, mm.
        record_attitude: record element orientations, quaternions w x y z.
        lanes: worlds stepped side by side by one thread: 1, 4 or 8.
        approach: bring the wire to its first inserted length from the ostium; else it starts there, straight.
        free_behind_mm: nodes farther behind the insertion point follow the drive, mm.
        push_limit_n: force at which the drive slips, N; of the device, where there is one.

    Returns:
        The arrays of `Rollout` that need no centerline, and `reason`: 0 fine, 1 not finite, 2 not converged.
    """
    simulation = _core.Simulation(
        rod=rod.model(),
        lumen=lumen,
        loads=loads,
        **insertion_arguments(insertion),
        options=core_options(
            config,
            push_limit_n=push_limit_n,
            approach=approach,
            free_behind_mm=free_behind_mm,
        ),
        worlds=len(control),
    )
    simulation.reset(
        index=np.arange(len(control)),
        initial=np.ascontiguousarray(initial, dtype=float),
        friction=np.ascontiguousarray(friction, dtype=float),
        sample_period=SAMPLE_PERIOD_S,
    )
    with progress("Simulating the wire", total=control.shape[0] * control.shape[1]) as advance:
        result = simulation.run(
            control=np.ascontiguousarray(control, dtype=float),
            force_driven=actuation == "force",
            time_step=config.time_step_s,
            steps_per_sample=config.steps_per_sample,
            record_shape=record_shape,
            record_attitude=record_attitude,
            threads=config.threads_for(len(control), lanes),
            lanes=lanes,
            progress=advance,
        )
    return {**result, "reason": simulation.reason().astype(int)}


def insertion_arguments(insertion: Insertion) -> dict[str, np.ndarray]:
    """Return an insertion as the core wants it: `origin`, mm, and `orientation`, a quaternion w x y z."""
    return {
        "origin": np.asarray(insertion.position, dtype=float),
        "orientation": _base_orientation(np.asarray(insertion.direction, dtype=float)),
    }


def core_options(
    config: SimulatorConfig,
    *,
    push_limit_n: float,
    free_behind_mm: float,
    approach: bool = True,
) -> _core.Options:
    """Return the settings as the core wants them."""
    options = _core.Options()
    options.stick_velocity = config.stick_velocity_mm_s
    options.wall_stiffness = wall_stiffness(config, push_limit_n)
    options.tolerance = config.tolerance_mm
    options.sample_tolerance = min(config.sample_tolerance_mm, config.tolerance_mm)
    options.largest_step = _LARGEST_NEWTON_STEP
    options.largest_jump = config.largest_jump
    options.most_iterations = _MOST_ITERATIONS
    options.free_behind = free_behind_mm
    options.push_limit = push_limit_n
    options.approach_velocity = config.approach_velocity_mm_s if approach else 0.0
    options.introducer_friction = config.introducer_friction_n
    options.introducer_drag = config.introducer_drag_n_s_mm
    return options


def wall_stiffness(config: SimulatorConfig, push_limit_n: float) -> float:
    """Return the stiffness of the wall at a node, N/mm, for a device of some push limit."""
    return config.wall_stiffness_n_mm or push_limit_n / _DENT_MM


def make_lumen(distance_map: DistanceMap, radius_mm: float) -> _core.Lumen:
    """Return the wall as the core wants it, a quadratic B-spline through the map, for a wire of some radius."""
    spacing = float(distance_map.spacing_mm)
    return _core.make_lumen(
        values=np.ascontiguousarray(distance_map.values, dtype=np.float32),
        origin=np.asarray(distance_map.origin_mm, dtype=float),
        spacing=spacing,
        near=radius_mm + spacing,
        far=0.5,
    )


def check_distance_map(anatomy: Anatomy) -> None:
    """Check that the distance map is finite, and positive at the ostium and around it along the catheter's axis.

    Raises:
        InputError: it is not.
    """
    field, insertion = anatomy.distance_map, anatomy.insertion
    if not np.isfinite(field.values).all():
        raise InputError(f"{anatomy.name}: the distance map has values that are not finite; extract it again")
    if not 0 < field.spacing_mm < np.inf:
        raise InputError(
            f"{anatomy.name}: the distance map's spacing_mm is {field.spacing_mm}; give a positive spacing"
        )
    if not np.isfinite(insertion.position).all():
        raise InputError(f"{anatomy.name}: insertion.position = {insertion.position} is not finite; extract it again")
    if not abs(float(np.linalg.norm(insertion.direction)) - 1) <= 1e-3:
        raise InputError(f"{anatomy.name}: insertion.direction = {insertion.direction} is no unit vector; normalise it")
    for along in (-FREE_BEHIND_MM, 0.0, 1.0):
        point = insertion.position + along * insertion.direction
        index = np.round((point - field.origin_mm) / field.spacing_mm).astype(int)[::-1]
        inside = (index >= 0).all() and (index < field.values.shape).all()
        value = float(field.values[tuple(index)]) if inside else -np.inf
        if value <= 0:
            raise InputError(
                f"{anatomy.name}: the distance map is {value:.2f} mm at {along:+g} mm from the ostium along the "
                "catheter, where it must be positive (inside); check the insertion and the sign of the map"
            )


def _check_controls(
    device: Device,
    control: Float[np.ndarray, "worlds samples 2"],
    initial: Float[np.ndarray, "worlds 2"],
    friction: Float[np.ndarray, "worlds"],
    actuation: Actuation,
) -> float:
    """Check controls, initial state and friction, and return the largest inserted length that they name, mm."""
    if actuation not in ("velocity", "force"):
        raise InputError(f"actuation: {actuation!r}; give 'velocity' or 'force'")
    worlds, samples = control.shape[:2]
    if worlds == 0 or samples == 0:
        raise InputError(f"control: {worlds} worlds of {samples} samples; give at least one of one")
    limits = (("translation", device.max_velocity_mm_s, "mm/s"), ("rotation", device.max_rotation_rad_s, "rad/s"))
    if actuation == "force":
        limits = (("force", np.inf, "N"), ("torque", np.inf, "N·mm"))
    for axis, (name, limit, unit) in enumerate(limits):
        _check(~np.isfinite(control[..., axis]), control[..., axis], f"{name} is no finite number; correct it")
        fast = np.abs(control[..., axis]) > limit * (1 + 1e-6)
        _check(fast, control[..., axis], f"{name} in {unit} exceeds {device.name}'s limit of {limit:g}; slow down")
    _check(~np.isfinite(initial), initial, "initial state is no finite number; correct it")
    _check(~(np.isfinite(friction) & (friction >= 0)), friction, "friction must be a finite number of 0 or more")
    advance = SAMPLE_PERIOD_S * control[..., 0] if actuation == "velocity" else np.zeros(control.shape[:2])
    inserted = np.cumsum(np.column_stack([initial[:, 0], advance]), axis=1)
    _check(inserted < -_OVERSHOOT_MM, inserted, "inserted length in mm is negative; pull less, or start deeper")
    return float(inserted.max())


def _check(bad: Bool[np.ndarray, "worlds *rest"], values: Float[np.ndarray, "worlds *rest"], what: str) -> None:
    if bad.any():
        where = [int(i) for i in np.argwhere(bad)[0]]
        at = f", sample {where[1]}" if len(where) > 1 else ""
        raise InputError(f"world {where[0]}{at}: {values[tuple(where)]:g}: {what}")


def _check_memory(worlds: int, samples: int, recorded_nodes: int) -> None:
    needed = 8 * worlds * samples * (20 + 3 * recorded_nodes)
    check_memory(needed, f"control: {worlds} worlds of {samples} samples", "simulate fewer at once")


def check_memory(needed: int, what: str, mend: str) -> None:
    """Check that `needed` bytes are at most 0.8 of the machine's memory.

    Raises:
        InputError: they are more; it begins with `what` needs them and ends with the mend.
    """
    available = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    if needed > 0.8 * available:
        raise InputError(f"{what} need {needed / 2**30:.1f} GiB of {available / 2**30:.1f}; {mend}")


def why_invalid(rollout: Rollout, world: int) -> str:
    """Return why and when a world of a rollout became invalid, such as "did not converge after 12.5 s"."""
    seconds = rollout.sample_period_s * float(np.argmin(rollout.valid[world]))
    return f"{_REASONS[int(rollout.reason[world])]} after {seconds:g} s"


def _report_invalid(rollout: Rollout) -> None:
    bad = np.flatnonzero(rollout.reason)
    if len(bad) == 0:
        return
    import warnings

    first = int(bad[0])
    warnings.warn(
        f"{len(bad)} of {len(rollout.valid)} worlds are invalid; world {first} {why_invalid(rollout, first)}",
        stacklevel=3,
    )


def _base_orientation(direction: Float[np.ndarray, "3"]) -> Float[np.ndarray, "4"]:
    """Return the quaternion (w x y z) of the shortest turn that takes the third axis to `direction`."""
    axis = np.array([-direction[1], direction[0], 0.0])
    quaternion = np.array([1 + direction[2], *axis])
    norm = np.linalg.norm(quaternion)
    return quaternion / norm if norm > 1e-6 else np.array([0.0, 1.0, 0.0, 0.0])
