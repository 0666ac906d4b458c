"""Which wire, lumen, wall and ostium explain what X-ray showed: `identify`.

Members that differ in all of these replay the way of the devices so far, and are weighed by all exposures. Those of
the next generation are drawn around the likeliest. In a generation, members of one *kind*, of a wire in a vessel, are
simulated side by side; they differ in friction and ostium.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np
from jaxtyping import Float
from scipy.special import ndtr, ndtri

from endopilot.belief.belief import Belief, BeliefConfig, Past
from endopilot.errors import InputError
from endopilot.models.ensemble import likelihoods
from endopilot.simulation.world import World

RANGES: Mapping[str, tuple[float, float]] = {
    "tip_bend_factor": (0.6, 1.5),
    "tip_bend_length_factor": (0.7, 1.4),
    "tip_stiffness_factor": (0.5, 2.0),
    "lumen_factor": (0.85, 1.15),
    "friction_factor": (0.4, 2.5),
    "ostium_mm": (-4.0, 4.0),
}
"""Parameters that are identified, and their ranges; factors are drawn by their logarithms."""
_NAMES: Mapping[str, str] = {
    "tip_bend_factor": "tip bend ×{:.2f} to {:.2f}",
    "tip_bend_length_factor": "bent length ×{:.2f} to {:.2f}",
    "tip_stiffness_factor": "tip stiffness ×{:.2f} to {:.2f}",
    "lumen_factor": "lumen ×{:.2f} to {:.2f}",
    "friction_factor": "friction ×{:.2f} to {:.2f}",
    "ostium_mm": "wire {:.1f} to {:.1f} mm deeper than by its encoder",
}
_OF_KIND = 4
"""The first of them are those of a kind."""
_LUMENS = 0.9, 1.0, 1.1
"""Lumens that are tried: each is prepared by itself."""
_LARGEST_MAP = 50_000_000
"""Points of a distance map beyond which no other lumen is tried: it would take gigabytes."""
_COMPLIANT_N_MM2 = 0.01
"""Stiffness of a wall that is compliant: that of an artery in the heart's muscle, docs/concepts/wall.md."""
_SCALES_MM = (0.5, 0.3, 0.3)
"""Scales of a good member's errors along and across its wire, and of its γtip, mm."""
_USUAL_SD: Mapping[str, float] = {
    "tip_bend_factor": 0.2,
    "tip_bend_length_factor": 0.15,
    "tip_stiffness_factor": 0.3,
    "lumen_factor": 0.08,
    "friction_factor": 0.5,
}
"""Standard deviations of the factors' logarithms before anything was seen: an assumption."""
_COMPLIANT_SHARE = 0.3
"""How much likelier a rigid wall is before: an assumption."""
_UNSURE = 0.15
"""The kind of wall is unknown where either is at least this likely."""
_KNOWN_SHARE = 0.5
"""A parameter is unknown where its interval is wider than this share of what was likely before."""
_OSTIUM_SD_MM = 0.4
"""Standard deviation of the ostium that the first exposure shows, at least, mm."""
_SHRINKS, _NARROWEST, _LEAST_OF_A_WALL = 0.7, 0.04, 2
"""Members are drawn around their parents, moved towards the mean; no closer than this share of a parameter's range; and
so many kinds have each kind of wall at least."""
_UNEXPLAINED = 3.0
"""A member that errs by this many of the scales at every exposure is as likely as none of all."""
_KINDS, _EACH, _GENERATIONS = 8, 8, 2
"""Wires in vessels that are tried in a generation, a third of the first ones in a compliant vessel; frictions and ostia
that are tried with each; and generations."""


