"""What is chosen before a wire goes in, `choose_tip`: the shape of its tip, and the axis of the guiding catheter.

Of the tips that a hand can give the wire, the one of least lateral reach is taken that enters every fork of the route
with a quarter of all rotations; else the one that enters the hardest fork with most. The guiding catheter is turned too
where none enters a fork near the ostium, and where the route leaves its axis steeply.

`describe_halt` says why a search ended before the target.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Annotated

import numpy as np
from jaxtyping import Float, Int

from endopilot.anatomy.catheter_axis import turned_axis, with_axis
from endopilot.control.drive import Halt
from endopilot.control.reach import ROTATIONS, Fork, forks, rotations_that_enter
from endopilot.devices.device import Wire
from endopilot.devices.stack import Stack
from endopilot.errors import InputError
from endopilot.settings import Finite, Positive, Seconds, Seed, Text, Within, settings
from endopilot.simulation.motion import Motion
from endopilot.tasks.navigation import Arrives, Navigation, Target
from endopilot.tasks.route import BEYOND_MM, ENTERED_MM, Route
from endopilot.types import Anatomy

SHAPES = ((45.0, 3.0), (60.0, 4.0), (75.0, 5.0), (90.0, 6.5), (90.0, 8.0), (90.0, 10.0))
"""Tips that are tried, angle in degrees and length in mm: from the usual one to the largest that a hand bends."""
ENOUGH = ROTATIONS // 4
"""A tip that enters every fork with this many of the rotations suffices: a quarter of a turn may be missed by a robot's
backlash and a wire's friction."""
TILT_DEG = 30.0
"""A guiding catheter's tip is turned this far at the ostium, at most, degrees."""
_COAXIAL_MM, _COAXIAL_DEG = 10.0, 45.0
"""A catheter is turned towards a route whose first millimetres leave its axis by more than this, mm and degrees: round
such a bend a stiff shaft presses on the wall long before it has pushed its tip to a distant target."""
_CATHETER_MM = 20.0
"""The catheter's axis decides how the wire lies as far as this from the ostium, mm."""
_AZIMUTHS = 8
Count = Int[np.ndarray, "forks"]


@settings
class GivenConfig:
    """What plans and navigations are given beside vessel, devices and target."""

    arrives: Arrives = "wire"
    """Whose tip is to go to the target: wire, or catheter, the one around the wire."""
    tip: Text = "auto"
    """Shape of the wire's tip: auto (chosen for the forks of the route), own (the device's), or angle and length such
    as 75/5, 75 degrees over 5 mm."""
    catheter_tilt_deg: Annotated[float, Within(0, 45)] = TILT_DEG
    """How far the guiding catheter may be turned at the ostium where a fork cannot be entered otherwise, degrees."""
    seconds: Seconds = 60.0
    """Time in which the target is to be reached, s."""
    force_limit_n: Positive = 0.5
    """Largest force of the wall on one node that is safe, N."""
    start_inserted_length_mm: Annotated[float, Within(0, 5000)] = 2.0
    """Inserted length at the start, mm."""
    start_rotation_rad: Finite = 0.0
    """Rotation at the start, rad."""
    seed: Seed = 0
    """Seed of encoder noise, detection errors, the policy or search, and of what the world draws."""

    def navigation(self, anatomy: Anatomy, stack: Stack, target: Target, known: Motion | None = None) -> Navigation:
        """Return what is to be done, in a vessel of which a motion is known, with the wire's tip as it is delivered."""
        return Navigation(
            anatomy=anatomy,
            device=stack.wire,
            target=target,
            catheters=stack.catheters,
            arrives=self.arrives,
            start_inserted_length_mm=self.start_inserted_length_mm,
            start_rotation_rad=self.start_rotation_rad,
            seconds=self.seconds,
            force_limit_n=self.force_limit_n,
            known_motion=known,
        )


@dataclass(frozen=True, eq=False)
class TipChoice:
    """How a navigation is set up.

    Attributes:
        navigation: with the wire as it is shaped, in the anatomy with its catheter as it is turned.
        tilt_deg: angle by which the catheter's axis was turned, degrees.
        forks: of the route.
        entering: with how many of `ROTATIONS` rotations the tip enters each.
        why: why this tip and this axis, in one line.
    """

    navigation: Navigation
    tilt_deg: float
    forks: tuple[Fork, ...]
    entering: Count
    why: str

    @property
    def refused(self) -> Fork | None:
        """The first fork that the tip enters with no rotation, or None."""
        return next((fork for fork, count in zip(self.forks, self.entering, strict=True) if not count), None)

    @property
    def tip(self) -> str:
        """The shape of the tip, such as "75/5": degrees and mm."""
        return tip_name(self.navigation.device)


