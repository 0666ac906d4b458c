"""Orders of convergence. What is measured stands in `benchmarks.verification.order`."""

from __future__ import annotations

from benchmarks.verification import order


def test_second_order_in_element_length() -> None:
    # Halving the elements changes the elastica's tip by 3 C l²/4: a fourth each time.
    (case,) = order.order_in_element_length()
    assert 1.9 <= case.value <= 2.1


def test_first_order_in_time_step() -> None:
    # c dδ/dt = F - 3 EI δ/L³: after one time constant implicit Euler errs by h/(2 e τ) of F L³/3EI, to leading order.
    (case,) = order.order_in_time_step()
    assert 0.95 <= case.value <= 1.05
    assert case.picture is not None
    size, error = case.picture.curves[1].x, case.picture.curves[1].y
    leading = size / (2 * order.RELAXATION_S) / (2.718281828 - 1)
    assert abs(error / leading - 1).max() < 0.1


def test_first_order_in_a_navigation() -> None:
    # With walls and friction: the tip's mean error is proportional to the step, as far as stick and slip let it.
    (case,) = order.order_in_navigation()
    assert 0.8 <= case.value <= 1.2
