"""What a navigation is: one vessel, one wire, one target, and when it counts as reached. One definition for all."""

from __future__ import annotations

from typing import Annotated, Any, Literal

import numpy as np
from jaxtyping import Bool, Float, Int
from pydantic import InstanceOf, field_validator, model_validator

from endopilot.devices.catheter import Catheter, check_nested
from endopilot.devices.device import Device, Wire
from endopilot.devices.drive_limits import Numbers
from endopilot.devices.robot import RobotConfig
from endopilot.devices.stack import Stack
from endopilot.lines import places_on
from endopilot.settings import CountOrZero, Finite, NonNegative, Positive, Seconds, Within, settings
from endopilot.simulation.motion import Motion
from endopilot.types import Anatomy, TipProjection, VesselTree

DECISION_PERIOD_S = 0.5
"""Time between two decisions, s: the paper's sample period, at which its models speak."""
SUCCESS_MM = 2.0
"""A target counts as reached when the tip lies in its branch, this near to it along the centerline, mm."""
Arrives = Literal["wire", "catheter"]
"""Whose tip is to reach the target: the wire's, or that of the catheter next to it."""
XrayKind = Literal["assumed", "images"]
"""How an exposure finds the tip: with assumed errors of detection, or in X-ray images."""


@settings
class Target:
    """A place on the centerline.

    Attributes:
        branch: index of the branch in `VesselTree.branches`.
        abscissa: distance from the ostium along the path, mm; it lies on that branch.
        near_mm: straight distance from it, mm, within which a tip has to lie as well: a second rule by which a task
            of somebody else is scored.
    """

    branch: CountOrZero
    abscissa: NonNegative
    near_mm: Positive | None = None

    def position(self, anatomy: Anatomy) -> Float[np.ndarray, "3"]:
        """Return the target's place on the centerline, LPS mm."""
        line = anatomy.tree.branches[self.branch].centerline
        return places_on(line.points, line.abscissa, np.array([self.abscissa]))[0]

    def reached(self, tip: TipProjection) -> Bool[np.ndarray, "..."]:
        """Return which worlds have reached it, see `reached`; the tips of each lie along the last axis."""
        return reached(tip, self.branch, self.abscissa, self.near_mm or np.inf)

    def check(self, tree: VesselTree) -> None:
        """Raise ValueError unless the place lies in a vessel, on a branch that runs there."""
        branches = tree.branches
        if not 0 <= self.branch < len(branches):
            raise ValueError(f"target.branch: {self.branch}; the vessel has branches 0 to {len(branches) - 1}")
        line = branches[self.branch].centerline.abscissa
        if not line[0] <= self.abscissa <= line[-1]:
            raise ValueError(
                f"target.abscissa: {self.abscissa:g} mm; branch {self.branch} of the vessel runs from "
                f"{line[0]:.1f} to {line[-1]:.1f} mm"
            )


