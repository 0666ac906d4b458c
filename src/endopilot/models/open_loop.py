"""Open-loop prediction: the first 30 states of an episode are given, and a predictor goes on without measurements.

P1, `rollout_forward`: the tip under the true controls. P2, `rollout_inverse`: the controls that bring about the true
tip, taken as desired. P3, `rollout_dual`: those controls, and the tip that the predictor expects of them; it may also
begin later, in a navigation under way whose tip was observed now and then.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import numpy as np
from jaxtyping import Bool, Float

from endopilot.models.config import WINDOW
from endopilot.models.episodes import Episodes

Observed = Bool[np.ndarray, "samples"]
"""Samples at which the tip was observed, for example by X-ray; the same for all episodes."""
EachObserved = Bool[np.ndarray, "episodes samples"]
"""The same for each episode."""
Steps2 = Float[np.ndarray, "episodes steps 2"]
JUMP_MM = 3.0
"""A tip jumps where it moves by this much more or less in a sample than the drive, mm: a snap, or a branch lost."""


@dataclass(frozen=True, eq=False)
class OpenLoop:
    """What is predicted of each episode for the samples after the given ones.

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
    """The predicted tip of each episode at every sample; where the tip was observed, that is the prediction.

    Attributes:
        tip: (Δtip, γtip), mm.
        spread: one standard deviation of its error as the model estimates it, mm.
        jump: probability that the tip jumps in the sample: see `jumps`.
    """

    tip: Float[np.ndarray, "episodes samples 2"]
    spread: Float[np.ndarray, "episodes samples 2"]
    jump: Float[np.ndarray, "episodes samples"]


@runtime_checkable
class ProbabilisticPredictor(Protocol):
    """A predictor that takes tips observed at any time and estimates its own error: causal networks and the twin."""

    def predict(self, episodes: Episodes, observed: Observed | EachObserved) -> Prediction:
        """Predict the tips of episodes from their controls and from the observed tips.

        Args:
            episodes: their controls, and their tips where `observed`; no other tip is read.
            observed: samples at which the tip was observed, of all episodes alike or of each.
        """
        ...


@runtime_checkable
class Predictor(Protocol):
    """Whatever predicts episodes: the networks of a run, the twin, or a baseline."""

    def rollout_forward(self, episodes: Episodes) -> OpenLoop:
        """P1: predict the tip under the true controls."""
        ...

    def rollout_inverse(self, episodes: Episodes) -> OpenLoop:
        """P2: predict the controls that bring about the true tip."""
        ...

    def rollout_dual(self, episodes: Episodes, observed: Observed | None = None) -> OpenLoop:
        """P3: predict the controls that bring about the true tip, and the tip that they lead to.

        Args:
            episodes: up to the last observed sample, the motion of the drive as it was, and the tip as observed or
                else as predicted at the time; after it, the desired tip.
            observed: the 30 given states if not given; else also later samples at which the tip was observed. What
                comes after the last of them is predicted.
        """
        ...


def given_states(episodes: Episodes) -> Observed:
    """Return the samples at which the tip is observed in every protocol: the first 30."""
    return np.arange(episodes.samples) < WINDOW


def begin_after(observed: Observed) -> int:
    """Return the first sample that is to be predicted: the one after the last observed one."""
    return int(np.flatnonzero(observed)[-1]) + 1


def jumps(
    tip_mm: Float[np.ndarray, "episodes samples"], inserted_length_mm: Float[np.ndarray, "episodes samples"]
) -> Bool[np.ndarray, "episodes samples"]:
    """Return the samples in which a tip at abscissas Δtip jumps: it moves otherwise than the drive by `JUMP_MM`."""
    slack = inserted_length_mm - tip_mm
    return np.abs(np.diff(slack, axis=1, prepend=slack[:, :1])) > JUMP_MM
