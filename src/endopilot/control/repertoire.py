"""The motions that a search tries, as data: `Repertoire`, a table for each kind of stack and lumen, of `Row`s."""

from __future__ import annotations

from collections.abc import Mapping
from functools import cache
from itertools import product
from pathlib import Path
from typing import Annotated

import numpy as np

from endopilot.control.drive import Each, Limits, Motions, SearchConfig
from endopilot.control.trials import CATHETER, WIRE, Control
from endopilot.files import read_yaml
from endopilot.settings import Finite, NonNegative, Positive, Share, Within, settings
from endopilot.tasks.navigation import Navigation
from endopilot.tasks.route import Route

_TABLE = Path(__file__).parent / "motions.yaml"
_ALL_ALONG_MM = 1000.0
"""The lead of a wire that goes all the way before its catheter follows."""
_WITHDRAWN_MM = -10.0
"""A wire that is placed deeper in its catheter than this stays there; else it is pushed out first, mm."""
_MOUTH_RADII = 1.4
"""Half the width of a branch's mouth, lumen radii."""
_AS_IS, _ANEW, _NEAR = 0.3, 0.25, 0.07
"""Shares of the motions that are drawn in which devices stay, are not retracted, or not turned, and of later ones that
are drawn anew; and the standard deviation of others around the best, as a share of the range of what is drawn."""


@settings
class Draws:
    """Velocities that are drawn for motions in which devices keep theirs."""

    speeds: tuple[Finite, ...]
    """Translations of the wire, as shares of the speed of a straight push."""
    spins: tuple[Finite, ...]
    """Rotations of the wire, as shares of the fastest."""
    rests: Share = 0.5
    """Share of the motions in which the catheter rests."""
    along: Share = 0.25
    """Share of those in which it is pushed and pulled as the wire is: what lies in loops where it is around the wire
    holds back its tip too. In the others its velocity is drawn, too."""
    periods: Annotated[int, Within(1, 1000)] = 8
    """Decision periods that the motions last."""
    kept: Annotated[int, Within(1, 1000)] = 4
    """Those that the course keeps."""
    step_mm: Annotated[float, Within(-1000, 1000)] = 3.0
    """A motion that brings the devices on by so much is taken though it does not pass the place, mm."""

    def velocity(self, count: int, devices: int, config: SearchConfig, random: np.random.Generator) -> Control:
        """Return the velocity of each device of each trial; the first wire is pushed straight on."""
        scale = config.speed_mm_s, config.turn_rad_s
        shares = random.choice(self.speeds, (count, devices)), random.choice(self.spins, (count, devices))
        velocity = np.stack(shares, axis=-1) * scale
        velocity[0, WIRE] = config.speed_mm_s, 0.0
        way = random.random(count)
        velocity[(way < self.rests) | (np.arange(count) == 0), CATHETER:] = 0.0
        along = way > 1 - self.along
        velocity[along, CATHETER:, 0] = velocity[along, :CATHETER, 0]
        return velocity


