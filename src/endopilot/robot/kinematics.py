"""The tip as its drive alone leads it: y(t) = a(t) + g P(u(t − τ)) + noise, fitted exactly, with intervals.

With the commanded course u, the play operator P, the gain g and the lag τ. Nobody logs the offset a, which drifts,
slips and jumps: a Kalman filter takes it out of tip and model alike. docs/concepts/calibration.md has the rest.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.special import ndtr, stdtrit

from endopilot.devices.robot import RobotConfig
from endopilot.robot.log import Courses

NAMES = ("gain_translation", "play_mm", "latency_s", "slip", "slack")
"""What is fitted; `slip` is the share of pushes that the grip loses, `slack` the share s of a simulated wire's."""
RANGES = ((-3.0, 3.0), (0.0, 10.0), (0.0, 2.0), (0.0, 1.0), (-2.0, 3.0))
"""Widest values of each, as the robot's file takes them; a wire has all of its slack or none, s = 1 or 0."""
_WEAK = np.diag([1 / (high - low) ** 2 for low, high in RANGES])
"""Information of ranges, where tracks have none."""
_FIRST = ((-1.0, -0.7, 0.7, 1.0, 1.4), (0.0, 0.7, 1.5, 3.0, 5.0), (0.0, 0.06, 0.12, 0.2, 0.35, 0.6, 1.0, 1.5))
"""Gains, plays and lags from the best of which the fit goes on."""
_STEPS = np.array([0.01, 0.05, 0.005, 0.02, 0.05])
"""Steps of the derivatives: less than noise makes of each."""
_JUMPS, _WITHIN_MM = 0.01, 10.0
"""One tip in a hundred jumps, to anywhere within 10 mm."""
_FEW_MM = 0.01
"""Travel below which a tip has none to lose, mm: far below the noise of a tip."""
_PLAYS = np.linspace(0.0, 8.0, 33)
_SCANS, _NEWTON_STEPS = 3, 8
"""A fit that has converged goes on from any of these plays that cost less, so often at most: commands come in steps,
so the cost has valleys."""
_NOISES = ((0.1, 1.0, 0.1, 0.5), (0.1, 1.0, 0.1, 1.0))
"""`Noise` that the search begins with: slips that leap as often as they lose, and such that only lose."""
Noise = tuple[float, float, float, float]
"""Standard deviation of a tip, mm; variance of the offset a mm of travel, in variances of a tip; share of tips that
slip by anything up to their travel; and the share of slips that are losses, not leaps: half, or all."""


@dataclass(frozen=True, eq=False)
class Tracks:
    """Tips of episodes along their vessel (Δtip, mm; NaN where it is not to be used), beside what their drives were
    asked for. `slack` is how much farther than its proximal end a simulated wire's tip went, mm."""

    courses: Courses
    abscissa: Float[np.ndarray, "episodes tips"]
    slack: Float[np.ndarray, "episodes tips"] | float = 0.0

    def motion(
        self, values: Float[np.ndarray, "candidates values"], start: float | Float[np.ndarray, "*candidates episodes"]
    ) -> Float[np.ndarray, "candidates episodes tips"]:
        """Return where candidates of `NAMES` lead the tips, from where each episode begins, mm."""
        gain, play, latency, slip, share = values.T
        followed = self.courses.followed(
            0, at_s=self.courses.seen_s, latency_s=latency, gain=gain, play=play, start=start
        )
        pushed = np.cumsum(np.maximum(np.diff(followed, axis=2, prepend=followed[..., :1]), 0.0), axis=2)
        return followed - slip[:, None, None] * pushed + share[:, None, None] * np.nan_to_num(self.slack)

    def travel(self, latency_s: float) -> Float[np.ndarray, "episodes tips"]:
        """Return how far each drive goes from one tip to the next, mm, backward negative."""
        at = self.motion(np.array([[1.0, 0.0, latency_s, 0.0, 0.0]]), 0.0)[0]
        return np.diff(at, axis=1, prepend=at[:, :1])


@dataclass(frozen=True, eq=False)
class Filtered:
    """What a Kalman filter leaves of residuals: each innovation in standard deviations (`spread`, mm; 0 where there is
    no tip, or one jumps), the `gain` by which each tip moves the offset, the `cost`, -2 log likelihood, and the last
    `offset`, mm."""

    innovation: Float[np.ndarray, "*of tips"]
    gain: Float[np.ndarray, "*of tips"]
    spread: Float[np.ndarray, "*of tips"]
    cost: Float[np.ndarray, "*of"]
    offset: Float[np.ndarray, "*of"]