@settings(eq=False)
class Navigation:
    """One wire, alone or with catheters around it, that is to be brought to one target.

    Attributes:
        anatomy: the vessel.
        device: the wire.
        catheters: around it, from the inside out.
        arrives: whose tip is to go to the target: "wire", or "catheter", the one next to the wire. The wire's tip may
            then not be pulled back into the catheter.
        target: where the tip is to go: what `Anatomy.target` takes, such as a section or a point.
        start_inserted_length_mm: inserted length Δ at the start, mm.
        start_rotation_rad: rotation φ at the start, rad.
        start_catheter_mm: inserted length of the catheters at the start, mm; their rotations are 0.
        seconds: time in which the target is to be reached, s.
        force_limit_n: largest force of the wall on one node that is safe, N.
        known_motion: how heart and breath are known to move the vessel, which the C-arm takes off what it measures and
            policies simulate; it is taken to lie still if not given.
        xray: how an exposure finds the tip; `NavigationLoop` says what its C-arm does.
        robot: as it is known, not what a seed draws of it. `NavigationLoop` takes its own if not given; else encoders
            sit at the devices.
    """

    anatomy: InstanceOf[Anatomy]
    device: Wire
    target: Target
    catheters: tuple[Catheter, ...] = ()
    arrives: Arrives = "wire"
    start_inserted_length_mm: Annotated[float, Within(0, 5000)] = 2.0
    start_rotation_rad: Finite = 0.0
    start_catheter_mm: Annotated[float, Within(0, 5000)] = 0.0
    seconds: Seconds = 60.0
    force_limit_n: Positive = 0.5
    known_motion: Motion | None = None
    xray: XrayKind = "assumed"
    robot: RobotConfig | None = None

    @field_validator("target", mode="before")
    @classmethod
    def _placed(cls, place: Any, info: Any) -> Any:
        anatomy = info.data.get("anatomy")
        return anatomy.target(place) if anatomy is not None and not isinstance(place, dict | Target) else place

    @model_validator(mode="after")
    def _consistent(self) -> Navigation:
        self.target.check(self.anatomy.tree)
        if len(self.catheters) < self.arriving:
            raise ValueError("arrives: catheter; there is none; give catheters, or arrives: wire")
        check_nested(self.device, self.catheters)
        return self

    @property
    def devices(self) -> tuple[Device, ...]:
        """The wire, then the catheters around it."""
        return self.stack.devices

    @property
    def arriving(self) -> int:
        """Place among `devices` of the one whose tip is to go to the target."""
        return int(self.arrives == "catheter")

    @property
    def stack(self) -> Stack:
        """The wire and its catheters, and what the robot has between their drives and the ostium."""
        drives = () if self.robot is None else self.robot.drives(1 + len(self.catheters))
        return Stack(self.device, self.catheters, tuple(drive.transmission for drive in drives))

    @property
    def start(self) -> Float[np.ndarray, "devices 2"]:
        """(Δ mm, φ rad) of each device at the start."""
        catheters = [(self.start_catheter_mm, 0.0)] * len(self.catheters)
        return np.array([(self.start_inserted_length_mm, self.start_rotation_rad), *catheters])

    def periods(self, period_s: float) -> int:
        """Return after how many periods of some length, s, the time is over."""
        return int(np.ceil(self.seconds / period_s - 1e-9))

    def reached(self, tip: TipProjection) -> Bool[np.ndarray, "..."]:
        """Return which worlds have reached the target, see `reached`; tips of all devices lie along the last axis."""
        return self.target.reached(tip[..., : self.arriving + 1])


def reached(
    tip: TipProjection,
    branch: int | Int[np.ndarray, "..."],
    abscissa: float | Float[np.ndarray, "..."],
    near_mm: float | Float[np.ndarray, "..."] = np.inf,
) -> Bool[np.ndarray, "..."]:
    """Return which worlds have reached their targets.

    The tip that is to arrive lies in the target's branch, within `SUCCESS_MM` of it along the centerline, and the
    wire's tip lies no more than that behind it. Where a straight distance `near_mm` is given, the tip lies within that
    too, as far as its distances along the centerline and from it say. Along the last axis lie the tips of the wires,
    and if a catheter's are to arrive, those last. Targets are one for all worlds, or one each.
    """
    wire, arriving = tip[..., 0], tip[..., -1]
    along_mm = np.abs(arriving.abscissa - abscissa)
    there = (along_mm <= SUCCESS_MM) & (arriving.branch == branch) & (np.hypot(along_mm, arriving.offset) <= near_mm)
    return there & (wire.abscissa >= arriving.abscissa - SUCCESS_MM)


def is_safe(force_n: Numbers, limit_n: Numbers) -> Bool[np.ndarray, "..."]:
    """Return where the largest force of the wall on one node, N, is no larger than the limit, N; NaN is not safe."""
    return np.asarray(np.less_equal(force_n, limit_n))
