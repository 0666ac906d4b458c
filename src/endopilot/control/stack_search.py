"""Search for a course of a wire in a catheter, fork by fork: `StackSearch`.

Up to the next fork and past it, copies of wire and catheter are pushed straight on, each with another lead of the wire
before the catheter follows. Where none passes, more copies try a grid of manoeuvres at the fork: the catheter is placed
before, at or beyond it, with the wire's tip in it or a little ahead; both are turned, to all sides; the wire is pushed
on, and the catheter follows. Of the places at which most rotations pass, the rotation in the middle of those is taken:
it bears errors best.
"""

from __future__ import annotations

from dataclasses import replace
from itertools import product

import numpy as np
from jaxtyping import Bool, Float, Int

from endopilot.belief.belief import Belief
from endopilot.control.course import Copies, Course
from endopilot.control.halt import SPARE_SHARE
from endopilot.control.search import SearchConfig
from endopilot.control.sweep import TURN_PERIODS, middle
from endopilot.devices.device import Wire
from endopilot.devices.drive_limits import SPARE_MM, DriveLimits
from endopilot.errors import InputError
from endopilot.progress import Advance
from endopilot.simulation.simulator import Simulator
from endopilot.simulation.state import Step
from endopilot.tasks.navigation import DECISION_PERIOD_S, Navigation
from endopilot.tasks.route import Route
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


class Stacks(Copies):
    """Copies of a wire in a catheter, and which of them stand still.

    Attributes:
        most_n: force on the wall that is too hard, N.
        failed: which have left the route, pressed too hard or folded.
        farthest: how far along the route each wire came in the last push, mm.
    """

    def __init__(self, navigation: Navigation, wires: list[Wire], like: Simulator) -> None:
        """Lay them out; the arguments are those of `Copies`."""
        super().__init__(navigation, wires, like)
        limits = [DriveLimits.of(device, navigation.anatomy) for device in navigation.devices]
        deepest = limits[0].travel_mm[1] - SPARE_MM / 10
        self._limits = [replace(each, travel_mm=(0.0, deepest)) for each in limits]
        self.most_n = SPARE_SHARE * navigation.force_limit_n
        self.failed, self.farthest = np.zeros(len(wires), dtype=bool), np.zeros(len(wires))

    def put(self, source: Int[np.ndarray, "worlds"], of: Simulator) -> None:
        """Put each where a world of a simulator of equal stacks is, and forget what it has done."""
        super().put(source, of)
        self.failed, self.farthest = np.zeros(len(source), dtype=bool), np.zeros(len(source))

    @property
    def wire(self) -> Float[np.ndarray, "worlds"]:
        """Inserted lengths of the wires, mm."""
        return self.simulator.inserted_length[:, 0]

    @property
    def catheter(self) -> Float[np.ndarray, "worlds"]:
        """Inserted lengths of the catheters, mm."""
        return self.simulator.inserted_length[:, 1]

    def foremost(self) -> TipProjection:
        """Return the foremost tips, those of the wires or of the catheters."""
        worlds = np.arange(self.simulator.worlds)
        return self.simulator.project()[worlds, np.where(self.wire >= self.catheter, 0, 1)]

    def move(self, wire: np.ndarray | float, catheter: np.ndarray | float, turn: np.ndarray | float = 0.0) -> Step:
        """Drive those that go on for a decision period, wire and catheter at mm/s, both turned at rad/s."""
        control = np.zeros((self.simulator.worlds, 2, 2))
        control[:, 0, 0], control[:, 1, 0] = wire, catheter
        control[..., 1] = np.broadcast_to(turn, len(control))[:, None]
        control[self.failed] = 0.0
        for k, inserted in enumerate((self.wire, self.catheter)):
            control[:, k] = self._limits[k].clip(control[:, k], inserted, DECISION_PERIOD_S)
        step = self.drive(control)
        self.failed |= self.peak > self.most_n
        return step


