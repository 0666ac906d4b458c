"""The protocols P1 to P4 and their baselines on the episodes of one split."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from endopilot.anatomy.io import read_anatomy
from endopilot.dataset.loader import Dataset
from endopilot.evaluation import baselines
from endopilot.evaluation.metrics import tip_events
from endopilot.evaluation.results import REPLAYED, SplitResult, TipSeries
from endopilot.models.config import WINDOW
from endopilot.models.open_loop import Predictor
from endopilot.progress import Advance
from endopilot.simulation.device import Device
from endopilot.simulation.simulator import SimulatorConfig, simulate
from endopilot.types import Anatomy, VesselTree

Control = Float[np.ndarray, "episodes samples 2"]
Samples = Float[np.ndarray, "episodes samples"]


def run_protocols(predictor: Predictor, data: Dataset, train: Dataset, advance: Advance) -> SplitResult:
    """Predict the samples after the 30 given states in every way, and simulate the controls that were chosen.

    P1 is the forward network under the true controls; P2 the inverse network with the true tip as desired; P3 the
    paper's loop of both; P4 the controls of P3 simulated again from the start of the episode, in the anatomy and with
    the device and friction that it was recorded with; what the drive cannot do it does as far as it can.

    Args:
        predictor: the networks of a run.
        data: the episodes of one split.
        train: the episodes that the networks were trained on, for the baselines that are means.
        advance: told after each protocol and after each anatomy's simulation.
    """
    names, anatomy_of = np.unique(data.anatomy, return_inverse=True)
    anatomies = [read_anatomy(data.anatomy_folder(str(name))) for name in names]
    device = Device.from_record(data.manifest["device"])
    predicted = {}
    for protocol in ("forward", "inverse", "dual"):
        predicted[protocol] = getattr(predictor, f"rollout_{protocol}")(data)
        advance(1, protocol)
    controls: dict[str, Control] = {
        "P2": predicted["inverse"].control,
        "P3": predicted["dual"].control,
        "hold_control": baselines.hold_control(data, WINDOW),
        "training_mean": baselines.mean_control(train, data, WINDOW),
        "follow_slack": baselines.follow_slack(data, WINDOW),
    }
    foretold = {
        "P1": predicted["forward"].tip,
        "P3": predicted["dual"].tip,
        "hold_slack": baselines.hold_slack(data, WINDOW),
        "training_mean": baselines.mean_tip(train, data, WINDOW),
    }
    tips = {name: _series(tip, [a.tree for a in anatomies], anatomy_of, data.branch) for name, tip in foretold.items()}
    replayed = {"P4": "P3", "P2_replayed": "P2", "hold_control": "hold_control", "follow_slack": "follow_slack"}
    reach_mm = np.array([a.tree.longest_path().abscissa[-1] for a in anatomies])[anatomy_of]
    simulated = {name: _drivable(data, controls[source], device, reach_mm) for name, source in replayed.items()}
    simulated |= dict.fromkeys(REPLAYED, data.asked[:, WINDOW:])
    replays = _replay(data, anatomies, anatomy_of, device, simulated, advance)
    return SplitResult(
        sample_period_s=data.sample_period_s,
        anatomies=tuple(str(name) for name in names),
        anatomy=anatomy_of,
        sequence=data.sequence,
        wire_radius_mm=device.tip_radius_mm,
        true=TipSeries(*(_after_given(values) for values in (data.tip_abscissa, data.tip_offset, data.lumen_radius))),
        true_control=data.control[:, WINDOW:].astype(float),
        tips=tips | {name: replay.tip for name, replay in replays.items()},
        controls=controls,
        base_force={"true": _after_given(data.base_force)} | {name: r.base_force for name, r in replays.items()},
        base_torque={"true": _after_given(data.base_torque)} | {name: r.base_torque for name, r in replays.items()},
        tip_distance={name: r.distance for name, r in replays.items()},
        events=tip_events(*(signal[:, WINDOW - 1 :] for signal in _moving(data))),
    )


def _moving(data: Dataset) -> tuple[np.ndarray, ...]:
    return data.inserted_length, data.rotation, data.tip_abscissa, data.tip_direction


def _drivable(data: Dataset, control: Control, device: Device, reach_mm: Float[np.ndarray, "episodes"]) -> Control:
    """Return what a drive makes of controls: no faster than it can, nor out of the catheter or beyond the vessel.

    Controls that are not finite stay so.
    """
    limits = np.array([device.max_velocity_mm_s, device.max_rotation_rad_s])
    driven = np.clip(control, -limits, limits)
    inserted = data.inserted_length[:, WINDOW - 1].astype(float)
    reach_mm = np.maximum(reach_mm, inserted)
    for sample in range(driven.shape[1]):
        after = np.clip(inserted + data.sample_period_s * driven[:, sample, 0], 0.0, reach_mm)
        driven[:, sample, 0] = (after - inserted) / data.sample_period_s
        inserted = after
    return driven


@dataclass(frozen=True, eq=False)
class _Replay:
    """One series of controls, simulated: its tip, the drive's load, and the tip's distance from the recorded one."""

    tip: TipSeries
    base_force: Samples
    base_torque: Samples
    distance: Samples


def _replay(
    data: Dataset,
    anatomies: Sequence[Anatomy],
    anatomy_of: Int[np.ndarray, "episodes"],
    device: Device,
    controls: Mapping[str, Control],
    advance: Advance,
) -> dict[str, _Replay]:
    """Simulate every episode again as the drive was asked while states are given, and with each series after.

    Those of `REPLAYED` with another friction have it from the start.

    Where a simulation fails, or a series holds no finite control, the result is NaN from there on.
    """
    settings = SimulatorConfig(**data.manifest["config"]["simulator"])
    shape = data.control[:, WINDOW:].shape[:2]
    out = {name: {key: np.full(shape, np.nan) for key in _REPLAYED} for name in controls}
    # a simulation has one anatomy and one wire
    alike = np.stack([anatomy_of, data.tip_bend, data.tip_stiffness_factor], axis=-1).astype(float)
    kinds, kind_of = np.unique(alike, axis=0, return_inverse=True)
    for kind, (index, bend, factor) in enumerate(kinds):
        anatomy, episodes = anatomies[int(index)], np.flatnonzero(kind_of.ravel() == kind)
        wire = device.with_tip(bend_rad=float(bend), stiffness_factor=float(factor))
        driven = np.concatenate([_whole(data, control)[episodes] for control in controls.values()])
        worlds = np.tile(episodes, len(controls))
        initial = np.stack([data.initial_inserted_length[worlds], data.initial_rotation[worlds]], axis=-1)
        friction = np.concatenate([REPLAYED.get(name, 1.0) * data.friction[episodes] for name in controls])
        rollout = simulate(anatomy, wire, np.nan_to_num(driven), initial=initial, config=settings, friction=friction)
        usable = (rollout.valid & np.isfinite(driven).all(axis=-1).cumprod(axis=1).astype(bool))[:, WINDOW:]
        distance = np.linalg.norm(rollout.tip_position - data.tip_position[worlds], axis=-1)
        tip = (rollout.tip.abscissa, rollout.tip.offset, rollout.tip.radius)
        for key, signal in zip(_REPLAYED, (*tip, rollout.base_force, rollout.base_torque, distance), strict=True):
            values = np.where(usable, signal[:, WINDOW:], np.nan)
            for name, part in zip(controls, values.reshape(len(controls), len(episodes), -1), strict=True):
                out[name][key][episodes] = part
        if kind + 1 == len(kinds) or kinds[kind + 1][0] != index:
            advance(1, anatomy.name)
    return {
        name: _Replay(
            tip=TipSeries(signals["abscissa"], signals["offset"], signals["radius"]),
            base_force=signals["base_force"],
            base_torque=signals["base_torque"],
            distance=signals["distance"],
        )
        for name, signals in out.items()
    }


_REPLAYED = ("abscissa", "offset", "radius", "base_force", "base_torque", "distance")


def _whole(data: Dataset, control: Control) -> Float[np.ndarray, "episodes all_samples 2"]:
    """Return what was asked of the drive while states are given, followed by `control`."""
    return np.concatenate([data.asked[:, :WINDOW], control], axis=1)


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


def _after_given(values: Float[np.ndarray, "episodes all_samples"]) -> Samples:
    return values[:, WINDOW:].astype(float)
