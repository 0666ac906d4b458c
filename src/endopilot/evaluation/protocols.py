"""The protocols P1 to P4 and their baselines on the episodes of one split, and their controls simulated: `replay`."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, fields, replace

import numpy as np
from jaxtyping import Bool, Float, Int

from endopilot.anatomy.io import read_anatomy
from endopilot.dataset.loader import Dataset
from endopilot.devices.device import Wire
from endopilot.devices.drive_limits import DriveLimits
from endopilot.devices.drive_motion import DriveMotion
from endopilot.devices.robot import RobotConfig
from endopilot.evaluation.metrics import tip_events
from endopilot.evaluation.results import REPLAYED, SplitResult, TipSeries
from endopilot.models.config import WINDOW
from endopilot.models.episodes import Episodes, OpenLoop, Predictor, begin_after, given_states
from endopilot.progress import Advance
from endopilot.simulation.trajectory import Trajectory
from endopilot.types import Anatomy, VesselTree

Control = Float[np.ndarray, "episodes samples 2"]
Samples = Float[np.ndarray, "episodes samples"]


@dataclass(frozen=True, eq=False)
class Recorded:
    """Recorded episodes, with the anatomies (in the order of their names), the wire, and the robot, if any, that
    controls pass."""

    data: Dataset
    names: tuple[str, ...]
    anatomies: tuple[Anatomy, ...]
    anatomy_of: Int[np.ndarray, "episodes"]
    device: Wire
    robot: RobotConfig | None = None

    @staticmethod
    def of(data: Dataset, robot: RobotConfig | None = None) -> Recorded:
        """Read what the episodes of a dataset were recorded with; InputError if an anatomy is missing or damaged."""
        names, anatomy_of = np.unique(data.anatomy, return_inverse=True)
        anatomies = tuple(read_anatomy(data.anatomy_folder(str(name))) for name in names)
        return Recorded(data, tuple(map(str, names)), anatomies, anatomy_of, data.stack.wire, robot)

    def drivable(self, control: Control) -> Control:
        """Return what a drive makes of controls, within its speed and travel; NaN stays NaN. A robot's drives begin at
        rest, in the middle of their play, after the given states."""
        driven, inserted = np.empty(control.shape), self.data.inserted_length[:, WINDOW - 1, 0].astype(float)
        for index, anatomy in enumerate(self.anatomies):
            mine, limits = self.anatomy_of == index, DriveLimits.of(self.device, anatomy)
            driven[mine] = limits.clip_sequence(control[mine], inserted[mine], self.data.sample_period_s)
            if self.robot is not None:
                driven[mine] = self._by_robot(self.robot, driven[mine], np.flatnonzero(mine), limits)
        return driven

    def _by_robot(
        self, robot: RobotConfig, control: Control, episodes: Int[np.ndarray, "episodes"], limits: DriveLimits
    ) -> Control:
        """Return what a robot makes of controls; each episode has one of its own."""
        held = (self.data.inserted_length, self.data.rotation)
        start = np.stack([each[episodes, WINDOW - 1, :1] for each in held], axis=-1).astype(float)
        seeds = [(int(self.data.sequence[each]), 7) for each in episodes]
        motion = DriveMotion(robot, [[limits]] * len(episodes), start, seeds=seeds)
        made, period = np.empty_like(control), self.data.sample_period_s
        for sample in range(control.shape[1]):
            motion.command(np.nan_to_num(control[:, sample, None]))
            made[:, sample] = motion.advance(period)[:, 0] / period
        lost = ~np.isfinite(control).all(axis=-1).cumprod(axis=1).astype(bool)
        made[lost] = np.nan
        return made

    def simulated(
        self, controls: Mapping[str, Control], advance: Advance | None = None
    ) -> Iterator[tuple[Int[np.ndarray, "chosen"], Trajectory]]:
        """Yield the episodes of one anatomy and their simulation, a world for each series and episode, series by
        series: driven as they were while states are given, then the wire by each series, catheters as commanded. Series
        of `REPLAYED` with another friction have it from the start."""
        for index, anatomy in enumerate(self.anatomies):
            mine = np.flatnonzero(self.anatomy_of == index)
            worlds = self.data[np.tile(mine, len(controls))]
            after = np.concatenate([control[mine] for control in controls.values()])
            driven = worlds.command[:, : WINDOW + after.shape[1]].astype(float)
            driven[:, WINDOW:, 0] = np.nan_to_num(after)
            friction = np.concatenate([REPLAYED.get(name, 1.0) * self.data.friction[mine] for name in controls])
            yield mine, worlds.driven(driven, anatomy=anatomy, friction=friction)
            if advance:
                advance(1, anatomy.name)


@dataclass(frozen=True, eq=False)
class Replay:
    """One series of controls, simulated: its tip, the drive's load, and the tip's distance from the recorded one, mm.
    NaN from where the simulation fails, or the series holds no finite control."""

    abscissa: Samples
    offset: Samples
    radius: Samples
    base_force: Samples
    base_torque: Samples
    distance: Samples

    @property
    def tip(self) -> TipSeries:
        """Where the tip went."""
        return TipSeries(self.abscissa, self.offset, self.radius)


def replay(recorded: Recorded, controls: Mapping[str, Control], advance: Advance) -> dict[str, Replay]:
    """Simulate every episode again with each series of controls (mm/s, rad/s) after the given states."""
    shape, signals = recorded.data.valid[:, WINDOW:].shape, [field.name for field in fields(Replay)]
    out = {name: Replay(*np.full((len(signals), *shape), np.nan)) for name in controls}
    for chosen, rollout in recorded.simulated(controls, advance):
        commanded = np.concatenate([control[chosen] for control in controls.values()])
        usable = rollout.valid[:, WINDOW:] & np.isfinite(commanded).all(axis=-1).cumprod(axis=1).astype(bool)
        true_tip = recorded.data.tip_position[np.tile(chosen, len(controls))]
        distance = np.linalg.norm(rollout.tip_position - true_tip, axis=-1)[:, :, 0]
        tip, load = rollout.tip, (rollout.base_force, rollout.base_torque)
        of_wire = [each[:, :, 0] for each in (tip.abscissa, tip.offset, tip.radius, *load)]
        for key, signal in zip(signals, (*of_wire, distance), strict=True):
            values = np.where(usable, signal[:, WINDOW:], np.nan)
            for name, part in zip(controls, values.reshape(len(controls), len(chosen), -1), strict=True):
                getattr(out[name], key)[chosen] = part
    return out


EXPOSURE_PERIOD_S = 10.0  # time between X-ray images after the given states, s


def exposures(data: Dataset) -> list[int]:
    """Return the samples after the given states at which an X-ray image shows the tip."""
    every = round(EXPOSURE_PERIOD_S / data.sample_period_s)
    return list(range(WINDOW - 1 + every, data.valid.shape[1] - 1, every))


def replanned(
    predictor: Predictor, recorded: Recorded, episodes: Episodes, first: OpenLoop, advance: Advance
) -> Control:
    """Return controls (mm/s, rad/s) after the given states that are planned anew at each of `exposures`.

    Each plan is driven in the simulator up to the next exposure, for which the predictor is given the motion of the
    drive, the given and observed tips, and in between those it predicted; the desired tips stay. Where the simulation
    fails, or no finite control is planned, controls are NaN from there on.
    """
    control, under_way, observed = first.control.copy(), _planned(episodes, first, WINDOW), given_states(episodes)
    for now in exposures(recorded.data):
        commanded = recorded.drivable(control)[:, : now + 1 - WINDOW]
        failed = ~np.isfinite(commanded).all(axis=(1, 2))
        under_way, lost = _driven(recorded, under_way, commanded, begin_after(observed) - 1)
        observed = observed.copy()
        observed[now] = True
        plan = predictor.rollout_dual(_desired(under_way, episodes, now + 1), observed)
        control[:, now + 1 - WINDOW :] = np.where((failed | lost)[:, None, None], np.nan, plan.control)
        under_way = _planned(under_way, plan, now + 1)
        advance(1, "replanning")
    return control


def _driven(
    recorded: Recorded, under_way: Episodes, commanded: Control, last: int
) -> tuple[Episodes, Bool[np.ndarray, "episodes"]]:
    """Return episodes after the drive was commanded, and which of them a simulation lost. Known are the motion of the
    drive and, at the end, the tip in an X-ray image, which was observed before at sample `last`."""
    now = WINDOW + commanded.shape[1] - 1
    names = ("control", "command", "proximal", "tip", "branch")
    made = {name: getattr(under_way, name).copy() for name in names}
    lost = np.zeros(len(under_way), dtype=bool)
    for chosen, rollout in recorded.simulated({"P4": commanded}):
        ok = rollout.valid[:, now]
        lost[chosen] = ~ok
        kept, moved = chosen[ok], slice(WINDOW, now + 1)
        made["control"][kept, moved] = rollout.control[ok, moved, 0]
        made["command"][kept, moved] = rollout.command[ok, moved]
        made["proximal"][kept, moved] = rollout.proximal[ok, moved, 0]
        made["tip"][kept, now] = np.stack([rollout.tip.abscissa, rollout.tip.offset], axis=-1)[ok, now, 0]
        made["branch"][kept, last + 1 : now] = made["branch"][kept, last, None]  # not observed since
        made["branch"][kept, now] = rollout.tip.branch[ok, now, 0]
    return replace(under_way, **made), lost


def _planned(under_way: Episodes, plan: OpenLoop, begin: int) -> Episodes:
    tip = under_way.tip.copy()
    finite = np.isfinite(plan.tip).all(axis=-1, keepdims=True)
    tip[:, begin:] = np.where(finite, plan.tip, tip[:, begin:])
    return replace(under_way, tip=tip)


def _desired(under_way: Episodes, desired: Episodes, begin: int) -> Episodes:
    names = ("control", "command", "proximal", "tip", "branch")
    parts = {name: (getattr(under_way, name)[:, :begin], getattr(desired, name)[:, begin:]) for name in names}
    return replace(under_way, **{name: np.concatenate(both, axis=1) for name, both in parts.items()})


def hold_slack(data: Dataset, given: int) -> Float[np.ndarray, "episodes samples 2"]:
    """Return (Δtip, γtip), mm, if the slack Δ − Δtip and the offset stay as in the last given state."""
    slack = data.inserted_length[:, given - 1, 0] - data.tip_abscissa[:, given - 1, 0]
    abscissa = data.inserted_length[:, given:, 0] - slack[:, None]
    offset = np.broadcast_to(data.tip_offset[:, given - 1, :1], abscissa.shape)
    return np.stack([abscissa, offset], axis=-1).astype(float)


def mean_tip(train: Dataset, data: Dataset, given: int) -> Float[np.ndarray, "episodes samples 2"]:
    """Return (Δtip, γtip), mm, if slack and offset are always the means over the training episodes."""
    slack = np.mean((train.inserted_length - train.tip_abscissa)[:, :, 0], dtype=float)
    abscissa = data.inserted_length[:, given:, 0] - slack
    return np.stack([abscissa, np.full(abscissa.shape, np.mean(train.tip_offset[:, :, 0], dtype=float))], axis=-1)


def hold_control(data: Dataset, given: int) -> Float[np.ndarray, "episodes samples 2"]:
    """Return the last given control at every sample, (mm/s, rad/s)."""
    samples = data.control.shape[1] - given
    return np.repeat(data.control[:, given - 1, :1], samples, axis=1).astype(float)


def mean_control(train: Dataset, data: Dataset, given: int) -> Float[np.ndarray, "episodes samples 2"]:
    """Return the mean control of the training episodes at every sample, (mm/s, rad/s)."""
    mean = train.control[:, :, 0].mean(axis=(0, 1), dtype=float)
    return np.broadcast_to(mean, data.control[:, given:, 0].shape).copy()


def follow_slack(data: Dataset, given: int) -> Float[np.ndarray, "episodes samples 2"]:
    """Return the control that moves the drive as far as the tip is to move, without rotation (mm/s, rad/s): with the
    slack of the last given state held, the tip is where it is desired."""
    travel = np.diff(data.tip_abscissa[:, given - 1 :, 0].astype(float), axis=1)
    return np.stack([travel / data.sample_period_s, np.zeros_like(travel)], axis=-1)


PROTOCOLS = ("forward", "inverse", "dual")  # what a predictor does with the episodes of each patient


def count_steps(data: Dataset) -> int:
    """Return how often `run_protocols` calls its `advance`."""
    return len(exposures(data)) + (1 + len(PROTOCOLS)) * len(np.unique(data.anatomy))


def run_protocols(
    predictor: Predictor, data: Dataset, training: Dataset | None, advance: Advance, robot: RobotConfig | None = None
) -> SplitResult:
    """Predict the samples after the 30 given states by every protocol, and simulate the controls that were chosen.

    P1 is the forward network under the true controls; P2 the inverse network with the true tip as desired; P3 the
    paper's loop of both; P4 the controls of P3 simulated again from the episode's start, as it was recorded, within the
    limits of the drive, or after `robot`, and once more with plans made anew at X-ray images (`replanned`). Baselines
    that are means are over `training`, if any. `advance` is called with P1's error, each new plan and each anatomy's
    simulation.
    """
    recorded, episodes = Recorded.of(data, robot), Episodes.of_dataset(data)
    predicted = _predicted(predictor, episodes, recorded.anatomy_of, advance)
    controls: dict[str, Control] = {
        "P2": predicted["inverse"].control,
        "P3": predicted["dual"].control,
        "hold_control": hold_control(data, WINDOW),
        "follow_slack": follow_slack(data, WINDOW),
    }
    predicted_tips = {
        "P1": predicted["forward"].tip,
        "P3": predicted["dual"].tip,
        "hold_slack": hold_slack(data, WINDOW),
    }
    if training is not None:
        controls["training_mean"] = mean_control(training, data, WINDOW)
        predicted_tips["training_mean"] = mean_tip(training, data, WINDOW)
    trees = [anatomy.tree for anatomy in recorded.anatomies]
    tips = {
        name: _series(tip, trees, recorded.anatomy_of, data.branch[:, :, 0]) for name, tip in predicted_tips.items()
    }
    replayed = {"P4": "P3", "P2_replayed": "P2", "hold_control": "hold_control", "follow_slack": "follow_slack"}
    planned = {name: controls[source] for name, source in replayed.items()}
    planned["P4_replanned"] = replanned(predictor, recorded, episodes, predicted["dual"], advance)
    driven = {name: recorded.drivable(control) for name, control in planned.items()}
    replays = replay(recorded, driven | dict.fromkeys(REPLAYED, data.command[:, WINDOW:, 0]), advance)
    true = (data.tip_abscissa, data.tip_offset, data.lumen_radius, data.base_force, data.base_torque)
    *true_tip, true_force, true_torque = (values[:, WINDOW:, 0].astype(float) for values in true)
    moving = (data.inserted_length, data.rotation, data.tip_abscissa, data.tip_direction)
    return SplitResult(
        sample_period_s=data.sample_period_s,
        anatomies=recorded.names,
        anatomy=recorded.anatomy_of,
        sequence=data.sequence,
        wire_radius_mm=recorded.device.tip_radius_mm,
        true=TipSeries(*true_tip),
        true_control=data.control[:, WINDOW:, 0].astype(float),
        tips=tips | {name: r.tip for name, r in replays.items()},
        controls=controls,
        base_force={"true": true_force} | {name: r.base_force for name, r in replays.items()},
        base_torque={"true": true_torque} | {name: r.base_torque for name, r in replays.items()},
        tip_distance={name: r.distance for name, r in replays.items()},
        events=tip_events(*(signal[:, WINDOW - 1 :, 0] for signal in moving)),
    )


def _predicted(
    predictor: Predictor, episodes: Episodes, anatomy_of: Int[np.ndarray, "episodes"], advance: Advance
) -> dict[str, OpenLoop]:
    """Return a predictor's answers by each protocol, an anatomy at a time: a slow model shows its errors early."""
    order = np.argsort(anatomy_of, kind="stable")
    parts = [
        episodes.select(chosen) for chosen in np.split(order, np.unique(anatomy_of[order], return_index=True)[1][1:])
    ]
    found, errors = {}, []
    for protocol in PROTOCOLS:
        rollouts = []
        for part in parts:
            rollouts.append(getattr(predictor, f"rollout_{protocol}")(part))
            if protocol == "forward":
                errors.append(np.abs(rollouts[-1].tip[..., 0] - part.tip[:, WINDOW:, 0]).mean())
            patients = "patient" if len(errors) == 1 else "patients"
            advance(1, f"{protocol}; P1: Δtip errs by {np.nanmean(errors):.3f} mm in {len(errors)} {patients}")
        back = np.argsort(order)
        signals = ([getattr(rollout, name) for rollout in rollouts] for name in ("tip", "proximal", "control"))
        found[protocol] = OpenLoop(*(np.concatenate(signal)[back] for signal in signals))
    return found


def _series(
    tip: Float[np.ndarray, "episodes samples 2"],
    trees: Sequence[VesselTree],
    anatomy_of: Int[np.ndarray, "episodes"],
    branch: Int[np.ndarray, "episodes all_samples"],
) -> TipSeries:
    """Return a predicted tip with the lumen's radius at its abscissa in the branch that the true tip is in."""
    abscissa, offset = (np.where(np.isfinite(tip).all(axis=-1), tip[..., i], np.nan) for i in range(2))
    radius = np.full(abscissa.shape, np.nan)
    branch = branch[:, WINDOW:]
    for index, tree in enumerate(trees):
        for into in np.unique(branch[anatomy_of == index]):
            here = (anatomy_of == index)[:, None] & (branch == into)
            line = tree.path(int(into))
            radius[here] = np.interp(abscissa[here], line.abscissa, line.radius)
    return TipSeries(abscissa, offset, radius)
