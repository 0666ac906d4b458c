"""Settings of the search for a course: `SearchConfig`."""

from __future__ import annotations

from dataclasses import field
from typing import Annotated

from endopilot.control.cost import Cost
from endopilot.settings import OpenShare, Positive, Seconds, Within, settings


@settings
class ManoeuvreConfig:
    """Settings of the manoeuvres of a wire in a catheter."""

    turns: Annotated[int, Within(1, 1000)] = 12
    """Rotations that are tried at each place."""
    behind_mm: Positive = 10.0
    """The catheter follows to this far behind the wire's tip, mm, except to the target if its own tip is to arrive."""
    together: bool = False
    """The wire goes on while its catheter follows, instead of resting: in half the time."""
    longest_s: Seconds = 30.0
    """A catheter is brought to its place in this time at most, s, and a wire past a fork."""


@settings
class SearchConfig:
    """Settings of the search; those of candidates are of a wire alone."""

    speed_mm_s: Annotated[float, Within(0.1, 1000)] = 10.0
    """Translation of a device that is pushed straight on, mm/s."""
    candidates: Annotated[int, Within(1, 4096)] = 32
    """Candidates that are tried side by side where pushing straight on fails."""
    rounds: Annotated[int, Within(1, 1000)] = 6
    """Rounds of one attempt, at most."""
    attempts: Annotated[int, Within(1, 1000)] = 4
    """Attempts, each from the same state, before a search is given up."""
    round_periods: Annotated[int, Within(1, 1000)] = 2
    """Decision periods of 0.5 s in a round."""
    keep_share: OpenShare = 0.25
    """Share of the candidates that a round keeps."""
    turn_rad_s: Annotated[float, Within(0.01, 1000)] = 7.0
    """Fastest rotation that is tried, rad/s."""
    lead_mm: Positive = 4.0
    """A search begins this far before a junction, mm, or 1.4 lumen radii where that is more."""
    cost: Cost = field(default_factory=Cost)
    """What the candidates are compared by."""
    manoeuvres: ManoeuvreConfig = field(default_factory=ManoeuvreConfig)
    """What is tried where there is a catheter."""
