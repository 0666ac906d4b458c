"""Vessels that move. Derivations stand in `benchmarks.verification.motion`."""

from __future__ import annotations

from benchmarks.verification import motion


def test_a_rigid_motion_leaves_the_wire_where_it_is_in_the_tube() -> None:
    (case,) = motion.rigid_motion()
    assert case.picture is not None
    assert case.picture.curves[0].y.max() > 20  # mm, in the laboratory
    assert case.value <= 1e-5


def test_the_work_of_a_contracting_wall_is_stored_or_lost_to_friction() -> None:
    (case,) = motion.power_balance()
    assert case.picture is not None
    work, elastic, _ = case.picture.curves
    assert work.y[-1] > 1.2 * elastic.y[-1] > 0  # friction has its share
    assert case.error <= 0.02


def test_first_order_in_time_in_a_beating_heart() -> None:
    (case,) = motion.order_in_a_beating_heart()
    assert 0.8 <= case.value <= 1.2
