"""Manoeuvres at an obstacle: the `Repertoire` of a stack, and how its devices are placed and retracted.

A manoeuvre places the devices of a stack about an obstacle, rotates all of them to some side, retracts them perhaps,
and pushes on. All places of a grid are tried at once, each with every rotation.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product
from typing import NamedTuple

import numpy as np

from endopilot.control.halt import SPARE_SHARE
from endopilot.control.push import ALL_ALONG_MM, REST_MM, Each
from endopilot.control.search_config import SearchConfig
from endopilot.control.trials import CATHETER, WIRE, Move, Trials
from endopilot.devices.catheter import Catheter
from endopilot.tasks.navigation import DECISION_PERIOD_S

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