@dataclass(frozen=True, eq=False)
class Identified:
    """What explains the exposures.

    Attributes:
        interval: of each parameter of `RANGES`, the range that holds 80 % of the likelihood; None where the exposures
            hardly tell it.
        compliant: how likely the wall is compliant; None where nothing tells it.
        explains: whether the likeliest explains the exposures better than no member does.
    """

    interval: Mapping[str, tuple[float, float] | None]
    compliant: float | None
    explains: bool

    @property
    def wall(self) -> Literal["compliant", "rigid", "unknown"]:
        """Of which kind the wall is."""
        if self.compliant is None or _UNSURE <= self.compliant <= 1 - _UNSURE:
            return "unknown"
        return "compliant" if self.compliant > 0.5 else "rigid"

    @property
    def words(self) -> str:
        """What was found, in words."""
        known = [_NAMES[name].format(*ends) for name, ends in self.interval.items() if ends is not None]
        found = ", ".join([*known, f"{self.wall} wall"])
        return found if self.explains else f"nothing explains the images well; likeliest {found}"


def identify(belief: Belief, past: Past, *, seed: int = 0) -> tuple[Belief, Identified]:
    """Find what explains the exposures of a navigation so far.

    Returns:
        The belief that takes its place, at the same moment, and what was found.
    """
    random = np.random.default_rng([seed, len(past.proximal), 0x1DE])
    ostium = _ostium(belief, past)
    if len(past.proximal) == 1:  # nothing but the ostium shows before the wire moves
        return _deeper(belief, past, *ostium)
    theta, walls = _first(ostium, random)
    lumens = _LUMENS if belief.navigation.anatomy.distance_map.values.size <= _LARGEST_MAP else (1.0,)
    members, score, weight, explains = _weighed(belief, past, theta, walls, lumens)
    for _ in range(_GENERATIONS - 1):
        theta, walls = _redrawn(theta, walls, weight, random)
        members, score, weight, explains = _weighed(belief, past, theta, walls, lumens)
    flat = theta.reshape(-1, len(RANGES))
    interval = {name: _interval(name, flat[:, k], weight) for k, name in enumerate(RANGES)}
    compliant = float(weight[np.repeat(walls, _EACH)].sum())
    found = belief.like(_chosen(members, score, weight, _EACH, belief.config))
    found.replay(past)
    return found, Identified(interval, compliant, explains)


def _weighed(
    belief: Belief, past: Past, theta: Theta, walls: np.ndarray, lumens: Sequence[float]
) -> tuple[list[World], np.ndarray, np.ndarray, bool]:
    """Return members of parameters, their logarithmic likelihoods, weights by a part of these, and whether the best
    explains more than none does."""
    members = _members(theta, walls, lumens)
    score, explains = _scores(belief, past, members)
    score = score + _prior(members)
    return members, score, _tempered(score, len(members) / 8), explains


def _ostium(belief: Belief, past: Past) -> tuple[float, float]:
    """Return how much deeper the wire was at the start than the encoder says, by the first exposure, and the standard
    deviation of that, mm."""
    low, high = RANGES["ostium_mm"]
    tried = np.arange(low, high + 0.1, 0.5)
    if 0 not in past.exposures:
        return 0.0, high / 2
    first = Past(past.proximal[:1], {0: past.exposures[0]})
    score, _ = _scores(belief, first, [World(ostium_mm=float(each)) for each in tried])
    weight = likelihoods(score)
    mean = float(weight @ tried)
    return mean, max(float(np.sqrt(weight @ (tried - mean) ** 2)), _OSTIUM_SD_MM)


def _deeper(belief: Belief, past: Past, ostium_mm: float, sd_mm: float) -> tuple[Belief, Identified]:
    """Return the same members with their ostia where the first exposure has them."""
    off = np.array([each.ostium_mm for each in belief.members])
    wider = sd_mm / max(float(off.std()), 1e-3)
    members = zip(belief.members, (ostium_mm + wider * (off - off.mean())).tolist(), strict=True)
    found = belief.like([replace(each, ostium_mm=deeper) for each, deeper in members])
    found.replay(past)
    interval = dict.fromkeys(RANGES) | {"ostium_mm": (ostium_mm - sd_mm, ostium_mm + sd_mm)}
    return found, Identified(interval, None, explains=True)


Theta = Float[np.ndarray, "kinds each parameters"]


