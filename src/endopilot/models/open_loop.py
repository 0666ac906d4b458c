"""Open loop: the first 30 states of an episode are given, then a predictor goes on alone.

P1, `rollout_forward`: the tip under the true controls. P2, `rollout_inverse`: the controls that make the true tip, as
desired. P3, `rollout_dual`: those controls, and the tip that the predictor believes they make; it may also begin later,
from a navigation under way whose tip was seen now and then.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import numpy as np
from jaxtyping import Bool, Float

from endopilot.dataset.loader import Dataset
from endopilot.models.config import WINDOW

Observed = Bool[np.ndarray, "samples"]
"""Samples at which the tip was measured, for example by X-ray."""
EachObserved = Bool[np.ndarray, "episodes samples"]
"""The same for each episode."""
Steps2 = Float[np.ndarray, "episodes steps 2"]


@dataclass(frozen=True, eq=False)
class OpenLoop:
    """What a predictor foretells of each episode for the samples after the given ones.

    Attributes:
        tip: (Δtip, γtip), mm; the true tip in P2, where none is predicted.
        proximal: x^prox = (Δ mm, φ rad), the exact integral of `control`; the true one in P1.
        control: π = (mm/s, rad/s); the true one in P1.
    """

    tip: Steps2
    proximal: Steps2
    control: Steps2


@dataclass(frozen=True, eq=False)
class Prediction:
    """What a predictor foretells of each episode at every sample, the tips that were seen included.

    Attributes:
        tip: (Δtip, γtip), mm.
        spread: how far they may be off: one standard deviation, mm.
    """

    tip: Float[np.ndarray, "episodes samples 2"]
    spread: Float[np.ndarray, "episodes samples 2"]


@runtime_checkable
class ProbabilisticPredictor(Protocol):
    """A predictor that takes tips seen at any time, and says how sure it is: the causal networks and the twin."""

    def foretell(self, episodes: Dataset, seen: Observed | EachObserved) -> Prediction:
        """Predict the tips of episodes under their controls, from those that were seen.

        Args:
            episodes: their controls, and the tips where `seen`; no other tip is looked at.
            seen: samples at which the tip was measured, for example by X-ray, of all episodes alike or of each.
        """
        ...


@runtime_checkable
class Predictor(Protocol):
    """Whatever rolls episodes out: the networks of a run, the twin, or a baseline."""

    def rollout_forward(self, episodes: Dataset) -> OpenLoop:
        """P1: predict the tip under the true controls."""
        ...

    def rollout_inverse(self, episodes: Dataset) -> OpenLoop:
        """P2: predict the controls that make the tip go the true way."""
        ...

    def rollout_dual(self, episodes: Dataset, seen: Observed | None = None) -> OpenLoop:
        """P3: predict the controls that make the tip go the true way, and the tip that they make.

        Args:
            episodes: up to the last seen sample the drive's motion as it was, and the tip as it was seen or else is
                believed to have been; after it, the desired tip.
            seen: the 30 given states if not given, and later samples at which the tip was measured too; what comes
                after the last of them is predicted.
        """
        ...


def given_states(episodes: Dataset) -> Observed:
    """Return the samples at which every protocol sees the tip: the first 30."""
    return np.arange(episodes.valid.shape[1]) < WINDOW


def begin_after(seen: Observed) -> int:
    """Return the first sample that is to be predicted: the one after the last that was seen."""
    return int(np.flatnonzero(seen)[-1]) + 1
