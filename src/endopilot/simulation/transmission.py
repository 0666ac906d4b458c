"""Devices between their drives and the ostium, as the core wants them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from endopilot.devices.stack import Stack
from endopilot.simulation.processor import CoreTransmission, Processor, core_for

_SPACING_MM = 1.0
"""Distance between the points of a profile, mm."""


@dataclass(frozen=True, eq=False)
class TransmissionLayout:
    """Devices behind the ostium; entry or row k belongs to device k, the innermost first.

    Attributes:
        spacing_mm: length of the equal stretches that follow each other from a device's tip, mm.
        length_mm: length between drive and ostium, mm; 0: the drive acts at the ostium.
        friction_n_mm_mm: friction torque a length, N·mm/mm.
        twist_n_mm2: GJ of the stretches, N·mm²; the last value goes on beyond them.
    """

    spacing_mm: float
    length_mm: Float[np.ndarray, "devices"]
    friction_n_mm_mm: Float[np.ndarray, "devices"]
    twist_n_mm2: Float[np.ndarray, "devices stretches"]

    def model(self, processor: Processor = "cpu") -> CoreTransmission:
        """Return the devices as the core wants them."""
        twists = np.cumsum(self.spacing_mm / self.twist_n_mm2, axis=1)
        return core_for(processor).make_transmission(
            spacing=self.spacing_mm,
            length=np.asarray(self.length_mm, dtype=float),
            friction=np.asarray(self.friction_n_mm_mm, dtype=float),
            compliance=np.concatenate([np.zeros((len(twists), 1)), twists], axis=1),
        )


def lay_out_transmission(stack: Stack, *, longest_mm: float) -> TransmissionLayout | None:
    """Return how the drives of a stack act on it; None where they act at the ostium.

    Args:
        stack: wire and catheters.
        longest_mm: length of them that may lie ahead of the catheter.
    """
    each = stack.transmissions
    if not any(one.length_mm > 0 for one in each):
        return None
    stretches = int(np.ceil((longest_mm + max(one.length_mm for one in each)) / _SPACING_MM)) + 1
    middle = _SPACING_MM * (np.arange(stretches) + 0.5)
    return TransmissionLayout(
        spacing_mm=_SPACING_MM,
        length_mm=np.array([one.length_mm for one in each]),
        friction_n_mm_mm=np.array([one.twist_friction_n_mm_mm for one in each]),
        twist_n_mm2=np.array([device.twist_stiffness(middle) for device in stack.devices]),
    )
