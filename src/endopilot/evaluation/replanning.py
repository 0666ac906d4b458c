"""P4 with replanning: an X-ray image shows the tip from time to time, and the rest is planned anew."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from jaxtyping import Bool

from endopilot.dataset.loader import Dataset
from endopilot.evaluation.replay import Control, Recorded
from endopilot.models.config import WINDOW
from endopilot.models.episodes import Episodes
from endopilot.models.open_loop import OpenLoop, Predictor, begin_after, given_states
from endopilot.progress import Advance

EXPOSURE_PERIOD_S = 10.0
"""Time between X-ray images after the given states, s."""


def exposures(data: Dataset) -> list[int]:
    """Return the samples after the given states at which an X-ray image shows the tip."""
    every = round(EXPOSURE_PERIOD_S / data.sample_period_s)
    return list(range(WINDOW - 1 + every, data.valid.shape[1] - 1, every))


def replanned(
    predictor: Predictor, recorded: Recorded, episodes: Episodes, first: OpenLoop, advance: Advance
) -> Control:
    """Return controls (mm/s, rad/s) after the given states that are planned anew at each of `exposures`.

    Each plan is driven in the simulator up to the next exposure. For the next one the predictor is given the motion of
    the drive, the given tips, the observed tips, and in between the tips that it predicted itself; the desired tips
    stay the same. Where the simulation fails, or no finite control is planned, controls are NaN from there on.

    Args:
        episodes: the same as the predictor is given them; their tips are the desired ones.
    """
    control, under_way, observed = first.control.copy(), _predicted(episodes, first, WINDOW), given_states(episodes)
    for now in exposures(recorded.data):
        commanded = recorded.drivable(control)[:, : now + 1 - WINDOW]
        failed = ~np.isfinite(commanded).all(axis=(1, 2))
        under_way, lost = _driven(recorded, under_way, commanded, begin_after(observed) - 1)
        observed = observed.copy()
        observed[now] = True
        plan = predictor.rollout_dual(_desired(under_way, episodes, now + 1), observed)
        control[:, now + 1 - WINDOW :] = np.where((failed | lost)[:, None, None], np.nan, plan.control)
        under_way = _predicted(under_way, plan, now + 1)
        advance(1, "replanning")
    return control


def _driven(
    recorded: Recorded, under_way: Episodes, commanded: Control, last: int
) -> tuple[Episodes, Bool[np.ndarray, "episodes"]]:
    """Return episodes after the drive was commanded, and which of them a simulation lost.

    Known are the motion of the drive and, at the end, the tip in an X-ray image. It was observed before at sample
    `last`.
    """
    now = WINDOW + commanded.shape[1] - 1
    names = ("control", "command", "proximal", "tip", "branch")
    made = {name: getattr(under_way, name).copy() for name in names}
    lost = np.zeros(len(under_way), dtype=bool)
    for chosen, rollout in recorded.simulated({"P4": commanded}):
        ok = rollout.valid[:, now]
        lost[chosen] = ~ok
        kept, moved = chosen[ok], slice(WINDOW, now + 1)
        made["control"][kept, moved] = rollout.control[ok, moved, 0]
        made["command"][kept, moved] = rollout.command[ok, moved, 0]
        made["proximal"][kept, moved] = rollout.proximal[ok, moved, 0]
        made["tip"][kept, now] = np.stack([rollout.tip.abscissa, rollout.tip.offset], axis=-1)[ok, now, 0]
        made["branch"][kept, last + 1 : now] = made["branch"][kept, last, None]  # not observed since
        made["branch"][kept, now] = rollout.tip.branch[ok, now, 0]
    return replace(under_way, **made), lost


def _predicted(under_way: Episodes, plan: OpenLoop, begin: int) -> Episodes:
    """Return episodes with the tips from a sample on as a plan predicts them, where it does."""
    tip = under_way.tip.copy()
    finite = np.isfinite(plan.tip).all(axis=-1, keepdims=True)
    tip[:, begin:] = np.where(finite, plan.tip, tip[:, begin:])
    return replace(under_way, tip=tip)


def _desired(under_way: Episodes, desired: Episodes, begin: int) -> Episodes:
    """Return episodes under way with everything from a sample on as it is desired."""
    names = ("control", "command", "proximal", "tip", "branch")
    parts = {name: (getattr(under_way, name)[:, :begin], getattr(desired, name)[:, begin:]) for name in names}
    return replace(under_way, **{name: np.concatenate(both, axis=1) for name, both in parts.items()})
