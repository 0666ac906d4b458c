"""The C-arm's angles as clinics use them: `draw_view`."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from endopilot.phantom.chest import is_left
from endopilot.types import Anatomy
from endopilot.xray.absorbers import is_coronary

Range = tuple[float, float]
LEFT: dict[str, tuple[Range, Range]] = {
    "LAO caudal": ((40, 50), (-40, -25)),
    "AP caudal": ((-15, 0), (-30, -30)),
    "RAO caudal": ((-45, -30), (-40, -30)),
    "AP cranial": ((-10, 0), (35, 45)),
    "LAO cranial": ((30, 45), (25, 35)),
    "lateral": ((90, 90), (-30, 30)),
}
"""Ranges of LAO (positive) or RAO, and of cranial (positive) or caudal angle, degrees, for left coronary arteries:
table 2 of Di Mario and Sutaria, Heart 91, 2005."""
RIGHT: dict[str, tuple[Range, Range]] = {
    "LAO": ((45, 60), (0, 0)),
    "RAO": ((-45, -30), (0, 0)),
    "LAO cranial": ((30, 45), (25, 35)),
    "AP cranial": ((-10, 0), (35, 45)),
    "lateral": ((90, 90), (-30, 30)),
}
"""The same for right coronary arteries."""
OTHER: dict[str, tuple[Range, Range]] = {
    "AP": ((-5, 5), (-5, 5)),
    "LAO": ((20, 40), (-10, 10)),
    "RAO": ((-40, -20), (-10, 10)),
    "lateral": ((85, 95), (-5, 5)),
}
"""The same for other vessels: frontal, oblique and lateral; an assumption."""


def draw_view(random: np.random.Generator, anatomy: Anatomy) -> tuple[str, tuple[float, float]]:
    """Draw a view of a vessel: each of its kind's is as likely, and each angle within its range.

    Returns:
        The view's name, and LAO (positive) or RAO, and cranial (positive) or caudal angle, degrees.
    """
    views = OTHER if not is_coronary(anatomy) else LEFT if is_left(anatomy.tree) else RIGHT
    name = list(views)[int(random.integers(len(views)))]
    lao, cranial = (round(float(random.uniform(*bounds)), 1) for bounds in views[name])
    return name, (lao, cranial)


def view_text(angles_deg: Sequence[float]) -> str:
    """Return a view as clinics write it, such as "LAO 45 CRAN 20"."""
    lao, cranial = angles_deg
    side, tilt = ("LAO" if lao >= 0 else "RAO"), ("CRAN" if cranial >= 0 else "CAUD")
    return f"{side} {abs(lao):.0f}" + (f" {tilt} {abs(cranial):.0f}" if cranial else "")
