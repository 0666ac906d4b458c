"""How much harder the drives push than the simulated ones."""

from __future__ import annotations

import numpy as np
import pytest

from endopilot.belief.monitor import LoadRatio


def test_the_load_ratio_is_the_one_that_the_forces_have() -> None:
    """Σ read · predicted / Σ predicted² of force less the valve's, less 0.25; what is slow or weak does not count."""
    valve = (0.05, 0.002)
    loads = LoadRatio()
    assert loads.value == 1.0
    for force_n in np.linspace(0.1, 0.3, 60):
        loads.take(1.5 * force_n + 0.05 + 0.002 * 5.0, force_n, speed_mm_s=5.0, valve=valve)
    assert loads.value == pytest.approx(1.25, abs=0.02)
    before = loads.value
    loads.take(9.0, 0.01, speed_mm_s=5.0, valve=valve)
    loads.take(9.0, 0.2, speed_mm_s=-5.0, valve=valve)
    assert loads.value == before
    for _ in range(50):
        loads.take(0.1, 0.2, speed_mm_s=5.0, valve=valve)
    assert loads.value == 1.0  # less force than predicted allows no more


def test_a_drive_pushes_otherwise_where_five_readings_are_outside_the_band_together() -> None:
    def pushed(off_n: float, sd_n: float, *, times: int = 5, speed_mm_s: float = 5.0) -> bool:
        loads = LoadRatio()
        for _ in range(times):
            loads.take(0.06 + off_n, 0.01, speed_mm_s=speed_mm_s, valve=(0.05, 0.0), sd_n=sd_n)
        return loads.outside

    assert pushed(0.1, 0.05) and pushed(-0.1, 0.05)
    assert not pushed(0.08, 0.05) and not pushed(0.1, np.inf)
    assert not pushed(0.1, 0.05, times=4) and not pushed(0.1, 0.05, speed_mm_s=0.4)
