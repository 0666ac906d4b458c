"""The play operator against its definition."""

from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as some

from endopilot.devices.drive_motion import through_play


@given(some.lists(some.floats(-5, 5), max_size=12), some.floats(0.0, 3.0), some.floats(-1.0, 1.0))
def test_a_device_stays_within_half_a_gap_of_its_motor(motions, gap, begins) -> None:
    """p ← clip(p, e − gap/2, e + gap/2), for many drives at once and whatever the order of motions."""
    motor, ahead = np.zeros((2, 2)), np.full((2, 2), begins * gap / 2)
    device = motor - ahead
    for motion in motions:
        motor = motor + motion
        ahead, moved = through_play(ahead, np.full((2, 2), motion), np.array([gap, gap]) / 2)
        wanted = np.clip(device, motor - gap / 2, motor + gap / 2)
        device = device + moved
        np.testing.assert_allclose(device, wanted, atol=1e-9)
        np.testing.assert_allclose(motor - device, ahead, atol=1e-9)