def filtered(
    residual: Float[np.ndarray, "*of tips"],
    travel: Float[np.ndarray, "episodes tips"],
    noise: Sequence[Float[np.ndarray, "..."] | float],
) -> Filtered:
    """Filter residuals, mm (NaN where there is no tip), whose mean drifts with the drive's travel since the tip before,
    mm, backward negative, and slips or jumps now and then, by `Noise`, each for all or to be broadcast."""
    sd, drift, slips, lost = noise
    shape = np.broadcast_shapes(residual.shape[:-1], np.shape(sd))
    offset, variance, cost = np.zeros(shape), np.full(shape, np.inf), np.zeros(shape)
    kept = np.zeros((3, residual.shape[-1], *shape))  # by time first: much faster
    with np.errstate(invalid="ignore"):
        for i, (value, way) in enumerate(zip(np.moveaxis(residual, -1, 0), travel.T, strict=True)):
            there, begun, far = np.isfinite(value), np.isfinite(variance), np.maximum(np.abs(way), _FEW_MM)
            variance = variance + drift * np.abs(way)
            spread, ahead = sd * np.sqrt(variance + 1), np.where(begun & there, value - offset, 0.0)
            z, on = ahead / spread, np.where(way < 0, -ahead, ahead) / spread
            follows = (1 - slips - _JUMPS) * np.exp(-(z**2) / 2) / (math.sqrt(2 * np.pi) * spread)
            ahead_of, here, behind = ndtr([on + far / spread, on, on - far / spread])
            slipped = slips / far * (lost * (ahead_of - here) + (1 - lost) * (here - behind))
            whole = follows + slipped + _JUMPS / _WITHIN_MM
            share = np.where(begun, follows / whole, 0.0)
            cost -= np.where(there & begun, 2 * np.log(np.where(begun, whole, 1.0)), 0.0)
            follow = np.where(begun, variance / (variance + 1), 1.0)
            gain = (1 - share * (1 - follow)) * there
            kept[:, i] = z * np.sqrt(share) * there, gain, spread / np.sqrt(np.maximum(share, 1e-12))
            apart = share * (1 - share) * ((1 - follow) * ahead / sd) ** 2
            offset = np.where(there, np.where(begun, offset + gain * ahead, value), offset)
            variance = np.where(there, np.where(begun, gain + apart, 1.0), variance)
    innovation, gain, spread = np.moveaxis(kept, 1, -1)
    return Filtered(innovation, gain, spread, cost, offset)


@dataclass(frozen=True, eq=False)
class DriveFit:
    """Values of `NAMES` that explain tracks best, with the half-widths of their intervals of 95 %, those that were
    fitted (`free`), the noise of the tips, what each episode counts to (`unit`), and what each unit costs, -2 log
    likelihood, by values that are fitted to all others."""

    values: Float[np.ndarray, "values"]
    half_width: Float[np.ndarray, "values"]
    free: Bool[np.ndarray, "values"]
    noise: Noise
    unit: Int[np.ndarray, "episodes"]
    left_out: Float[np.ndarray, "units"]


def evenly(count: int, most: int) -> Int[np.ndarray, "chosen"]:
    """Return places of so many things at most, evenly chosen among some."""
    return np.unique(np.linspace(0, count - 1, min(count, most)).round().astype(int))


def earns(without: Float[np.ndarray, "units"], costs: Float[np.ndarray, "units"], level: float) -> bool:
    """Return whether units that were left out cost less by a model than without it, at a level (Student's t)."""
    less = without - costs
    return bool(less.mean() > stdtrit(len(less) - 1, level) * less.std(ddof=1) / math.sqrt(len(less)))


