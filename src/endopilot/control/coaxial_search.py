"""Search for a course of a wire in a catheter, fork by fork: `CoaxialSearch`.

Up to the next fork and past it, copies of wire and catheter are pushed straight on, each with another lead of the wire
before the catheter follows. Where none passes, more copies try a grid of manoeuvres at the fork: the catheter is placed
before, at or beyond it, with the wire's tip in it or a little ahead; both are turned, to all sides; the wire is pushed
on, and the catheter follows. Of the places at which most rotations pass, the rotation in the middle of those is taken:
it bears errors best.
"""

from __future__ import annotations

from itertools import product

import numpy as np
from jaxtyping import Bool, Float, Int

from endopilot.control.coaxial_copies import CoaxialCourse, CoaxialSearchConfig, Copies, Kept
from endopilot.control.halt import SPARE_SHARE
from endopilot.control.route import Route
from endopilot.control.sweep import TURN_PERIODS, middle
from endopilot.simulation.simulator import Simulator
from endopilot.tasks.navigation import DECISION_PERIOD_S, Navigation
from endopilot.types import TipProjection

_ALL_ALONG_MM = 1000.0
_LEADS_MM = (_ALL_ALONG_MM, 40.0, 20.0, 10.0, 5.0, 2.0)
_LEADS_SHAPED_MM = (*_LEADS_MM, -5.0, -30.0)
"""How far a wire that is pushed straight on leads before its catheter follows, mm; the first leads all along. Where
it is negative the wire's tip stays so deep in the catheter until the catheter's tip is past: its own shape then shows.
"""
_WITHDRAWN_MM = -10.0
"""A wire that a manoeuvre places deeper in its catheter than this stays there; else it is pushed out first, mm."""
_PLACE_RADII, _PLACE_MM = 1.4, 4.0
"""The catheter is placed this many lumen radii, and this far at least, before and beyond a fork."""
_AT_MM, _REST_MM = 1.0, 0.1
"""A catheter this near to its place is there, mm; what is this near to its goal rests."""
_AHEAD_MM = 10.0
"""A wire that is not past its waypoint is pushed as though it had this far to go, mm."""
_OFF_MM, _OFF_RADII = 5.0, 2.0
"""A tip that is this far in a wrong branch, and as many radii of the route's lumen, does not come back by itself."""
_STRETCH_MM = 20.0
"""The route is passed in stretches of this length at most, mm."""
_PLACES = [*product((-1.0, 0.0, 1.0), (-3.0, 6.0), (0.0,))]
_SHAPED = [
    [*product((-1.0, 0.0, 1.0), (-15.0, -40.0), (0.0,))],
    [*product((1.0, 2.0, 3.0), (-3.0, 6.0), (-1.5,))],
    [*product((-0.5, -0.25, 0.5), (-15.0, 6.0), (0.0,))],
]
_UNSHAPED = [[*product((-4.0, -8.0), (-3.0, 6.0, 15.0), (0.0,))]]
"""The grids of manoeuvres: the first, then those of catheters with a shape of their own, or those of others. Each tells
where the catheter is placed, in steps before or beyond the fork; the wire's lead, mm, negative where its tip is in the
catheter; and by how many steps both are pulled back once turned."""
_SLACK_MM = 40.0
"""A wire that was pushed this far and did not come forward folds, mm."""
_CANDIDATES = 3
"""Manoeuvres that are driven again alone before a fork counts as refusing."""


