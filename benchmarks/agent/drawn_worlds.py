"""Worlds drawn at random from continuous ranges, of one kind or of two at once: `drawn_world`.

No shipped world, and no hypothesis of the belief, has a point of its own in these ranges. The seed gives the worlds.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np

from endopilot.devices.robot import DriveConfig, RobotConfig
from endopilot.simulation.motion import AMPLITUDES, Motion
from endopilot.simulation.world import Stenosis, World

_Draw = Callable[[np.random.Generator], dict[str, Any]]


def _factors(**ranges: tuple[float, float]) -> _Draw:
    """Return what draws factors, evenly in their logarithms, between two ends each."""

    def draw(random: np.random.Generator) -> dict[str, Any]:
        return {name: float(np.exp(random.uniform(*np.log(ends)))) for name, ends in ranges.items()}

    return draw


def _numbers(**ranges: tuple[float, float]) -> _Draw:
    """Return what draws numbers evenly between two ends each."""

    def draw(random: np.random.Generator) -> dict[str, Any]:
        return {name: float(random.uniform(*ends)) for name, ends in ranges.items()}

    return draw


def _registration(random: np.random.Generator) -> dict[str, Any]:
    side = random.standard_normal(3)
    return {"registration_mm": tuple((random.uniform(0.5, 1.5) * side / np.linalg.norm(side)).tolist())}


def _drift(random: np.random.Generator) -> dict[str, Any]:
    side = random.standard_normal(3)
    return {"drift_mm_min": tuple((random.uniform(0.7, 3.0) * side / np.linalg.norm(side)).tolist())}


def _ostium_aside(random: np.random.Generator) -> dict[str, Any]:
    angle, off_mm = random.uniform(0.0, 2 * np.pi), random.uniform(0.2, 0.7)
    return {"ostium_aside_mm": (off_mm * float(np.cos(angle)), off_mm * float(np.sin(angle)))}


def _wall(random: np.random.Generator) -> dict[str, Any]:
    found = _factors(compliant_wall_n_mm2=(0.01, 0.04))(random)
    draws = {"wall_along": random, "wall_around": random.spawn(1)[0]}  # what else is drawn stays as it was
    for name, own in draws.items():
        if own.random() < 0.5:
            factors = np.exp(own.uniform(np.log(0.3), np.log(3.0), 3))
            found[name] = tuple((factors / min(factors.min(), 1.0)).tolist())  # nowhere softer than a wall can be
    return found


def _rough(random: np.random.Generator) -> dict[str, Any]:
    found = _factors(friction_factor=(0.45, 2.3))(random)
    if random.random() < 0.3:
        found["friction_along"] = tuple(np.exp(random.uniform(np.log(0.5), np.log(2.5), 3)).tolist())
    return found


def _robot(random: np.random.Generator) -> dict[str, Any]:
    drive = DriveConfig(play_mm=float(random.uniform(0.5, 3.0)), play_rad=float(random.uniform(0.0, 2.0)))
    return {"robot": RobotConfig(encoders_at="motor", wire=drive)}


def _motion(random: np.random.Generator) -> dict[str, Any]:
    size = {name: float(Motion.__dataclass_fields__[name].default * random.uniform(0.6, 1.5)) for name in AMPLITUDES}
    heart_s, breath_s = float(random.uniform(0.65, 1.1)), float(random.uniform(3.0, 5.5))
    return {"motion": replace(Motion(), **size, heart_period_s=heart_s, breathing_period_s=breath_s)}


def _stenosis(random: np.random.Generator) -> dict[str, Any]:
    share, at = float(random.uniform(0.3, 0.55)), float(random.uniform(0.25, 0.6))
    return {"stenosis": Stenosis(at_share=at, length_mm=float(random.uniform(6.0, 15.0)), diameter_share=share)}


KINDS: dict[str, _Draw] = {
    "bend": _factors(tip_bend_factor=(0.65, 1.5), tip_bend_length_factor=(0.75, 1.35)),
    "lumen": _factors(lumen_factor=(0.86, 1.16)),
    "ostium": _numbers(ostium_mm=(-3.0, 3.0)),
    "wall": _wall,
    "wire": _factors(tip_stiffness_factor=(0.6, 1.8), shaft_stiffness_factor=(0.6, 1.8)),
    "registration": _registration,
    "friction": _rough,
    "lean": _numbers(axis_deg=(4.0, 16.0)),
    "motion": _motion,
    "robot": _robot,
    "drift": _drift,
    "backing": _numbers(backs_out_mm=(1.0, 4.0), backs_out_after_s=(2.0, 15.0)),
    "aside": _ostium_aside,
    "stenosis": _stenosis,
}
"""What a world differs in, and how it is drawn."""


def drawn_world(seed: int, number: int) -> World:
    """Return one of the worlds of a seed: its first kind is the next of `KINDS`, and every other world has two."""
    random, names = np.random.default_rng([seed, number, 0xD1FF]), list(KINDS)
    first = names[number % len(names)]
    kinds = [first]
    if (number + number // len(names)) % 2:
        kinds.append(str(random.choice([name for name in names if name != first])))
    values: dict[str, Any] = {}
    for name in kinds:
        values |= KINDS[name](random)
    return World(about=" and ".join(kinds), **values)
