"""A tip's lateral reach against its closed form; the test of reach at a fork of known width; what is chosen by it."""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np
import pytest

from endopilot.anatomy.catheter_axis import with_axis
from endopilot.control.reach import ROTATIONS, forks, rotations_that_enter
from endopilot.control.set_up import choose_tip
from endopilot.devices.device import lateral_reach
from endopilot.errors import InputError
from endopilot.tasks.navigation import Navigation, Target
from endopilot.tasks.route import Route
from toy_fork import make_fork

RADIUS_MM = 2.6
"""Of the wide vessel: that of a real left main."""


@pytest.fixture(scope="module")
def wide(wire) -> Navigation:
    return Navigation(anatomy=make_fork((RADIUS_MM, 2.0)), device=wire, target=Target(branch=2, abscissa=33.0))


@pytest.mark.parametrize(
    ("angle_deg", "length_mm", "reach_mm"), [(45.0, 3.0, 1.119), (75.0, 5.0, 2.831), (90.0, 8.0, 5.093)]
)
def test_reach_is_that_of_an_arc(angle_deg, length_mm, reach_mm) -> None:
    """An arc of angle θ and length L has the radius L/θ, and its end lies L/θ·(1 − cos θ) beside its tangent."""
    assert lateral_reach(np.radians(angle_deg), length_mm) == pytest.approx(reach_mm, abs=1e-3)
    assert lateral_reach(-np.radians(angle_deg), length_mm) == pytest.approx(reach_mm, abs=1e-3)


def test_reach_of_tips_without_and_with_more_than_half_a_turn() -> None:
    assert lateral_reach(0.0, 0.0) == 0.0 and lateral_reach(1e-6, 5.0) == pytest.approx(0.0, abs=1e-5)
    assert lateral_reach(np.pi, 3 * np.pi) == pytest.approx(6.0)  # half a circle of radius 3 mm: its diameter
    assert lateral_reach(1.5 * np.pi, 4.5 * np.pi) == pytest.approx(6.0)  # what lies beyond comes back


def test_a_fork_is_as_wide_as_its_lumen_leaves_the_wire(wide, wire) -> None:
    (fork,) = forks(Route.to(wide.anatomy, wide.target), wire)
    assert fork.width_mm == pytest.approx(2 * RADIUS_MM - 0.36)
    assert fork.abscissa == pytest.approx(20.0) and fork.branch == 2
    assert not forks(Route.to(wide.anatomy, Target(branch=0, abscissa=10.0)), wire)


def test_a_wide_fork_refuses_a_short_tip_and_takes_a_long_one(wide, wire) -> None:
    """4.8 mm are free: 45°/3 mm reaches 1.1 mm of them, 90°/8 mm all."""
    refused = rotations_that_enter(wide, wire.shaped(45.0, 3.0))
    assert refused.tolist() == [0]
    (entering,) = rotations_that_enter(wide, wire.shaped(90.0, 8.0)).tolist()
    assert ROTATIONS / 4 <= entering <= ROTATIONS / 2  # the side that looks into the branch
    straight = replace(wide, target=Target(branch=1, abscissa=33.0))
    assert rotations_that_enter(straight, wire.shaped(45.0, 3.0)).tolist() == [ROTATIONS]


def test_a_tip_is_chosen_that_enters(wide, wire) -> None:
    choice = choose_tip(wide)
    made = choice.navigation
    assert choice.refused is None and choice.tilt_deg == 0.0 and made.anatomy is wide.anatomy
    assert lateral_reach(made.device.tip_bend_rad, made.device.tip_bend_length_mm) > 1.2
    angle_deg, length_mm = choice.tip.split("/")
    section, entering = choice.forks[0].section, choice.entering[0]
    tip = f"the tip ({angle_deg}° over {length_mm} mm) enters {section} from {entering} of 24 rotations"
    assert re.fullmatch(re.escape(tip) + r"; as delivered from (none|\d+)", choice.why)
    assert rotations_that_enter(made, made.device)[0] == choice.entering[0] > 0
    straight = choose_tip(replace(wide, target=Target(branch=1, abscissa=33.0)))
    assert straight.tip == "45/3" and straight.navigation.device == wire  # its own tip suffices and is kept


def test_a_fixed_tip_is_kept_and_the_fork_that_refuses_it_is_named(wide) -> None:
    choice = choose_tip(wide, tip="45/3", catheter_tilt_deg=0.0)
    assert choice.tip == "45/3"
    assert choice.refused is not None and choice.refused.branch == 2
    section = choice.refused.section
    assert choice.why == f"the tip (45° over 3 mm) enters {section} from none of 24 rotations"


@pytest.mark.parametrize(("off_deg", "turned_deg"), [(80.0, 30.0), (30.0, 0.0)])
def test_a_catheter_is_turned_towards_a_route_that_leaves_its_axis_steeply(wide, off_deg, turned_deg) -> None:
    along, off = Target(branch=1, abscissa=33.0), np.radians(off_deg)
    axis = np.array([np.sin(off), 0.0, np.cos(off)])
    steep = replace(wide, anatomy=with_axis(wide.anatomy, axis), target=along)
    choice = choose_tip(steep)
    onwards = choice.navigation.anatomy.insertion.direction[2]  # the vessel goes along z
    assert choice.tilt_deg == turned_deg
    assert np.degrees(np.arccos(onwards)) == pytest.approx(off_deg - turned_deg, abs=1.0)
    assert ("the route leaves its axis by 80°" in choice.why) == (turned_deg > 0)
    assert choose_tip(steep, catheter_tilt_deg=0.0).navigation.anatomy is steep.anatomy


@pytest.mark.parametrize(
    ("tip", "message"),
    [
        ("120/8", "120/8 cannot be given to workhorse-014; a hand bends its tip by 0 to 90 degrees over 2 to 10 mm"),
        ("90/12", "90/12 cannot be given to workhorse-014"),
        ("nan/8", "nan/8 cannot be given"),
        ("bent", "'bent'; give auto, own, or angle and length as 75/5"),
        ("75", "'75'; give auto, own"),
    ],
)
def test_a_tip_that_no_hand_can_shape_is_refused(wide, tip, message) -> None:
    with pytest.raises(InputError, match=message):
        choose_tip(wide, tip=tip)


def test_a_wire_that_keeps_its_shape_is_tried_with_its_own_tip_alone(wide, wire) -> None:
    fixed = replace(wide, device=replace(wire, tip_shaping=None))
    assert choose_tip(fixed).tip == "45/3"
    with pytest.raises(InputError, match="its tip keeps its shape"):
        choose_tip(fixed, tip="75/5")
