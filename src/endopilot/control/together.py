"""How a course brings on wire and catheter that move together where time is short: `Together`.

Such devices are often so soft that they lie down in loops, press forward as these unbend, and slide back when they are
pulled. In a narrow lumen the wire goes ahead, turned as it is pushed, while its catheter is held where the lumen is not
wide: so much less of what is pushed is stiff, and no wire lies alone in a wide lumen.

The `Repertoire` of a stack is its manoeuvres at an obstacle. A manoeuvre places the devices about the obstacle, rotates
all of them to some side, retracts them perhaps, and pushes on. All places of a grid are tried at once, each with every
rotation.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import product
from typing import NamedTuple

import numpy as np

from endopilot.control.course import Controls
from endopilot.control.population import ConstantMotions, Population, Sampler
from endopilot.control.push import ALL_ALONG_MM, REST_MM, Each
from endopilot.control.search_config import SearchConfig
from endopilot.control.set_up import SPARE_SHARE
from endopilot.control.trials import CATHETER, WIRE, Kept, Move, Trials
from endopilot.devices.catheter import Catheter
from endopilot.tasks.navigation import DECISION_PERIOD_S

_LOOKOUT_MM = 12.0
"""Motions are drawn that lead to a place no farther ahead than this, mm."""
_SLACK_MM, _TAUT_MM, _COMES_MM, _LEAVES_MM = 25.0, 8.0, 3.0, 10.0
"""Devices with more slack than the first of these are pulled back, mm, until they have no more than the second, or the
tip comes along by the third. Where it then slides back by more than the last, they stay as they were."""
_GAIN_MM = 3.0
"""A motion is a step if the devices come this much forward, mm, and do not lie in loops then."""
_LOOSE_MM = 60.0
"""Devices lie in loops with more slack than this, mm, or than the outer walls of a wide lumen take."""
_NEARER = 0.5
"""Near to the target a motion is a step if it makes the distance that is left so many times as long."""
_HELD_MM, _TIGHT_MM = 9.0, 6.5
"""A catheter is held beyond where the lumen is wider than the first of these, mm: there a wire alone folds before it is
pushed through a bend. One of radius R takes EI / 2R² of push, and a loop as wide as the lumen no more. It is held
before the first bend of a smaller radius than the second, mm, which pushes it back with as much of its own EI."""
_BEFORE_MM = 5.0
"""So far before that bend, mm."""
_RETREAT_MM = 10.0, 40.0
"""A wire that is stuck is pulled back by between these two, mm."""


@dataclass(eq=False)
class Together(Sampler):
    """What the course of a wire and its catheter does where a straight push fails, and in narrow lumens.

    Attributes:
        trials: the course.
        population: by which motions are drawn one after another.
        motions: by which motions are drawn that stay the same.
        ahead: whether the wire goes ahead of its catheter now, in a narrow lumen to which its own tip is to go.
        most_periods: decision periods that the course may take.
    """

    population: Population
    motions: ConstantMotions
    ahead: bool = False
    most_periods: int = 0

    @cached_property
    def _held_at(self) -> float:
        """How far along the route the catheter's tip is held, mm."""
        return self.route.bends_from(self.route.narrow_from(_HELD_MM), _TIGHT_MM) - _BEFORE_MM

    @cached_property
    def _loose_mm(self) -> float:
        """Slack with which devices lie in loops, mm."""
        return max(self.route.outer_mm(self.route.narrow_from()), _LOOSE_MM)

    def set_out(self) -> None:
        """Note whether the wire goes ahead from where the devices are."""
        soft = self.config.manoeuvres.together and not self.navigation.arriving
        self.ahead = soft and self.here >= self.route.narrow_from()

    @property
    def here(self) -> float:
        """How far along the route the devices have come, mm."""
        return float(self.trials.progress(self.route)[0])

    @property
    def slack_mm(self) -> float:
        """How much deeper than that the foremost of them is inserted, mm: what lies in loops."""
        return float(self.trials.deepest[0]) - self.here

    @property
    def lead_mm(self) -> float:
        """How much deeper the wire is inserted than its catheter, mm."""
        return float((self.trials.inserted(WIRE) - self.trials.inserted(CATHETER))[0])

    @property
    def left(self) -> int:
        """Decision periods that the course may still take."""
        return self.most_periods - len(self.trials.rows)

    def pull_taut(self, waypoint: float) -> None:
        """Pull devices back that have passed a place with slack: what lies in loops comes out, and the tip stays.

        A device in loops presses forward with EI / 2R² as it unbends, R being the radius of the wide lumen.
        """
        course, speed = self.trials, self.config.speed_mm_s
        if self.slack_mm <= _SLACK_MM or waypoint >= self.route.target.abscissa:
            return
        kept, passed = course.kept(), self.here
        back = course.control(*(Move(device, -speed) for device in range(course.devices)))
        while self.slack_mm > _TAUT_MM and self.here > passed - _COMES_MM and course.lengths.min() > 1.0:
            course.move(back)
        if self.here < passed - _LEAVES_MM:
            course.restore(kept)

    def bring_on(self, waypoint: float, kept: Kept) -> bool:
        """Bring devices on from where they lay, straight pushes aside; return whether they come forward.

        A wire that goes ahead is turned on, and its catheter brought to where it is held. Where that does not help, and
        in wide lumens, motions are drawn.

        Args:
            waypoint: the place that is to be passed, mm.
            kept: where the devices lay.
        """
        self.trials.restore(kept)
        begun = self.here
        if self.ahead:
            controls, gain_mm = self.motions.best(self.trials, self._held_at, self._step_mm(begun))
            if gain_mm >= self._step_mm(begun):
                self._follow(controls)
                return True
        goal = min(self.route.next_waypoint(begun), begun + _LOOKOUT_MM)
        rounds = min(self.config.rounds, self.left // self.config.round_periods)
        course, share = self.trials, SPARE_SHARE
        self._follow(self.population.find(course, goal, rounds=rounds, spare_share=share, rests=self.ahead)[0])
        if self.here < begun + self._step_mm(begun) or self.slack_mm > self._loose_mm:
            return False
        if not self.ahead:
            self.pull_taut(waypoint)
        return self.here >= begun + self._step_mm(begun)

    def _step_mm(self, here: float) -> float:
        """Return how far devices have to come forward in a step, mm: half the distance to the target, near to it."""
        return min(_GAIN_MM, _NEARER * abs(self.route.target.abscissa - here))

    def _follow(self, controls: Controls) -> None:
        """Let the devices do what was found, until they are at the target."""
        course, navigation = self.trials, self.navigation
        for control in controls[: self.left]:
            course.move(control[None])
            if course.all(navigation.reached(course.tips))[0]:
                return

    def retreat(self, kept: Kept) -> None:
        """Pull a wire that goes ahead back from where it is stuck, for another search to begin there.

        Its catheter comes back too where its tip lies beyond a fork at which the wire has left it.
        """
        course, random = self.trials, self.random
        course.restore(kept)
        astray = bool((self.route.off_route(course.tips[:, CATHETER]) > 0).any())
        leads, wire_mm = self.lead_mm > 0, random.uniform(*_RETREAT_MM)
        catheter_mm = random.uniform(*_RETREAT_MM) if astray or not leads else 0.0
        periods = int(np.ceil(max(wire_mm, catheter_mm) / (self.config.speed_mm_s * DECISION_PERIOD_S)))
        back = [-mm / (periods * DECISION_PERIOD_S) for mm in (wire_mm, catheter_mm)]
        for _ in range(min(periods, self.left)):
            if course.lengths.min() < 1.0 or self.slack_mm < -_TAUT_MM or (leads and self.lead_mm <= 0):
                return
            course.move(course.control(Move(WIRE, back[0]), Move(CATHETER, back[1])))


_WITHDRAWN_MM = -10.0
"""A wire that a manoeuvre places deeper in its catheter than this stays there; else it is pushed out first, mm."""
_AT_MM = 1.0
"""A catheter this near to its place is there, mm."""


class Place(NamedTuple):
    """Where the devices are placed about an obstacle, in steps of a lumen's width.

    Attributes:
        beyond: place of a wire alone, or of the catheter's tip, steps beyond the obstacle or, if negative, before it;
            None where devices are left where the course has them.
        lead_mm: how far the wire is ahead of the catheter, mm; negative where its tip is in the catheter.
        back: steps by which wire and catheter are retracted once turned.
    """

    beyond: float | None
    lead_mm: float = 0.0
    back: float = 0.0

    @property
    def push_lead_mm(self) -> float:
        """How far the wire leads as it is pushed on, mm."""
        return self.lead_mm if self.lead_mm < _WITHDRAWN_MM else ALL_ALONG_MM


Grid = tuple[Place, ...]
STRAIGHT: Grid = ()
"""Devices are pushed on as they are."""
_ALONE: tuple[Grid, ...] = ((Place(-1.0),), (Place(None),))
_BACK: tuple[Grid, ...] = ((Place(None, back=1.5),), (Place(None, back=3.0),))
"""Grids of a wire alone; the latter in a wide lumen, where loops that lie in it come out as it is pulled back."""


def _grid(beyond: tuple[float, ...], lead_mm: tuple[float, ...], back: float = 0.0) -> Grid:
    return tuple(Place(*place, back) for place in product(beyond, lead_mm))


_GRID = _grid((-1.0, 0.0, 1.0), (-3.0, 6.0))
_SHAPED = (
    _grid((-1.0, 0.0, 1.0), (-15.0, -40.0)),
    _grid((1.0, 2.0, 3.0), (-3.0, 6.0), back=1.5),
    _grid((-0.5, -0.25, 0.5), (-15.0, 6.0)),
)
_UNSHAPED = (_grid((-4.0, -8.0), (-3.0, 6.0, 15.0)),)
"""Grids of a wire in a catheter: the first, then those of catheters with a shape of their own, or those of others."""
_LEADS_MM = (ALL_ALONG_MM, 40.0, 20.0, 10.0, 5.0, 2.0)
_LEADS_SHAPED_MM = (-5.0, -30.0)
"""Leads of a wire that is pushed straight on, mm, see `Push.run`; the latter too where the catheter has a shape of its
own, which shows where the wire is withdrawn."""


@dataclass(frozen=True)
class Repertoire:
    """The manoeuvres of a stack.

    Attributes:
        leads: of wires that are pushed straight on, mm, a trial each; one for a wire alone.
        turns: rotations at each place of a grid.
        ways: what is tried where that fails: a share of the force limit, and a grid that is to pass within it.
    """

    leads: tuple[float, ...]
    turns: int
    ways: tuple[tuple[float, Grid], ...]

    @staticmethod
    def of(catheters: Sequence[Catheter], config: SearchConfig, *, wide: bool) -> Repertoire:
        """Return the manoeuvres of a wire alone, in a wide lumen or not, or of one in a catheter."""
        if not catheters:
            shares, grids = (config.cost.forbidden_share, SPARE_SHARE), _ALONE + _BACK * wide
            return Repertoire((ALL_ALONG_MM,), config.candidates, tuple(product(shares, grids)))
        shaped = bool(catheters[0].shape)
        grids = (_GRID, *(_SHAPED if shaped else _UNSHAPED))
        ways = [*product((SPARE_SHARE,), grids), *product((1.0,), (STRAIGHT, _GRID))]
        if config.manoeuvres.together:  # what straight pushes lay into loops costs less than all further grids
            ways.insert(1, ways.pop(len(grids)))
        return Repertoire(_LEADS_MM + _LEADS_SHAPED_MM * shaped, config.manoeuvres.turns, tuple(ways))

    @property
    def trials(self) -> int:
        """Number of trials of the largest grid."""
        return self.turns * max(len(grid) for _, grid in self.ways)


def place(trials: Trials, wanted: Each, lead: Each, *, config: SearchConfig, force_n: float) -> None:
    """Bring catheters' tips to their places, and wires to their leads, unless they press too hard on the way.

    Args:
        trials: wires in catheters.
        wanted: abscissae of the catheters' tips, mm.
        lead: how much deeper each wire is than its catheter, mm.
        config: speed, twice which catheters move with at most, and wires with twice as much; and longest time.
        force_n: wall force on a node that is too hard, N.
    """
    fastest = 2 * config.speed_mm_s
    for _ in range(round(config.manoeuvres.longest_s / DECISION_PERIOD_S)):
        error = wanted - trials.mean(trials.tips.abscissa[:, CATHETER])
        moving = np.abs(error) > _AT_MM
        catheter = np.where(moving, np.clip(error / (2 * DECISION_PERIOD_S), -fastest, fastest), 0.0)
        gap = np.maximum(trials.inserted(CATHETER) + catheter * DECISION_PERIOD_S + lead, 0.0) - trials.inserted(WIRE)
        gap = np.where(np.abs(gap) > REST_MM, gap, 0.0)
        if not ((moving | (gap != 0)) & ~trials.still).any():
            return
        wire = np.clip(gap / DECISION_PERIOD_S, -2 * fastest, 2 * fastest)
        trials.still |= trials.move(trials.control(Move(WIRE, wire), Move(CATHETER, catheter)), force_n=force_n)


def retract(trials: Trials, length: Each, *, config: SearchConfig, force_n: float) -> None:
    """Retract all devices of each trial by some length, mm; the other arguments are those of `place`."""
    period_mm = 2 * config.speed_mm_s * DECISION_PERIOD_S
    for k in range(int(np.ceil(length.max() / period_mm))):
        speed = -np.clip(length - k * period_mm, 0.0, period_mm) / DECISION_PERIOD_S
        moves = (Move(device, speed) for device in range(trials.devices))
        trials.still |= trials.move(trials.control(*moves), force_n=force_n)
