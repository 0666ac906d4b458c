"""`simulate`: whole sequences of controls of many worlds, with one anatomy and one device.

Every world is a discrete Cosserat rod that slides out of the guiding catheter into the lumen. The time stepper is the
C++ core in `src/core`; this module checks its input, lays out the rod and returns what happened as a `Rollout`.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from jaxtyping import Float

from endopilot import _core
from endopilot.anatomy.projection import project_tip
from endopilot.devices.catheter import Catheter
from endopilot.devices.device import Device
from endopilot.devices.drive_limits import far_end_mm
from endopilot.devices.stack import Stack
from endopilot.errors import InputError, Remark
from endopilot.simulation.checks import check_distance_map, check_memory, check_sequences
from endopilot.simulation.config import FREE_BEHIND_MM, Actuation, SimulatorConfig
from endopilot.simulation.core import of_device, run_core
from endopilot.simulation.motion import Motion
from endopilot.simulation.rod import lay_out
from endopilot.simulation.tubes import lay_out_tubes
from endopilot.simulation.vessel_wall import make_wall
from endopilot.types import SAMPLE_PERIOD_S, Anatomy, CatheterMotion, Rollout

_OWN = ("inserted_length", "rotation", "shape")
"""Fields of `Rollout` that are not the core's as they are."""
_REASONS = {1: "left the finite numbers", 2: "did not converge", 3: "went through the wall"}
"""Meaning of `Rollout.reason` for an invalid world."""
WALL_FORCE_LIMIT_N = 0.7
"""Force on 2 mm of the wall that no navigation should exert, N. The fibrous cap of an occlusion of up to six weeks is
punctured at 0.72 ± 0.10 N (rabbit femoral arteries; Thind et al., puncture force of the proximal fibrous cap,
EuroIntervention). The atrial wall takes more: 1.7 N where it was ablated before and 2.9 N where it was not, under the
blunt tip of a 7 French catheter (pigs; Shah et al., Europace 2011). No such figure was found for the wall of a coronary
or cerebral artery."""


@dataclass(frozen=True)
class WallForceEvent:
    """A world whose wire presses the wall harder than `WALL_FORCE_LIMIT_N`.

    Attributes:
        world: its number.
        time_s: end of the first sample in which it does, s.
        force_n: largest force in any of its samples, N.
    """

    world: int
    time_s: float
    force_n: float


