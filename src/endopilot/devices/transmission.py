"""What lies between a drive and the ostium: a length of the device in its guiding catheter, which rubs there."""

from __future__ import annotations

from typing import Annotated

from endopilot.settings import Within, settings


@settings
class Transmission:
    """How a drive's rotation reaches the ostium.

    The device behind the ostium twists under a Coulomb friction torque along it. docs/concepts/transmission.md derives
    what that does: of a uniform device with the torsional stiffness GJ and free at the ostium, the rotation lags behind
    the drive's by m L²/2GJ while it turns, and starts after a reversal when the drive has turned by twice that.

    Attributes:
        length_mm: length of the device between its drive and the ostium, mm; 0: the drive acts at the ostium.
        twist_friction_n_mm_mm: friction torque a length, m, N·mm/mm.
    """

    length_mm: Annotated[float, Within(0, 3000, unit="mm", mistaken=(("m", 1000.0),))] = 0.0
    twist_friction_n_mm_mm: Annotated[float, Within(0, 1)] = 0.0
