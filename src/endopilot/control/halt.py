"""Why a search ended before the target, in words."""

from __future__ import annotations

from endopilot.control.push import Halt
from endopilot.control.reach import Fork, forks
from endopilot.control.set_up import tip_name
from endopilot.tasks.navigation import Navigation
from endopilot.tasks.route import BEYOND_MM, Route

SPARE_SHARE = 0.9
"""Share of the force limit that a path is followed under: what is uncertain takes the rest."""


def near_fork(at_mm: float, route: Route, navigation: Navigation) -> Fork | None:
    """Return the fork of the route that a tip which came to an abscissa (mm) is at, or None."""
    device = navigation.device
    for fork in forks(route, device):
        radius = 0.5 * (fork.width_mm + device.diameter_mm)
        if abs(at_mm - fork.abscissa) <= radius + BEYOND_MM + 1.0:
            return fork
    return None


def describe_halt(halt: Halt, at_mm: float, route: Route, navigation: Navigation) -> str:
    """Return where and why no path goes on, and what may help, as a part of a sentence.

    Args:
        halt: what a straight push met.
        at_mm: how far along the route it came, mm.
        route: to the target.
        navigation: with the wire and the limits.
    """
    device = navigation.device
    if halt == "late":
        return f"the {navigation.seconds:g} s are over; give more seconds"
    if navigation.catheters:
        return f"no manoeuvre leads past {at_mm:.0f} mm; give another catheter, wire or tip"
    near = near_fork(at_mm, route, navigation)
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
