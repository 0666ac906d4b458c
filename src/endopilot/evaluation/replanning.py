"""P4 with replanning: now and then an X-ray image shows the tip, and the rest of the way is planned anew."""

from __future__ import annotations

from dataclasses import fields, replace

import numpy as np
from jaxtyping import Bool

from endopilot.dataset.loader import Dataset
from endopilot.evaluation.replay import Control, Recorded
from endopilot.models.config import WINDOW
from endopilot.models.open_loop import OpenLoop, Predictor, begin_after, given_states
from endopilot.progress import Advance

EXPOSURE_PERIOD_S = 10.0
"""Time between X-ray images after the given states, s."""


def exposures(data: Dataset) -> list[int]:
    """Return the samples after the given states at which an X-ray image shows the tip."""
    every = round(EXPOSURE_PERIOD_S / data.sample_period_s)
    return list(range(WINDOW - 1 + every, data.valid.shape[1] - 1, every))


def replanned(predictor: Predictor, recorded: Recorded, first: OpenLoop, advance: Advance) -> Control:
    """Return controls (mm/s, rad/s) after the given states that are planned anew at each of `exposures`.

    Each plan is driven in the simulator up to the next exposure. The predictor then knows the drive's motion, the given
    tips, the tips that were exposed, and what it foretold in between itself; the way that is desired stays the same.
    Where the simulation fails, or no finite control is planned, controls are NaN from there on.

    Args:
        predictor: of the plans.
        recorded: the episodes, whose tips are the desired way.
        first: the plan from the given states on.
        advance: told after each plan.
    """
    data = recorded.data
    control, under_way, seen = first.control.copy(), _believing(data, first, WINDOW), given_states(data)
    for now in exposures(data):
        asked = recorded.drivable(control)[:, : now + 1 - WINDOW]
        failed = ~np.isfinite(asked).all(axis=(1, 2))
        under_way, lost = _driven(recorded, under_way, asked, begin_after(seen) - 1)
        seen = seen.copy()
        seen[now] = True
        plan = predictor.rollout_dual(_desiring(under_way, data, now + 1), seen)
        control[:, now + 1 - WINDOW :] = np.where((failed | lost)[:, None, None], np.nan, plan.control)
        under_way = _believing(under_way, plan, now + 1)
        advance(1, "replanning")
    return control


def _driven(
    recorded: Recorded, under_way: Dataset, asked: Control, last: int
) -> tuple[Dataset, Bool[np.ndarray, "episodes"]]:
    """Return episodes after the drive did what was asked, and which of them a simulation lost.

    The drive's motion is known; of the tip, what an X-ray image shows in the end. It was seen before at sample `last`.
    """
    now = WINDOW + asked.shape[1] - 1
    motion = {name: getattr(under_way, name).copy() for name in ("control", "inserted_length", "rotation", "slip")}
    tip = {name: getattr(under_way, name).copy() for name in ("tip_abscissa", "tip_offset", "branch")}
    lost = np.zeros(len(under_way), dtype=bool)
    for chosen, rollout in recorded.simulated({"P4": asked}):
        ok = rollout.valid[:, now]
        lost[chosen] = ~ok
        kept = chosen[ok]
        for name, values in motion.items():
            values[kept, WINDOW : now + 1] = getattr(rollout, name)[ok, WINDOW:]
        tip["branch"][kept, last + 1 : now] = tip["branch"][kept, last, None]  # not seen: as it was seen last
        for name, shown in zip(tip, (rollout.tip.abscissa, rollout.tip.offset, rollout.tip.branch), strict=True):
            tip[name][kept, now] = shown[ok, now]
    return replace(under_way, **motion, **tip), lost


def _believing(under_way: Dataset, plan: OpenLoop, begin: int) -> Dataset:
    """Return episodes with the tips from a sample on as a plan foretells them."""
    abscissa, offset = under_way.tip_abscissa.copy(), under_way.tip_offset.copy()
    finite = np.isfinite(plan.tip).all(axis=-1)
    abscissa[:, begin:] = np.where(finite, plan.tip[..., 0], abscissa[:, begin:])
    offset[:, begin:] = np.where(finite, plan.tip[..., 1], offset[:, begin:])
    return replace(under_way, tip_abscissa=abscissa, tip_offset=offset)


def _desiring(under_way: Dataset, desired: Dataset, begin: int) -> Dataset:
    """Return episodes under way with everything from a sample on as it is desired."""
    later = {}
    for field in fields(Dataset):
        values = getattr(under_way, field.name)
        if isinstance(values, np.ndarray) and values.ndim > 1:
            later[field.name] = np.concatenate([values[:, :begin], getattr(desired, field.name)[:, begin:]], axis=1)
    return replace(under_way, **later)
