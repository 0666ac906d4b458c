"""A device laid out as a rod: where the tip of a free wire comes to lie."""

from __future__ import annotations

import numpy as np
import pytest

from endopilot.simulation.config import SimulatorConfig
from endopilot.simulation.core import run_core
from endopilot.simulation.device import read_device
from endopilot.simulation.rod import lay_out
from endopilot.types import Insertion


@pytest.mark.parametrize("elements", [50, 67, 100, 140, 200])
def test_the_polygon_of_a_free_bent_tip_ends_where_the_arc_does(elements: int) -> None:
    device, inserted = read_device("workhorse-014"), 6.0
    rod = lay_out(device, path_mm=120.0, elements=elements, length_mm=130.0)
    rested = run_core(
        rod,
        None,
        Insertion(np.zeros(3), np.array([0.0, 0.0, 1.0])),
        config=SimulatorConfig(elements=elements, threads=1),
        initial=np.array([[inserted, 0.0]]),
        control=np.zeros((1, 4, 2)),
        friction=np.zeros(1),
        approach=False,
    )
    tip = rested["tip_position"][0, -1]
    length, curvature = device.tip_bend_length_mm, device.tip_bend_rad / device.tip_bend_length_mm
    across, along = (1 - np.cos(device.tip_bend_rad)) / curvature, np.sin(device.tip_bend_rad) / curvature
    # Each element has the arc's direction at its middle. As the midpoint rule does, the sum over elements of length h
    # errs by at most κ²h²/24 of the arc, and by κh²/8 where the bend ends within an element.
    h = float(np.diff(rod.abscissa_mm[rod.abscissa_mm < length + 1.0]).max())
    most = (curvature * h) ** 2 / 24 * length + curvature * h**2 / 8
    assert np.hypot(tip[0], tip[1]) == pytest.approx(across, abs=most)
    assert tip[2] == pytest.approx(inserted - length + along, abs=most)
