"""What bands allow for beside what they are calibrated for."""

from __future__ import annotations

import numpy as np

from endopilot.belief.adviser import AdviserConfig, Predicted
from endopilot.belief.watch import Watch
from endopilot.control.agent_config import read_agent_calibration


def at(inserted_mm: float, abscissa_mm: float, radius_mm: float = 2.0) -> Predicted:
    return Predicted(np.array([inserted_mm, 0.0]), np.array([abscissa_mm, 0.0]), np.zeros(2), radius_mm)


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
