"""Which wires retrace the given tips: friction, stiffness of the tip and, of a patient who moves, the heart's motion.

A few wires that differ in these are driven through the given samples. A linear regression over them says how each
sample's tip depends on the parameters, and how badly a line describes that: snaps count little. Its posterior is where
the next wires are tried, closer together. What is known before are the spreads of `SPREADS`.
"""

from __future__ import annotations

from dataclasses import replace
from itertools import product

import numpy as np
from jaxtyping import Bool, Float

from endopilot.models.ensemble import Ensemble
from endopilot.models.episodes import Episodes, EpisodeSetUp
from endopilot.simulation.motion import AMPLITUDES, Motion
from endopilot.types import Anatomy

NAMES = ("friction", "tip stiffness", "annulus_mm", "heart_volume_share")
"""Parameters: all are factors, of what the device has and of the known motion of the heart. Breath moves vessel and
catheter together, and so no tip in its vessel."""
SPREADS = np.array(
    [0.2, 0.2, *(AMPLITUDES[name][1] / AMPLITUDES[name][0] for name in ("annulus_mm", "heart_volume_share"))]
)
"""Their standard deviations before anything was seen: an assumption of the wires, published of the heart."""
SCALES_MM = np.array([0.05, 0.025])
"""Scales of a good wire's error in Δtip and γtip, mm: those of the twin."""
GENERATIONS = 2
"""Times that wires are tried; those of the next are spread over two standard deviations, and this share of the first
at least."""
NARROWEST = 0.1
LEVELS = np.array([0.0, 0.05, 0.05, 0.05])
"""Parameters are rounded to these: wires of one stiffness in one motion are simulated side by side."""
_FAR_MM = 2.0
"""Differences between tips are cut off here, mm: beyond, a wire has snapped, or lies in another branch."""
_MEDIAN_SQUARE = 0.455
"""Median of the square of a normal deviate."""
_REFITS = 10
"""Times that the tips' weights follow from how well they are explained."""
_STILL = np.array([(f, s, 0.0, 0.0) for f, s in product((-0.9, -0.3, 0.3, 0.9), (-0.75, 0.0, 0.75))])
_MOVING = np.array(
    [(f, 0.0, a, v) for a, v in ((0, 0), (-1.2, 0), (1.2, 0), (0, -1.4), (0, 1.4)) for f in (-0.75, 0.0, 0.75)]
)
"""Wires that are tried, in spreads from the middle, in a vessel that lies still and in one that moves."""
Wires = Float[np.ndarray, "episodes 4"]
"""Parameters of one wire for each episode."""
Members = Float[np.ndarray, "episodes members 4"]


def fitted(episodes: Episodes, given: Bool[np.ndarray, "episodes given"]) -> Wires:
    """Return the wire of each episode of one patient that retraces the given tips best, as far as these say.

    Args:
        episodes: of one patient; their tips where `given` are read.

    Raises:
        InputError: the anatomy is missing or damaged.
    """
    mean, sd = np.ones((len(episodes), 4)), np.tile(SPREADS, (len(episodes), 1))
    if not given.any():
        return mean
    name, samples = str(episodes.anatomy[0]), given.shape[1]
    anatomy, signals = episodes.setup.anatomies[name](), (episodes.tip, episodes.tip_sd)
    tips, sd_mm = (signal[:, :samples].astype(float) for signal in signals)
    design = _STILL if episodes.setup.known_motions.get(name) is None else _MOVING
    for _ in range(GENERATIONS):
        theta = rounded(mean[:, None] + sd[:, None] * design)
        paths = _replayed(episodes, anatomy, theta, samples)
        scales = np.maximum(SCALES_MM, sd_mm)
        found = [posterior(*each) for each in zip(theta, paths, tips, scales, given, strict=True)]
        mean, sd = np.array([each[0] for each in found]), np.array([each[1] for each in found])
        sd = np.clip(2 * sd, NARROWEST * SPREADS, SPREADS)
    return rounded(mean)


def rounded(theta: Float[np.ndarray, "*n 4"]) -> Float[np.ndarray, "*n 4"]:
    """Return parameters on their levels, within three spreads."""
    within = np.clip(theta, 1 - 3 * SPREADS, 1 + 3 * SPREADS)
    return np.where(LEVELS > 0, np.round(within / np.maximum(LEVELS, 1e-9)) * LEVELS, within)


