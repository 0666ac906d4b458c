"""The rod against closed forms, without a wall. Equations and sources stand in `endopilot.simulation.verify_free`."""

from __future__ import annotations

import numpy as np
import pytest

from endopilot.simulation import verify_free


@pytest.mark.parametrize("group", verify_free.CASES, ids=lambda group: group.__name__)
def test_closed_form(group) -> None:
    for case in group():
        assert case.error <= case.bar, case.case


def test_second_order_in_element_length() -> None:
    # The error of w/L at α = 10 falls fourfold when the elements are halved.
    exact = 0.810609
    coarse, fine = (abs(verify_free.elastica_tip(10.0, n)[0][0] - exact) for n in (10, 20))
    assert 1.7 < np.log2(coarse / fine) < 2.3