@settings
class Row:
    """Motions that are tried at once: every place, lead and retraction with every rotation.

    Where there are several rounds they are drawn instead: evenly at first, then around the best so far. Where a value
    is drawn, its first and last are the ends. Drawn velocities go on where the best of the round before have led.

    A *step* is half the width of a branch's mouth: 1.4 lumen radii at the obstacle, `SearchConfig.lead_mm` at least.
    The *obstacle* is the fork before the place that is to be passed, or where the first row came to.
    """

    at: tuple[Finite, ...] | None = None
    """Where the tip of a wire alone or of its catheter is placed, steps beyond the obstacle; as it is if not given."""
    lead_mm: tuple[Finite, ...] = (0.0,)
    """How much deeper than its catheter the wire is then, mm."""
    back: tuple[NonNegative, ...] = (0.0,)
    """Steps by which devices that are turned are retracted."""
    turns: Annotated[int, Within(1, 1000)] = 1
    """Rotations, evenly over a full turn; of none if 1."""
    follow_mm: tuple[Finite, ...] = ()
    """How far the wire then leads before its catheter follows, mm; where this is negative the wire's tip stays so deep
    in the catheter until the catheter's tip is past. All along if not given, or as deep as it is placed."""
    off_radii: NonNegative = 3.0
    """A tip that is so many radii of the route's lumen deep in another branch does not come back: in a wide fork it may
    seem to leave the route."""
    draws: Draws | None = None
    """Devices keep velocities that are drawn, as many as there are rotations; they are not turned before."""
    rounds: Annotated[int, Within(1, 1000)] = 1
    """Times that motions are tried."""
    agree: Share = 1.0
    """Share of the wires, by weight, that is to pass the place; the others are no longer believed. Of several rounds
    all have to pass in the first, and this share in the last."""
    force: Share = 1.0
    """Share of the force limit that a motion which is taken stays within, at most."""

    @property
    def count(self) -> int:
        """Number of motions."""
        grid = len(self.at or (0,)) * len(self.lead_mm) * len(self.back) * max(len(self.follow_mm), 1)
        return self.turns * (grid if self.rounds == 1 else 1)

    @property
    def onward(self) -> bool:
        """Whether each round goes on where the best of the one before have led, instead of where the devices are."""
        return self.draws is not None and self.rounds > 1

    def agrees(self, number: int) -> float:
        """Return the share of the wires, by weight, that is to pass the place in a round, from 0 on."""
        return self.agree if self.rounds == 1 else 1 - (1 - self.agree) * number / (self.rounds - 1)

    def motions(
        self,
        obstacle_mm: float,
        step_mm: float,
        config: SearchConfig,
        devices: int,
        random: np.random.Generator,
        best: Motions | None = None,
    ) -> Motions:
        """Return the motions about an obstacle, rotations next to each other; `best` are those of the rounds before."""
        if self.rounds > 1:
            at, turn, back = self._drawn(obstacle_mm, step_mm, random, best)
            lead, follow = np.zeros(self.turns), np.full(self.turns, _ALL_ALONG_MM)
        else:
            leads = [(lead, lead if lead < _WITHDRAWN_MM else _ALL_ALONG_MM) for lead in self.lead_mm]
            leads = list(product(self.lead_mm, self.follow_mm)) if self.follow_mm else leads
            each = np.array([(at, *lead, back) for at in self.at or (np.nan,) for lead in leads for back in self.back])
            at, lead, follow, back = np.repeat(each, self.turns, axis=0).T
            at, back = np.maximum(obstacle_mm + at * step_mm, 0.0), back * step_mm
            turn = np.tile(sides(self.turns), len(each)) if self.turns > 1 else np.zeros(len(at))
        velocity = np.zeros((len(at), devices, 2))
        velocity[:, WIRE, 0] = config.speed_mm_s
        if self.draws is not None:
            velocity, follow = self.draws.velocity(len(at), devices, config, random), np.full(len(at), np.nan)
            turn = np.zeros(len(at))
        return Motions(at, lead, turn, back, follow, velocity)

    def _drawn(
        self, obstacle_mm: float, step_mm: float, random: np.random.Generator, best: Motions | None
    ) -> tuple[Each, Each, Each]:
        """Return places, rotations and retractions that are drawn: evenly, and most of later rounds near the best."""
        count, ends = self.turns, np.array([(each[0], each[-1]) for each in (self.at or (np.nan,), self.back)])
        turn = random.uniform(-np.pi, np.pi, count)
        drawn = ends[:, :1] + np.diff(ends) * random.random((2, count))
        stays = random.random((3, count)) < _AS_IS
        at = np.where(stays[0], np.nan, obstacle_mm + drawn[0] * step_mm)
        back, turn = np.where(stays[1:], 0.0, [drawn[1] * step_mm, turn])
        if best is not None:
            chosen, anew = random.integers(0, len(best.at_mm), count), random.random(count) < _ANEW
            off = _NEAR * np.append(np.diff(ends)[:, 0] * step_mm, 2 * np.pi)[:, None] * random.normal(size=(3, count))
            near = np.stack([best.at_mm, best.back_mm, best.turn_rad])[:, chosen] + off
            at, back, turn = np.where(anew, [at, back, turn], near)
        return np.maximum(at, 0.0), turn, np.maximum(back, 0.0)


@settings
class Repertoire:
    """What is tried with one kind of stack in one kind of lumen, and when a trial is given up."""

    rows: tuple[Row, ...]
    """In the order in which they are tried; the first is straight on."""
    drawn: tuple[Row, ...] = ()
    """Those that are drawn where none of these passes."""
    force: tuple[Share, ...] = (0.9, 1.0)
    """Shares of the force limit: where no row passes within one, the next will do."""
    slack_mm: Positive = 40.0
    """Devices that were pushed so far and did not come forward fold, mm."""
    slack_widths: NonNegative = 0.0
    """The same in widths of the lumen, where that is more."""
    agree: Share = 1.0
    """Share of the wires, by weight, that has to come to the target."""

    @staticmethod
    def of(
        navigation: Navigation, route: Route, config: SearchConfig, here_mm: float, table: Table | None = None
    ) -> Repertoire:
        """Return what is tried in a navigation, from a place of the route on, mm; the package's own table if no other
        is given.
        """
        if not navigation.catheters:
            kind = "wire in a wide lumen" if route.is_wide(route.target.abscissa) else "wire"
        elif config.together:
            kind = "soft pair in a narrow lumen" if here_mm >= route.narrow_from() else "soft pair"
        else:
            kind = "wire in a shaped catheter" if navigation.catheters[0].shape else "wire in a catheter"
        return (table or read_table())[kind]

    def limits(self, row: Row, route: Route, begun_mm: float, end_mm: float, force_n: float) -> Limits:
        """Return when trials of a row that lead from one place of the route to another, mm, are given up."""
        return Limits(
            force_n=force_n,
            off_mm=row.off_radii * float(route.radius(np.array([begun_mm, end_mm])).max()),
            slack_mm=max(self.slack_mm, self.slack_widths * route.width_mm(end_mm)),
        )


Table = Mapping[str, Repertoire]
"""What is tried with each kind of stack in each kind of lumen."""


@cache
def read_table() -> Table:
    """Return the package's own table."""
    return {kind: Repertoire(**record) for kind, record in read_yaml(_TABLE).items()}


def sides(count: int) -> Each:
    """Return angles evenly over a full turn, from half a turn back on, rad."""
    return 2 * np.pi * (np.arange(count) / count - 0.5)


def stand_off(route: Route, at_mm: float, least_mm: float) -> float:
    """Return how far off a place of the route devices are turned, mm: a branch's mouth is about as wide."""
    return max(least_mm, _MOUTH_RADII * float(route.radius(np.array([at_mm]))[0]))
