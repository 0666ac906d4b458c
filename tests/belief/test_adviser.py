"""The adviser: bands that hold over whole intervals, what they allow for besides, and when an exposure is due."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from endopilot.belief.bands import (
    AdviserConfig,
    Calibration,
    Members,
    Predicted,
    conformal_scale,
    fit_spread,
    narrowest,
    spread_of,
    surely_missed,
)
from endopilot.belief.events import astray_mm, count_events
from endopilot.belief.watch import Watch
from endopilot.control.agent_config import read_agent_calibration
from endopilot.errors import InputError


def calibration(scale: float = 1.0, abscissa: float = 0.1, offset: float = 0.05, onset: float = 0.3) -> Calibration:
    return Calibration(
        level=0.9,
        scale=scale,
        abscissa_terms=(0.0, 0.0, abscissa, 0.0),
        offset_terms=(offset, 0.0, 0.0, 0.0),
        anatomies=10,
        intervals=40,
        dataset="key",
        onset=onset,
        longest_s=45.0,
    )


@pytest.mark.parametrize("unlike", [0.0, 0.5])  # patients alike, and patients that differ
def test_bands_hold_over_whole_intervals_of_new_patients(unlike) -> None:
    random = np.random.default_rng(5)
    covered, samplewise = [], []
    for _ in range(100):
        size = np.exp(unlike * random.standard_normal(17))  # the last patient is new
        errors = np.abs(size[:, None, None] * random.standard_normal((17, 6, 40)))
        score, anatomy = errors.max(axis=2), np.repeat(np.arange(16), 6)
        scale = conformal_scale(score[:16].ravel(), anatomy, 0.9)
        covered.append((score[16] <= scale).mean())
        samplewise.append((score[16] <= np.quantile(errors[:16], 0.9)).mean())
    assert abs(np.mean(covered) - 0.9) < 0.03
    assert np.mean(samplewise) < 0.5  # bands made sample by sample hold too few whole intervals


def test_an_event_is_where_a_state_begins_and_an_exposure_then_or_soon_after_shows_it() -> None:
    state = np.array([[1, 1, 0, 1, 1, 0, 0, 1, 0, 1], [0, 0, 0, 0, 1, 0, 0, 0, 0, 0]], dtype=bool)
    exposed = np.zeros((2, 10), dtype=bool)
    assert count_events(state, exposed) == (3, 3, 3.0)  # not what was so at first, nor the last sample
    exposed[0, [2, 9]] = True  # one period before the first; two after the second
    exposed[1, 5] = True
    assert count_events(state, exposed)[:2] == (3, 2)
    assert count_events(state, exposed, before=True)[:2] == (3, 1)  # as the ladder's second version has it


def test_as_many_exposures_at_even_times_miss_what_they_would_whenever_the_first_is() -> None:
    state = np.random.default_rng(1).random(401) < 0.3
    every_fifth = [(np.arange(401) % 5 == first) | (np.arange(401) == 0) for first in range(5)]
    counted = [count_events(state, exposed) for exposed in every_fifth]
    assert counted[0].happened > 50 and len({each.missed for each in counted}) > 1
    assert np.mean([each.missed for each in counted]) == pytest.approx(counted[0].missed_evenly)
    assert counted[0].missed_evenly == pytest.approx(0.6 * counted[0].happened)


def test_a_tip_in_another_branch_is_astray_by_way_of_the_fork(fork) -> None:
    """The branches leave at 20 mm, where the lumen's radius is a mouth in which a tip counts as in both."""
    tree = fork.tree
    leaves = float(tree.departures(1)[2])
    line = tree.path(1)
    mouth = leaves + float(np.interp(leaves, line.abscissa, line.radius))
    one, at = np.array([1, 1, 1, -1, 0]), np.array([mouth + 3.0, mouth + 3.0, mouth - 0.5, 9.0, 5.0])
    other, there = np.array([1, 2, 2, 2, 2]), np.array([mouth + 5.0, mouth + 2.0, mouth - 0.2, 7.0, leaves + 4.0])
    found = astray_mm(tree, (one, at), (other, there))
    np.testing.assert_allclose(found, [2.0, 5.0, 0.3, 2.0, leaves - 1.0])


def test_too_few_patients_are_refused() -> None:
    with pytest.raises(InputError, match=r"needs at least 9 patients.* has 8"):
        conformal_scale(np.ones(16), np.repeat(np.arange(8), 2), 0.9)
    assert conformal_scale(np.arange(9.0), np.arange(9), 0.9) == 8.0


