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
