"""`endopilot simulate`: anatomy and proximal controls -> motion of wire and catheters, and their contact forces."""

from __future__ import annotations

import sys
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any

import numpy as np

from endopilot.anatomy.io import read_anatomy
from endopilot.cli.arguments import Figures
from endopilot.control.plan_file import read_plan
from endopilot.dataset.navigations import simulate_navigations
from endopilot.devices.stack import Stack
from endopilot.errors import InputError
from endopilot.extras import require_extras
from endopilot.progress import progress
from endopilot.runs import Existing, Picture
from endopilot.settings import LONGEST_S, Seed, Within, settings
from endopilot.simulation.config import SimulatorConfig
from endopilot.simulation.controls import ControlConfig, random_controls, read_controls_csv
from endopilot.simulation.motion import MotionName, motion_named
from endopilot.simulation.simulate import simulate, wall_force_worlds
from endopilot.simulation.trajectory import WRITTEN, SimulationSetUp, Trajectory, read_trajectory, trajectory_suffix
from endopilot.types import SAMPLE_PERIOD_S, Anatomy


@settings
class RandomConfig:
    """The random navigations that are simulated if no controls are given: a tip stops 5 mm before the end of its
    branch, where the image ends and not the vessel, and a caught wire is pulled back."""

    sequences: Annotated[int, Within(1, 100000)] = 8
    """Number of navigations."""
    seconds: Annotated[float, Within(SAMPLE_PERIOD_S, LONGEST_S)] = 60.0
    """Length of a navigation, s."""
    seed: Seed = 0
    """Seed of the random controls."""


def simulate_command(
    anatomy: Existing,
    /,
    *,
    output: Annotated[Path, WRITTEN],
    device: str | None = None,
    catheter: tuple[str, ...] = (),
    controls: Existing | None = None,
    motion: MotionName = "still",
    motion_seed: Seed | None = None,
    shape: bool = False,
    picture: Picture | None = None,
    random: RandomConfig = RandomConfig(),
    config: SimulatorConfig = SimulatorConfig(),
) -> Figures:
    """Drive a guidewire through an anatomy and record it at 2 Hz, or at the end of each control of a file.

    Args:
        output: .parquet or .csv with a row for each sample, or .npz with all arrays.
        device: name of a device (`endopilot devices`) or a YAML file; workhorse-014 if not given.
        controls: CSV of scripted proximal velocities (time_s, translation_mm_s, rotation_rad_s, those of catheters as
            catheter_1_translation_mm_s, ...), or what is driven again to the bit with its own devices, motion and
            settings: a trajectory (.npz), such as `endopilot navigate` writes, or a folder made by `endopilot plan`;
            random ones by default.
        motion: how heart and breath move the vessel and the guiding catheter: still, breathing, heartbeat or both.
        motion_seed: draws the patient's amplitudes from the published distributions; their means by default.
        shape: also record the positions of all nodes, mm (.npz only).
        picture: PNG of the vessel with the first navigation's wire and catheters at its end.
        random: the random controls, if no others are given.
    """
    trajectory_suffix(output, shape=shape)  # before the work
    if picture is not None:
        require_extras("report")
    patient = read_anatomy(anatomy)
    stack = Stack.of(device or "workhorse-014", *catheter)
    moves, stopped = motion_named(motion, motion_seed), None
    also: dict[str, Any] = {"motion": moves, "record_shape": shape or picture is not None}
    if controls is None:
        initial, control = random_controls(
            ControlConfig(),
            devices=len(stack),
            n_sequences=random.sequences,
            n_samples=round(random.seconds / SAMPLE_PERIOD_S),
            seed=random.seed,
            max_inserted_length_mm=float(patient.tree.longest_path().abscissa[-1]),
        )
        worlds, samples = control.shape[:2]
        frictions = stack.frictions(np.full(worlds, stack.wire.friction))
        set_up = SimulationSetUp([patient] * worlds, [stack] * worlds, initial, frictions, "velocity", moves, config)
        with progress("Simulating the wire", total=worlds * samples) as advance:
            trajectory, stopped = simulate_navigations(
                set_up, control, record_shape=also["record_shape"], advance=advance
            )
    elif controls.is_dir() or controls.suffix.lower() == ".npz":
        recorded = _recorded(controls, patient, stack if device is not None or catheter else None)
        patient, stack = recorded.set_up.anatomies[0], recorded.set_up.stacks[0]
        also |= {"config": None if config == SimulatorConfig() else config}
        trajectory = recorded.replay(**{name: value for name, value in also.items() if value is not None})
    else:
        script = read_controls_csv(controls, devices=len(stack))
        also |= {"initial": script.initial, "period_s": script.period_s}
        trajectory = simulate(patient, stack, script.control, config=config, **also)
    (trajectory if shape else replace(trajectory, shape=None)).write(output)
    valid, force, torque = trajectory.valid, np.abs(trajectory.base_force), np.abs(trajectory.base_torque)
    figures = {
        "rollout": output,
        "worlds": int(valid.shape[0]),
        "samples": int(valid.shape[1]),
        "valid_worlds": int(valid[:, -1].sum()),
        **({} if stopped is None else {"worlds_stopped_short": int(stopped.sum())}),
        "slipped_worlds": int(((trajectory.slip != 0) | (trajectory.rotation_slip != 0))[..., 0].any(axis=1).sum()),
        "deepest_tip_mm": _largest(trajectory.tip.abscissa[..., 0], valid),
        "largest_contact_force_n": _largest(trajectory.contact_force_max, valid),
        "largest_wall_force_n": _largest(trajectory.wall_force, valid),
        "wall_force_worlds": len(wall_force_worlds(trajectory)),
        "largest_base_force_n": _largest(force[..., 0], valid),
        "largest_base_torque_n_mm": _largest(torque[..., 0], valid),
    }
    if stack.catheters:
        figures["largest_catheter_force_n"] = _largest(force[..., 1:].max(axis=-1), valid)
        figures["largest_catheter_torque_n_mm"] = _largest(torque[..., 1:].max(axis=-1), valid)
    if picture is not None:
        from endopilot.report.scene import visible_devices  # plotly is slow to import
        from endopilot.report.still import render_still

        shown, devices = visible_devices(trajectory, 0, -1), stack.devices
        missing = render_still(patient, shown, picture, devices=devices)
        if missing is None:
            figures["picture"] = picture
        else:
            print(missing, file=sys.stderr)
    return figures


def _recorded(path: Path, patient: Anatomy, asked: Stack | None) -> Trajectory:
    """Return what a plan's folder or a file holds; devices that are asked for must be its own."""
    if path.is_dir():
        return read_plan(path, patient, asked)
    recorded = read_trajectory(path, anatomy=patient)
    if asked is not None and any(stack.constants != asked.constants for stack in recorded.set_up.stacks):
        made_with = recorded.set_up.stacks[0].name
        raise InputError(
            f"device: {path} was made with another ({made_with}), not with this {asked.name}; leave it out"
        )
    return recorded


def _largest(values: np.ndarray, valid: np.ndarray) -> float | None:
    return round(float(values[valid].max()), 4) if valid.any() else None
