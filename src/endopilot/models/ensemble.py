"""Simulated wires that differ in what is uncertain: how they move, and how likely each is after what was seen.

They differ in friction, in the stiffness of the tip, in how deep the ostium lies along the guiding catheter's axis and,
in a patient who moves, in what the heart does. Breath moves vessel and catheter together, and so no tip in its vessel.
"""

from __future__ import annotations

import warnings
from dataclasses import replace

import numpy as np
from jaxtyping import Bool, Float
from scipy.special import ndtri

from endopilot.devices.stack import Stack
from endopilot.simulation.config import SimulatorConfig
from endopilot.simulation.motion import AMPLITUDES, Motion
from endopilot.simulation.simulate import run_set_up
from endopilot.simulation.state import SimulationSetUp
from endopilot.types import SAMPLE_PERIOD_S, Anatomy

NAMES = ("friction_factor", "tip_stiffness_factor", "ostium_mm", "annulus_factor", "heart_volume_factor")
"""What members differ in; the last two are factors on the known motion of the heart."""
NOMINAL = np.array([1.0, 1.0, 0.0, 1.0, 1.0])
"""A wire, and a heart, as they are given."""
SPREADS = np.array(
    [0.2, 0.2, 0.3, *(AMPLITUDES[name][1] / AMPLITUDES[name][0] for name in ("annulus_mm", "heart_volume_share"))]
)
"""Standard deviations before anything was seen: assumed of wire and ostium, published of the heart."""
SCALES_MM = np.array([0.05, 0.025])
"""Scales of a good wire's error in Δtip and γtip where the tip is measured exactly, mm."""
NARROWEST = 0.1
"""Members are spread over this share of `SPREADS` at least."""
_LEVELS = np.array([0.0, 0.05, 0.0, 0.05, 0.05])
"""Parameters are rounded to these: members of one stiffness in one motion are simulated side by side."""
_KINDS = {False: 2, True: 4}
"""Stiffnesses and motions that drawn members have together, in a vessel that lies still and in one that moves: as few
as a plane needs, for members of one kind share the processor's lanes."""
_FAR_MM = 2.0
"""Differences between tips are cut off here, mm: beyond, a wire has snapped, or lies in another branch."""
_MEDIAN_SQUARE = 0.455
"""Median of the square of a normal deviate."""
_REFITS = 10
"""Times that the tips' weights follow from how well they are explained."""
Members = Float[np.ndarray, "members episodes 5"]
"""Values of `NAMES` of each member, for each episode."""
Paths = Float[np.ndarray, "members episodes samples 2"]
"""(Δtip, γtip) of each member at each sample, mm; NaN from where its simulation fails."""
Tips = Float[np.ndarray, "episodes samples 2"]
Seen = Bool[np.ndarray, "episodes samples"]


