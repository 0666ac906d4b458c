"""`simulate`: whole sequences of controls of many worlds, with one anatomy and one stack of devices."""

from __future__ import annotations

import warnings
from pathlib import Path

import numpy as np
from jaxtyping import Float, Int

from endopilot.devices.device import Wire
from endopilot.devices.stack import Stack
from endopilot.errors import InputError, Remark
from endopilot.progress import progress
from endopilot.settings import public
from endopilot.simulation.checks import check_control, check_memory, check_shape_memory, with_device_axis
from endopilot.simulation.config import Actuation, SimulatorConfig
from endopilot.simulation.motion import Motion, MotionName, motion_named
from endopilot.simulation.simulator import Simulator
from endopilot.simulation.trajectory import SimulationSetUp, Trajectory
from endopilot.types import SAMPLE_PERIOD_S, Anatomy

WALL_FORCE_LIMIT_N = 0.7
"""Force on 2 mm of the wall that no navigation should exert, N. The fibrous cap of an occlusion of up to six weeks is
punctured at 0.72 ± 0.10 N (rabbit femoral arteries; Thind et al., puncture force of the proximal fibrous cap,
EuroIntervention). The atrial wall takes more: 1.7 N where it was ablated before and 2.9 N where it was not, under the
blunt tip of a 7 French catheter (pigs; Shah et al., Europace 2011). No such figure was found for the wall of a coronary
or cerebral artery."""


LONGEST_MM = 5000.0  # no wire or catheter is longer, mm: exchange wires have up to 4.5 m


@public
def simulate(
    anatomy: Anatomy,
    device: Wire | Stack | str | Path,
    control: Float[np.ndarray, "worlds samples *devices 2"],
    *,
    actuation: Actuation = "velocity",
    initial: Float[np.ndarray, "worlds ... 2"] | None = None,
    friction: Float[np.ndarray, "worlds ..."] | None = None,
    motion: Motion | MotionName | None = None,
    config: SimulatorConfig | None = None,
    record_shape: bool = False,
    period_s: float = SAMPLE_PERIOD_S,
) -> Trajectory:
    """Drive devices through an anatomy and record them at the end of each control: a new `Simulator`, and its `run`.

    The drive slips rather than push, pull or turn a device harder than its limits, and stops when the device is pulled
    out: `Trajectory.control` is what was made. Where force and torque are given, advance and rotation follow.

    Results are the same to the last bit whatever the number of worlds, their order and the number of threads.

    Args:
        anatomy: the vessel.
        device: the wire or its name, or the wire and its catheters; a wire alone needs no axis of devices below.
        control: proximal velocities (mm/s, rad/s), or force and torque (N, N·mm) of the drive, constant over each
            period, of each device.
        actuation: which of the two: "velocity" or "force"; catheters are driven by velocity.
        initial: inserted length (mm) and rotation (rad) of each device before the first period; zeros if not given.
            The wire is pushed there from the ostium at `config.approach_velocity_mm_s`, with its catheters along with
            it, then rests for 0.5 s.
        friction: Coulomb friction coefficients on the wall; the devices' own if not given.
        motion: how the vessel moves with time, or the name of a motion such as "breathing"; it lies still if not given.
        config: settings of the rod core.
        record_shape: record the positions of all nodes too.
        period_s: time that each control holds, and from one recorded sample to the next, s.

    Raises:
        InputError: a period that is not positive; controls that are not finite or too fast for the device; a device
            that does not fit the vessel or the catheter around it; a distance map that is not finite, or negative at
            the ostium.
    """
    stack = Stack.of(device)
    if control.ndim not in (3, 4) or 0 in control.shape:
        raise InputError(
            f"control: shape {control.shape}; give (worlds, samples, {len(stack)}, 2), at least one of one"
        )
    worlds, samples = control.shape[:2]
    control = with_device_axis("control", control, (worlds, samples, len(stack), 2))
    if initial is None:
        initial = np.zeros((worlds, len(stack), 2))
    if friction is None:
        friction = stack.frictions(np.full(worlds, stack.wire.friction))
    set_up = SimulationSetUp(
        anatomies=[anatomy] * worlds,
        stacks=[stack] * worlds,
        initial=with_device_axis("initial", np.asarray(initial, dtype=float), (worlds, len(stack), 2)),
        friction=with_device_axis("friction", np.asarray(friction, dtype=float), (worlds, len(stack))),
        actuation=actuation,
        motion=motion_named(motion) if isinstance(motion, str) else motion,
        config=config or SimulatorConfig(),
    )
    trajectory = run_set_up(set_up, control, period_s=period_s, record_shape=record_shape)
    _report(trajectory)
    return trajectory