def moved(motion: Motion | None, factors: Float[np.ndarray, "2"]) -> Motion | None:
    """Return a known motion with factors on what the heart does."""
    if motion is None:
        return None
    share = min(motion.heart_volume_share * float(factors[1]), 0.3)
    return replace(motion, annulus_mm=motion.annulus_mm * float(factors[0]), heart_volume_share=share)


def ensemble_of(
    setup: EpisodeSetUp, anatomy: Anatomy, theta: Float[np.ndarray, "n 4"], start: Float[np.ndarray, "n 2"]
) -> Ensemble:
    """Return the worlds of wires that share one motion."""
    return Ensemble(
        anatomy,
        setup.device,
        np.column_stack([theta[:, :2], np.zeros(len(theta))]),
        start=start[:, None],
        config=replace(setup.simulator, threads=1),
        motion=moved(setup.known_motions.get(anatomy.name), theta[0, 2:]),
    )


def _replayed(
    episodes: Episodes, anatomy: Anatomy, theta: Members, samples: int
) -> Float[np.ndarray, "episodes members s 2"]:
    """Return (Δtip, γtip) of wires over the first samples, mm; NaN from where a simulation fails.

    Wires that are the same, under the same commands, are simulated once.
    """
    members = theta.shape[1]
    command = np.repeat(episodes.command[:, :samples], members, axis=0).astype(float)
    start = np.repeat(episodes.initial, members, axis=0).astype(float)
    each = np.column_stack([theta.reshape(-1, 4), start, command.reshape(len(command), -1)])
    _, first, back = np.unique(each, axis=0, return_index=True, return_inverse=True)
    flat, command, start = theta.reshape(-1, 4)[first], command[first], start[first]
    tips = np.full((len(flat), samples, 2), np.nan)
    for rows in by_motion(flat):
        tips[rows] = ensemble_of(episodes.setup, anatomy, flat[rows], start[rows]).replay(command[rows])
    return tips[back.ravel()].reshape(len(episodes), members, samples, 2)


def by_motion(theta: Float[np.ndarray, "n 4"]) -> list[np.ndarray]:
    """Return the rows of wires that share one motion, for each motion."""
    kind = np.unique(theta[:, 2:], axis=0, return_inverse=True)[1].ravel()
    return [np.flatnonzero(kind == k) for k in range(kind.max() + 1)]


def posterior(
    theta: Float[np.ndarray, "members 4"],
    paths: Float[np.ndarray, "members samples 2"],
    tip: Float[np.ndarray, "samples 2"],
    scale_mm: Float[np.ndarray, "samples 2"],
    given: Bool[np.ndarray, "samples"],
) -> tuple[Float[np.ndarray, "4"], Float[np.ndarray, "4"]]:
    """Return mean and standard deviation of the parameters of one episode after the given tips.

    Args:
        paths: their tips, mm; NaN from where a simulation fails.
        tip: the observed ones, mm.
        scale_mm: of a good wire's errors.
    """
    whole = np.isfinite(paths).all(axis=(1, 2))
    if whole.sum() < 8 or not given.any():
        return np.ones(4), SPREADS
    unit = (theta[whole] - 1) / SPREADS
    y = paths[whole][:, given].reshape(whole.sum(), -1)
    seen, scale = tip[given].ravel(), scale_mm[given].ravel()
    center = np.median(y, axis=0)
    y, away = np.clip(y - center, -_FAR_MM, _FAR_MM), np.clip(seen - center, -_FAR_MM, _FAR_MM)
    lines = np.column_stack([np.ones(len(unit)), unit])
    slope = np.linalg.solve(lines.T @ lines + 1e-3 * np.eye(5), lines.T @ y)
    left = ((y - lines @ slope) ** 2).mean(axis=0)
    found, precision = np.zeros(4), np.eye(4)
    for _ in range(_REFITS):
        misfit = (away - slope[0] - found @ slope[1:]) ** 2
        noise = np.median(misfit.reshape(-1, 2), axis=0) / _MEDIAN_SQUARE  # of Δtip and γtip, which no wire explains
        variance = 0.25 * scale**2 + 4 * left + np.tile(noise, len(misfit) // 2)
        weight = 1 / (variance * (1 + misfit / (4 * variance)))
        precision = (slope[1:] * weight) @ slope[1:].T + np.eye(4)
        found = np.linalg.solve(precision, (slope[1:] * weight) @ (away - slope[0]))
    return 1 + SPREADS * found, SPREADS * np.sqrt(np.diag(np.linalg.inv(precision)))