class StackSearch:
    """Searches courses for a navigation of wire and catheter.

    Attributes:
        halt: where and why the last search ended before the target, in words; empty if it arrived.
        draws: it draws nothing at random.
    """

    draws = False

    def __init__(self, navigation: Navigation, route: Route, belief: Belief, *, config: SearchConfig) -> None:
        """Lay wire and catheter out.

        Args:
            navigation: what is to be done.
            route: to its target.
            belief: whose wire of the middle stiffness and whose settings of the rod core are taken.
            config: settings of the search.

        Raises:
            InputError: there is more than one catheter.
        """
        catheter, *others = navigation.catheters
        if others:
            raise InputError(f"catheter: {len(navigation.catheters)}; the search drives one: give one")
        self._navigation, self.route, self.config = navigation, route, config
        shaped = bool(catheter.shape)
        self._leads = np.array(_LEADS_SHAPED_MM if shaped else _LEADS_MM)
        self._grids = [_PLACES, *(_SHAPED if shaped else _UNSHAPED)]
        wires = list(belief.wires.values())
        self._stiffness = len(wires) // 2
        self._one, self._few, self._many = (
            Stacks(navigation, [wires[self._stiffness]] * count, belief.simulator)
            for count in (1, len(self._leads), len(_PLACES) * config.manoeuvres.turns)
        )
        self.halt = ""

    def find(self, belief: Belief, *, seconds: float, first: bool = False, advance: Advance | None = None) -> Course:
        """Find a course from where the likeliest devices are, as `Search` has it; it may take longer than is left."""
        one, route = self._one, self.route
        source = int(belief.likeliest()[0][self._stiffness])
        one.put(np.array([source]), belief.simulator)
        begun = reported = float(route.progress(one.foremost())[0])
        settled: list[int] = []
        self.halt = ""
        for waypoint in [] if self._reached() else _stretches(begun, route):
            if not self._go_on(waypoint):
                self.halt = f"no manoeuvre leads past {waypoint:.0f} mm; give another catheter, wire or tip"
                break
            settled.append(one.log.periods - 1)
            if advance is not None:
                advance(max(waypoint - reported, 0.0))
                reported = max(waypoint, reported)
        ostium_mm = float(belief.parameters[source, 2])
        return one.log.course((1, one.devices), reached=float(self._reached()), ostium_mm=ostium_mm, settled=settled)

    def _reached(self) -> bool:
        return bool(self._navigation.reached(self._one.simulator.project())[0])

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

    def _straight(self, waypoint: float) -> bool:
        """Push copies straight on past a waypoint, each with its own lead; follow the gentlest that passes."""
        few = self._copied(self._few)
        passed = self._push(few, waypoint, self._leads)
        self._farthest = float(few.farthest.max())
        order = np.argsort(np.where(passed, few.peak, np.inf), kind="stable")
        return self._repeat(few, order[: min(int(passed.sum()), _CANDIDATES)], waypoint)

    def _manoeuvre(self, waypoint: float, grid: list[tuple[float, float, float]]) -> bool:
        """Try a grid before a waypoint, and follow the best of it; return whether any passes."""
        many, turns = self._copied(self._many), self.config.manoeuvres.turns
        where, lead, pull = (np.repeat([place[k] for place in grid], turns) for k in range(3))
        side = np.tile(2 * np.pi * (np.arange(turns) / turns - 0.5), len(grid))
        obstacle, step = self._obstacle(waypoint)
        self._place(many, np.maximum(obstacle + where * step, 0.0), lead)
        for _ in range(TURN_PERIODS):
            many.move(0.0, 0.0, side / (TURN_PERIODS * DECISION_PERIOD_S))
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

    def _pull(self, copies: Stacks, length: Float[np.ndarray, "worlds"]) -> None:
        """Pull wires and catheters back, mm."""
        period_mm = 2 * self.config.speed_mm_s * DECISION_PERIOD_S
        for k in range(int(np.ceil(length.max() / period_mm))):
            speed = -np.clip(length - k * period_mm, 0.0, period_mm) / DECISION_PERIOD_S
            copies.move(speed, speed)

    def _copied(self, copies: Stacks) -> Stacks:
        """Return copies that are put where the course has come to."""
        copies.put(np.zeros(copies.simulator.worlds, dtype=int), self._one.simulator)
        return copies

    def _repeat(self, copies: Stacks, chosen: Int[np.ndarray, "n"], waypoint: float) -> bool:
        """Add to the course what the first of some copies did that passes again without its pauses."""
        one, kept = self._one, self._one.kept()
        self._pressed |= bool((copies.peak > copies.most_n).any())
        for place in chosen:
            for period in copies.log.rows:
                (wire, turn), (catheter, _) = period.control[place]
                if wire or turn or catheter:
                    one.move(wire, catheter, turn)
            if self._there(one, waypoint)[0]:
                return True
            one.restore(kept)
            one.failed[:] = False
        return False

    def _place(self, copies: Stacks, wanted: Float[np.ndarray, "worlds"], lead: Float[np.ndarray, "worlds"]) -> None:
        """Bring the catheters' tips to some abscissae, mm, and the wires so much deeper than the catheters, mm."""
        speed = 2 * self.config.speed_mm_s
        for _ in range(round(self.config.manoeuvres.longest_s / DECISION_PERIOD_S)):
            error = wanted - copies.simulator.project().abscissa[:, 1]
            moving = np.abs(error) > _AT_MM
            catheter = np.where(moving, np.clip(error / (2 * DECISION_PERIOD_S), -speed, speed), 0.0)
            gap = np.maximum(copies.catheter + catheter * DECISION_PERIOD_S + lead, 0.0) - copies.wire
            gap = np.where(np.abs(gap) > _REST_MM, gap, 0.0)
            if not ((moving | (gap != 0)) & ~copies.failed).any():
                return
            copies.move(np.clip(gap / DECISION_PERIOD_S, -2 * speed, 2 * speed), catheter)

    def _push(self, copies: Stacks, waypoint: float, lead: Float[np.ndarray, "worlds"]) -> Bool[np.ndarray, "worlds"]:
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
        for _ in range(round((2 * max(far, 0.0) / speed + self.config.manoeuvres.longest_s) / DECISION_PERIOD_S)):
            progress, inserted = route.progress(tip), np.maximum(copies.wire, copies.catheter)
            at_best = np.where(progress > best + _REST_MM, inserted, at_best)
            best = np.maximum(best, progress)
            copies.failed |= (route.off_route(tip) > off_mm) | (inserted - at_best > _SLACK_MM)
            wire, catheter = self._left(copies, tip, waypoint, np.minimum(lead, self.config.manoeuvres.behind_mm))
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
            copies.move(wire, catheter)
            tip = copies.foremost()
        copies.farthest = np.maximum(best, route.progress(tip))
        return self._there(copies, waypoint)

    def _left(
        self, copies: Stacks, tip: TipProjection, waypoint: float, behind: Float[np.ndarray, "worlds"]
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
        self, copies: Stacks, tip: TipProjection, waypoint: float, lead: Float[np.ndarray, "worlds"]
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

    def _there(self, copies: Stacks, waypoint: float) -> Bool[np.ndarray, "worlds"]:
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