def drawn(
    mean: Float[np.ndarray, "episodes 5"], sd: Float[np.ndarray, "episodes 5"], count: int, *, moves: bool
) -> Members:
    """Return members evenly around some means, in normal distributions.

    Args:
        count: of them, a power of 2.
        moves: whether the vessel moves; motion does not differ where it does not.
    """
    from scipy.stats import qmc  # slow to import

    def normal(dimensions: int, points: int) -> Float[np.ndarray, "points dimensions"]:
        even = qmc.Sobol(dimensions, scramble=False).random_base2(points.bit_length() - 1)
        return ndtri(even + 0.5 / points)

    kinds, unit = _KINDS[moves], np.zeros((count, 5))
    unit[:, [1, 3, 4] if moves else [1]] = np.repeat(normal(3 if moves else 1, kinds), count // kinds, axis=0)
    unit[:, [0, 2]] = normal(2, count)
    return rounded(mean + unit[:, None] * sd)


def rounded(members: Float[np.ndarray, "*n 5"]) -> Float[np.ndarray, "*n 5"]:
    """Return parameters on their levels, within three spreads."""
    within = np.clip(members, NOMINAL - 3 * SPREADS, NOMINAL + 3 * SPREADS)
    return np.where(_LEVELS > 0, np.round(within / np.maximum(_LEVELS, 1e-9)) * _LEVELS, within)


def replay(
    anatomy: Anatomy,
    stack: Stack,
    members: Members,
    *,
    start: Float[np.ndarray, "episodes devices 2"],
    command: Float[np.ndarray, "episodes samples devices 2"],
    config: SimulatorConfig,
    motion: Motion | None = None,
) -> Paths:
    """Drive every member from the start of each episode as the robot was commanded.

    Args:
        stack: the devices as they are given.
        start: inserted length (mm) and rotation (rad) of each device as the encoders have it.
        command: mm/s and rad/s of each sample.
        motion: as it is known.
    """
    count, episodes = members.shape[:2]
    flat = members.reshape(-1, 5)
    starts, commands = np.tile(start, (count, 1, 1)), np.tile(command, (count, 1, 1, 1)).astype(float)
    made = np.full((len(flat), command.shape[1], 2), np.nan)
    heart = np.unique(flat[:, 3:], axis=0, return_inverse=True)[1].ravel() if motion else np.zeros(len(flat), dtype=int)
    for rows in (np.flatnonzero(heart == k) for k in range(heart.max() + 1)):
        devices = with_stiffnesses(stack, flat[rows, 1])
        set_up = SimulationSetUp(
            anatomies=[anatomy] * len(rows),
            stacks=[devices[factor] for factor in flat[rows, 1]],
            initial=as_deep(starts[rows], flat[rows, 2]),
            friction=frictions(stack, flat[rows, 0]),
            actuation="velocity",
            motion=_moved(motion, flat[rows[0], 3:]),
            config=config,
        )
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # a member that fails is left out
            run = run_set_up(set_up, commands[rows], period_s=SAMPLE_PERIOD_S, record_shape=False)
        tip = run.tip[:, :, 0]
        made[rows] = np.where(run.valid[..., None], np.stack([tip.abscissa, tip.offset], axis=-1), np.nan)
    return made.reshape(count, episodes, -1, 2)


def with_stiffnesses(stack: Stack, factors: Float[np.ndarray, "n"]) -> dict[float, Stack]:
    """Return devices whose wire's tip is as many times as stiff as some factors say, by the factor."""
    wire = stack.wire
    return {
        each: replace(stack, wire=wire.with_tip(bend_rad=wire.tip_bend_rad, stiffness_factor=each))
        for each in np.unique(factors).tolist()
    }


def frictions(stack: Stack, factors: Float[np.ndarray, "n"]) -> Float[np.ndarray, "n devices"]:
    """Return the friction coefficients of devices whose wire has so many times its own."""
    return stack.frictions(stack.wire.friction * factors)


def as_deep(
    start: Float[np.ndarray, "n devices 2"], ostium_mm: Float[np.ndarray, "n"]
) -> Float[np.ndarray, "n devices 2"]:
    """Return starts of devices that lie so much deeper than the encoders have it, mm."""
    return np.stack([np.maximum(start[..., 0] + ostium_mm[:, None], 0.0), start[..., 1]], axis=-1)


def _moved(motion: Motion | None, factors: Float[np.ndarray, "2"]) -> Motion | None:
    """Return a known motion with factors on what the heart does."""
    if motion is None:
        return None
    share = min(motion.heart_volume_share * float(factors[1]), 0.3)
    return replace(motion, annulus_mm=motion.annulus_mm * float(factors[0]), heart_volume_share=share)


def posterior(
    members: Float[np.ndarray, "members 5"],
    paths: Float[np.ndarray, "members samples 2"],
    tip: Float[np.ndarray, "samples 2"],
    sd_mm: Float[np.ndarray, "samples 2"],
    seen: Bool[np.ndarray, "samples"],
) -> tuple[Float[np.ndarray, "5"], Float[np.ndarray, "5"]]:
    """Return mean and standard deviation of the parameters of one episode after the tips that were seen.

    A linear regression over the members says how each sample's tip depends on the parameters, and how badly a line
    describes that: snaps count little.

    Args:
        sd_mm: standard deviations of the tips as whatever measured them states them, mm; 0 where it states none.
    """
    whole = np.isfinite(paths).all(axis=(1, 2))
    if whole.sum() < 8 or not seen.any():
        return NOMINAL, SPREADS
    unit = (members[whole] - NOMINAL) / SPREADS
    y = paths[whole][:, seen].reshape(whole.sum(), -1)
    shown, scale = tip[seen].ravel(), np.maximum(SCALES_MM, sd_mm)[seen].ravel()
    center = np.median(y, axis=0)
    y, away = np.clip(y - center, -_FAR_MM, _FAR_MM), np.clip(shown - center, -_FAR_MM, _FAR_MM)
    lines = np.column_stack([np.ones(len(unit)), unit])
    slope = np.linalg.solve(lines.T @ lines + 1e-3 * np.eye(6), lines.T @ y)
    left = ((y - lines @ slope) ** 2).mean(axis=0)
    found, precision = np.zeros(5), np.eye(5)
    for _ in range(_REFITS):
        misfit = (away - slope[0] - found @ slope[1:]) ** 2
        noise = np.median(misfit.reshape(-1, 2), axis=0) / _MEDIAN_SQUARE  # of Δtip and γtip, which no wire explains
        variance = 0.25 * scale**2 + 4 * left + np.tile(noise, len(misfit) // 2)
        weight = 1 / (variance * (1 + misfit / (4 * variance)))
        precision = (slope[1:] * weight) @ slope[1:].T + np.eye(5)
        found = np.linalg.solve(precision, (slope[1:] * weight) @ (away - slope[0]))
    return NOMINAL + SPREADS * found, SPREADS * np.sqrt(np.diag(np.linalg.inv(precision)))


def weights(paths: Paths, tips: Tips, seen: Seen, sd_mm: Tips) -> Float[np.ndarray, "members episodes"]:
    """Return how likely the members are: the product of Cauchy densities of their errors at the tips that were seen.

    Heavy tails, because a snap that comes a moment too early errs by a millimetre and says little about friction. The
    scale is no smaller than what the best member leaves unexplained: of a measurement that is worse than it states, and
    of a world that no member is like.
    """
    error = np.where(seen[..., None], np.nan_to_num(paths - tips, nan=1e3), np.nan)
    scale = np.maximum(np.maximum(SCALES_MM, sd_mm), misfit(paths, tips, seen)[:, None])
    score = np.nansum(-np.log1p((error / scale) ** 2), axis=(2, 3))
    return likelihoods(score)


def misfit(paths: Paths, tips: Tips, seen: Seen) -> Float[np.ndarray, "episodes 2"]:
    """Return the standard deviation of what the best member leaves unexplained of the tips that were seen, mm."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # nothing was seen
        error = np.where(seen[..., None], np.nan_to_num(np.abs(paths - tips), nan=1e3), np.nan)
        median = np.nanmedian(error, axis=2)
    return np.nan_to_num(median.min(axis=0)) / np.sqrt(_MEDIAN_SQUARE)


def weigh(paths: Paths, tips: Tips, seen: Seen, sd_mm: Tips) -> tuple[Tips, Tips]:
    """Return the tip that members predict, and its spread, mm: their weighted median and deviation from it.

    The spread holds what no member explains too: members that all err alike agree. NaN where none is left.
    """
    weight = weights(paths, tips, seen, sd_mm)
    share = np.where(np.isfinite(paths), weight[:, :, None, None], 0.0)
    total = share.sum(axis=0)
    order = np.argsort(paths, axis=0)  # NaN last
    reached = np.cumsum(np.take_along_axis(share, order, axis=0), axis=0) >= 0.5 * total
    middle = np.take_along_axis(paths, np.take_along_axis(order, reached.argmax(axis=0)[None], axis=0), axis=0)[0]
    variance = (share * np.nan_to_num(paths - middle) ** 2).sum(axis=0)
    left = total > 0
    spread = np.sqrt(np.divide(variance, total, out=np.full_like(total, np.nan), where=left))
    return np.where(left, middle, np.nan), np.hypot(spread, misfit(paths, tips, seen)[:, None])


def likelihoods(score: Float[np.ndarray, "members *n"]) -> Float[np.ndarray, "members *n"]:
    """Return how likely members are, in the sum 1, from their logarithmic likelihoods up to a constant."""
    weight = np.exp(score - score.max(axis=0))
    return weight / weight.sum(axis=0)
