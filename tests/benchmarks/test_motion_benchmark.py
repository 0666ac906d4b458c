"""`python -m benchmarks simulation --motion` on a few short worlds."""

from __future__ import annotations

import json
from functools import partial

import pytest

from benchmarks import figures
from benchmarks.__main__ import main
from benchmarks.core import beside, scenes, simulation


def test_the_figures_belong_together(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    monkeypatch.setattr(scenes, "KINDS", {"right": "rca"})
    monkeypatch.setattr(figures, "REPEATS", 1)
    monkeypatch.setattr(beside, "LEAST_SHARE_MOVING", 1e-6)  # how fast it is here says nothing
    monkeypatch.setattr(simulation, "bench_motion", partial(beside.bench_motion, worlds=2, samples=4))
    with pytest.raises(SystemExit) as left:
        main(["simulation", "--motion", "heartbeat", "--json"])
    assert not left.value.code
    measured = json.loads(capsys.readouterr().out)
    assert measured["motion"] == "heartbeat" and measured["passed"] is True
    assert measured["worlds"] == 2 and measured["valid_worlds"] == 1
    ratio = measured["realtime_factor_per_core"] / measured["still_realtime_factor_per_core"]
    assert measured["share"] == pytest.approx(ratio, rel=0.05)
    assert 0 < measured["tip_error_median_mm"] < 0.5