def _first(ostium: tuple[float, float], random: np.random.Generator) -> tuple[Theta, np.ndarray]:
    """Return evenly spread parameters: the first kind is as given, and ostia are about where the first image has it."""
    from scipy.stats import qmc  # slow to import

    kinds, each = _KINDS, _EACH
    of_kind = qmc.Sobol(_OF_KIND, rng=random).random(kinds)
    of_kind[0] = [_to_unit(name, 1.0) for name in list(RANGES)[:_OF_KIND]]
    rest = qmc.Sobol(len(RANGES) - _OF_KIND, rng=random).random(kinds * each).reshape(kinds, each, -1)
    off = ndtri(np.clip(rest[..., -1], 1e-3, 1 - 1e-3)) * ostium[1]
    rest[..., -1] = np.clip(_to_unit("ostium_mm", ostium[0] + off), 0.0, 1.0)
    unit = np.concatenate([np.repeat(of_kind[:, None], each, axis=1), rest], axis=-1)
    unit[:, 0, list(RANGES).index("friction_factor")] = _to_unit("friction_factor", 1.0)
    walls = np.arange(kinds) % 3 == 1
    return unit, walls


def _bounds(name: str) -> tuple[float, float]:
    low, high = RANGES[name]
    return (np.log(low), np.log(high)) if name.endswith("factor") else (low, high)


def _to_unit(name: str, value: Any) -> Any:
    low, high = _bounds(name)
    return ((np.log(value) if name.endswith("factor") else value) - low) / (high - low)


def _from_unit(name: str, unit: float) -> float:
    low, high = _bounds(name)
    value = low + unit * (high - low)
    return float(np.exp(value)) if name.endswith("factor") else float(value)


def _members(theta: Theta, walls: np.ndarray, lumens: Sequence[float]) -> list[World]:
    """Return members of parameters; each has the nearest of the lumens that are tried, in a compliant vessel the given
    one."""
    made = []
    for of_kind, wall in zip(theta, walls, strict=True):
        for unit in of_kind:
            values: dict[str, Any] = {name: _from_unit(name, float(u)) for name, u in zip(RANGES, unit, strict=True)}
            wanted = 1.0 if wall else values["lumen_factor"]
            values["lumen_factor"] = min(lumens, key=lambda factor: abs(factor - wanted))
            made.append(World(**values, compliant_wall_n_mm2=_COMPLIANT_N_MM2 if wall else None))
    return made


def _prior(members: Sequence[World]) -> Float[np.ndarray, "members"]:
    """Return how likely members are before anything was seen, as logarithms: near to what is given, most likely."""
    off = [[np.log(getattr(each, name)) / sd for name, sd in _USUAL_SD.items()] for each in members]
    compliant = [each.compliant_wall_n_mm2 is not None for each in members]
    return -0.5 * np.square(off).sum(axis=1) + np.where(compliant, np.log(_COMPLIANT_SHARE), 0.0)


def _scores(belief: Belief, past: Past, members: Sequence[World]) -> tuple[Float[np.ndarray, "members"], bool]:
    """Return the logarithmic likelihoods of members, and whether the best explains more than none does."""
    score = np.full(len(members), -1e6)
    wall = np.array([each.compliant_wall_n_mm2 is not None for each in members])
    count = len(past.exposures)
    for kind in (False, True):
        chosen = np.flatnonzero(wall == kind)
        if not len(chosen):
            continue
        try:
            tried = belief.like([members[k] for k in chosen.tolist()])
        except InputError:  # the wire does not fit
            continue
        error = tried.replay(past)
        scaled = error / np.maximum(_SCALES_MM, [(0.0, *seen.tip_sd_mm) for seen in past.exposures.values()])
        found = -np.log1p((scaled**2).sum(axis=-1)).sum(axis=1)
        score[chosen] = np.where(tried.simulator.valid, np.nan_to_num(found, nan=-1e6), -1e6)
    return score, bool(score.max() > -count * np.log1p(_UNEXPLAINED**2))


