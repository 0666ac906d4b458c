"""What a search finds: `Course`."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float

from endopilot.types import TipProjection

Controls = Float[np.ndarray, "periods devices 2"]
"""Translation (mm/s) and rotation (rad/s) of each device in each decision period."""


@dataclass(frozen=True, eq=False)
class Course:
    """Controls, and what the wires that they were found with do under them.

    Attributes:
        control: (mm/s, rad/s) of each device in each decision period.
        proximal: inserted length (mm) and rotation (rad) of each device at the end of each period, as encoders tell.
        tip: of the wires then, a column a wire; those that the course leaves behind are not among them.
        force: largest wall force on a node, N, of all wires.
        checked: whether a wire that is elsewhere then has left the course.
        exposed: whether X-ray is to show where a manoeuvre has led.
        reached: whether they end at the target, by weight: 1 if all do.
    """

    control: Controls
    proximal: Controls
    tip: TipProjection
    force: Float[np.ndarray, "periods wires"]
    checked: Bool[np.ndarray, "periods"]
    exposed: Bool[np.ndarray, "periods"]
    reached: float
