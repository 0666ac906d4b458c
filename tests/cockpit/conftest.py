"""A session in a vessel that forks, and its parts."""

from __future__ import annotations

import pytest
from browser import ready


@pytest.fixture
def navigation(fork, wire):
    from endopilot.tasks.navigation import Navigation, Target

    return Navigation(anatomy=fork, device=wire, target=Target(branch=0, abscissa=15.0))


@pytest.fixture
def world(navigation):
    from endopilot.cockpit.world import LiveWorld

    return LiveWorld(navigation)


@pytest.fixture
def xray(navigation):
    from endopilot.cockpit.open import xray_unit

    unit = ready(xray_unit(navigation, None))
    yield unit
    unit.close()


@pytest.fixture
def recorded(vessel, tmp_path):
    """Return a function that makes the recorder of a world."""
    from endopilot.cockpit.recording import Recorder, Where

    return lambda world: Recorder(tmp_path / "a.cockpit.jsonl", world, Where(patient=vessel), 0)


@pytest.fixture
def session(world, xray, recorded):
    from endopilot.cockpit.session import Session

    made = Session(world, xray, recorded(world))
    yield made
    made.close()