def choose_tip(navigation: Navigation, *, tip: str = "auto", catheter_tilt_deg: float = TILT_DEG) -> TipChoice:
    """Choose the shape of the wire's tip for a navigation, and turn the guiding catheter where that alone helps.

    The options are those of `GivenConfig`; no such tip, or one that a hand cannot give the wire, raises `InputError`.
    """
    devices, given = _tips(navigation.device, tip), navigation
    route = Route.to(navigation.anatomy, navigation.target)
    places, steep_deg = forks(route, navigation.device), _off_axis_deg(route)
    tilt_deg, turned_for = 0.0, ""
    if steep_deg > _COAXIAL_DEG and catheter_tilt_deg > 0:
        tilt_deg = min(catheter_tilt_deg, steep_deg)
        navigation = replace(given, anatomy=with_axis(given.anatomy, _towards(route, tilt_deg)))
        turned_for = f"the route leaves its axis by {steep_deg:.0f}°"
    made = _choose(navigation, devices, places, tilt_deg, turned_for)
    refused = made.refused
    if refused is None or not catheter_tilt_deg or refused.abscissa > _CATHETER_MM:  # too far for its axis to help
        return made
    turned_for = f"along its given axis no tip enters {_into(refused)}"
    for axis in _axes(route, catheter_tilt_deg):
        turned = replace(given, anatomy=with_axis(given.anatomy, axis))
        other = _choose(turned, devices, places, catheter_tilt_deg, turned_for)
        made = max(made, other, key=lambda each: _merit(each.entering))  # the first of equals
        if (made.entering >= ENOUGH).all():
            break
    return made


def tip_name(device: Wire) -> str:
    """Return the shape of a wire's tip as `--tip` takes it, such as "75/5": degrees and mm."""
    return f"{np.degrees(device.tip_bend_rad):.4g}/{device.tip_bend_length_mm:.4g}"


def _tips(device: Wire, tip: str) -> list[Wire]:
    """Return the wire with each tip that may be chosen, its own one first."""
    shaping = device.tip_shaping
    if tip == "own" or (tip == "auto" and shaping is None):
        return [device]
    if tip == "auto":
        assert shaping is not None
        shapes = [device.shaped(*shape) for shape in SHAPES if shaping.allows(*shape)]
        return [device, *(made for made in shapes if made.constants != device.constants)]
    try:
        angle_deg, length_mm = (float(part) for part in tip.split("/"))
    except ValueError:
        raise InputError(f"tip: {tip!r}; give auto, own, or angle and length as 75/5 (75 degrees over 5 mm)") from None
    if shaping is None or not shaping.allows(angle_deg, length_mm):
        raise InputError(f"tip: {tip} cannot be given to {device.name}; {_limits(device)}")
    return [device.shaped(angle_deg, length_mm)]


def _limits(device: Wire) -> str:
    shaping = device.tip_shaping
    if shaping is None:
        return "its tip keeps its shape"
    (least, largest), (shortest, longest) = shaping.angle_deg, shaping.length_mm
    return f"a hand bends its tip by {least:g} to {largest:g} degrees over {shortest:g} to {longest:g} mm"


def _choose(
    navigation: Navigation, devices: list[Wire], places: tuple[Fork, ...], tilt_deg: float, turned_for: str
) -> TipChoice:
    """Choose the first wire that suffices, else the best one."""
    counts: list[Count] = []
    for device in devices:
        counts.append(rotations_that_enter(navigation, device))
        if (counts[-1] >= ENOUGH).all():
            best = len(counts) - 1
            break
    else:
        best = max(range(len(counts)), key=lambda index: _merit(counts[index]))  # the first of equals
    why = _why(devices[best], places, counts, best)
    if tilt_deg:
        why += f"; the catheter is turned by {tilt_deg:.3g}°: {turned_for}"
    return TipChoice(replace(navigation, device=devices[best]), tilt_deg, places, counts[best], why)


def _merit(count: Count) -> tuple[int, int]:
    """Return how good a tip is: places that it passes, and rotations at the hardest of them."""
    passed = count[count > 0]
    return len(passed), int(passed.min()) if len(passed) else 0


