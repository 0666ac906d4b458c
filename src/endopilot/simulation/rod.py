"""Devices laid out as the core wants them: a rod of nodes from tip to base, telescoping tubes on one shared centreline,
and their way from the drives to the ostium."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float
from scipy.optimize import brentq

from endopilot.devices.device import Wire
from endopilot.devices.stack import Stack
from endopilot.simulation.config import CoreTransmission, Processor, RodModel, Tubes, core_for

POISSON_RATIO = 0.3  # of steel and nitinol; it ties shear to bending stiffness
SHEAR_CORRECTION = 6 * (1 + POISSON_RATIO) / (7 + 6 * POISSON_RATIO)  # round section (Cowper, J. Appl. Mech. 33)
_DRAG_N_S_MM2, _SOFT_N_MM2 = 5e-6, 0.1
"""Drag on one mm of wire, N·s/mm²; far below friction. On a wire softer than the latter anywhere, N·mm², it falls with
the square of that: it would fold as it is pushed."""
_LEAST_N_S_MM2 = 1e-10
"""Drag is no less than this, N·s/mm². That of blood would be more, 2πη / ln(length / diameter) = 1e-8 with η = 0.0035
Pa·s, and fold a wire of less than some 0.005 N·mm² as it is pushed; no blood is modelled."""
_GROWTH_MM = 40.0  # elements so far from the tip are twice as long as there, mm; they grow in proportion
LONGEST_ELEMENTS = 5.0  # in elements at the tip: the shaft is stiffer and bends less sharply


@dataclass(frozen=True, eq=False)
class RodLayout:
    """A discrete rod; entry i of each array belongs to node i or to the element between nodes i and i + 1.

    Attributes:
        abscissa_mm: distance of the nodes from the tip, mm.
        shear_n: shear stiffness κGA of the elements, N; `stretch_n` is EA, N.
        bend_n_mm2: EI at the nodes, N·mm²; `twist_n_mm2` is GJ.
        rest_curvature: curvature and twist of the unloaded rod at the nodes, in the elements' axes, rad/mm.
        radius_mm: outer radius at the nodes, mm.
        drag_n_s_mm: viscous drag of the nodes, N·s/mm; `spin_drag_n_mm_s` of the elements' rotation, N·mm·s.
    """

    abscissa_mm: Float[np.ndarray, "n"]
    shear_n: Float[np.ndarray, "n"]
    stretch_n: Float[np.ndarray, "n"]
    bend_n_mm2: Float[np.ndarray, "n"]
    twist_n_mm2: Float[np.ndarray, "n"]
    rest_curvature: Float[np.ndarray, "n 3"]
    radius_mm: Float[np.ndarray, "n"]
    drag_n_s_mm: Float[np.ndarray, "n"]
    spin_drag_n_mm_s: Float[np.ndarray, "n"]

    def model(self, processor: Processor = "cpu") -> RodModel:
        """Return the rod as the core wants it."""
        return core_for(processor).make_rod(
            abscissa=self.abscissa_mm,
            shear=self.shear_n,
            stretch=self.stretch_n,
            bend=self.bend_n_mm2,
            twist=self.twist_n_mm2,
            rest=self.rest_curvature,
            radius=self.radius_mm,
            drag=self.drag_n_s_mm,
            spin_drag=self.spin_drag_n_mm_s,
        )


def lay_out(device: Wire, *, element_mm: float, length_mm: float) -> RodLayout:
    """Lay a device out as a rod of at least `length_mm` and two elements behind it. Nodes depend on the device and
    `element_mm` alone, a longer rod only adds some at the base; those at the tip are shorter, so that the middle of one
    lies where its bend ends."""
    abscissa = _nodes(element_mm, length_mm, device.tip_bend_length_mm)
    length = np.append(np.diff(abscissa), np.diff(abscissa)[-1])
    middle = abscissa + 0.5 * length
    # A joint stands for the stretch between the middles of its elements: the bend that falls there is its own. That
    # ahead of the first joint is dropped: the first element's direction is that of the wire at its middle.
    ends = np.minimum(middle, device.tip_bend_length_mm)
    curvature = np.zeros((len(abscissa), 3))
    if device.tip_bend_length_mm > 0:
        bent = device.tip_bend_rad * np.diff(ends) / device.tip_bend_length_mm
        curvature[1:, 0] = bent / np.diff(middle)
    softness = min(1.0, min(device.bend_stiffness_n_mm2) / _SOFT_N_MM2)
    drag = max(_DRAG_N_S_MM2 * softness**2, _LEAST_N_S_MM2)
    spin_drag = drag * device.tip_radius_mm**2 * length  # of the surface, radius times rotation
    return rod_at(device, abscissa, middle, curvature, drag * length, spin_drag)


def rod_at(
    device: Wire,
    abscissa_mm: Float[np.ndarray, "n"],
    middle_mm: Float[np.ndarray, "n"],
    rest_curvature: Float[np.ndarray, "n 3"],
    drag_n_s_mm: Float[np.ndarray, "n"],
    spin_drag_n_mm_s: Float[np.ndarray, "n"],
) -> RodLayout:
    """Return a device as a rod with these nodes and middles of elements. A round section of the device's diameter ties
    EA and kGA to EI: EA = 16 EI / d², with EI that of the element."""
    stretch = 16.0 * device.bend_stiffness(middle_mm) / device.diameter_mm**2
    return RodLayout(
        abscissa_mm=abscissa_mm,
        shear_n=SHEAR_CORRECTION * stretch / (2 * (1 + POISSON_RATIO)),
        stretch_n=stretch,
        bend_n_mm2=device.bend_stiffness(abscissa_mm),
        twist_n_mm2=device.twist_stiffness(abscissa_mm),
        rest_curvature=rest_curvature,
        radius_mm=np.full(len(abscissa_mm), device.tip_radius_mm),
        drag_n_s_mm=drag_n_s_mm,
        spin_drag_n_mm_s=spin_drag_n_mm_s,
    )


def _nodes(element_mm: float, length_mm: float, bend_mm: float) -> Float[np.ndarray, "n"]:
    """Return the abscissas of nodes that reach `length_mm` at least, an element's middle lying at `bend_mm`."""

    def nodes(first: float, count: int) -> Float[np.ndarray, "n"]:
        at = np.zeros(count)
        for i in range(1, count):
            at[i] = at[i - 1] + min(first * (1 + at[i - 1] / _GROWTH_MM), LONGEST_ELEMENTS * element_mm)
        return at

    def middle(first: float, element: int) -> float:
        return float(nodes(first, element + 2)[-2:].mean())

    first = element_mm
    if bend_mm > 0:
        element = 1  # a joint at least lies ahead of it
        while middle(first, element) < bend_mm:
            element += 1
        aligned: Any = brentq(lambda first: middle(first, element) - bend_mm, 0.0, max(element_mm, bend_mm))
        first = aligned
    count = 4
    while (abscissa := nodes(first, count))[-3] < length_mm:
        count *= 2
    return abscissa[: int(np.searchsorted(abscissa, length_mm)) + 3]


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