def run_set_up(
    set_up: SimulationSetUp,
    command: Float[np.ndarray, "worlds samples devices 2"],
    *,
    period_s: float,
    record_shape: bool,
) -> Trajectory:
    """Drive worlds from their start with a sequence of commands each (mm/s and rad/s, or N and N·mm)."""
    worlds, samples = command.shape[:2]
    check_memory(8 * worlds * samples * 20, f"control: {worlds} worlds of {samples} samples", "simulate fewer at once")
    if not 0 < period_s < np.inf:
        raise InputError(f"period_s: {period_s}; give a positive number of seconds")
    check_control(command, set_up.largest, set_up.stacks, set_up.actuation)
    if not np.isfinite(set_up.initial).all():
        raise InputError(f"initial: world {int(np.argwhere(~np.isfinite(set_up.initial))[0][0])}: not a finite number")
    start = set_up.initial[..., 0]
    if (start > LONGEST_MM).any():
        world = int(np.argmax(start.max(axis=1)))
        raise InputError(f"initial: world {world}: {start[world].max():g} mm inserted; give at most {LONGEST_MM:g}")
    reach_mm = 0.0
    if set_up.actuation == "velocity":
        # A drive that slips leaves in the vessel what it did not pull back, and pushes on from there.
        ahead = np.maximum(command[..., 0], 0.0).sum(axis=1) * period_s
        reach_mm = float(np.max(ahead)) + float(np.max(start, initial=0.0))
    simulator = Simulator(
        set_up.anatomies,
        set_up.stacks,
        actuation=set_up.actuation,
        motion=set_up.motion,
        config=set_up.config,
        reach_mm=reach_mm,
    )
    if record_shape:
        check_shape_memory(worlds, samples, simulator.nodes)
    simulator.reset(inserted_length=start, rotation=set_up.initial[..., 1], friction=set_up.friction)
    with progress("Simulating the wire", total=worlds * samples) as advance:
        return simulator.run(command, period_s=period_s, record_shape=record_shape, advance=advance)


def wall_force_worlds(trajectory: Trajectory) -> Int[np.ndarray, "pressing"]:
    """Return the numbers of the worlds whose wire, while they are valid, presses the wall harder than it should."""
    return np.flatnonzero((trajectory.valid & (trajectory.wall_force > WALL_FORCE_LIMIT_N)).any(axis=1))


def _report(trajectory: Trajectory) -> None:
    notes, worlds = [], len(trajectory.valid)
    bad, pressing = np.flatnonzero(trajectory.reason), wall_force_worlds(trajectory)
    if len(bad):
        first = int(bad[0])
        notes.append(f"{len(bad)} of {worlds} worlds are invalid; world {first} {trajectory.why_invalid(first)}")
    if len(pressing):
        force = np.where(trajectory.valid, trajectory.wall_force, 0.0)[pressing[0]]
        time_s = trajectory.period_s * (int(np.argmax(force > WALL_FORCE_LIMIT_N)) + 1)
        notes.append(
            f"{len(pressing)} of {worlds} worlds press the wall with more than {WALL_FORCE_LIMIT_N:g} N; world "
            f"{pressing[0]} after {time_s:g} s, with up to {force.max():.2f} N"
        )
    for note in notes:
        warnings.warn(note, Remark, stacklevel=3)