def test_the_spread_is_fitted_to_the_errors() -> None:
    random = np.random.default_rng(2)
    seconds = np.tile(np.arange(40) * 0.5, (200, 1))
    travel, own = random.uniform(0, 100, (200, 40)), random.uniform(0, 1, (200, 40, 2))
    wanted = ((0.05, 0.0, 0.01, 0.0), (0.02, 0.004, 0.0, 0.5))
    size = spread_of(wanted, seconds, travel, own)
    error = size * random.choice([-1.0, 1.0], size.shape) * random.uniform(0.5, 1.5, size.shape)
    found = fit_spread(error, seconds, travel, own)
    np.testing.assert_allclose(found, wanted, atol=0.01, rtol=0.2)
    assert (np.array(fit_spread(error, seconds, travel, np.zeros_like(own))) >= 0).all()


def test_the_bands_are_the_narrowest_that_both_hold() -> None:
    """No other pair of widths with which both bands hold in 90 % of the intervals has a smaller product."""
    worst = np.random.default_rng(4).lognormal(size=(61, 2))
    terms = ((1.0, 0.0, 0.0, 2.0), (0.5, 0.0, 0.0, 0.0))
    found = narrowest(terms, worst, 0.9)
    widths = np.array([found[0][0], found[1][0] / 0.5])
    np.testing.assert_allclose(found[0], widths[0] * np.array(terms[0]))
    first, second = np.meshgrid(*worst.T, indexing="ij")
    hold = ((worst[:, 0] <= first[..., None]) & (worst[:, 1] <= second[..., None])).mean(axis=2) >= 0.9
    assert (worst <= widths).all(axis=1).mean() >= 0.9
    assert widths.prod() == pytest.approx((first * second)[hold].min())


def test_what_is_missed_for_sure_is_the_share_and_its_standard_error() -> None:
    alike = np.array([20.0, 40.0, 60.0])
    assert surely_missed(alike / 20, alike) == pytest.approx(0.05)  # all patients alike: no error
    # 1 of 20 is missed; residuals of ±1/2, of two patients: a variance of 2 (1/4 + 1/4) over 20 events squared
    assert surely_missed(np.array([1.0, 0.0]), np.array([10.0, 10.0])) == pytest.approx(0.05 + 1 / 20)
    assert surely_missed(np.zeros(3), np.zeros(3)) == 0.0
    assert surely_missed(np.array([1.0]), np.array([50.0])) > 1.0  # one patient says nothing of others


def test_a_calibration_is_read_again_and_its_absence_named(tmp_path) -> None:
    with pytest.raises(InputError, match=r"the model has no calibration.*endopilot advise"):
        Calibration.read(tmp_path)
    calibration(onset=0.25).write(tmp_path)
    assert Calibration.read(tmp_path) == calibration(onset=0.25)
    (tmp_path / "xray.json").write_text('{"level": 0.9, "abscissa_terms": [], "offset_terms": []}')
    with pytest.raises(InputError, match=r"xray.json: scale: missing; .* run `endopilot advise` again"):
        Calibration.read(tmp_path)


def predicted(offset_mm: float = 0.0, *, inserted_mm: float = 0.0, radius_mm: float = 1.2) -> Predicted:
    """Return what a model predicts of a tip that follows the wire; one of 0.2 mm radius has a clearance of 1 mm."""
    return at(inserted_mm, inserted_mm, radius_mm, offset_mm)


def at(inserted_mm: float, abscissa_mm: float, radius_mm: float = 2.0, offset_mm: float = 0.0) -> Predicted:
    return Predicted(np.array([inserted_mm, 0.0]), np.array([abscissa_mm, offset_mm]), np.zeros(2), radius_mm)


def adviser_at(at: Predicted, config: AdviserConfig | None = None, **bands: float) -> Watch:
    return Watch(calibration(**bands), config or AdviserConfig(), 0.2, at, alone=False)


def asks(adviser: Watch, at: Predicted, *more: object, moved_mm: float = 1.0, **others: float) -> bool:
    """Return whether an exposure is due after a period in which the wire moved to and fro."""
    adviser.move(at._replace(proximal=at.proximal + np.array([moved_mm, 0.0])))
    adviser.move(at)
    return adviser.advise(at, *more, **others)


def advices(at: list[float], inserted: list[float], *, config: AdviserConfig, **bands: float) -> list[int]:
    """Return at which samples an exposure is due."""
    each = [predicted(offset, inserted_mm=mm) for offset, mm in zip(at, inserted, strict=True)]
    adviser = adviser_at(each[0], config, **bands)
    return [index for index, now in enumerate(each) if index and asks(adviser, now)]


