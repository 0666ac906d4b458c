"""What a wire's tip can reach at the forks of a route: in closed form, and tested in the rod core.

A tip that is bent by θ over a length L stands L(1 − cos θ)/θ beside the wire behind it: its *lateral reach*. A fork's
*free width* is what the lumen leaves the wire's axis to move in, 2r − d. A tip whose reach is as large enters every
branch of the fork, on whichever side the wire lies. One with less may, if the wire lies well: `rotations_that_enter`
asks the rod core, by pushing the wire on from the fork with its tip turned to all sides.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Int

from endopilot.control.drive import Driver, Goal, SearchConfig
from endopilot.control.repertoire import Repertoire, Row, stand_off
from endopilot.control.trials import Trials
from endopilot.devices.device import Wire
from endopilot.devices.drive_limits import DriveLimits
from endopilot.simulation.config import PRESETS
from endopilot.simulation.simulator import Simulator
from endopilot.tasks.navigation import DECISION_PERIOD_S, Navigation
from endopilot.tasks.route import ENTERED_MM, Route

ROTATIONS = 24
"""Rotations of the wire that are tried at a fork, evenly over a full turn."""
_MORE_PERIODS = 8
"""Decision periods that a wire has for its turn and its detours, beside half as many again as the straight advance."""


@dataclass(frozen=True)
class Fork:
    """A place of a route where branches part.

    Attributes:
        abscissa: Δtip of the branching point, mm.
        branch: index of the branch that the route takes.
        section: name of the section that this branch begins with.
        width_mm: free width of the lumen there for the wire's axis, 2r − d, mm.
    """

    abscissa: float
    branch: int
    section: str
    width_mm: float

    def __str__(self) -> str:
        return f"the fork into section {self.section} (branch {self.branch}) at {self.abscissa:.1f} mm"


def forks(route: Route, device: Wire) -> tuple[Fork, ...]:
    """Return the forks of a route, the nearest to the ostium first."""
    tree = route.anatomy.tree
    found = []
    for abscissa, branch in zip(route.junctions.tolist(), route.branches[1:], strict=False):
        own = tree.branches[branch].section
        radius = float(route.radius(np.array([abscissa]))[0])
        section = tree.section_names[int(own[min(1, len(own) - 1)])]
        found.append(Fork(abscissa, branch, section, 2 * radius - device.diameter_mm))
    return tuple(found)


def rotations_that_enter(navigation: Navigation, device: Wire) -> Int[np.ndarray, "forks"]:
    """Return with how many of `ROTATIONS` rotations a wire enters the right branch at each fork of the route.

    A wire is brought up to each fork of the route, turned to all sides and pushed on straight. It goes on with the
    rotation in the middle of those that enter. Behind a fork that no rotation enters, or that the wire does not come up
    to, the numbers are 0. A rotation that presses on the wall with more than the navigation's force limit does not
    count. The navigation's own device does not matter.
    """
    end = float(navigation.anatomy.tree.branches[navigation.target.branch].centerline.abscissa[-1])
    route = Route.to(navigation.anatomy, replace(navigation.target, abscissa=end))  # a fork may lie next to the target
    simulator = Simulator(navigation.anatomy, device, worlds=ROTATIONS, config=PRESETS["fast"])
    simulator.reset(
        inserted_length=np.full(ROTATIONS, navigation.start_inserted_length_mm),
        rotation=np.full(ROTATIONS, navigation.start_rotation_rad),
    )
    limits, config, row = [DriveLimits.of(device, navigation.anatomy)], SearchConfig(), Row(turns=ROTATIONS)

    def go_on(waypoint: float) -> int:
        """Turn and push up to a waypoint, put all where the middle of those is that pass it; return how many do."""
        here, trials = float(route.progress(simulator.project()[:, 0])[0]), Trials(simulator, limits)
        straight = int(1.5 * max(waypoint - here, 0.0) / (config.speed_mm_s * DECISION_PERIOD_S))
        motions = row.motions(waypoint, 0.0, config, 1, np.random.default_rng(0))
        goal, limit_n = Goal(navigation, route, waypoint), navigation.force_limit_n
        given_up = Repertoire.of(navigation, route, config, here).limits(row, route, here, waypoint, limit_n)
        outcome = Driver(trials, motions, goal, given_up, config).run(straight + _MORE_PERIODS)
        trials.copy_trials(np.full(ROTATIONS, np.argmin(outcome.expected_cost(limit_n))))
        return int((outcome.share == 1.0).sum())

    places = forks(Route.to(navigation.anatomy, navigation.target), device)
    count = np.zeros(len(places), dtype=int)
    for index, fork in enumerate(places):
        before = fork.abscissa - stand_off(route, fork.abscissa, config.lead_mm)
        if before > route.progress(simulator.project()[:, 0])[0] + 1.0 and not go_on(before - ENTERED_MM):
            return count
        count[index] = go_on(float(route.waypoints[index]))
        if not count[index]:
            return count
    return count