def fit_drive(
    tracks: Tracks, unit: Int[np.ndarray, "episodes"], begin: DriveFit | None = None, layer: str = ""
) -> DriveFit:
    """Fit gain, play and lag to tracks, and a layer, "slip" or "slack", if one is named. `unit` is what each episode
    counts to, its log or itself; the fit goes on from `begin` with its layers, or from the best of a grid."""
    free = np.array([k < 3 or name == layer for k, name in enumerate(NAMES)])
    free |= False if begin is None else begin.free
    some, fits = np.unique(np.linspace(0, len(unit) - 1, 8).astype(int)), []
    few = Tracks(Courses(*(array[some] for array in vars(tracks.courses).values())), tracks.abscissa[some])
    for noise in _NOISES if begin is None else [begin.noise]:
        values = _best_of_grid(few, noise) if begin is None else begin.values
        for _ in range(_SCANS):
            values, noise = _converged(tracks, values, noise, free)
            scanned = np.repeat(values[None], len(_PLAYS) + 1, axis=0)
            scanned[1:, 1] = _PLAYS
            parts = np.array_split(scanned, len(scanned) // 4)  # at a time, for memory
            best = int(np.argmin(np.concatenate([starts(tracks, part, noise)[1] for part in parts]).sum(axis=1)))
            values = scanned[best]
            if best == 0:
                break
        fits.append((values, noise))
    values, noise = min(fits, key=lambda fit: starts(tracks, fit[0][None], fit[1])[1].sum())
    found, slope = _sloped(tracks, values, starts(tracks, values[None], noise)[0][0], noise, free)
    half_width, left_out = _left_out(found, slope, unit)
    return DriveFit(values, half_width, free, noise, unit, left_out)


def _converged(
    tracks: Tracks, values: Float[np.ndarray, "values"], noise: Noise, free: Bool[np.ndarray, "values"]
) -> tuple[Float[np.ndarray, "values"], Noise]:
    """Return values and noise from which no step of Gauss and Newton costs less."""
    low, high = np.array(RANGES).T
    for _ in range(_NEWTON_STEPS):
        start = starts(tracks, values[None], noise)[0][0]
        noise = fit_noise(tracks, values, start, noise)
        found, slope = _sloped(tracks, values, start, noise, free)
        information = np.einsum("eti,etj->ij", slope, slope) + _WEAK
        step = -np.linalg.solve(information, np.einsum("eti,et->i", slope, found.innovation))
        tried = np.clip(values + np.outer([1.0, 0.5, 0.25, 0.1, 0.0], step), low, high)
        before, values = values, tried[int(np.argmin(starts(tracks, tried, noise)[1].sum(axis=1)))]
        if (np.abs(values - before) < 0.1 * _STEPS).all():
            break
    return values, noise


def _left_out(
    found: Filtered, slope: Float[np.ndarray, "episodes tips values"], unit: Int[np.ndarray, "episodes"]
) -> tuple[Float[np.ndarray, "values"], Float[np.ndarray, "units"]]:
    """Return half the intervals of 95 %, and what each unit costs that is left out. Standard errors are the
    jackknife's, and no less than independent innovations make them."""
    units = unit.max() + 1
    information, score = np.zeros((units, len(NAMES), len(NAMES))), np.zeros((units, len(NAMES)))
    np.add.at(information, unit, np.einsum("eti,etj->eij", slope, slope))
    np.add.at(score, unit, np.einsum("eti,et->ei", slope, found.innovation))
    whole, cost = information.sum(axis=0) + _WEAK, np.zeros(units)
    change = np.linalg.solve(whole - information, score[..., None])[..., 0]
    moved = found.innovation + np.einsum("eti,ei->et", slope, change[unit])
    np.add.at(cost, unit, found.cost + (moved**2 - found.innovation**2).sum(axis=1))
    variance = np.maximum((units - 1) * change.var(axis=0), np.diag(np.linalg.inv(whole)))
    return stdtrit(units - 1, 0.975) * np.sqrt(variance), cost


def _best_of_grid(tracks: Tracks, noise: Noise) -> Float[np.ndarray, "values"]:
    tried = np.array([(*row, 0.0, 0.0) for row in product(*_FIRST)])
    cost = np.full((len(tried), len(tracks.abscissa)), np.inf)
    for start in (-1.0, 0.0, 1.0):
        residual = tracks.abscissa - tracks.motion(tried, start)
        cost = np.minimum(cost, filtered(residual, tracks.travel(0.1), noise).cost)
    return tried[np.argmin(cost.sum(axis=1))]


def starts(
    tracks: Tracks, values: Float[np.ndarray, "candidates values"], noise: Noise
) -> tuple[Float[np.ndarray, "candidates episodes"], Float[np.ndarray, "candidates episodes"]]:
    """Return where in its play the device of each episode begins, of five places and then those between; its cost."""
    best, travel = np.zeros((len(values), len(tracks.abscissa))), tracks.travel(values[0, 2])
    for offsets in ((0.0, -1.0, -0.5, 0.5, 1.0), (0.0, -0.25, 0.25), (0.0, -0.125, 0.125), (0.0, -0.0625, 0.0625)):
        around = np.clip([best + step for step in offsets], -1.0, 1.0)
        moved = tracks.motion(np.tile(values, (len(offsets), 1)), np.concatenate(around))
        cost = filtered(tracks.abscissa - moved, travel, noise).cost.reshape(around.shape)
        chosen = np.argmin(cost, axis=0)[None]
        best, least = (np.take_along_axis(each, chosen, axis=0)[0] for each in (around, cost))
    return best, least


def fit_noise(
    tracks: Tracks,
    values: Float[np.ndarray, "values"],
    start: Float[np.ndarray, "episodes"],
    noise: Noise,
) -> Noise:
    """Return the likeliest noise of tips, mm, and drift of their offset, in variances of a tip a mm of travel."""
    residual, travel = tracks.abscissa - tracks.motion(values[None], start)[0], tracks.travel(values[2])
    for factor in (4.0, 2.0, 1.4, 1.2):
        sd = noise[0] * factor ** np.array([-1.0, -0.5, 0.0, 0.5, 1.0])
        drift = np.clip(noise[1] * factor ** (2.0 * np.arange(-2, 3)), 1e-6, 1e3)
        slips = np.clip(noise[2] * factor ** np.array([-2.0, 0.0, 2.0]), 1e-4, 0.5)
        tried = np.array(list(product(sd, drift, slips, noise[3:])))
        cost = filtered(residual[None], travel, tuple(tried.T[..., None])).cost.sum(axis=1)
        noise = tuple(tried[np.argmin(cost)].tolist())
    return noise


def led(
    tracks: Tracks, robot: RobotConfig
) -> tuple[Float[np.ndarray, "episodes tips"], Filtered, Float[np.ndarray, "episodes"], Noise]:
    """Return where a robot's drive alone leads tips after those that tracks have, Δtip, mm, with the filter of the tips
    that were seen, where in its play each device begins, and the noise of the tips."""
    drive = robot.wire
    values = np.array([drive.gain_translation, drive.play_mm, robot.latency_s, 0.0, 0.0])
    noise = fit_noise(tracks, values, starts(tracks, values[None], _NOISES[0])[0][0], _NOISES[0])
    begun = starts(tracks, values[None], noise)[0][0]
    motion = tracks.motion(values[None], begun)[0]
    seen = filtered(tracks.abscissa - motion, tracks.travel(robot.latency_s), noise)
    return motion + seen.offset[:, None], seen, begun, noise


def _sloped(
    tracks: Tracks,
    values: Float[np.ndarray, "values"],
    start: Float[np.ndarray, "episodes"],
    noise: Noise,
    free: Bool[np.ndarray, "values"],
) -> tuple[Filtered, Float[np.ndarray, "episodes tips values"]]:
    """Return innovations and their slopes, jumps where they are, without what other starts in the play would do."""
    steps = np.diag(_STEPS)
    down, up = np.maximum(values - steps, [-np.inf, 0.0, 0.0, -1.0, -np.inf]), values + steps
    apart = np.diag(up - down)[:, None, None]
    residual = tracks.abscissa - tracks.motion(values[None], start)[0]
    slopes = -(tracks.motion(up, start) - tracks.motion(down, start)) / apart
    sides = [tracks.motion(values[None], np.clip(start + step, -1, 1))[0] for step in (-0.1, 0.1)]
    found = filtered(residual, tracks.travel(values[2]), noise)
    columns = np.concatenate([slopes, [sides[1] - sides[0]]])
    white, offset = np.zeros_like(columns), np.zeros(columns.shape[:2])
    for i in range(columns.shape[2]):  # the filter, with jumps where they were
        ahead = columns[..., i] - offset
        white[..., i] = ahead / found.spread[:, i] * np.isfinite(residual[:, i])
        offset += found.gain[:, i] * ahead
    slope, begin = np.moveaxis(white[:-1], 0, -1) * free, white[-1]
    share = np.einsum("et,eti->ei", begin, slope) / np.maximum((begin**2).sum(axis=1), 1e-12)[:, None]
    return found, slope - begin[..., None] * share[:, None]
