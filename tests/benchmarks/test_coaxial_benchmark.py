"""`python -m benchmarks simulation` with a catheter and with a vessel that moves, on a few short worlds."""

from __future__ import annotations

import pytest

from benchmarks import figures
from benchmarks.core import scenes
from benchmarks.core.beside import LEAST_SHARE_MOVING, bench_motion
from benchmarks.core.coaxial import LEAST_SHARE, bench_coaxial
from endopilot.devices.catheter import read_catheter
from endopilot.simulation.motion import motion_named


@pytest.fixture
def one_patient(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(scenes, "KINDS", {"right": "rca"})
    monkeypatch.setattr(figures, "REPEATS", 1)


@pytest.mark.parametrize(
    ("what", "alone", "bench", "given", "bar"),
    [
        ("catheter", "wire_alone_", bench_coaxial, read_catheter("microcatheter-1.7f"), LEAST_SHARE),
        ("motion", "still_", bench_motion, motion_named("heartbeat"), LEAST_SHARE_MOVING),
    ],
)
def test_the_figures_belong_together(one_patient, what, alone, bench, given, bar) -> None:
    measured = bench(given, worlds=2, samples=4)
    assert measured["passed"] is (measured["share"] >= bar)  # how fast it is here says nothing
    assert measured["worlds"] == 2 and measured["valid_worlds"] == 1
    ratio = measured["realtime_factor_per_core"] / measured[f"{alone}realtime_factor_per_core"]
    assert measured["share"] == pytest.approx(ratio, rel=0.05)
    if what == "motion":
        assert 0 < measured["tip_error_median_mm"] < 0.5
        return
    of_both, of_catheter = (measured[f"{part}node_iterations_per_second"] for part in ("", "catheter_alone_"))
    assert 0 < of_catheter != measured["wire_alone_node_iterations_per_second"] and of_catheter < of_both
    assert 0 <= measured["wire_tip_error_median_mm"] < 0.5 and 0 <= measured["catheter_tip_error_median_mm"] < 0.5
