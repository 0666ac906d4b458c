"""Play between the motor of a drive and the device that it holds: `through_play`."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float


def through_play(
    ahead: Float[np.ndarray, "*n"], driven: Float[np.ndarray, "*n"], half_gap: Float[np.ndarray, "..."]
) -> tuple[Float[np.ndarray, "*n"], Float[np.ndarray, "*n"]]:
    """Let motors go on, and return how far they are ahead of their devices then, and how far the devices went.

    This is the play operator, p ← clip(p, e − half_gap, e + half_gap), of a motor at e and a device at p: the device
    rests until the motor has gone through the gap, and then goes with it.

    Args:
        ahead: how far each motor is ahead of its device, e − p, mm or rad; no more than half a gap either way.
        driven: how far it goes on without turning back, mm or rad.
        half_gap: half of what is lost at a reversal, mm or rad.
    """
    after = np.clip(ahead + driven, -half_gap, half_gap)
    return after, driven - (after - ahead)
