"""Telescoping devices on one shared centreline, and their way from the drives to the ostium, as the core wants them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from endopilot.devices.stack import Stack
from endopilot.simulation.config import CoreTransmission, Processor, Tubes, core_for
from endopilot.simulation.rod import POISSON_RATIO, SHEAR_CORRECTION

_SPACING_MM, _BEHIND_SPACING_MM = 0.25, 1.0  # between a profile's points, mm; of those behind the ostium


@dataclass(frozen=True, eq=False)
class TubeLayout:
    """Two or three telescoping tubes; row k of each array belongs to tube k, the innermost first.

    A profile has a value for each of the equal stretches (`spacing_mm`) that follow each other from the tube's tip; the
    last value goes on beyond them. EI and GJ are in N·mm², EA in N.

    Attributes:
        rest_curvature: curvature of the unloaded tube about its first director, 1/mm.
        bore_friction: Coulomb coefficient between a tube and the next one in it; that of the innermost is not used.
        limits: force (N) at which its drive slips where it pushes, where it pulls, and torque (N·mm) at which it slips.
        shear_share: κGA / EA of all tubes.
    """

    spacing_mm: float
    bend_n_mm2: Float[np.ndarray, "tubes stretches"]
    twist_n_mm2: Float[np.ndarray, "tubes stretches"]
    stretch_n: Float[np.ndarray, "tubes stretches"]
    rest_curvature: Float[np.ndarray, "tubes stretches"]
    radius_mm: Float[np.ndarray, "tubes"]
    bore_friction: Float[np.ndarray, "tubes"]
    limits: Float[np.ndarray, "tubes 3"]
    shear_share: float = SHEAR_CORRECTION / (2 * (1 + POISSON_RATIO))

    def model(self, processor: Processor = "cpu") -> Tubes:
        """Return the tubes as the core wants them."""

        def integral(profile: Float[np.ndarray, "tubes stretches"]) -> Float[np.ndarray, "tubes points"]:
            return np.concatenate([np.zeros((len(profile), 1)), self.spacing_mm * np.cumsum(profile, axis=1)], axis=1)

        return core_for(processor).make_tubes(
            spacing=self.spacing_mm,
            shear_share=self.shear_share,
            bend=integral(self.bend_n_mm2),
            twist=integral(self.twist_n_mm2),
            stretch=integral(self.stretch_n),
            rest=integral(self.rest_curvature),
            radius=self.radius_mm,
            bore_friction=self.bore_friction,
        )


def lay_out_tubes(stack: Stack, *, length_mm: float) -> TubeLayout | None:
    """Return the tubes of a stack, their profiles covering `length_mm`; None for a wire alone."""
    if not stack.catheters:
        return None
    wire, catheters, devices = stack.wire, stack.catheters, stack.devices
    stretches = int(np.ceil(length_mm / _SPACING_MM)) + 2
    edges = _SPACING_MM * np.arange(stretches + 1)
    middle = edges[:-1] + 0.5 * _SPACING_MM
    bend = np.array([device.bend_stiffness(middle) for device in devices])
    bores = np.array([0.0, *(catheter.inner_diameter_mm for catheter in catheters)])
    widths = np.array([device.diameter_mm for device in devices])
    tip = wire.tip_bend_rad * np.minimum(edges / max(wire.tip_bend_length_mm, 1e-9), 1.0)
    turned = np.array([tip, *(catheter.turned(edges) for catheter in catheters)])
    return TubeLayout(
        spacing_mm=_SPACING_MM,
        bend_n_mm2=bend,
        twist_n_mm2=np.array([device.twist_stiffness(middle) for device in devices]),
        stretch_n=16 * bend / (widths**2 + bores**2)[:, None],  # of a ring of these diameters, EA / EI
        rest_curvature=np.diff(turned, axis=1) / _SPACING_MM,
        radius_mm=widths / 2,
        bore_friction=np.array([0.0, *(catheter.bore_friction for catheter in catheters)]),
        limits=stack.limits,
    )


@dataclass(frozen=True, eq=False)
class TransmissionLayout:
    """Devices behind the ostium, the innermost first: length between drive and ostium (0: the drive acts there),
    friction torque a length, and GJ of equal stretches from the tip, as in `TubeLayout`."""

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
    """Return how a stack's drives, of which `longest_mm` may lie ahead of the catheter, act; None if at the ostium."""
    each = stack.transmissions
    if not any(one.length_mm > 0 for one in each):
        return None
    stretches = int(np.ceil((longest_mm + max(one.length_mm for one in each)) / _BEHIND_SPACING_MM)) + 1
    middle = _BEHIND_SPACING_MM * (np.arange(stretches) + 0.5)
    return TransmissionLayout(
        spacing_mm=_BEHIND_SPACING_MM,
        length_mm=np.array([one.length_mm for one in each]),
        friction_n_mm_mm=np.array([one.twist_friction_n_mm_mm for one in each]),
        twist_n_mm2=np.array([device.twist_stiffness(middle) for device in stack.devices]),
    )
