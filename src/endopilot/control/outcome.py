"""What came of a navigation in a patient, in one line: `tell_outcome`."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from endopilot.anatomy.projection import safety_ratio
from endopilot.control.navigate import PatientNavigation, SetUp
from endopilot.robot.robot import CYCLE_S
from endopilot.simulation.trajectory import Trajectory
from endopilot.tasks.navigation import DECISION_PERIOD_S, SUCCESS_MM
from endopilot.tasks.route import Route
from endopilot.tasks.targets import section_at

_TIGHT_RATIO = 0.8
"""A wire that fills this share of a lumen is held up by its walls."""
_AT_FORK_MM = 4.0
"""A tip that came this near to a fork, and the length of its bend, was held up by it, mm."""
_STILL_S, _STILL_MM = 5.0, 1.0
"""A tip that comes no farther than this in this time has stopped, s and mm."""


def name_target(set_up: SetUp) -> str:
    """Return the target in words."""
    navigation = set_up.navigation
    target = navigation.target
    section = section_at(navigation.anatomy.tree, target.branch, target.abscissa)
    place = f"section {section} at {target.abscissa:.1f} mm"
    if set_up.snapped_mm is None:
        return place
    return f"{place}, {set_up.snapped_mm:.1f} mm from the given point"


def tell_outcome(found: PatientNavigation) -> str:
    """Return one line: reached, or why not."""
    record, navigation = found.record, found.set_up.navigation
    exposures = f"{record.exposures} exposure{'' if record.exposures == 1 else 's'}"
    force = f"at most {record.peak_force_n:.3f} N on the wall (limit {navigation.force_limit_n:g} N)"
    if record.success:
        unsafe = "" if record.safe else ", but too hard"
        return f"reached {name_target(found.set_up)} in {record.seconds:g} s{unsafe}: {exposures}, {force}"
    return f"not reached: {why_not(found)}; {exposures}, {force}"


def why_not(found: PatientNavigation) -> str:
    """Return where a navigation that did not reach its target ended, and what held it up."""
    record, navigation = found.record, found.set_up.navigation
    if record.reason == "invalid":
        return f"the simulation failed after {record.seconds:g} s"
    route = Route.to(navigation.anatomy, navigation.target)
    tree, tip = navigation.anatomy.tree, record.tip[:, navigation.arriving]
    branch, at = int(tip.branch[-1]), round(float(tip.abscissa[-1]), 1) + 0.0  # no "-0.0"
    whose = "the catheter's tip" if navigation.arriving else "the tip"
    where = f"after {record.seconds:g} s {whose} is in section {section_at(tree, branch, at)} at {at:.1f} mm"
    departs = route.leaves_at[branch]
    if np.isfinite(departs):
        where += f", off the route, which it left at the fork at {departs:.1f} mm"
    else:
        where += f", {navigation.target.abscissa - at:.1f} mm before the target"
    if record.gives_up:
        proposal = f"; in a search {found.proposal} reaches it" if found.proposal else ""
        return f"{where}; the policy gave up: {record.gives_up}{proposal}"
    return f"{where}: {_held_up(found, route)}"


def _held_up(found: PatientNavigation, route: Route) -> str:
    """Return what is likeliest to have held up the device that was to arrive, or the wire ahead of it."""
    record, navigation = found.record, found.set_up.navigation
    if 2 * record.faults >= len(record.time_s):
        return f"{record.faults} decisions were not finite, or beyond the drive's limits"
    wire, device, tip = navigation.device, navigation.devices[navigation.arriving], record.tip[:, navigation.arriving]
    refused, wire_came = found.set_up.choice.refused, float(route.progress(record.tip[:, 0]).max())
    if refused is not None and abs(wire_came - refused.abscissa) <= _AT_FORK_MM + wire.tip_bend_length_mm:
        return f"no rotation of the tip enters {refused}"
    narrow = _narrowest(route, float(route.progress(tip).max()), device.tip_radius_mm)
    if narrow is not None:
        at, width = narrow
        what = "catheter" if navigation.arriving else "wire"
        return f"at {at:.1f} mm the lumen is {width:.2f} mm wide, and the {what} {device.diameter_mm:g} mm"
    for k, (each, slip) in enumerate(zip(navigation.devices, _slips(found.record.trajectory), strict=True)):
        slipped, caught = int((slip[:, 0] > 0).sum()), "catheter" if k else "wire"
        if slipped:
            return f"the {caught} is caught; the drive slipped at its limit of {each.push_limit_n:g} N {slipped} times"
    if route.off_route(tip)[-1] > 0:
        return "it took another branch"
    still = min(round(_STILL_S / DECISION_PERIOD_S), len(record.time_s) - 1)
    progress = [route.progress(record.tip[:, k]) for k in range(navigation.arriving + 1)]
    if any(each[-1] - each[-1 - still] > _STILL_MM for each in progress):
        return "it was still on its course; give more --seconds"
    if found.plans is not None and found.plans > 1:
        return f"none of {found.plans} searched courses led on"
    return "the tip has stopped"


def _narrowest(route: Route, came_mm: float, wire_radius_mm: float) -> tuple[float, float] | None:
    """Return where ahead of the tip a wire fills the lumen, mm, and how wide it is there, mm; None if nowhere."""
    line = route.line
    ahead = (line.abscissa >= came_mm - 2 * SUCCESS_MM) & (line.abscissa <= route.target.abscissa)
    if not ahead.any():
        return None
    at = int(np.flatnonzero(ahead)[np.argmin(line.radius[ahead])])
    if wire_radius_mm < _TIGHT_RATIO * line.radius[at]:
        return None
    return float(line.abscissa[at]), 2 * float(line.radius[at])


def decision_times(found: PatientNavigation) -> dict[str, float]:
    """Return how long decisions took, wall time, s: the median, the 99th percentile and the longest."""
    median, most, longest = np.quantile(found.decision_s, [0.5, 0.99, 1.0]).tolist()
    return {"median": round(median, 3), "p99": round(most, 3), "longest": round(longest, 3)}


def worst_ratio(found: PatientNavigation) -> float:
    """Return the largest safety ratio γ/(r − r_w) of the tip."""
    tip, radius = found.record.tip[:, 0], found.set_up.navigation.device.tip_radius_mm
    return float(safety_ratio(tip.offset, tip.radius, radius).max())


def slipped_s(found: PatientNavigation) -> float:
    """Return for how long a drive slipped, s."""
    cycles = found.record.cycles
    slip = np.zeros((0, 1)) if cycles is None else np.hstack(_slips(cycles))
    return float((slip != 0).any(axis=1).sum()) * CYCLE_S


def _slips(rollout: Trajectory) -> list[Float[np.ndarray, "samples 2"]]:
    """Return advance (mm) and rotation (rad) that the drive of each device slipped over in each period."""
    return list(np.moveaxis(np.stack([rollout.slip[0], rollout.rotation_slip[0]], axis=-1), 1, 0))
