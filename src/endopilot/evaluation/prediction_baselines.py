"""Predictions that need no learning: the baselines that stand beside every result."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from endopilot.dataset.loader import Dataset


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
