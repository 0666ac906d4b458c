"""What a search finds, `Course`, and the places of a route that it passes: `places_of`, `next_place`."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float

from endopilot.tasks.route import ENTERED_MM, Route
from endopilot.types import TipProjection

Controls = Float[np.ndarray, "periods devices 2"]
"""Translation (mm/s) and rotation (rad/s) of each device in each decision period."""


@dataclass(frozen=True, eq=False)
class Course:
    """Controls, and what the wires that they were found with do under them.

    Attributes:
        control: (mm/s, rad/s) of each device in each decision period.
        proximal: inserted length (mm) and rotation (rad) of each device at the end of each period, as encoders tell.
        tip: of the wires then, a column a wire; those that the course leaves behind are not among them.
        force: largest wall force on a node, N, of all wires.
        checked: whether a wire that is elsewhere then has left the course.
        exposed: whether X-ray is to show where a manoeuvre has led.
        reached: whether they end at the target, by weight: 1 if all do.
    """

    control: Controls
    proximal: Controls
    tip: TipProjection
    force: Float[np.ndarray, "periods wires"]
    checked: Bool[np.ndarray, "periods"]
    exposed: Bool[np.ndarray, "periods"]
    reached: float


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
