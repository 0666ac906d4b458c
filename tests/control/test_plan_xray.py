"""X-ray that a plan will need: as the agent's simulated wires predict it, and as a run does."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from endopilot.belief.bands import Calibration
from endopilot.belief.belief import Belief
from endopilot.control.agent_config import CALIBRATIONS
from endopilot.control.plan_config import PlanConfig
from endopilot.control.plan_file import read_plan, write_plan
from endopilot.control.plan_xray import PlannedXray, plan_xray, read_calibration
from endopilot.errors import InputError
from endopilot.files import write_json
from endopilot.models.config import WINDOW
from endopilot.models.episodes import Episodes, OpenLoop

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


class Lagging:
    """A network whose tip is at 0.8 Δ, in the middle of the lumen."""

    def rollout_forward(self, episodes: Episodes) -> OpenLoop:
        proximal = episodes.proximal[:, WINDOW:]
        tip = np.stack([0.8 * proximal[..., 0], np.full(proximal.shape[:2], 0.1)], axis=-1)
        return OpenLoop(tip=tip, proximal=proximal, control=episodes.control[:, WINDOW:])

    rollout_inverse = rollout_dual = rollout_forward


@pytest.fixture
def by_network(found, tmp_path, monkeypatch):
    """Return what makes a plan of 20 periods at 4 mm/s by a run that predicts as the given predictor does."""

    def made(predictor):
        monkeypatch.setattr("endopilot.models.checkpoint.load_model", lambda _: predictor)
        write_json(tmp_path / "run" / "manifest.json", {"config": {}, "networks": {}, "device": {}})
        inserted = 2.0 + 2.0 * np.arange(1, 21)
        longer = found.trajectory._each(lambda values: np.resize(values, (1, 20, *values.shape[2:])))
        return replace(
            found,
            config=PlanConfig(method="inverse"),
            model=str(tmp_path / "run"),
            trajectory=replace(
                longer,
                command=np.tile([4.0, 0.0], (1, 20, 1, 1)),
                inserted_length=inserted[None, :, None],
                rotation=np.zeros((1, 20, 1)),
            ),
            desired=np.resize(found.desired, (20, 2)),
            predicted=np.column_stack([0.8 * inserted, np.full(20, 0.1)]),
        )

    return made


def due(xray: PlannedXray) -> list[int]:
    return (1 + np.flatnonzero(xray.exposure)).tolist()


def test_a_networks_band_grows_from_exposure_to_exposure(by_network):
    # half-width 0.15 mm a mm of travel: 2 mm are reached after 14 mm, which are 7 periods of 2 mm
    xray = plan_xray(by_network(Lagging()), calibration=calibration(abscissa=(0.0, 0.0, 0.15, 0.0)))
    assert due(xray) == [7, 14]
    travel = 2.0 * np.array([*range(1, 8), *range(1, 8), *range(1, 7)])
    np.testing.assert_allclose(xray.half_width[:, 0], 0.15 * travel, atol=1e-5)


def test_a_networks_band_of_the_offset_reaches_the_wall(by_network):
    plan = by_network(Lagging())
    # clearance 1 − r_w mm: γ + 0.05 mm a period reaches 0.7 of it
    first = int(np.ceil((0.7 * (1.0 - plan.navigation.device.tip_radius_mm) - 0.1) / 0.05))
    assert due(plan_xray(plan, calibration=calibration(offset=(0.0, 0.1, 0.0, 0.0))))[0] == first


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
    assert due(xray) == list(range(3, 1 + len(found.control), 3))  # not sooner than 1.5 s after the last
    np.testing.assert_array_equal(observed, found.trajectory.tip_position[0, xray.exposure, 0])
    np.testing.assert_array_equal(followed, found.trajectory.proximal[0])


def test_the_agents_own_calibration_asks_seldom_along_a_straight_vessel(found):
    own = read_calibration("search", None, 1)
    assert own == Calibration.read(CALIBRATIONS["assumed", 1])
    xray = plan_xray(found)
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
        == [1.5 * (k + 1) for k in range(len(figures["xray_due_s"]))]
    )
    assert figures["xray_due_s"]
    np.testing.assert_allclose(table[["band_tip_abscissa_mm", "band_tip_offset_mm"]], xray.half_width)
    read_plan(tmp_path / "plan", read_anatomy(vessel))
    assert "xray_due_s" not in write_plan(found, output=tmp_path / "plan")


def test_a_model_without_calibration_is_refused(tmp_path):
    (tmp_path / "run").mkdir()
    with pytest.raises(InputError, match=r"no finished run here"):
        read_calibration("inverse", tmp_path / "run", 1)
    write_json(tmp_path / "run" / "manifest.json", {"config": {}, "networks": {}, "device": {}})
    with pytest.raises(InputError, match=r"run: the model has no calibration.*endopilot advise"):
        read_calibration("inverse", tmp_path / "run", 1)
    assert read_calibration("inverse", "wires", 1) == read_calibration("search", None, 1)
    assert read_calibration("search", tmp_path / "run", 1) == read_calibration("search", None, 1)
    with pytest.raises(InputError, match="no such run"):
        read_calibration("inverse", Path("nowhere"), 1)