def test_an_exposure_is_due_where_the_tip_is_likely_astray() -> None:
    """One in ten lies outside a band of 90 %, and 0.3 outside 1.036 of its 1.645 standard deviations."""
    inserted = [2.0 * abs(6 - i) for i in range(20)]  # back and forth by 2 mm a sample: the band grows by 0.202 mm
    config = AdviserConfig(abscissa_mm=1.0, wall_ratio=9.0)
    for onset, due in ((0.1, [5, 10, 15]), (0.3, [8, 16])):
        assert advices([0.3] * 20, inserted, config=config, abscissa=0.101, onset=onset) == due


def test_an_exposure_is_due_where_the_tip_comes_to_the_wall_unseen() -> None:
    offset = [0.1] * 5 + [0.9] * 10 + [0.1] * 5 + [0.9] * 5
    due = advices(offset, [10.0] * len(offset), config=AdviserConfig(wall_ratio=0.6), abscissa=0.0)
    assert due == [5, 20]  # as it comes, and comes again; not as it rests or leaves
    assert advices(offset, [10.0] * 25, config=AdviserConfig(wall_ratio=1.3), abscissa=0.0) == []
    near = [0.1] * 5 + [0.55] * 20  # the band of ±0.05 mm ends at τ
    assert advices(near, [10.0] * 25, config=AdviserConfig(wall_ratio=0.6), abscissa=0.0, onset=0.7) == []
    assert advices(near, [10.0] * 25, config=AdviserConfig(wall_ratio=0.6), abscissa=0.0, onset=0.05)[0] == 5


def test_a_contact_that_x_ray_showed_needs_no_second_look_and_one_that_it_did_not_does() -> None:
    """γtip/(1.2 - 0.2 mm) is predicted as 0.9; τ is 0.7."""
    at = predicted(0.9)
    asked = []
    for shown_mm in (0.95, 0.3):
        adviser = adviser_at(predicted(), abscissa=0.0)
        asks(adviser, predicted())
        adviser.exposed(shown_mm, at)
        asked.append([asks(adviser, at) for _ in range(6)])
    assert not any(asked[0]) and np.flatnonzero(asked[1]).tolist() == [1]


def test_an_exposure_is_due_where_the_wire_begins_to_fill_the_lumen() -> None:
    adviser = adviser_at(predicted(), abscissa=0.0, offset=0.0)
    due = [asks(adviser, predicted(radius_mm=r)) for r in (1.2, 1.2, 1.2, 0.2, 0.1, 0.1, 0.1)]
    assert due == [False, False, False, True, False, False, False]


def test_what_a_play_adds_widens_both_bands_at_once() -> None:
    """90 % of a normal distribution lie within 1.645 standard deviations."""
    at = predicted(radius_mm=9.0)
    adviser = adviser_at(at, abscissa=0.0, offset=0.3, onset=0.1)
    asks(adviser, at)
    known = adviser.half_width
    asks(adviser, at, 0.0)
    assert np.array_equal(adviser.half_width, known)
    due = asks(adviser, at, np.array([1.5, 0.2]) ** 2)
    np.testing.assert_allclose(adviser.half_width, [1.645 * 1.5, np.hypot(0.3, 1.645 * 0.2)], rtol=1e-3)
    assert due  # Δtip is known to no more than 2 mm


def test_where_a_model_is_taken_to_be_wrong_each_image_tests_it() -> None:
    adviser = adviser_at(predicted(), abscissa=0.0, offset=0.0)
    adviser.innovations.alarm = True
    assert [asks(adviser, predicted()) for _ in range(6)] == [False, False, True] * 2


def simulated(*weight: float, apart_mm: float = 0.0, pressed: float = 0.0, offset_mm: float = 0.0) -> Predicted:
    """Return what two wires predict: the second lies so far from the first and off the centerline, and is pressed."""
    second, at = np.array([0.0, 1.0]), predicted()
    return at._replace(
        simulated=Members(np.array(weight), apart_mm * second, offset_mm * second, np.full(2, 1.2), pressed * second)
    )