def _tempered(score: Float[np.ndarray, "n"], least: float) -> Float[np.ndarray, "n"]:
    """Return weights by as much of the likelihood as leaves some number of members effective."""
    low, high = 0.0, 1.0
    for _ in range(30):
        power = high if high == 1.0 else 0.5 * (low + high)
        if 1 / (likelihoods(power * score) ** 2).sum() >= least:
            low = power
            if power == 1.0:
                break
        else:
            high = power if power < 1.0 else 1.0 - 1e-9
    return likelihoods(low * score)


def _redrawn(
    theta: Theta, walls: np.ndarray, weight: np.ndarray, random: np.random.Generator
) -> tuple[Theta, np.ndarray]:
    """Draw the next generation around the likeliest members, as kernels that keep mean and variance (Liu and West)."""
    kinds, each, count = theta.shape
    flat, wall = theta.reshape(-1, count), np.repeat(walls, each)
    at = (np.arange(kinds) + random.random()) / kinds
    parents = np.searchsorted(np.cumsum(weight), at).clip(0, len(weight) - 1)
    parents[0] = int(np.argmax(weight))
    for kind in (False, True):  # neither kind of wall is given up
        lacking = max(_LEAST_OF_A_WALL - int((wall[parents] == kind).sum()), 0)
        others = np.flatnonzero(wall == kind)
        if lacking and len(others):
            parents[kinds - lacking :] = others[np.argsort(-weight[others])[:lacking]]
    mean = weight @ flat
    sd = np.sqrt(weight @ (flat - mean) ** 2)
    center = _SHRINKS * flat[parents] + (1 - _SHRINKS) * mean
    width = np.maximum(np.sqrt(1 - _SHRINKS**2) * sd, _NARROWEST)
    center = np.repeat(center[:, None], each, axis=1)
    drawn = _truncated(center, width, random)
    drawn[:, :, :_OF_KIND] = drawn[:, :1, :_OF_KIND]
    drawn[0, :, :_OF_KIND], drawn[:, 0, _OF_KIND:] = flat[parents[0], :_OF_KIND], flat[parents, _OF_KIND:]
    return drawn, wall[parents]


def _truncated(center: np.ndarray, sd: np.ndarray, random: np.random.Generator) -> np.ndarray:
    """Return normal deviates between 0 and 1."""
    low, high = ndtr((0.0 - center) / sd), ndtr((1.0 - center) / sd)
    return np.clip(center + sd * ndtri(low + (high - low) * random.random(center.shape)), 0.0, 1.0)


def _interval(name: str, unit: np.ndarray, weight: np.ndarray) -> tuple[float, float] | None:
    """Return the range of a parameter that holds 80 % of the weight; None where it is hardly narrower than before."""
    order = np.argsort(unit)
    share = np.cumsum(weight[order])
    ends = (unit[order][min(int(np.searchsorted(share, at)), len(unit) - 1)] for at in (0.1, 0.9))
    low, high = (_from_unit(name, float(end)) for end in ends)
    before = 2 * 1.28 * _USUAL_SD[name] if name in _USUAL_SD else RANGES[name][1]
    after = np.log(high / low) if name in _USUAL_SD else high - low
    return (low, high) if after <= _KNOWN_SHARE * before else None


def _chosen(
    members: Sequence[World], score: Float[np.ndarray, "members"], weight: np.ndarray, each: int, config: BeliefConfig
) -> tuple[World, ...]:
    """Return the likeliest members, of the likelier kind of wall: some of each of the likeliest kinds."""
    compliant = np.array([member.compliant_wall_n_mm2 is not None for member in members])
    rows = np.where(compliant == (weight[compliant].sum() > 0.5), score, -np.inf).reshape(-1, each)
    kinds = np.argsort(-rows.max(axis=1))[: config.stiffness_levels]
    most = config.members // len(kinds)
    return tuple(members[kind * each + lane] for kind in kinds for lane in np.argsort(-rows[kind])[:most])
