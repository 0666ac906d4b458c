"""X-ray that a plan will need, as the agent's simulated wires predict it."""

from __future__ import annotations

import numpy as np

from endopilot.belief.bands import Calibration
from endopilot.belief.belief import Belief
from endopilot.control.agent_config import CALIBRATIONS
from endopilot.control.plan_file import read_plan, write_plan
from endopilot.control.plan_xray import PlannedXray, plan_xray

STILL = (0.0, 0.0, 0.0, 0.0)


def calibration(abscissa=STILL, offset=STILL) -> Calibration:
    return Calibration(
        level=0.9,
        scale=1.0,
        abscissa_terms=abscissa,
        offset_terms=offset,
        anatomies=9,
        intervals=36,
        dataset="key",
        offset_share=1.0,
        longest_s=45.0,
    )


def due(xray: PlannedXray) -> list[int]:
    return (1 + np.flatnonzero(xray.exposure)).tolist()


def test_the_agents_wires_follow_the_plan_and_observe_its_tip(found, monkeypatch):
    observed, followed = [], []
    weigh, follow = Belief.weigh, Belief.follow

    def watched_weigh(self, measured):
        observed.append(measured.position)
        weigh(self, measured)

    def watched_follow(self, devices):
        followed.append(devices)
        follow(self, devices)

    monkeypatch.setattr(Belief, "weigh", watched_weigh)
    monkeypatch.setattr(Belief, "follow", watched_follow)
    xray = plan_xray(found, calibration=calibration(abscissa=(5.0, 0.0, 0.0, 0.0)))  # wider than 2 mm from the start
    assert due(xray) == list(range(2, 1 + len(found.control), 2))  # not sooner than 1 s after the last
    np.testing.assert_array_equal(observed, found.trajectory.tip_position[0, xray.exposure, 0])
    np.testing.assert_array_equal(followed, found.trajectory.proximal[0])


def test_the_agents_own_calibration_asks_seldom_along_a_straight_vessel(found):
    xray = plan_xray(found)
    by_shipped = plan_xray(found, calibration=Calibration.read(CALIBRATIONS["assumed", 1]))
    np.testing.assert_array_equal(xray.half_width, by_shipped.half_width)
    assert (xray.half_width > 0).all()
    assert xray.exposure.sum() < len(found.control) / 3


def test_the_bands_of_the_agents_wires_allow_for_another_lumen(found):
    half = plan_xray(found, calibration=calibration()).half_width
    np.testing.assert_allclose(half[:, 1], 0.12, rtol=1e-3)  # 12 % of 1 mm


def test_it_is_written_beside_the_plan(found, vessel, tmp_path):
    import pandas as pd

    from endopilot.anatomy.io import read_anatomy

    xray = plan_xray(found, calibration=calibration(abscissa=(5.0, 0.0, 0.0, 0.0)))
    figures = write_plan(found, output=tmp_path / "plan", xray=xray)
    table = pd.read_csv(tmp_path / "plan" / "plan.csv")
    assert (
        figures["xray_due_s"]
        == table.time_s[table.xray == 1].tolist()
        == [1.0 * (k + 1) for k in range(len(figures["xray_due_s"]))]
    )
    assert figures["xray_due_s"]
    np.testing.assert_allclose(table[["band_tip_abscissa_mm", "band_tip_offset_mm"]], xray.half_width)
    read_plan(tmp_path / "plan", read_anatomy(vessel))
    assert "xray_due_s" not in write_plan(found, output=tmp_path / "plan")
