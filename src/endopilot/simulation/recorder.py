"""The steps of a simulator gathered as a trajectory: `Recorder`, for whoever decides from one step to the next."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from endopilot.simulation.simulator import Simulator
from endopilot.simulation.state import Step
from endopilot.simulation.trajectory import Trajectory
from endopilot.types import TipProjection


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
            record_shape: keep the positions of all nodes too.
        """
        self.simulator, self.period_s = simulator, period_s
        self._set_up, self._start, self._record_shape = simulator.set_up, simulator.proximal, record_shape
        self._commands: list[np.ndarray] = []
        self._steps: list[Step] = []
        self._tips: list[TipProjection] = []
        self._shapes: list[np.ndarray] = []
        self._maps: list[np.ndarray] = []

    def step(self, control: ArrayLike) -> Step:
        """Drive every world for a period, as `Simulator.step` does."""
        step = self.simulator.step(control, self.period_s)
        self._commands.append(np.array(control, dtype=float).reshape(self._start.shape))
        self._steps.append(step)
        self._tips.append(self.simulator.project())
        if self._record_shape:
            self._shapes.append(self.simulator.position)
        if self._set_up.motion is not None:
            self._maps.append(self.simulator.vessel_to_laboratory)
        return step

    @property
    def tip(self) -> TipProjection:
        """Where tips are after the last step."""
        return self._tips[-1] if self._tips else self.simulator.project()

    def trajectory(self) -> Trajectory:
        """Return all steps so far.

        Raises:
            ValueError: there is none yet.
        """
        if not self._steps:
            raise ValueError("nothing was driven yet")
        recorded: dict[str, Any] = {
            name: np.stack([getattr(step, name) for step in self._steps], axis=1) for name in Step.__dataclass_fields__
        }
        names = TipProjection.__dataclass_fields__
        return Trajectory(
            set_up=self._set_up,
            period_s=self.period_s,
            start=self._start,
            command=np.stack(self._commands, axis=1),
            tip=TipProjection(**{name: np.stack([getattr(tip, name) for tip in self._tips], axis=1) for name in names}),
            reason=self.simulator.reason,
            shape=np.stack(self._shapes, axis=1) if self._shapes else None,
            vessel_to_laboratory=np.stack(self._maps, axis=1) if self._maps else None,
            **recorded,
        )
