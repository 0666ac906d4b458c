"""The crux of the heart, and which coronary artery reaches it: dominance, the same whichever artery is asked for."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from jaxtyping import Float

from endopilot.types import Centerline

Dominance = Literal["right", "balanced", "left"]

CRUX_FROM_OSTIUM_MM = np.array([12.0, 43.0, -44.0])
"""The crux as seen from the right ostium, LPS mm: behind and below it. In six real patients within 13 mm of this."""

REACHED_MM = 20.0
"""An artery that comes this near to the crux reaches it; in seven real patients the other one stays 34 mm away."""


@dataclass(frozen=True, eq=False)
class Crux:
    """Where the posterior interventricular groove meets the atrioventricular one.

    Attributes:
        position: LPS mm, within some 15 mm.
        dominance: which artery reaches it.
    """

    position: Float[np.ndarray, "3"]
    dominance: Dominance

    def abscissa(self, line: Centerline) -> float | None:
        """Return where a line passes the crux, mm; None if it does not come near."""
        gap = np.linalg.norm(line.points - self.position, axis=1)
        return float(line.abscissa[gap.argmin()]) if gap.min() < REACHED_MM else None


def find_crux(
    right_ostium: Float[np.ndarray, "3"], right: Float[np.ndarray, "n 3"], left: Float[np.ndarray, "m 3"]
) -> Crux | None:
    """Return the crux of a patient, or None where neither artery reaches it: then the ends are cut off.

    Args:
        right_ostium: ostium of the right coronary artery, LPS mm.
        right: points along the right artery's tree, LPS mm.
        left: points along the left artery's tree, LPS mm.
    """
    position = right_ostium + CRUX_FROM_OSTIUM_MM
    reached = [bool(np.linalg.norm(tree - position, axis=1).min() < REACHED_MM) for tree in (right, left)]
    if not any(reached):
        return None
    return Crux(position, "balanced" if all(reached) else "right" if reached[0] else "left")
