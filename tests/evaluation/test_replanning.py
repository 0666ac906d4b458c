"""P4 with replanning: what each new plan is given, and that X-ray images help."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from unittest.mock import patch

import numpy as np
import pytest

from endopilot.dataset.loader import read_dataset
from endopilot.evaluation.protocols import EXPOSURE_PERIOD_S, Recorded, exposures, replanned, replay
from endopilot.models.episodes import Episodes, OpenLoop, begin_after, given_states
from toy_navigation import toy_run

GIVEN = 30


@dataclass
class HoldSlack:
    """Drives as if the slack stayed as last observed, and predicts that the tip goes as desired, 1 mm aside."""

    given: list[tuple[Episodes, np.ndarray]] = field(default_factory=list)

    def rollout_dual(self, episodes: Episodes, observed: np.ndarray | None = None) -> OpenLoop:
        observed = given_states(episodes) if observed is None else observed
        self.given.append((episodes, observed))
        begin = begin_after(observed)
        desired = episodes.tip[..., 0].astype(float)
        control = np.zeros((len(episodes), desired.shape[1] - begin, 2))
        control[..., 0] = np.diff(desired, axis=1)[:, begin - 1 :] / 0.5
        tip = np.stack([desired[:, begin:], np.ones(control.shape[:2])], axis=-1)
        return OpenLoop(tip=tip, proximal=tip, control=control)

    rollout_forward = rollout_inverse = rollout_dual


@pytest.fixture(scope="module")
def recorded(toy_dataset) -> Recorded:
    return Recorded.of(read_dataset(toy_dataset).of_split("test")[:12])


def planned(recorded, predictor):
    episodes = Episodes.of_dataset(recorded.data)
    first = predictor.rollout_dual(episodes)
    control = replanned(predictor, recorded, episodes, first, lambda *_: None)
    return first, control


def test_each_plan_is_given_the_drive_and_what_was_exposed_and_nothing_else(recorded) -> None:
    predictor, data = HoldSlack(), recorded.data
    with patch("endopilot.dataset.loader.run_set_up", toy_run):
        _, control = planned(recorded, predictor)
        done = replay(recorded, {"P4": recorded.drivable(control)}, lambda *_: None)["P4"]
    assert (
        [begin_after(observed) - 1 for _, observed in predictor.given]
        == [29, *exposures(data)]
        == [29, 49, 69, 89, 109]
    )
    desired = Episodes.of_dataset(data)
    for episodes, observed in predictor.given[1:]:
        now = begin_after(observed) - 1
        exposed = [sample for sample in exposures(data) if sample <= now]
        assert np.flatnonzero(observed).tolist() == [*range(GIVEN), *exposed]
        # where it was exposed, the tip as it went; in between, as it was predicted; later, as it is desired
        at = np.array(exposed)
        np.testing.assert_allclose(episodes.tip[:, at, 0], done.tip.abscissa[:, at - GIVEN], atol=1e-4)
        np.testing.assert_allclose(episodes.tip[:, at, 1], done.tip.offset[:, at - GIVEN], atol=1e-4)
        between = np.setdiff1d(np.arange(GIVEN, now), at)
        assert (episodes.tip[:, between, 1] == 1.0).all()
        for name in ("tip", "branch", "proximal"):
            np.testing.assert_array_equal(getattr(episodes, name)[:, now + 1 :], getattr(desired, name)[:, now + 1 :])
        # the drive's motion, as it was made
        driven = recorded.drivable(control)[:, : now + 1 - GIVEN]
        np.testing.assert_allclose(episodes.control[:, GIVEN : now + 1], driven, atol=1e-4)
        inserted = data.inserted_length[:, 29] + 0.5 * np.cumsum(driven[..., 0], axis=1)
        np.testing.assert_allclose(episodes.proximal[:, GIVEN : now + 1, 0], inserted, atol=1e-3)


def test_x_ray_brings_the_tip_back_to_its_desired_path(recorded) -> None:
    predictor, data = HoldSlack(), recorded.data
    with patch("endopilot.dataset.loader.run_set_up", toy_run):
        first, control = planned(recorded, predictor)
        series = {"P4": recorded.drivable(first.control), "P4_replanned": recorded.drivable(control)}
        done = replay(recorded, series, lambda *_: None)
    error = {name: np.abs(r.tip.abscissa - data.tip_abscissa[:, GIVEN:, 0]) for name, r in done.items()}
    until = round(EXPOSURE_PERIOD_S / 0.5)
    np.testing.assert_array_equal(error["P4"][:, :until], error["P4_replanned"][:, :until])
    assert error["P4_replanned"][:, until:].mean() < 0.7 * error["P4"][:, until:].mean()


def test_a_world_that_fails_has_no_controls_from_there_on(recorded) -> None:
    def failing(set_up, command, **how):
        rollout = toy_run(set_up, command, **how)
        valid = rollout.valid.copy()
        valid[0, 60:] = False  # first episode of each patient
        return replace(rollout, valid=valid)

    with patch("endopilot.dataset.loader.run_set_up", failing):
        _, control = planned(recorded, HoldSlack())
    firsts = [int(np.flatnonzero(recorded.anatomy_of == i)[0]) for i in range(len(recorded.anatomies))]
    lost = np.isnan(control).any(axis=-1)
    assert lost[firsts, 40:].all() and not lost[firsts, :40].any()  # found at sample 69, the 40th after the given
    assert not np.delete(lost, firsts, axis=0).any()