def _off_axis_deg(route: Route) -> float:
    """Return how far a route's first millimetres leave the catheter's axis, degrees."""
    onwards = route.position(_COAXIAL_MM) - route.position(0.0)
    cosine = onwards @ route.anatomy.insertion.direction / np.linalg.norm(onwards)
    return float(np.degrees(np.arccos(np.clip(cosine, -1.0, 1.0))))


def _towards(route: Route, tilt_deg: float) -> Float[np.ndarray, "3"]:
    """Return the catheter's axis, turned by an angle (degrees) towards the route's first millimetres."""
    axis, onwards = route.anatomy.insertion.direction, route.position(_COAXIAL_MM) - route.position(0.0)
    side = onwards - (onwards @ axis) * axis
    return np.cos(np.radians(tilt_deg)) * axis + np.sin(np.radians(tilt_deg)) * side / np.linalg.norm(side)


def _axes(route: Route, tilt_deg: float) -> list[Float[np.ndarray, "3"]]:
    """Return the catheter's axis, turned to all sides, that nearest to the route's direction first."""
    axis, sides_deg = route.anatomy.insertion.direction, 360.0 * np.arange(_AZIMUTHS) / _AZIMUTHS
    turned = [turned_axis(axis, tilt_deg, side_deg) for side_deg in sides_deg]
    onwards = route.position(_CATHETER_MM) - route.position(0.0)
    return sorted(turned, key=lambda axis: -float(axis @ onwards))


def _why(device: Wire, places: tuple[Fork, ...], counts: list[Count], best: int) -> str:
    """Return why a tip was taken of those that were tried, the wire's own or the only one first."""
    shape = f"the tip ({np.degrees(device.tip_bend_rad):.3g}° over {device.tip_bend_length_mm:.3g} mm)"
    if not places:
        return f"{shape}: the route has no fork"
    hardest = int(np.argmin(counts[best]))
    others = "" if len(counts) == 1 else f", as from the other {len(counts) - 1} tips tried"
    if not counts[best][hardest]:
        return f"{shape} enters {_into(places[hardest])} from none of {ROTATIONS} rotations{others}"
    why = f"{shape} enters {_into(places[hardest])} from {counts[best][hardest]} of {ROTATIONS} rotations"
    return f"{why}; as delivered from {int(counts[0][hardest]) or 'none'}" if best else why


def _into(fork: Fork) -> str:
    """Return what a fork leads into: a section's number alone would be taken for a count."""
    return f"section {fork.section}" if fork.section.isdigit() else fork.section


SPARE_SHARE = 0.9
"""Share of the force limit that a path is followed under: what is uncertain takes the rest."""


def describe_halt(halt: Halt, at_mm: float, route: Route, navigation: Navigation) -> str:
    """Return where and why no path goes on, and what may help, as a part of a sentence.

    `halt` is what a straight push met, which came to `at_mm` along the route.
    """
    device = navigation.device
    if halt == "late":
        return f"the {navigation.seconds:g} s are over; give more seconds"
    if navigation.catheters:
        return f"no manoeuvre leads past {at_mm:.0f} mm; give another catheter, wire or tip"
    reach = 0.5 * device.diameter_mm + BEYOND_MM + ENTERED_MM
    at = (each for each in forks(route, device) if abs(at_mm - each.abscissa) <= 0.5 * each.width_mm + reach)
    near = next(at, None)
    where = f"at {near}" if near else f"at {at_mm:.0f} mm, where no branch leaves,"
    if halt == "pressed":
        limit = (
            f"{where} it cannot go on with less than {SPARE_SHARE:.0%} of the limit of {navigation.force_limit_n:.2g} N"
        )
        return f"{limit} on the wall; give a larger force_limit_n or a softer wire"
    if halt == "slipped":
        return (
            f"{where} the drive slips, which pushes {device.name} with no more than {device.push_limit_n:g} N; "
            "give a wire of less friction or a drive of a larger push_limit_n"
        )
    if near:
        tip = f"{where}, which its tip of {tip_name(device)} does not enter"
        return f"{tip}; give another tip (--tip), or let the catheter be turned (--catheter-tilt-deg)"
    folds = f"{where} the wire is pushed and its tip does not come forward: it folds in a bend"
    return f"{folds}; give another tip (--tip) or a stiffer wire"