def make_transmission(
    length_mm: Float[np.ndarray, "devices"],
    friction_n_mm_mm: Float[np.ndarray, "devices"],
    twist_n_mm2: Float[np.ndarray, "devices stretches"],
    processor: Processor = "cpu",
) -> CoreTransmission:
    """Return devices behind the ostium as the core wants them, the innermost first: length between drive and ostium (0:
    the drive acts there), friction torque a length, and GJ of stretches of 1 mm from the tip."""
    twists = np.cumsum(_BEHIND_SPACING_MM / twist_n_mm2, axis=1)
    return core_for(processor).make_transmission(
        spacing=_BEHIND_SPACING_MM,
        length=length_mm,
        friction=friction_n_mm_mm,
        compliance=np.concatenate([np.zeros((len(twists), 1)), twists], axis=1),
    )


def lay_out_transmission(stack: Stack, *, longest_mm: float, processor: Processor) -> CoreTransmission | None:
    """Return how a stack's drives, of which `longest_mm` may lie ahead of the catheter, act; None if at the ostium."""
    each = stack.transmissions
    if not any(one.length_mm > 0 for one in each):
        return None
    stretches = int(np.ceil((longest_mm + max(one.length_mm for one in each)) / _BEHIND_SPACING_MM)) + 1
    middle = _BEHIND_SPACING_MM * (np.arange(stretches) + 0.5)
    length, friction = np.array([[one.length_mm, one.twist_friction_n_mm_mm] for one in each]).T.copy()
    twist = np.array([device.twist_stiffness(middle) for device in stack.devices])
    return make_transmission(length, friction, twist, processor)
