"""The simulated tip-load test against the catalogue and against the formula of a clamped-free column."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from endopilot.devices.device import read_wire
from endopilot.devices.device_files import list_wires
from endopilot.simulation.tip_load import HELD_MM, TOLERANCE, simulate_tip_load, tip_load_row


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
