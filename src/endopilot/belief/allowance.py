"""What bands allow for that no calibration knows: `Allowance`.

The lumen may be another than CT shows it, and the tip another than it is given. A wire that is pushed while its tip
rests buckles, and then snaps or folds, which no two wires do alike. In a wide lumen it lies down on the outer walls of
bends before, which simulated wires predict.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from endopilot.devices.drive_limits import SLACK_WIDTHS, WIDE_MM

_LUMEN_SHARE, _LUMEN_MM = 0.12, 0.3
"""The lumen's radius may be off by this share, and no more than this, mm: CT shows it to a tenth or a voxel, an
assumption."""
_FREE_MM, _HELD_SHARE = 5.0, np.array([0.3, 0.05])
"""A wire that is moved by more than this while its tip rests buckles: standard deviations of (Δtip, γtip) that this
adds, as shares of what goes beyond, mm; found in coronary arteries with compliant walls, on patients to improve agents
on. In a wide lumen it folds later (`SLACK_WIDTHS`)."""
_TIP_MM = np.array([0.2, 0.0])
"""Standard deviations of (Δtip, γtip) that are always added, mm: a tip is shaped by hand, and simulated wires that all
have the given one agree better than they are right; found with other tips, on patients to improve agents on."""


class Allowance:
    """What a wire's bands allow for, beside what they are calibrated for.

    Attributes:
        held_mm: by how much the wire was moved while its tip rested, since the last exposure, mm.
    """

    def __init__(self, inserted_mm: float, abscissa_mm: float, *, alone: bool) -> None:
        """Begin at an exposure.

        Args:
            alone: whether no catheter is around the wire; nothing is allowed for where one is.
        """
        self._at, self._alone, self.held_mm = np.array([inserted_mm, abscissa_mm]), alone, 0.0
        self._width_mm = 0.0

    def move(self, inserted_mm: float, abscissa_mm: float, radius_mm: float) -> None:
        """Take where the wire's ends are a period later, and the lumen's radius at its tip, mm."""
        self._width_mm = max(self._width_mm, 2 * radius_mm)
        now = np.array([inserted_mm, abscissa_mm])
        moved, tip_moved = np.abs(now - self._at).tolist()
        self._at, self.held_mm = now, self.held_mm + max(moved - tip_moved, 0.0)

    def exposed(self) -> None:
        """Begin anew at an exposure."""
        self.held_mm = 0.0

    def wall_mm(self, radius_mm: float) -> float:
        """Return by how much the lumen's radius may be another, mm, where it is given as this, mm."""
        return min(_LUMEN_SHARE * radius_mm, _LUMEN_MM) * self._alone

    @property
    def sd_mm(self) -> Float[np.ndarray, "2"]:
        """Standard deviations of (Δtip, γtip), mm."""
        free_mm = SLACK_WIDTHS * self._width_mm if self._width_mm > WIDE_MM else _FREE_MM
        return np.hypot(_HELD_SHARE * max(self.held_mm - free_mm, 0.0), _TIP_MM) * self._alone
