"""What a search finds, `Course`, and how it grows, `Log`."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int

from endopilot.tasks.navigation import DECISION_PERIOD_S
from endopilot.types import TipProjection

Controls = Float[np.ndarray, "periods 2"]
STALL_PERIODS = 4
"""A tip that has come forward by less than `STALL_SHARE` of the wire's advance in this many periods has stopped."""
STALL_SHARE = 0.25
SLIP_SHARE = 0.5
"""A drive slips that advances the wire by less than this share of what is commanded in a period."""


@dataclass(frozen=True, eq=False)
class Course:
    """Controls, and what the wires that they were found with do under them.

    Attributes:
        control: (mm/s, rad/s) of each decision period.
        abscissa: Δtip at the end of each period, a column a wire, mm.
        offset: γtip, mm.
        branch: index of the branch of the tip.
        radius: lumen radius at the tip, mm.
        position: of the tips, LPS mm.
        force: largest wall force on a node, N.
        inserted: Δ, mm, of the first wire.
        rotation: φ, rad, of the first wire.
        reached: whether they end at the target, by weight: 1 if all do.
    """

    control: Controls
    abscissa: Float[np.ndarray, "periods wires"]
    offset: Float[np.ndarray, "periods wires"]
    branch: Int[np.ndarray, "periods wires"]
    radius: Float[np.ndarray, "periods wires"]
    position: Float[np.ndarray, "periods wires 3"]
    force: Float[np.ndarray, "periods wires"]
    inserted: Float[np.ndarray, "periods"]
    rotation: Float[np.ndarray, "periods"]
    reached: float


class Log:
    """What the wires have done so far, a row a period."""

    def __init__(self) -> None:
        self.rows: list[tuple] = []

    def add(self, control: np.ndarray, tip: TipProjection, *rest: np.ndarray) -> None:
        """Add a period: control, tips, and their positions, forces, inserted lengths and rotations."""
        self.rows.append((control, tip.abscissa, tip.offset, tip.branch, tip.radius, *rest))

    def cut(self, periods: int) -> None:
        """Forget all but the first periods."""
        del self.rows[periods:]

    @property
    def periods(self) -> int:
        """Number of periods."""
        return len(self.rows)

    @property
    def control(self) -> np.ndarray:
        """The last control, mm/s and rad/s."""
        return self.rows[-1][0]

    @property
    def force(self) -> list[np.ndarray]:
        """Largest wall forces on a node, N, an array a period with a number a wire."""
        return [row[6] for row in self.rows]

    def stalled(self, counted: Bool[np.ndarray, "wires"]) -> bool:
        """Return whether a tip that counts has stayed behind in the last periods while the wires went forward."""
        last = self.rows[-STALL_PERIODS:]
        advance = sum(float(row[0][0]) for row in last) * DECISION_PERIOD_S
        gain = float(np.min((last[-1][1] - last[0][1])[counted]))
        return len(last) == STALL_PERIODS and advance > 2.0 and gain < STALL_SHARE * advance

    def course(self, wires: int, reached: float) -> Course:
        """Return all periods as a course."""
        shapes = ((2,), *[(wires,)] * 4, (wires, 3), *[(wires,)] * 3)
        empty = [np.zeros((0, *shape), dtype=int if k == 3 else float) for k, shape in enumerate(shapes)]
        columns = [np.array(column) for column in zip(*self.rows, strict=True)] or empty
        control, abscissa, offset, branch, radius, position, force, inserted, rotation = columns
        return Course(
            control=control, abscissa=abscissa, offset=offset, branch=branch, radius=radius, position=position,
            force=force, inserted=inserted[:, 0], rotation=rotation[:, 0], reached=reached,
        )  # fmt: skip
