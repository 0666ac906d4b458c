"""A device laid out as a discrete rod: node positions, stiffnesses and rest curvature from tip to base."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float
from scipy.optimize import brentq

from endopilot.simulation.device import Device
from endopilot.simulation.processor import Processor, RodModel, core_for

POISSON_RATIO = 0.3
"""Of steel and nitinol; it ties shear to bending stiffness."""
SHEAR_CORRECTION = 6 * (1 + POISSON_RATIO) / (7 + 6 * POISSON_RATIO)
"""Cowper's shear coefficient of a round section (J. Appl. Mech. 33, 1966)."""
_DRAG_N_S_MM2 = 5e-6
"""Drag of the surrounding blood on one mm of wire, N·s/mm²; far below friction."""
_FINEST_MM = 0.75
"""Element length at the tip, mm, if the elements suffice."""
_RAMP_MM = 30.0
"""Length from the tip over which elements grow to their full length, mm."""


@dataclass(frozen=True, eq=False)
class RodLayout:
    """A discrete rod; entry i of each array belongs to node i or to the element between nodes i and i + 1.

    Attributes:
        abscissa_mm: distance of the nodes from the tip, mm.
        shear_n: shear stiffness κGA of the elements, N.
        stretch_n: axial stiffness EA of the elements, N.
        bend_n_mm2: EI at the nodes, N·mm².
        twist_n_mm2: GJ at the nodes, N·mm².
        rest_curvature: curvature and twist of the unloaded rod at the nodes, in the elements' axes, rad/mm.
        radius_mm: outer radius at the nodes, mm.
        drag_n_s_mm: viscous drag of the nodes, N·s/mm.
        spin_drag_n_mm_s: viscous drag of the elements' rotation, N·mm·s.
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


def lay_out(device: Device, *, path_mm: float, elements: int, length_mm: float) -> RodLayout:
    """Lay a device out with `elements` elements over `path_mm`, shorter near the tip.

    The nodes depend on the device, the path and the number of elements alone; a longer `length_mm` only adds nodes at
    the base. So worlds do not notice what other worlds need.

    Args:
        device: the wire.
        path_mm: length that the elements are spread over, mm.
        elements: their number.
        length_mm: length that the rod must have at least, mm; two more elements are added behind it.
    """
    abscissa = _nodes(path_mm, elements, length_mm)
    length = np.append(np.diff(abscissa), np.diff(abscissa)[-1])
    middle = abscissa + 0.5 * length
    # A round section of the device's diameter ties EA and kGA to EI: EA = 16 EI / d², with EI that of the element.
    stretch = 16.0 * device.bend_stiffness(middle) / device.diameter_mm**2
    shear = SHEAR_CORRECTION * stretch / (2 * (1 + POISSON_RATIO))
    # A joint stands for the stretch between the middles of its elements: the bend that falls there is its own. That
    # ahead of the first joint is dropped: the first element's direction is that of the wire at its middle.
    ends = np.minimum(middle, device.tip_bend_length_mm)
    curvature = np.zeros((len(abscissa), 3))
    if device.tip_bend_length_mm > 0:
        bent = device.tip_bend_rad * np.diff(ends) / device.tip_bend_length_mm
        curvature[1:, 0] = bent / np.diff(middle)
    return RodLayout(
        abscissa_mm=abscissa,
        shear_n=shear,
        stretch_n=stretch,
        bend_n_mm2=device.bend_stiffness(abscissa),
        twist_n_mm2=device.twist_stiffness(abscissa),
        rest_curvature=curvature,
        radius_mm=np.full(len(abscissa), device.tip_radius_mm),
        drag_n_s_mm=_DRAG_N_S_MM2 * length,
        spin_drag_n_mm_s=_DRAG_N_S_MM2 * device.tip_radius_mm**2 * length,  # of the surface, radius times rotation
    )


def _nodes(path_mm: float, elements: int, length_mm: float) -> Float[np.ndarray, "n"]:
    finest = min(_FINEST_MM, 0.5 * path_mm / elements)
    count = np.arange(elements)

    def lengths(full: float) -> Float[np.ndarray, "elements"]:
        growth = (full - finest) * finest / _RAMP_MM  # about linear in the abscissa until `full` is reached
        return np.minimum(finest + growth * count, full)

    full: Any = brentq(lambda full: lengths(full).sum() - path_mm, finest, 1e3 * path_mm)
    nodes = np.append(0.0, np.cumsum(lengths(full)))
    extra = max(0, int(np.ceil((length_mm - nodes[-1]) / full))) + 2
    return np.append(nodes, nodes[-1] + full * (1 + np.arange(extra)))