class CoaxialSearch:
    """Searches courses for a navigation of wire and catheter.

    Attributes:
        config: settings.
        route: to the target.
        halted_mm: abscissa of the waypoint that the last search found no course past, mm; None if it arrived.
    """

    def __init__(
        self, navigation: Navigation, config: CoaxialSearchConfig | None = None, *, sharing: Simulator | None = None
    ) -> None:
        """Lay wire and catheter out.

        Args:
            navigation: what is to be done.
            config: settings.
            sharing: a simulator that has prepared the same anatomy, whose lumen is then not prepared again.
        """
        self._navigation, self.config = navigation, config or CoaxialSearchConfig()
        self.route = Route.to(navigation.anatomy, navigation.target)
        shaped = bool(navigation.catheters[0].shape)
        self._leads = np.array(_LEADS_SHAPED_MM if shaped else _LEADS_MM)
        self._grids = [_PLACES, *(_SHAPED if shaped else _UNSHAPED)]
        worlds = (1, len(self._leads), len(_PLACES) * self.config.turns)
        self._one, self._few, self._many = (
            Copies(navigation, self.route, self.config, count, sharing) for count in worlds
        )
        self.halted_mm: float | None = None

    def find(self, start: Simulator, world: int = 0) -> CoaxialCourse:
        """Search a course from the state of a world of a simulator that has the settings of this search."""
        one, route = self._one, self.route
        one.simulator.copy_worlds([world], of=start)
        one.begin()
        self.halted_mm = None
        begun = float(route.progress(one.foremost())[0])
        settled: list[int] = []
        for waypoint in _stretches(begun, route):
            if not self._go_on(waypoint):
                self.halted_mm = waypoint
                break
            settled.append(len(one.made) - 1)
        abscissa, off = (np.array([tip[k] for tip in one.tip]).reshape(-1) for k in range(2))
        return CoaxialCourse(
            control=np.array(one.made).reshape(-1, 2, 2),
            proximal=np.array(one.proximal).reshape(-1, 2, 2),
            abscissa=abscissa,
            off_route=off,
            settled=np.isin(np.arange(len(one.made)), settled),
            peak_n=float(one.peak.max()),
            reached=bool(self._navigation.reached(one.simulator.project())[0]),
        )

    def _go_on(self, waypoint: float) -> bool:
        """Go past a place, straight or by a manoeuvre; return whether any passes within the force limit."""
        for share, grids in ((SPARE_SHARE, self._grids), (1.0, self._grids[:1])):
            for copies in (self._one, self._few, self._many):
                copies.most_n = share * self._navigation.force_limit_n
            self._pressed = False
            if self._straight(waypoint) or any(self._manoeuvre(waypoint, grid) for grid in grids):
                return True
            if not self._pressed:
                break
        return False

    def _kept(self) -> Kept:
        return Kept(self._one.simulator.state, self._one.peak.copy(), len(self._one.made))

    def _restore(self, kept: Kept) -> None:
        """Bring the course back to where it was."""
        one = self._one
        one.simulator.set_state(kept.state)
        one.peak, one.failed[:] = kept.peak.copy(), False
        for log in (one.made, one.proximal, one.tip):
            del log[kept.periods :]

    def _straight(self, waypoint: float) -> bool:
        """Push copies straight on past a waypoint, each with its own lead; follow the gentlest that passes."""
        few = self._copied(self._few)
        passed = self._push(few, waypoint, self._leads)
        self._farthest = float(few.farthest.max())
        order = np.argsort(np.where(passed, few.peak, np.inf), kind="stable")
        return self._repeat(few, order[: min(int(passed.sum()), _CANDIDATES)], waypoint)

    def _manoeuvre(self, waypoint: float, grid: list[tuple[float, float, float]]) -> bool:
        """Try a grid before a waypoint, and follow the best of it; return whether any passes."""
        many, turns = self._copied(self._many), self.config.turns
        where, lead, pull = (np.repeat([place[k] for place in grid], turns) for k in range(3))
        side = np.tile(2 * np.pi * (np.arange(turns) / turns - 0.5), len(grid))
        obstacle, step = self._obstacle(waypoint)
        self._place(many, np.maximum(obstacle + where * step, 0.0), lead)
        for _ in range(TURN_PERIODS):
            many.drive(0.0, 0.0, side / (TURN_PERIODS * DECISION_PERIOD_S))
        self._pull(many, -pull * step)
        leads = np.where(lead < _WITHDRAWN_MM, lead, _ALL_ALONG_MM)
        rows = self._push(many, waypoint, leads).reshape(len(grid), turns)
        best = np.argsort(-rows.sum(axis=1), kind="stable")[:_CANDIDATES]
        chosen = np.array([place * turns + middle(rows[place]) for place in best if rows[place].any()], dtype=int)
        return self._repeat(many, chosen, waypoint)

    def _obstacle(self, waypoint: float) -> tuple[float, float]:
        """Return what lies in the way of a place, and the steps in which devices are placed about it, mm.

        That is the fork before the place, unless it is well behind, or where the straight push came to.
        """
        now, junctions = float(self.route.progress(self._one.foremost())[0]), self.route.junctions
        near = float(junctions[junctions < waypoint].max(initial=0.0))
        width = 2 * float(self.route.radius(np.array([near]))[0])
        obstacle = min(near, self._farthest) if near > max(now - width, 0.0) else self._farthest
        radius = float(self.route.radius(np.array([obstacle]))[0])
        return obstacle, max(_PLACE_RADII * radius, _PLACE_MM)

    def _pull(self, copies: Copies, length: Float[np.ndarray, "worlds"]) -> None:
        """Pull wires and catheters back, mm."""
        period_mm = 2 * self.config.speed_mm_s * DECISION_PERIOD_S
        for k in range(int(np.ceil(length.max() / period_mm))):
            speed = -np.clip(length - k * period_mm, 0.0, period_mm) / DECISION_PERIOD_S
            copies.drive(speed, speed)

    def _copied(self, copies: Copies) -> Copies:
        """Return copies that are put where the course has come to."""
        copies.simulator.copy_worlds(np.zeros(copies.simulator.worlds, dtype=int), of=self._one.simulator)
        copies.begin()
        return copies

    def _repeat(self, copies: Copies, chosen: Int[np.ndarray, "n"], waypoint: float) -> bool:
        """Add to the course what the first of some copies did that passes again without its pauses."""
        one, kept = self._one, self._kept()
        self._pressed |= bool((copies.peak > copies.most_n).any())
        for place in chosen:
            for controls in copies.made:
                (wire, turn), (catheter, _) = controls[place]
                if wire or turn or catheter:
                    one.drive(wire, catheter, turn)
            if self._there(one, waypoint)[0]:
                return True
            self._restore(kept)
        return False

    def _place(self, copies: Copies, wanted: Float[np.ndarray, "worlds"], lead: Float[np.ndarray, "worlds"]) -> None:
        """Bring the catheters' tips to some abscissae, mm, and the wires so much deeper than the catheters, mm."""
        speed = 2 * self.config.speed_mm_s
        for _ in range(round(self.config.longest_s / DECISION_PERIOD_S)):
            error = wanted - copies.simulator.project().abscissa[:, 1]
            moving = np.abs(error) > _AT_MM
            catheter = np.where(moving, np.clip(error / (2 * DECISION_PERIOD_S), -speed, speed), 0.0)
            gap = np.maximum(copies.catheter + catheter * DECISION_PERIOD_S + lead, 0.0) - copies.wire
            gap = np.where(np.abs(gap) > _REST_MM, gap, 0.0)
            if not ((moving | (gap != 0)) & ~copies.failed).any():
                return
            copies.drive(np.clip(gap / DECISION_PERIOD_S, -2 * speed, 2 * speed), catheter)

    def _push(self, copies: Copies, waypoint: float, lead: Float[np.ndarray, "worlds"]) -> Bool[np.ndarray, "worlds"]:
        """Push wires past a waypoint, and let their catheters follow; return which arrive.

        Args:
            copies: wire and catheter.
            waypoint: that is to be passed, mm.
            lead: how far the wire leads before the catheter follows, mm; see `_LEADS_MM`.
        """
        route, speed = self.route, self.config.speed_mm_s
        tip = copies.foremost()
        far = waypoint - float(route.progress(tip).min())
        off_mm = _OFF_MM + _OFF_RADII * float(route.radius(np.array([waypoint - far, waypoint])).max())
        follows, together = np.zeros(len(lead), dtype=bool), lead < 0
        best, at_best = np.full(len(lead), -np.inf), np.maximum(copies.wire, copies.catheter)
        for _ in range(round((2 * max(far, 0.0) / speed + self.config.longest_s) / DECISION_PERIOD_S)):
            progress, inserted = route.progress(tip), np.maximum(copies.wire, copies.catheter)
            at_best = np.where(progress > best + _REST_MM, inserted, at_best)
            best = np.maximum(best, progress)
            copies.failed |= (route.off_route(tip) > off_mm) | (inserted - at_best > _SLACK_MM)
            wire, catheter = self._left(copies, tip, waypoint, np.minimum(lead, self.config.behind_mm))
            there = np.abs(wire) <= _REST_MM
            behind = catheter > _REST_MM
            follows = behind & (follows | there | (copies.wire - copies.catheter >= lead))
            wire = np.where(there | follows, 0.0, np.clip(wire / DECISION_PERIOD_S, -1.0, speed))
            catheter = np.where(follows, np.clip(catheter / DECISION_PERIOD_S, 0.0, speed), 0.0)
            if together.any():
                ahead, beside = self._together(copies, tip, waypoint, lead)
                wire, catheter = np.where(together, ahead, wire), np.where(together, beside, catheter)
            if not (((wire != 0) | (catheter != 0)) & ~copies.failed).any():
                break
            copies.drive(wire, catheter)
            tip = copies.foremost()
        copies.farthest = np.maximum(best, route.progress(tip))
        return self._there(copies, waypoint)

    def _left(
        self, copies: Copies, tip: TipProjection, waypoint: float, behind: Float[np.ndarray, "worlds"]
    ) -> tuple[Float[np.ndarray, "worlds"], Float[np.ndarray, "worlds"]]:
        """Return how far wires and catheters that follow them have still to go for a waypoint, mm.

        Beyond a target to which the catheter's tip is to go, the wire goes as far as the catheter stays behind it
        elsewhere: the less, the fewer of its stiffer parts lie in the bends behind.
        """
        route = self.route
        if waypoint < route.target.abscissa:
            wire = np.where(self._passed(tip, waypoint), 0.0, _AHEAD_MM)
            return wire, copies.wire - behind - copies.catheter
        if not self._navigation.arriving:
            return waypoint - route.progress(tip), copies.wire - behind - copies.catheter
        end = float(self._navigation.anatomy.tree.branches[route.target.branch].centerline.abscissa[-1])
        goal = np.clip(waypoint + behind, waypoint, max(end - _REST_MM, waypoint))
        left = waypoint - copies.simulator.project().abscissa[:, 1]
        return goal - route.progress(tip), np.minimum(left, copies.wire - copies.catheter)

    def _together(
        self, copies: Copies, tip: TipProjection, waypoint: float, lead: Float[np.ndarray, "worlds"]
    ) -> tuple[Float[np.ndarray, "worlds"], Float[np.ndarray, "worlds"]]:
        """Return the speeds, mm/s, of wires that stay in catheters until these are past a waypoint, and of these."""
        speed = self.config.speed_mm_s
        left = (
            waypoint - self.route.progress(tip) if waypoint >= self.route.target.abscissa else np.full(len(lead), 10.0)
        )
        past = self._passed(tip, waypoint) if waypoint < self.route.target.abscissa else np.abs(left) <= _AT_MM
        catheter = np.where(past, 0.0, np.clip(left / DECISION_PERIOD_S, -1.0, speed))
        gap = np.maximum(copies.catheter + np.where(past, 0.0, lead), 0.0) - copies.wire
        wire = np.clip(gap / DECISION_PERIOD_S, -2 * speed, speed)
        withdrawn = gap >= -_AT_MM  # the wire comes out of the way first
        return np.where(np.abs(gap) > _REST_MM, wire, 0.0), np.where(withdrawn, catheter, 0.0)

    def _passed(self, tip: TipProjection, waypoint: float) -> Bool[np.ndarray, "worlds"]:
        """Return which tips are past a place of the route before the target, within the branch if it is a waypoint."""
        if waypoint in self.route.waypoints:
            return self.route.passed(tip, waypoint)
        return self.route.progress(tip) >= waypoint

    def _there(self, copies: Copies, waypoint: float) -> Bool[np.ndarray, "worlds"]:
        """Return which copies are past a place, or at the target, and never pressed too hard."""
        if waypoint >= self.route.target.abscissa:
            return self._navigation.reached(copies.simulator.project()) & ~copies.failed
        tip = copies.foremost()
        if waypoint in self.route.waypoints:
            return (self.route.off_route(tip) == 0) & (tip.abscissa >= waypoint) & ~copies.failed
        return (self.route.progress(tip) >= waypoint) & ~copies.failed


def _stretches(begun: float, route: Route) -> list[float]:
    """Return the places that are passed one after another, mm: waypoints, and others where these lie far apart."""
    ahead = [*route.waypoints[:-1][route.waypoints[:-1] > begun].tolist(), route.target.abscissa]
    places: list[float] = []
    for goal in ahead:
        begin = places[-1] if places else begun
        count = max(1, int(np.ceil((goal - begin) / _STRETCH_MM)))
        places += [begin + (goal - begin) * (k + 1) / count for k in range(count - 1)] + [goal]
    return places
