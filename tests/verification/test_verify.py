"""Every case of the verification keeps its bar; what the commands print, draw and leave with."""

from __future__ import annotations

import importlib.util
import json
from collections.abc import Callable

import numpy as np
import pytest

from benchmarks.__main__ import main as benchmarks
from benchmarks.verification import contact, engine, kirchhoff, motion, order, stability, transmission, tube, tubes
from endopilot.cli import main
from endopilot.verification import free_rod
from endopilot.verification.free_rod import Case, compare

KEYS = ["case", "reference", "value", "error", "bar", "passed"]


def test_commands_print_rows_draw_figures_and_fail_where_a_bar_is_exceeded(monkeypatch, tmp_path, capsys) -> None:
    nothing = float("nan")
    skipped = Case("other engine", nothing, nothing, nothing, 0.02, skipped="it is not installed")
    found = [*free_rod.timoshenko(), skipped]
    for module in (contact, engine, kirchhoff, motion, order, stability, transmission, tube, tubes):
        monkeypatch.setattr(module, "CASES", ())
    monkeypatch.setattr(free_rod, "CASES", (lambda: found,))
    plots = ("--plots", str(tmp_path / "plots"))
    for code, further in ((0, []), (1, [compare("failed", 1.0, 1.1, 0.01)])):
        found += further
        for command, words in ((main, ("verify",)), (benchmarks, ("verification", *plots))):
            with pytest.raises(SystemExit) as left:
                command([*words, "--json"])
            assert left.value.code == code
            good, none, *bad = json.loads(capsys.readouterr().out)
            assert (
                list(good) == KEYS and [row["passed"] for row in (good, none, *bad)] == [True, None, False][: 2 + code]
            )
            assert none["case"] == "other engine (skipped: it is not installed)" and none["value"] is None
    assert {path.name for path in (tmp_path / "plots").iterdir()} == {"Timoshenko-tip.png", "failed.png"}


GROUPS = {
    f"{module.__name__.rsplit('.', 1)[-1]}.{group.__name__}": group
    for module in (free_rod, contact, motion, order, stability, transmission, tube, tubes, engine, kirchhoff)
    for group in module.CASES
}
LARGEST_BAR = 0.02
WIDER = {"tube.sinusoidal_buckling": 0.05, "tube.helical_buckling": 0.05, "order.order_in_element_length": 0.05}
WIDER |= {"kirchhoff.pushed_into_a_bend": 0.15, "kirchhoff.capstan": 0.05, "kirchhoff.helix_in_a_tube": 0.1}
WIDER |= {"order.order_in_navigation": 0.2, "order.order_in_time_step": 0.05, "motion.order_in_a_beating_heart": 0.2}


def turned_by(share: float, low: float, high: float) -> Callable[[Case], None]:
    """Return a check of the angle, rad, whose capstan a case compares with: T2/T1 = exp(µ θ)."""

    def check(case: Case) -> None:
        assert low < np.log(case.reference) / share < high

    return check


def friction_has_its_share(case: Case) -> None:
    work, elastic, _ = curves(case)
    assert work.y[-1] > 1.2 * elastic.y[-1] > 0


def errs_by_the_leading_term(case: Case) -> None:
    # c dδ/dt = F - 3 EI δ/L³: after one time constant implicit Euler errs by h/(2 e τ) of F L³/3EI
    error = curves(case)[1]
    assert abs(error.y * 2 * order.RELAXATION_S * (np.e - 1) / error.x - 1).max() < 0.1


def loses_its_stiffness(case: Case) -> None:
    # a ring's stiffness against cos 2θ falls towards its critical twist as 1 - (Tw/Tw_critical)²
    core = curves(case)[1]
    assert abs(core.y - (1 - (core.x / case.reference) ** 2)).max() < 0.01


def lies_as_winkler_says(case: Case) -> None:
    # along the whole rod: w = F β/(2k) exp(-β|x|) (cos βx + sin β|x|), β = (k/4EI)^¼ (Hetényi 1946)
    exact, core = curves(case)
    assert np.abs(core.y - exact.y).max() < 0.005 * exact.y.max()
    assert exact.y.min() < 0  # it lifts beside the load


def follows_or_whips(case: Case) -> None:
    # Far from θ = π the short wire's tip follows the closed form; the long one's jumps twice in a turn there and back.
    formula, short, _, long = curves(case)
    expected = np.interp(short.x, formula.x[np.argsort(formula.x)], np.sort(formula.y))
    assert np.abs(short.y - expected).max() < 0.05
    assert (np.abs(np.diff(long.y)) > 2.0).sum() == 2


SHOWN = {
    "contact.capstan": turned_by(0.4, 0.98 * np.pi / 2, np.pi / 2),
    "contact.capstan_over_bends": turned_by(0.3, np.pi - 0.97, np.pi - 0.93),  # a string cuts 0.95 rad off corners
    "contact.capstan_in_a_helix": turned_by(0.2, 2 * np.pi * 0.5**0.5 - 0.13, 2 * np.pi * 0.5**0.5 - 0.09),
    "motion.power_balance": friction_has_its_share,
    "order.order_in_time_step": errs_by_the_leading_term,
    "stability.michell_ring": loses_its_stiffness,
    "tube.compliant_wall": lies_as_winkler_says,
    "tube.torque_whip": follows_or_whips,
}
REFERENCES = {
    "free_rod.euler_column": np.pi**2 / 4,  # P = π² EI/(2L)² of a clamped-free column
    "stability.greenhill": 20.0,  # M = 2 √(EI T) (Greenhill 1883) with EI = 100 N mm², T = 1 N
    "tube.helical_buckling": 2 * np.sqrt(2) * tube.LOAD_N,  # Chen, Lin and Cheatham 1990
}


def curves(case: Case):
    assert case.picture is not None
    return case.picture.curves


@pytest.mark.parametrize("name", GROUPS)
def test_every_case_keeps_its_bar(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    if name.startswith("engine.") and importlib.util.find_spec("mujoco") is None:
        pytest.skip(engine.MISSING)
    if name == "kirchhoff.capstan":
        monkeypatch.setattr(kirchhoff, "LEAD_MM", 15.0)  # of 30 mm: half as much rod ahead of the bend
    cases = GROUPS[name]()
    assert cases
    for case in cases:
        assert case.error <= case.bar <= WIDER.get(name, LARGEST_BAR), case.case
    if name in REFERENCES:
        assert cases[0].reference == pytest.approx(REFERENCES[name])
    if name in SHOWN:
        SHOWN[name](cases[0])


def test_skipped_without_mujoco(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    rows = [case.row() for group in engine.CASES for case in group()]
    assert len(rows) == 3
    for row in rows:
        assert row["passed"] is None and row["value"] is None
        assert "MuJoCo is not installed" in row["case"]