def test_an_exposure_is_due_where_the_wall_begins_to_press() -> None:
    """How likely a force is beyond the limit is Φ(ln(share)/0.2): 0.04, 0.21, 0.30, 0.68, 0.82 and 0.91 at shares of
    0.7, 0.85, 0.9, 1.1, 1.2 and 1.3. An exposure is due where that has grown by 0.2 since one, or since it was less."""
    share = (0.5, 0.7, 0.85, 0.9, 0.7, 0.7, 0.9, 0.9, 1.1, 1.2, 1.3, 1.3, 0.7)
    for harder, weight, onset in ((1.0, 1.0, 0.2), (1.25, 1.0, 0.2), (1.0, 0.5, 0.1)):
        adviser = adviser_at(predicted(), abscissa=0.0, offset=0.0, onset=onset)
        due = [asks(adviser, simulated(1 - weight, weight, pressed=s / harder), harder=harder) for s in share]
        assert np.flatnonzero(due).tolist() == [2, 6, 8, 10]


def test_an_exposure_is_due_where_likely_wires_lie_elsewhere_or_at_the_wall() -> None:
    for where in ({"apart_mm": 6.0}, {"offset_mm": 0.95}):
        for weight, due in ((0.25, True), (0.15, False)):
            adviser = adviser_at(predicted(), AdviserConfig(abscissa_mm=5.0), abscissa=0.1, offset=0.1, onset=0.2)
            asked = [asks(adviser, simulated(1.0, 0.0)), asks(adviser, simulated(1 - weight, weight, **where))]
            assert asked == [False, due], (where, weight)


def test_a_wire_that_rests_is_looked_at_once() -> None:
    """Δtip is known to 2 mm only, before an exposure and after."""
    at = predicted()
    for moved_mm, due in ((1.0, [1, 3, 5]), (0.01, [1])):
        adviser, found = adviser_at(at, AdviserConfig(abscissa_mm=1.0), abscissa=0.0), []
        adviser.move(at._replace(proximal=at.proximal + 1.0))
        for period in range(6):
            found += [period] * asks(adviser, at, 4.0, moved_mm=moved_mm)
            if found[-1:] == [period]:
                adviser.exposed(0.0, at)
        assert found == due


def test_an_exposure_is_due_after_as_long_as_was_calibrated_on() -> None:
    bands = replace(calibration(abscissa=0.0), longest_s=4.0)
    adviser = Watch(bands, AdviserConfig(), 0.2, predicted(), alone=False)
    due = [asks(adviser, predicted()) for _ in range(20)]
    assert [i for i, each in enumerate(due, 1) if each] == [8, 16]  # periods of 0.5 s


def watch(inserted_mm: float = 0.0, *, alone: bool = True) -> Watch:
    calibration = read_agent_calibration("assumed", 1)
    return Watch(calibration, AdviserConfig(), 0.18, at(inserted_mm, inserted_mm), alone=alone)


def test_a_wire_that_is_pushed_while_its_tip_rests_is_known_less_well_until_it_is_seen() -> None:
    made, tip_mm = watch(10.0), [0.2, 0.0]
    made.move(at(30.0, 30.5, 2.0))
    np.testing.assert_array_equal(made.sd_mm, tip_mm)  # the tip went along
    for inserted in (33.0, 36.0, 35.0, 37.0):
        made.move(at(inserted, 30.5, 2.0))
    held = [0.3 * 4.0, 0.05 * 4.0]  # 3 + 3 + 1 + 2 mm, of which 5 are free
    np.testing.assert_allclose(made.sd_mm, np.hypot(held, tip_mm))
    made.exposed(0.0, at(37.0, 30.5))
    np.testing.assert_array_equal(made.sd_mm, tip_mm)
    assert not watch(alone=False).sd_mm.any()


def test_in_a_wide_lumen_a_wire_lies_down_on_the_walls_before_it_is_known_less_well() -> None:
    made, tip_mm = watch(10.0), [0.2, 0.0]
    made.move(at(100.0, 100.0, 10.0))
    made.move(at(140.0, 100.0, 3.0))  # the tip is in an artery that leaves; the wire lies in what is 20 mm wide
    np.testing.assert_array_equal(made.sd_mm, tip_mm)
    made.move(at(144.0, 100.0, 3.0))  # two widths, and 4 mm more
    np.testing.assert_allclose(made.sd_mm, np.hypot([0.3 * 4.0, 0.05 * 4.0], tip_mm))


def test_the_lumen_may_be_another_by_a_share_and_no_more_than_some_millimetres() -> None:
    alone = watch()
    np.testing.assert_allclose([alone.wall_mm(1.0), alone.wall_mm(10.0)], [0.12, 0.3])
    assert not watch(alone=False).wall_mm(1.0)
