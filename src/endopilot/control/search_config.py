"""Settings of the search for a course: `SearchConfig`."""

from __future__ import annotations

from typing import Annotated

from endopilot.settings import Positive, Seconds, Within, settings


@settings
class SearchConfig:
    """How fast devices are moved in a search, and how a catheter follows its wire; `motions.yaml` has what is tried."""

    speed_mm_s: Annotated[float, Within(0.1, 1000)] = 10.0
    """Translation of a device that is pushed straight on, mm/s."""
    turn_rad_s: Annotated[float, Within(0.01, 1000)] = 7.0
    """Fastest rotation that is tried, rad/s."""
    lead_mm: Positive = 4.0
    """Devices are turned this far before a junction, mm, or 1.4 lumen radii where that is more."""
    behind_mm: Positive = 10.0
    """The catheter follows to this far behind the wire's tip, mm, except to the target if its own tip is to arrive."""
    together: bool = False
    """The wire goes on while its catheter follows, instead of resting: in half the time."""
    longest_s: Seconds = 30.0
    """A motion that leads past a place takes this much longer than twice the way at full speed at most, s."""
