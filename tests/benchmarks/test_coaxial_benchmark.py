"""`python -m benchmarks simulation --catheter` on a few short worlds."""

from __future__ import annotations

import json
from functools import partial

import pytest

from benchmarks import figures
from benchmarks.__main__ import main
from benchmarks.core import coaxial, scenes, simulation
from endopilot.devices.catheter import read_catheter


@pytest.fixture(autouse=True)
def one_patient(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(scenes, "KINDS", {"right": "rca"})
    monkeypatch.setattr(figures, "REPEATS", 1)


def test_the_figures_belong_together(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    monkeypatch.setattr(coaxial, "LEAST_SHARE", 1e-6)  # how fast it is here says nothing
    monkeypatch.setattr(simulation, "bench_coaxial", partial(coaxial.bench_coaxial, worlds=2, samples=4))
    with pytest.raises(SystemExit) as left:
        main(["simulation", "--catheter", "microcatheter-1.7f", "--json"])
    assert not left.value.code
    measured = json.loads(capsys.readouterr().out)
    assert measured["catheter"] == "microcatheter-1.7f" and measured["passed"] is True
    assert measured["worlds"] == 2 and measured["valid_worlds"] == 1
    ratio = measured["realtime_factor_per_core"] / measured["wire_alone_realtime_factor_per_core"]
    assert measured["share"] == pytest.approx(ratio, rel=0.05)
    of_both, of_catheter = (measured[f"{what}node_iterations_per_second"] for what in ("", "catheter_alone_"))
    assert 0 < of_catheter != measured["wire_alone_node_iterations_per_second"] and of_catheter < of_both
    assert 0 <= measured["wire_tip_error_median_mm"] < 0.5 and 0 <= measured["catheter_tip_error_median_mm"] < 0.5


def test_a_slow_core_fails(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(coaxial, "LEAST_SHARE", 100.0)
    assert not coaxial.bench_coaxial(read_catheter("microcatheter-1.7f"), worlds=1, samples=2)["passed"]
