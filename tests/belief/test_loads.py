"""How much harder the drives push than the simulated ones."""

from __future__ import annotations

import numpy as np
import pytest

from endopilot.belief.drives import ahead_of_valve_n
from endopilot.belief.monitor import LoadRatio


def test_the_load_ratio_is_the_one_that_the_forces_have() -> None:
    """Σ read · predicted / Σ predicted², less 0.25; what is weak does not count."""
    loads = LoadRatio()
    assert loads.value == 1.0
    for force_n in np.linspace(0.1, 0.3, 60):
        loads.take(1.5 * force_n, force_n)
    assert loads.value == pytest.approx(1.25, abs=0.02)
    before = loads.value
    loads.take(9.0, 0.01)
    assert loads.value == before
    for _ in range(50):
        loads.take(0.04, 0.2)
    assert loads.value == 1.0  # less force than predicted allows no more


@pytest.mark.parametrize(("speed_mm_s", "ahead_n"), [(5.0, 0.2), (0.4, None), (-5.0, None)])
def test_the_valve_hides_the_force_of_a_drive_that_does_not_advance(speed_mm_s, ahead_n) -> None:
    assert ahead_of_valve_n(((0.26, 0.0),), ((speed_mm_s, 1.0),), (0.05, 0.002)) == pytest.approx(ahead_n)
    assert ahead_of_valve_n((), ((speed_mm_s, 1.0),), (0.05, 0.002)) is None


@pytest.mark.parametrize(
    ("off_n", "sd_n", "times", "outside"),
    [
        (0.1, 0.05, 5, True),
        (-0.1, 0.05, 5, True),
        (0.08, 0.05, 5, False),
        (0.1, np.inf, 5, False),
        (0.1, 0.05, 4, False),
    ],
)
def test_a_drive_pushes_otherwise_where_five_readings_are_outside_the_band_together(
    off_n, sd_n, times, outside
) -> None:
    loads = LoadRatio()
    for _ in range(times):
        loads.take(0.01 + off_n, 0.01, sd_n)
    assert loads.outside == outside