def simulate(
    anatomy: Anatomy,
    device: Device,
    control: Float[np.ndarray, "worlds samples numbers"],
    *,
    catheters: Sequence[Catheter] = (),
    actuation: Actuation = "velocity",
    initial: Float[np.ndarray, "worlds numbers"] | None = None,
    config: SimulatorConfig | None = None,
    record_shape: bool = False,
    friction: Float[np.ndarray, "worlds"] | None = None,
    period_s: float = SAMPLE_PERIOD_S,
    motion: Motion | None = None,
) -> Rollout:
    """Drive a device through an anatomy and record it every 0.5 s.

    The drive slips rather than push, pull or turn the wire harder than the device's limits, and stops when the wire is
    pulled out: controls, inserted lengths, rotations and the initial state of the answer are those that were made.
    Where force and torque are given, advance and rotation follow, and the answer's controls are the mean velocities
    that came of them.

    Results are the same to the last bit whatever the number of worlds, their order and the number of threads.

    Args:
        anatomy: the vessel.
        device: the wire.
        control: proximal velocities (mm/s, rad/s), or force and torque (N, N·mm) of the drive, constant over each
            sample period; two numbers for the wire, and two for each catheter.
        catheters: catheters around the wire, from the inside out.
        actuation: which of the two: "velocity" or "force"; catheters are driven by velocity.
        initial: inserted length (mm) and rotation (rad) before the first period, of the wire and of each catheter;
            zeros if not given. The wire is pushed there from the ostium at `config.approach_velocity_mm_s`, then rests
            for one period; catheters are pushed along with it.
        config: settings of the rod core.
        record_shape: record the positions of all nodes too.
        friction: Coulomb friction coefficient of the wire of each world; the device's own if not given.
        period_s: time that each control holds, and from one recorded sample to the next, s.
        motion: how the vessel moves with time; it lies still if not given.

    Raises:
        InputError: a period that is not positive; controls that are not finite or too fast for the device; a device
            that does not fit the vessel or the catheter around it; a distance map that is not finite, or negative at
            the ostium.
    """
    config, stack = config or SimulatorConfig(), Stack(device, tuple(catheters))
    numbers = 2 * len(stack.devices)
    if control.ndim != 3 or control.shape[2] != numbers:
        raise InputError(f"control: shape {control.shape}; give (worlds, samples, {numbers}), in mm/s and rad/s")
    worlds, samples = control.shape[:2]
    initial = np.zeros((worlds, numbers)) if initial is None else np.asarray(initial, dtype=float)
    friction = np.full(worlds, device.friction) if friction is None else np.asarray(friction, dtype=float)
    if initial.shape != (worlds, numbers):
        raise InputError(
            f"initial: shape {initial.shape}; give ({worlds}, {numbers}), inserted length in mm and rotation in rad"
        )
    if friction.shape != (worlds,):
        raise InputError(f"friction: shape {friction.shape}; give one number for each of the {worlds} worlds")
    _check_memory(worlds, samples, 0)
    control = np.ascontiguousarray(control, dtype=float)
    if not 0 < period_s < np.inf:
        raise InputError(f"period_s: {period_s}; give a positive number of seconds")
    commanded_mm, possible_mm = _check_drives(stack, control, initial, friction, actuation, period_s)
    stack.check(anatomy)
    check_distance_map(anatomy)
    path_mm = float(anatomy.tree.longest_path().abscissa[-1])
    if actuation == "force":
        commanded_mm = possible_mm = far_end_mm(anatomy)
    length_mm = max(path_mm, possible_mm) + FREE_BEHIND_MM
    rod = lay_out(device, element_mm=config.element_mm, length_mm=length_mm)
    _check_memory(worlds, samples, len(rod.abscissa_mm) if record_shape else 0)
    moving = None if motion is None else motion.core(np.asarray(anatomy.insertion.position), config.processor)
    result = run_core(
        rod,
        make_wall(anatomy, stack, config),
        anatomy.insertion,
        config=config,
        initial=initial,
        control=control,
        actuation=actuation,
        friction=np.column_stack([friction, *(np.full(worlds, each.friction) for each in stack.devices[1:])]),
        period_s=period_s,
        record_shape=record_shape,
        push_limit_n=stack.push_limit_n,
        pull_limit_n=device.pull_limit_n,
        torque_limit_n_mm=device.torque_limit_n_mm,
        tubes=lay_out_tubes(stack, length_mm=length_mm),
        motion=moving,
    )
    if record_shape:  # of the wire that was needed
        needed = max(path_mm, commanded_mm, float(result["inserted_length"].max())) + FREE_BEHIND_MM
        result["shape"] = result["shape"][:, :, : np.searchsorted(rod.abscissa_mm, needed) + 3]
    started = initial[:, :2] - result["approach_slip"][:, 0]
    rollout = make_rollout(anatomy, actuation, started, control[..., :2], of_device(result, 0), period_s=period_s)
    if moving is not None:
        rollout = replace(rollout, vessel_to_laboratory=moving.placements(period_s * np.arange(1, samples + 1))[0])
    if catheters:
        rollout = replace(rollout, catheters=catheter_motion(control, result, period_s))
    _report(rollout)
    return rollout


def _check_drives(
    stack: Stack,
    control: Float[np.ndarray, "worlds samples numbers"],
    initial: Float[np.ndarray, "worlds numbers"],
    friction: Float[np.ndarray, "worlds"],
    actuation: Actuation,
    period_s: float,
) -> tuple[float, float]:
    """Check the controls of all devices; return the largest inserted lengths as `check_sequences` does."""
    if stack.catheters and actuation == "force":
        raise InputError("actuation: 'force' with catheters; give 'velocity'")
    lengths = [
        check_sequences(
            device, control[..., 2 * k : 2 * k + 2], initial[:, 2 * k : 2 * k + 2], friction, actuation, period_s
        )
        for k, device in enumerate(stack.devices)
    ]
    return max(commanded for commanded, _ in lengths), max(possible for _, possible in lengths)


