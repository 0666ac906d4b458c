"""The steps of a simulator gathered as a trajectory: `Recorder`, for whoever decides from one step to the next."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from endopilot.simulation.simulator import Simulator
from endopilot.simulation.state import Step
from endopilot.simulation.trajectory import Trajectory


class Recorder:
    """Drives a simulator step by step and keeps what it does.

    Attributes:
        simulator: what is driven.
        period_s: duration of a step, s.
    """

    def __init__(self, simulator: Simulator, period_s: float, *, record_shape: bool = False) -> None:
        """Begin where the worlds are now.

        Args:
            simulator: what is driven.
            period_s: duration of a step, s.
            record_shape: record the positions of all nodes too.
        """
        self.simulator, self.period_s = simulator, period_s
        self._set_up, self._start, self._began_s = simulator.set_up, simulator.proximal, simulator.time
        self._commands: list[np.ndarray] = []
        self._rows: list[np.ndarray] = []
        self._shapes: list[np.ndarray] | None = [] if record_shape else None
        self._step: Step | None = None

    def __len__(self) -> int:
        """Return the number of steps so far."""
        return len(self._rows)

    def step(self, control: ArrayLike) -> Step:
        """Drive every world for a period, as `Simulator.step` does."""
        self._step = step = self.simulator.step(control, self.period_s)
        self._commands.append(np.array(control, dtype=float).reshape(self._start.shape))
        # one row a world, for a step's many small arrays take much more memory
        parts = (getattr(step, name).reshape(len(self._start), -1) for name in Step.__dataclass_fields__)
        self._rows.append(np.concatenate([part.astype(float) for part in parts], axis=1))
        if self._shapes is not None:
            self._shapes.append(self.simulator.position)
        return step

    def trajectory(self) -> Trajectory:
        """Return all steps so far.

        Raises:
            ValueError: there is none yet.
        """
        if self._step is None:
            raise ValueError("nothing was driven yet")
        rows, recorded, at = np.stack(self._rows, axis=1), {}, 0
        for name in Step.__dataclass_fields__:
            like = getattr(self._step, name)
            count = like.size // len(like)
            values = rows[:, :, at : at + count].reshape(*rows.shape[:2], *like.shape[1:])
            recorded[name], at = values.astype(like.dtype), at + count
        if self._shapes is not None:
            recorded["shape"] = self.simulator._shown(np.stack(self._shapes, axis=1), recorded["inserted_length"])
        return self.simulator._made(
            self._set_up, self._start, np.stack(self._commands, axis=1), self.period_s, self._began_s, recorded
        )
