"""Play between the motor of a drive and the device that it holds, and what is known of it."""

from __future__ import annotations

from typing import Annotated

import numpy as np
from jaxtyping import Float

from endopilot.settings import NonNegative, Share, Within, settings


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


@settings
class KnownDrive:
    """What is known of a drive whose encoders sit at the motor: what lies between them and the device."""

    play_mm: NonNegative = 0.0
    """Motion that is lost where the translation reverses, mm."""
    play_rad: NonNegative = 0.0
    """Motion that is lost where the rotation reverses, rad."""
    play_sd: Share = 0.15
    """Standard deviation of both plays, as a share of them."""
    gain_translation: Annotated[float, Within(0.1, 10)] = 1.0
    """Translation of the device by that of the encoder, while it moves."""
    gain_rotation: Annotated[float, Within(0.1, 10)] = 1.0
    """The same of the rotation."""
    latency_s: NonNegative = 0.0
    """Time in which the motor goes on as it was commanded before, s."""
    max_acceleration_mm_s2: Annotated[float, Within(1e-3, 1e9)] = 1e6
    """Largest change of the translation's speed, mm/s²."""
    max_acceleration_rad_s2: Annotated[float, Within(1e-3, 1e9)] = 1e6
    """Largest change of the rotation's speed, rad/s²."""

    @property
    def gap(self) -> Float[np.ndarray, "2"]:
        """Motion lost at a reversal, mm and rad."""
        return np.array([self.play_mm, self.play_rad])

    @property
    def gain(self) -> Float[np.ndarray, "2"]:
        """Motion of the device by that of the encoder, of translation and rotation."""
        return np.array([self.gain_translation, self.gain_rotation])

    def run_out(self, velocity: Float[np.ndarray, "2"]) -> Float[np.ndarray, "2"]:
        """Return how far the motor goes on before it turns back, mm and rad.

        Args:
            velocity: that it has, mm/s and rad/s.
        """
        braking = np.array([self.max_acceleration_mm_s2, self.max_acceleration_rad_s2])
        return velocity * self.latency_s + velocity * np.abs(velocity) / (2 * braking)
