"""The protocols P1 to P4 and their baselines on the episodes of one split."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float, Int

from endopilot.dataset.loader import Dataset
from endopilot.devices.robot import RobotConfig
from endopilot.evaluation.metrics import tip_events
from endopilot.evaluation.replay import Control, Recorded, exposures, replanned, replay
from endopilot.evaluation.results import REPLAYED, SplitResult, TipSeries
from endopilot.models.config import WINDOW
from endopilot.models.episodes import Episodes, OpenLoop, Predictor
from endopilot.progress import Advance
from endopilot.types import VesselTree


def hold_slack(data: Dataset, given: int) -> Float[np.ndarray, "episodes samples 2"]:
    """Return (Δtip, γtip), mm, if the slack Δ − Δtip and the offset stay as in the last given state."""
    slack = data.inserted_length[:, given - 1, 0] - data.tip_abscissa[:, given - 1, 0]
    abscissa = data.inserted_length[:, given:, 0] - slack[:, None]
    offset = np.broadcast_to(data.tip_offset[:, given - 1], abscissa.shape)
    return np.stack([abscissa, offset], axis=-1).astype(float)


def mean_tip(train: Dataset, data: Dataset, given: int) -> Float[np.ndarray, "episodes samples 2"]:
    """Return (Δtip, γtip), mm, if slack and offset are always the means over the training episodes."""
    slack = np.mean(train.inserted_length - train.tip_abscissa, dtype=float)
    abscissa = data.inserted_length[:, given:, 0] - slack
    return np.stack([abscissa, np.full(abscissa.shape, np.mean(train.tip_offset, dtype=float))], axis=-1)


def hold_control(data: Dataset, given: int) -> Float[np.ndarray, "episodes samples 2"]:
    """Return the last given control at every sample, (mm/s, rad/s)."""
    samples = data.control.shape[1] - given
    return np.repeat(data.control[:, given - 1], samples, axis=1).astype(float)


def mean_control(train: Dataset, data: Dataset, given: int) -> Float[np.ndarray, "episodes samples 2"]:
    """Return the mean control of the training episodes at every sample, (mm/s, rad/s)."""
    return np.broadcast_to(train.control.mean(axis=(0, 1), dtype=float), data.control[:, given:, 0].shape).copy()


def follow_slack(data: Dataset, given: int) -> Float[np.ndarray, "episodes samples 2"]:
    """Return the control that moves the drive as far as the tip is to move, without rotation, (mm/s, rad/s).

    With the slack of the last given state held this puts the tip where it is desired.
    """
    travel = np.diff(data.tip_abscissa[:, given - 1 :, 0].astype(float), axis=1)
    return np.stack([travel / data.sample_period_s, np.zeros_like(travel)], axis=-1)


PROTOCOLS = ("forward", "inverse", "dual")
"""What a predictor does with the episodes of each patient."""


def count_steps(data: Dataset) -> int:
    """Return how often `run_protocols` calls its `advance`."""
    return len(exposures(data)) + (1 + len(PROTOCOLS)) * len(np.unique(data.anatomy))


def run_protocols(
    predictor: Predictor,
    data: Dataset,
    training: Dataset | None,
    advance: Advance,
    robot: RobotConfig | None = None,
) -> SplitResult:
    """Predict the samples after the 30 given states by every protocol, and simulate the controls that were chosen.

    P1 is the forward network under the true controls; P2 the inverse network with the true tip as desired; P3 the
    paper's loop of both; P4 the controls of P3 simulated again from the start of the episode, in the anatomy and with
    the device and friction that it was recorded with, within the limits of the drive. P4 is driven once more with plans
    made anew at X-ray images (`replanned`).

    Args:
        training: the episodes that the run was trained on, over which the baselines that are means are taken; these
            are left out if there are none.
        advance: called after each protocol in each anatomy, with P1's error so far, each new plan and each anatomy's
            simulation.
        robot: what the controls of P4 pass before they move the wire; a drive does exactly what it can if not given.
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
    """Return what a predictor makes of the episodes by each protocol.

    One anatomy comes after the other, so that a slow model shows its first errors early.
    """
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
