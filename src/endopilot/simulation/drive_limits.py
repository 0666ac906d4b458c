"""What a drive must never exceed with a wire in a vessel: `DriveLimits`."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float

from endopilot.errors import InputError
from endopilot.simulation.config import SPARE_MM
from endopilot.simulation.device import Device
from endopilot.types import Anatomy


@dataclass(frozen=True, kw_only=True)
class DriveLimits:
    """What a drive must never exceed.

    Attributes:
        max_velocity_mm_s: fastest translation, either way, mm/s.
        max_rotation_rad_s: fastest rotation, either way, rad/s.
        travel_mm: least and largest inserted length, mm.
    """

    max_velocity_mm_s: float
    max_rotation_rad_s: float
    travel_mm: tuple[float, float] = (0.0, np.inf)

    def __post_init__(self) -> None:
        """Check every limit.

        Raises:
            InputError: a limit is not positive, or the travel is no range.
        """
        for name in ("max_velocity_mm_s", "max_rotation_rad_s"):
            if not 0 < getattr(self, name) < np.inf:
                raise InputError(f"{name}: {getattr(self, name)}; give a positive number")
        if not self.travel_mm[0] < self.travel_mm[1]:
            raise InputError(f"travel_mm: {self.travel_mm} is no range; give the smaller first")

    @staticmethod
    def of(device: Device, anatomy: Anatomy) -> DriveLimits:
        """Return the limits of a wire in a vessel: the drive's speed, and no more wire than reaches its far end."""
        reach = float(anatomy.tree.longest_path().abscissa[-1]) + SPARE_MM
        return DriveLimits(
            max_velocity_mm_s=device.max_velocity_mm_s,
            max_rotation_rad_s=device.max_rotation_rad_s,
            travel_mm=(0.0, reach),
        )

    def safe(self, translation: Any, rotation: Any) -> tuple[float, float]:
        """Return a command that is finite and within the speed limits, whatever is asked; what is no number stops.

        Args:
            translation: mm/s.
            rotation: rad/s.
        """
        try:
            asked = np.array([float(translation), float(rotation)])
        except (TypeError, ValueError, OverflowError):
            return 0.0, 0.0
        if not np.isfinite(asked).all():
            return 0.0, 0.0
        translation_mm_s, rotation_rad_s = np.clip(asked, -self.fastest, self.fastest).tolist()
        return translation_mm_s, rotation_rad_s

    @property
    def fastest(self) -> Float[np.ndarray, "2"]:
        """Largest translation and rotation, mm/s and rad/s."""
        return np.array([self.max_velocity_mm_s, self.max_rotation_rad_s])

    def possible(
        self, control: Float[np.ndarray, "n 2"], inserted_length: Float[np.ndarray, "wires"], duration: float
    ) -> Float[np.ndarray, "n 2"]:
        """Return what a drive can do of finite controls, mm/s and rad/s, within its speed and its travel.

        Args:
            control: each is held for the whole time.
            inserted_length: of the wires that it may hold, mm: neither the shortest nor the longest leaves the travel.
            duration: s.
        """
        made = np.clip(control, -self.fastest, self.fastest)
        back = (self.travel_mm[0] - float(inserted_length.min())) / duration
        room = (self.travel_mm[1] - float(inserted_length.max())) / duration
        made[:, 0] = np.clip(made[:, 0], min(back, 0.0), max(room, 0.0))
        return made