def catheter_motion(
    control: Float[np.ndarray, "worlds samples numbers"], result: Mapping[str, np.ndarray], period_s: float
) -> CatheterMotion:
    """Return what the core recorded of catheters as their motion.

    Args:
        control: what was asked of the drives, of the wire's first.
        result: arrays as `run_core` returns them.
        period_s: time of a sample, s.
    """
    asked = control[..., 2:].reshape(*control.shape[:2], -1, 2)
    of_catheters = {name: result[name][:, :, 1:] for name in CatheterMotion.__dataclass_fields__ if name != "control"}
    slip = np.stack([of_catheters["slip"], of_catheters["rotation_slip"]], axis=-1)
    return CatheterMotion(control=asked - slip / period_s, **of_catheters)


def make_rollout(
    anatomy: Anatomy,
    actuation: Actuation,
    started: Float[np.ndarray, "worlds 2"],
    control: Float[np.ndarray, "worlds samples 2"],
    result: Mapping[str, np.ndarray],
    *,
    period_s: float = SAMPLE_PERIOD_S,
) -> Rollout:
    """Return what the core recorded as a rollout.

    Args:
        anatomy: the vessel.
        actuation: what the controls are.
        started: inserted length (mm) and rotation (rad) before the first period.
        control: what was asked of the drive.
        result: arrays as `of_device` returns them.
        period_s: time of a sample, s.
    """
    start = started[:, None, :]
    if actuation == "velocity":
        slip = np.stack([result["slip"], result["rotation_slip"]], axis=-1)
        made = control - slip / period_s
        proximal = start + np.cumsum(made, axis=1) * period_s
    else:
        proximal = np.stack([result["inserted_length"], result["rotation"]], axis=-1)
        made = np.diff(proximal, axis=1, prepend=start) / period_s
    recorded: dict[str, Any] = {name: result[name] for name in RECORDED}
    return Rollout(
        sample_period_s=period_s,
        initial_inserted_length=started[:, 0],
        initial_rotation=started[:, 1],
        control=made,
        inserted_length=proximal[..., 0],
        rotation=proximal[..., 1],
        tip=project_tip(anatomy.tree, anatomy.insertion, result["tip_position"]),
        reason=result["reason"],
        shape=result.get("shape"),
        **recorded,
    )


RECORDED = tuple(name for name, *_ in _core.OUTPUTS if name in Rollout.__dataclass_fields__ and name not in _OWN)


def _check_memory(worlds: int, samples: int, recorded_nodes: int) -> None:
    needed = 8 * worlds * samples * (20 + 3 * recorded_nodes)
    check_memory(needed, f"control: {worlds} worlds of {samples} samples", "simulate fewer at once")


def why_invalid(rollout: Rollout, world: int) -> str:
    """Return why and when a world of a rollout became invalid, such as "did not converge after 12.5 s"."""
    seconds = rollout.sample_period_s * float(np.argmin(rollout.valid[world]))
    return f"{_REASONS[int(rollout.reason[world])]} after {seconds:g} s"


def wall_force_events(rollout: Rollout) -> tuple[WallForceEvent, ...]:
    """Return the worlds whose wire presses the wall harder than it should, in the order of their numbers.

    Forces are those at the ends of samples, of valid worlds.
    """
    force = np.where(rollout.valid, rollout.wall_force, 0.0)
    above = force > WALL_FORCE_LIMIT_N
    return tuple(
        WallForceEvent(world, rollout.sample_period_s * (int(np.argmax(above[world])) + 1), float(force[world].max()))
        for world in np.flatnonzero(above.any(axis=1)).tolist()
    )


def _report(rollout: Rollout) -> None:
    notes, worlds = [], len(rollout.valid)
    bad = np.flatnonzero(rollout.reason)
    if len(bad):
        first = int(bad[0])
        notes.append(f"{len(bad)} of {worlds} worlds are invalid; world {first} {why_invalid(rollout, first)}")
    events = wall_force_events(rollout)
    if events:
        notes.append(
            f"{len(events)} of {worlds} worlds press the wall with more than {WALL_FORCE_LIMIT_N:g} N; world "
            f"{events[0].world} after {events[0].time_s:g} s, with up to {events[0].force_n:.2f} N"
        )
    if notes:
        import warnings

        for note in notes:
            warnings.warn(note, Remark, stacklevel=3)
