"""The places of a route that a course passes one after another: `places_of`, `next_place`."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from endopilot.tasks.route import ENTERED_MM, Route

_STRETCH_MM, _LONG_STRETCH_MM = 20.0, 40.0
"""A wire in a catheter passes the route in stretches of this length at most, mm; of the latter where the two move
together, since each stretch ends with the wire at rest until its catheter has come."""


def places_of(route: Route, begun: float, *, alone: bool, together: bool) -> list[float]:
    """Return the places that are passed, mm: the route's waypoints, and with a catheter others between.

    Args:
        route: to the target.
        begun: how far along it the devices have come, mm.
        alone: whether there is no catheter.
        together: whether wire and catheter move together.
    """
    if alone:
        return route.waypoints.tolist()
    longest = _LONG_STRETCH_MM if together else _STRETCH_MM
    places: list[float] = []
    for goal in [*route.waypoints[:-1][route.waypoints[:-1] > begun].tolist(), route.target.abscissa]:
        begin = places[-1] if places else begun
        count = max(1, int(np.ceil((goal - begin) / longest)))
        places += [begin + (goal - begin) * (k + 1) / count for k in range(count - 1)] + [goal]
    return places


def next_place(places: Sequence[float], here: float, *, alone: bool) -> float:
    """Return the first place that devices which have come to an abscissa, mm, have not passed; else the last."""
    beyond = ENTERED_MM if alone else 0.0
    return next((place for place in places if place + beyond > here), places[-1])
