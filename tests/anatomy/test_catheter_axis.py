"""The guiding catheter's axis, turned, and how far two of them lie apart."""

from __future__ import annotations

import numpy as np
import pytest

from endopilot.anatomy.catheter_axis import lean_between, turned_axis


@pytest.mark.parametrize("tilt_deg", [0.3, 20.0, 89.0, 120.0])
@pytest.mark.parametrize("side_deg", [-170.0, -45.0, 0.0, 90.0, 179.0])
def test_a_turned_axis_leans_by_its_angle_to_its_side(tilt_deg, side_deg) -> None:
    random = np.random.default_rng(round(tilt_deg + side_deg) % 97)
    axis = random.standard_normal(3)
    axis /= np.linalg.norm(axis)
    other = turned_axis(axis, tilt_deg, side_deg)
    assert np.degrees(np.arccos(axis @ other)) == pytest.approx(tilt_deg, abs=1e-6)
    assert lean_between(axis, other) == pytest.approx((tilt_deg, side_deg), abs=1e-6)
