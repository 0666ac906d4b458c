"""What a drive must never exceed with a wire in a vessel: `DriveLimits`."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from jaxtyping import Float
from pydantic import model_validator

from endopilot.devices.device import Device
from endopilot.settings import Finite, Positive, settings
from endopilot.types import Anatomy

SPARE_MM = 20.0
"""Length that a wire can be driven beyond the end of the vessel's longest path, mm. A wire lies slack along the wall:
it takes more wire than centerline to reach the end."""
_HAIR_MM = 1e-9  # what rounding may add to an inserted length, mm
WIDE_MM, SPARE_WIDTHS = 16.0, 3.0
"""In a lumen wider than this, such as an aorta, a wire lies down on the outer walls of bends and in loops, mm; that
takes up to so many widths of it."""
SLACK_WIDTHS = 2.0  # a wire pushed by so many widths of such a lumen, while its tip does not come forward, folds
Numbers = float | Float[np.ndarray, "..."]


def far_end_mm(anatomy: Anatomy) -> float:
    """Return the largest inserted length in a vessel, mm: its longest path and `SPARE_MM` more, or `SPARE_WIDTHS`."""
    tree = anatomy.tree
    width = 2 * max(float(branch.centerline.radius.max()) for branch in tree.branches)
    spare = SPARE_WIDTHS * width if width > WIDE_MM else SPARE_MM
    return float(tree.longest_path().abscissa[-1]) + spare


def within_travel(
    translation: Numbers,
    inserted_length: Numbers,
    duration: float,
    *,
    travel_mm: tuple[Numbers, Numbers] = (0.0, np.inf),
) -> Numbers:
    """Return translations, each held for some time, that leave no wire outside its travel, mm/s; one that is beyond it
    already is not moved farther out, nor back. NaN stays NaN."""
    low, high = travel_mm
    back = np.minimum(-(inserted_length - low) / duration, 0.0)
    ahead = np.maximum((high - inserted_length) / duration, 0.0)
    return np.clip(translation, back, ahead)


@settings
class DriveLimits:
    """What a drive must never exceed: translation and rotation either way, and least and largest inserted length."""

    max_velocity_mm_s: Positive
    max_rotation_rad_s: Positive
    travel_mm: tuple[Finite, float] = (0.0, np.inf)

    @model_validator(mode="after")
    def _consistent(self) -> DriveLimits:
        if not self.travel_mm[0] < self.travel_mm[1]:
            raise ValueError(f"travel_mm: {self.travel_mm} is no range; give the smaller first")
        return self

    @staticmethod
    def of(device: Device, anatomy: Anatomy | None = None) -> DriveLimits:
        """Return a device's limits in a vessel: its drive's speed, ostium and far end (none without a vessel)."""
        return DriveLimits(
            max_velocity_mm_s=device.max_velocity_mm_s,
            max_rotation_rad_s=device.max_rotation_rad_s,
            travel_mm=(0.0, np.inf if anatomy is None else far_end_mm(anatomy)),
        )

    @property
    def fastest(self) -> Float[np.ndarray, "2"]:
        """Largest translation and rotation, mm/s and rad/s."""
        return np.array([self.max_velocity_mm_s, self.max_rotation_rad_s])

    def by_encoder(self, ostium_mm: float) -> DriveLimits:
        """Return limits whose far end, by an encoder, is no deeper than where the device truly ends; the true inserted
        length is at most `ostium_mm` more than the encoder's."""
        low, high = self.travel_mm
        return replace(self, travel_mm=(low, high - max(ostium_mm, 0.0) - _HAIR_MM))

    def safe(self, translation: Any, rotation: Any) -> tuple[float, float]:
        """Return a finite command within the speed limits, mm/s and rad/s, whatever is asked; NaN stops."""
        try:
            asked = np.array([float(translation), float(rotation)])
        except (TypeError, ValueError, OverflowError):
            return 0.0, 0.0
        if not np.isfinite(asked).all():
            return 0.0, 0.0
        translation_mm_s, rotation_rad_s = np.clip(asked, -self.fastest, self.fastest).tolist()
        return translation_mm_s, rotation_rad_s

    def clip(
        self, control: Float[np.ndarray, "*n 2"], inserted_length: Numbers, duration: float
    ) -> Float[np.ndarray, "*n 2"]:
        """Return what a drive can do of controls (mm/s, rad/s), each held for the whole time, within speed and travel;
        what is within stays to the last bit, NaN stays NaN. The inserted length is at the start."""
        made = np.clip(control, -self.fastest, self.fastest)
        made[..., 0] = within_travel(made[..., 0], inserted_length, duration, travel_mm=self.travel_mm)
        return made

    def clip_sequence(
        self, control: Float[np.ndarray, "*n samples 2"], inserted_length: Numbers, duration: float
    ) -> Float[np.ndarray, "*n samples 2"]:
        """Return `clip` of sequences of controls, one after the other; what follows a NaN is NaN."""
        made, inserted = np.array(control, dtype=float), np.asarray(inserted_length, dtype=float)
        for sample in range(made.shape[-2]):
            made[..., sample, :] = self.clip(made[..., sample, :], inserted, duration)
            inserted = inserted + duration * made[..., sample, 0]
        return made
