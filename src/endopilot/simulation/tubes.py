"""Telescoping devices on one shared centreline, as the core wants them: a wire, and the catheters around it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float

from endopilot.simulation.catheter import Catheter, check_nested
from endopilot.simulation.device import Device, check_fits
from endopilot.simulation.processor import Processor, Tubes, core_for
from endopilot.simulation.rod import POISSON_RATIO, SHEAR_CORRECTION
from endopilot.types import Anatomy

SHOWN_BEHIND_MM = 20.0
"""Length of devices that pictures show behind the ostium, in the guiding catheter, mm."""
_SPACING_MM = 0.25
"""Distance between the points of a profile, mm."""
_APART_MM = 1e-6
"""Nodes nearer to a tip than this are the tip, mm."""


@dataclass(frozen=True, eq=False)
class TubeLayout:
    """Two or three telescoping tubes; row k of each array belongs to tube k, the innermost first.

    A profile has a value for each of the equal stretches that follow each other from the tube's tip; the last value
    goes on beyond them.

    Attributes:
        spacing_mm: length of a stretch, mm.
        bend_n_mm2: EI, N·mm².
        twist_n_mm2: GJ, N·mm².
        stretch_n: EA, N.
        rest_curvature: curvature of the unloaded tube about its first director, 1/mm.
        radius_mm: outer radius, mm.
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


@dataclass(frozen=True)
class Stack:
    """A wire, and the catheters around it from the inside out; none for a wire alone."""

    wire: Device
    catheters: tuple[Catheter, ...] = ()

    @property
    def devices(self) -> tuple[Device, ...]:
        """The wire, and what each catheter has in common with one."""
        return (self.wire, *(catheter.device for catheter in self.catheters))

    @property
    def outer_radius_mm(self) -> float:
        """Radius of the widest device, mm."""
        return max(device.tip_radius_mm for device in self.devices)

    @property
    def push_limit_n(self) -> float:
        """What all drives together can push with, N: it sizes the wall's stiffness."""
        return sum(device.push_limit_n for device in self.devices)

    @property
    def limits(self) -> Float[np.ndarray, "devices 3"]:
        """Where the drive of each device slips: push (N), pull (N) and torque (N·mm)."""
        return np.array([[each.push_limit_n, each.pull_limit_n, each.torque_limit_n_mm] for each in self.devices])

    @property
    def constants(self) -> tuple[Any, ...]:
        """All numbers of the devices: stacks with the same constants behave the same."""
        bores = tuple((each.inner_diameter_mm, each.bore_friction, each.shape) for each in self.catheters)
        return self.wire.constants + tuple(each.device.constants for each in self.catheters) + bores

    def check(self, anatomy: Anatomy) -> None:
        """Check that the devices fit into each other, and into an anatomy.

        Raises:
            InputError: one does not.
        """
        check_nested(self.wire, self.catheters)
        for device in self.devices:
            check_fits(device, anatomy)

    def lay_out(self, *, length_mm: float) -> TubeLayout | None:
        """Return the tubes that the core takes; None for a wire alone.

        Args:
            length_mm: length that the profiles must cover.
        """
        return _lay_out(self, length_mm) if self.catheters else None


def lines_from_tips(
    nodes: Float[np.ndarray, "n 3"], inserted_mm: Float[np.ndarray, "devices"]
) -> list[Float[np.ndarray, "_ 3"]]:
    """Return the line that telescoping devices share, as each of them has it: from its own tip on.

    Args:
        nodes: of the line, from the foremost tip on, LPS mm.
        inserted_mm: inserted length of each device; the foremost tip is that of the largest.
    """
    behind = inserted_mm.max() - inserted_mm
    along = _along(nodes)
    return [
        nodes if at == 0 else np.vstack([_at(nodes, along, at), nodes[along > at + _APART_MM]])
        for at in behind.tolist()
    ]


def shown_part(nodes: Float[np.ndarray, "n 3"], deepest_mm: float) -> Float[np.ndarray, "shown 3"]:
    """Return what pictures show of a line: from its tip to `SHOWN_BEHIND_MM` behind the ostium, LPS mm.

    Args:
        nodes: of the line, from the foremost tip on, LPS mm; NaN beyond its end.
        deepest_mm: inserted length of the device with that tip.
    """
    nodes = nodes[np.isfinite(nodes).all(axis=1)]
    return nodes[_along(nodes) <= deepest_mm + SHOWN_BEHIND_MM]


def _along(nodes: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n"]:
    """Return how far from the first node each one lies along the line, mm."""
    return np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(nodes, axis=0), axis=1))])


def _at(nodes: Float[np.ndarray, "n 3"], along: Float[np.ndarray, "n"], at_mm: float) -> Float[np.ndarray, "3"]:
    return np.array([np.interp(at_mm, along, axis) for axis in nodes.T])


def _lay_out(stack: Stack, length_mm: float) -> TubeLayout:
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
