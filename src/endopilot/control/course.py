"""What a search finds, `Course`, and how it grows: `Copies` of a stack are driven, and a `Log` keeps what they do."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from endopilot.control.period import drive_period
from endopilot.devices.device import Wire
from endopilot.simulation.simulator import Simulator
from endopilot.simulation.state import SimulatorState, Step
from endopilot.tasks.navigation import DECISION_PERIOD_S, Navigation
from endopilot.types import TipProjection

Controls = Float[np.ndarray, "periods devices 2"]
STALL_PERIODS = 4
"""A tip that has come forward by less than `STALL_SHARE` of the wire's advance in this many periods has stopped."""
STALL_SHARE = 0.25
SLIP_SHARE = 0.5
"""A drive slips that advances the wire by less than this share of what is commanded in a period."""
_TIP = tuple(TipProjection.__dataclass_fields__)


@dataclass(frozen=True, eq=False)
class Course:
    """Controls, and what the wires that they were found with do under them.

    Attributes:
        control: (mm/s, rad/s) of each device in each decision period.
        proximal: inserted length (mm) and rotation (rad) of each device at the end of each period, as encoders tell.
        tip: of the wires then, a column a wire.
        force: largest wall force on a node, N.
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


class Period(NamedTuple):
    """What copies did in a period, and where they were at its end, as `Course` has it; a row a world."""

    control: Float[np.ndarray, "worlds devices 2"]
    proximal: Float[np.ndarray, "worlds devices 2"]
    tip: TipProjection
    force: Float[np.ndarray, "worlds"]


class Log:
    """What copies have done so far."""

    def __init__(self) -> None:
        self.rows: list[Period] = []

    def cut(self, periods: int) -> None:
        """Forget all but the first periods."""
        del self.rows[periods:]

    @property
    def periods(self) -> int:
        """Number of periods."""
        return len(self.rows)

    def stalled(self, counted: Bool[np.ndarray, "worlds"]) -> bool:
        """Return whether a tip that counts has stayed behind in the last periods while the wires went forward."""
        last = self.rows[-STALL_PERIODS:]
        advance = sum(float(row.control[0, 0, 0]) for row in last) * DECISION_PERIOD_S
        gain = float(np.min((last[-1].tip.abscissa - last[0].tip.abscissa)[counted]))
        return len(last) == STALL_PERIODS and advance > 2.0 and gain < STALL_SHARE * advance

    def course(
        self, stack: tuple[int, int], *, reached: float, ostium_mm: float = 0.0, settled: Sequence[int] | None = None
    ) -> Course:
        """Return all periods as a course.

        Args:
            stack: number of worlds and of devices.
            reached: whether they end at the target, by weight.
            ostium_mm: how much deeper the devices of the first world lie than the encoders say, mm.
            settled: periods at whose ends a manoeuvre is over: there the course is checked, under X-ray. If not given,
                it is checked at every period without.
        """
        worlds, devices = stack
        ends = np.isin(np.arange(self.periods), settled or ())
        columns = {name: np.array([getattr(row.tip, name) for row in self.rows]) for name in _TIP}
        columns["branch"] = columns["branch"].astype(int)
        proximal = np.array([row.proximal[0] for row in self.rows]).reshape(-1, devices, 2)
        return Course(
            control=np.array([row.control[0] for row in self.rows]).reshape(-1, devices, 2),
            proximal=proximal - [ostium_mm, 0.0],
            tip=TipProjection(**{name: column.reshape(-1, worlds) for name, column in columns.items()}),
            force=np.array([row.force for row in self.rows]).reshape(-1, worlds),
            checked=np.ones_like(ends) if settled is None else ends,
            exposed=ends,
            reached=reached,
        )


class Kept(NamedTuple):
    """Where copies were: their state, the largest forces so far, N, and their periods."""

    state: SimulatorState
    peak: Float[np.ndarray, "worlds"]
    periods: int


class Copies:
    """Copies of a stack that are driven side by side, and what they have done.

    Attributes:
        simulator: their worlds.
        log: what they have done.
        peak: largest wall force on a node of each since `put`, N; infinite where the simulation has failed.
    """

    def __init__(self, navigation: Navigation, wires: list[Wire], like: Simulator) -> None:
        """Lay them out.

        Args:
            navigation: vessel and catheters.
            wires: the wire of each.
            like: a simulator of the same anatomy, whose settings are taken.
        """
        self.simulator = Simulator(
            navigation.anatomy,
            [replace(navigation.stack, wire=wire) for wire in wires],
            motion=navigation.known_motion,
            config=like.config,
            sharing=like,
        )
        self.devices = len(navigation.devices)
        self.log, self.peak = Log(), np.zeros(len(wires))

    def put(self, source: Int[np.ndarray, "worlds"], of: Simulator) -> None:
        """Put each where a world of a simulator of equal stacks is, and forget what it has done."""
        self.simulator.copy_worlds(source, of=of)
        self.log, self.peak = Log(), np.zeros(self.simulator.worlds)

    def drive(self, control: Float[np.ndarray, "worlds devices 2"]) -> Step:
        """Drive each for a decision period; return the worlds at its end, with the largest force within it."""
        simulator = self.simulator
        step = drive_period(simulator, control)
        self.peak = np.maximum(self.peak, np.where(step.valid, step.contact_force_max, np.inf))
        self.log.rows.append(Period(control, simulator.proximal, simulator.project()[:, 0], step.contact_force_max))
        return step

    def kept(self) -> Kept:
        """Return where they are."""
        return Kept(self.simulator.state, self.peak.copy(), self.log.periods)

    def restore(self, kept: Kept) -> None:
        """Put them back to where they were, and forget what they have done since."""
        self.simulator.set_state(kept.state)
        self.peak = kept.peak.copy()
        self.log.cut(kept.periods)
