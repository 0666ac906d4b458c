"""Drag, stick-slip, torque lag and whip, tip buckling: what docs/evidence/physics.md shows."""

from __future__ import annotations

import numpy as np
import pytest

from benchmarks.verification import scenes as scenarios
from endopilot.devices.device import read_wire


def test_a_string_is_dragged_as_the_capstan_equation_says() -> None:
    # T2/T1 = exp(µ θ), θ the sum of all angles that the string turns by, whatever their direction
    for bends, friction in ((0, 0.2), (3, 0.2), (6, 0.2), (4, 0.4)):
        run = scenarios.drag_through_bends(bends, friction=friction)
        assert run.ratio == pytest.approx(np.exp(friction * run.wire_turning_rad), rel=0.01)
        # it cuts every bend but by no more than the vessel's width lets it
        assert 0.5 * run.axis_turning_rad <= run.wire_turning_rad <= run.axis_turning_rad + 1e-6


def test_a_stiff_wire_is_dragged_more_than_a_string() -> None:
    string, wire = (scenarios.drag_through_bends(4, bend_n_mm2=stiffness) for stiffness in (0.1, 3.0))
    assert wire.wire_turning_rad == pytest.approx(string.wire_turning_rad, rel=0.1)
    assert wire.ratio > 1.2 * np.exp(0.2 * wire.wire_turning_rad)


def test_a_tip_sticks_at_ridges_and_slips_over_them() -> None:
    run = scenarios.stick_slip()
    later = run.pushed_mm > 12
    speed = np.diff(run.tip_mm)[later[1:]] / np.diff(run.pushed_mm)[later[1:]]
    assert np.mean(np.abs(speed) < 0.15) > 0.25  # it stands still again and again
    assert speed.max() > 2  # and leaps when it goes; this is a mean over half a second
    assert run.tip_mm[-1] == pytest.approx(run.pushed_mm[-1] - run.pushed_mm[0], rel=0.1)  # and gets there all the same
    # the leaps spend the energy that the pushing has stored: the force falls with each
    leaps = np.flatnonzero(later[1:] & (np.diff(run.tip_mm) > 2 * np.diff(run.pushed_mm)))
    assert len(leaps) >= 5
    assert (run.force_n[leaps + 1] < 0.8 * run.force_n[leaps]).all()


def test_a_short_curved_wire_lags_and_a_long_one_whips() -> None:
    # L √(EI κ₀ κ_t / GJ) is 1.14 and 2.56: below and above π/2
    smooth, whipping = scenarios.turn_in_a_bend(20.0, turns=1.0), scenarios.turn_in_a_bend(45.0, turns=1.0)
    assert np.diff(smooth.tip_rad).max() < 0.5
    jump = int(np.argmax(np.diff(whipping.tip_rad)))
    assert np.diff(whipping.tip_rad)[jump] > np.pi
    assert (whipping.drive_rad - whipping.tip_rad)[jump] > np.pi / 2
    # where it snaps the theory's curve folds back: no equilibrium beyond
    tip = np.linspace(0, np.pi, 100)
    drive, torque = scenarios.whip_theory(45.0, tip)
    assert whipping.drive_rad[jump] == pytest.approx(drive.max(), rel=0.04)
    assert whipping.torque_n_mm.max() == pytest.approx(torque.max(), rel=0.04)
    # the short wire follows its whole curve
    drive, _ = scenarios.whip_theory(20.0, np.linspace(0, 2 * np.pi, 100))
    expected = np.interp(smooth.drive_rad, drive, np.linspace(0, 2 * np.pi, 100))
    np.testing.assert_allclose(smooth.tip_rad, expected, atol=0.12)


def test_a_tip_buckles_on_a_plate_as_its_hold_allows() -> None:
    stiffness = read_wire("workhorse-014").bend_stiffness_n_mm2[0] / scenarios.PLATE_GAP_MM**2

    def load(friction: float, bend_deg: float) -> float:
        run = scenarios.push_against_a_plate(friction=friction, tip_bend_deg=bend_deg)
        return float(run.force_n[(run.pushed_mm > 0) & (run.pushed_mm < 0.5)].max())

    # π² EI/(4 L²) where the tip slides, 20.19 EI/L² where it sticks; the tip is bent by 1°, which takes 6 to 10 %
    assert load(0.0, 1.0) == pytest.approx(np.pi**2 / 4 * stiffness, rel=0.10)
    assert load(0.3, 1.0) == pytest.approx(20.19 * stiffness, rel=0.12)
    # a shaped tip buckles far below either
    assert load(0.1, 45.0) < 0.9 * np.pi**2 / 4 * stiffness
    # where it sticks and buckles, it slips in the end, and the force falls to the sliding one's
    run = scenarios.push_against_a_plate(friction=0.1, tip_bend_deg=1.0)
    assert run.force_n[run.pushed_mm > 1.0][0] < 0.2 * run.force_n.max()
