"""A navigation for the environments."""

from __future__ import annotations

import pytest

from endopilot.tasks.navigation import Navigation, Target


@pytest.fixture(scope="session")
def ahead(fork, wire) -> Navigation:
    """Return a target 20 mm beyond the fork, to be reached within 2 s."""
    return Navigation(
        anatomy=fork, device=wire, target=Target(branch=1, abscissa=38.0), start_inserted_length_mm=6.0, seconds=2.0
    )
