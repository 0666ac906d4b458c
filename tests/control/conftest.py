"""A navigation that several tests of control share."""

from __future__ import annotations

import pytest

from endopilot.devices.catheter import read_catheter
from endopilot.tasks.navigation import Navigation, Target


@pytest.fixture(scope="module")
def pair(fork, wire) -> Navigation:
    """Return a navigation of a pair that has too little time to move in turn, to a place straight ahead."""
    return Navigation(
        anatomy=fork,
        device=wire,
        target=Target(branch=1, abscissa=34.0),
        catheters=(read_catheter("microcatheter-1.7f"),),
        start_inserted_length_mm=6.0,
        seconds=8.0,
        force_limit_n=0.3,
    )
