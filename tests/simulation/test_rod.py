"""A device as a rod: where the tip of a free wire lies, its elements, and the load at which the tip buckles."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from endopilot.devices.device import read_wire
from endopilot.devices.device_files import list_wires
from endopilot.simulation.config import SimulatorConfig
from endopilot.simulation.core import make_lumen, run_core
from endopilot.simulation.rod import lay_out
from endopilot.simulation.tip_load import HELD_MM, TOLERANCE, simulate_tip_load, tip_load_row
from endopilot.types import DistanceMap, Insertion


@pytest.mark.parametrize("element_mm", [0.2, 0.5, 0.75, 1.0, 1.5])
def test_a_free_bent_tip_lies_where_the_arc_ends(element_mm: float) -> None:
    device, inserted = read_wire("workhorse-014"), 6.0
    rested = run_core(
        lay_out(device, element_mm=element_mm, length_mm=30.0),
        _wide_lumen(),
        Insertion(np.zeros(3), np.array([0.0, 0.0, 1.0])),
        config=SimulatorConfig(threads=1),
        initial=np.array([[inserted, 0.0]]),
        control=np.zeros((1, 4, 2)),
        friction=np.zeros(1),
        approach=False,
    )
    angle, length = device.tip_bend_rad, device.tip_bend_length_mm
    curvature = angle / length
    across, along = (1 - np.cos(angle)) / curvature, np.sin(angle) / curvature
    # The polygon of elements of length h has the arc's direction at their middles. Its nodes lie beside the arc, by
    # κh²/24 along the normal there and by κh²/12 along the normal where the bend ends within an element. The core adds
    # κh²/8 along the normal at the tip, which leaves κh²/12 times the distance of the two normals, 2 sin(angle/2).
    tip, direction = rested["tip_position"][0, -1, 0], rested["tip_direction"][0, -1, 0]
    most = curvature * element_mm**2 / 6 * np.sin(angle / 2) + 1e-5
    assert np.hypot(tip[0], tip[1]) == pytest.approx(across, abs=most)
    assert tip[2] == pytest.approx(inserted - length + along, abs=most)
    assert np.arccos(direction[2]) == pytest.approx(angle, abs=(curvature * element_mm) ** 3 / 4 + 1e-5)


def test_an_element_has_its_middle_where_the_bend_of_the_tip_ends() -> None:
    device = read_wire("workhorse-014")
    for element_mm in (0.2, 0.5, 0.75, 1.0, 1.5, 4.0):
        rod = lay_out(device, element_mm=element_mm, length_mm=100.0)
        length = np.diff(rod.abscissa_mm)
        middle = rod.abscissa_mm[:-1] + 0.5 * length
        assert np.abs(middle - device.tip_bend_length_mm).min() < 1e-9
        assert length[0] <= element_mm and length.max() <= 5 * element_mm
        assert (np.diff(length) > -1e-12).all()
        assert rod.abscissa_mm[-3] >= 100.0
        # the joints ahead of the bend's end carry the bend of their own stretches: all but the first half element's
        bend = (rod.rest_curvature[1:-1, 0] * np.diff(middle)).sum()
        share = 1 - 0.5 * length[0] / device.tip_bend_length_mm
        assert bend == pytest.approx(device.tip_bend_rad * share, rel=1e-9)


def test_a_soft_wire_is_not_folded_by_its_drag() -> None:
    """A wire folds in a lumen of radius r at EI/r²; its drag is to stay below that at the speed that it is pushed with.

    Here by 10 mm/s, with half a metre of it in an aorta of 12 mm radius.
    """
    like = read_wire("workhorse-014")
    soft = replace(like, bend_stiffness_n_mm2=tuple(0.0008 for _ in like.bend_stiffness_n_mm2))
    rod = lay_out(soft, element_mm=1.25, length_mm=500.0)
    assert 0 < 10.0 * rod.drag_n_s_mm.sum() < 0.5 * 0.0008 / 12.0**2


def _wide_lumen() -> Any:
    """Return a lumen whose walls are far."""
    grid = DistanceMap(np.full((20, 20, 40), 20.0, dtype=np.float32), 1.0, np.array([-10.0, -10.0, -10.0]))
    return make_lumen(grid, 0.18, "cpu")


@pytest.mark.parametrize("name", list_wires())
def test_every_shipped_device_has_its_catalogue_tip_load(name: str) -> None:
    device = read_wire(name)
    row = tip_load_row(device)
    if device.tip_load_n is None:
        assert row["error"] is None and row["passed"] is None
        return
    assert row["passed"] is True
    assert row["tested_tip_load_n"] == pytest.approx(device.tip_load_n, rel=TOLERANCE)


def test_a_uniform_tip_buckles_at_the_column_formula() -> None:
    # F = π² EI / (4 L²); pushed on by 2 % of its length, a buckled column carries 1 % more (elastica).
    device = replace(
        read_wire("workhorse-014"),
        abscissa_mm=[0.0],
        bend_stiffness_n_mm2=[0.5],
        twist_stiffness_n_mm2=[0.4],
    )
    test = simulate_tip_load(device)
    column = np.pi**2 * 0.5 / (4 * HELD_MM**2)
    assert 0.995 * column < test.load_n < 1.015 * column
    # It really buckles: the force stops growing while the holder is lowered on, and the tip slides away sideways.
    assert test.force_n[-1] < 1.05 * test.force_n[4]
    assert np.linalg.norm(test.shape_mm[0, 1:]) > 1.0
    assert test.shape_mm[0, 0] == pytest.approx(HELD_MM, abs=1e-3)


def test_a_taper_that_reaches_into_the_tip_raises_the_load() -> None:
    soft = read_wire("workhorse-014")
    stiff_behind = replace(soft, bend_stiffness_n_mm2=[0.3, 1.2, 2.0, 8.0, 30.0, 80.0])
    row = tip_load_row(stiff_behind)
    assert row["passed"] is False
    assert row["error"] > 1.0
