"""The X-ray that a plan will need if all goes as planned: `plan_xray`.

The adviser monitors the model that predicts the tip, as it does during a navigation. For a plan that no network made,
that model is the ensemble of simulated wires of the ladder's agent: they follow the plan's proximal end, and each
exposure shows the tip where the plan has it. What their bands allow for beside (`Allowance`) is as in a navigation. For
a plan by networks it is the same run, and each exposure shows the tip that the run itself predicts.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

import numpy as np
from jaxtyping import Bool, Float

from endopilot.belief.adviser import AdviserConfig, Predicted
from endopilot.belief.bands import Calibration
from endopilot.belief.belief import Belief
from endopilot.belief.monitor import predicted_tip
from endopilot.belief.online_predictors import online_predictor
from endopilot.belief.watch import Watch
from endopilot.control.agent_config import AgentConfig, read_agent_calibration
from endopilot.control.plan_config import Plan
from endopilot.models.config import WINDOW, WIRES, read_run
from endopilot.tasks.route import Route
from endopilot.xray.fluoroscope import TipMeasurement


@dataclass(frozen=True, eq=False)
class PlannedXray:
    """X-ray along a plan; row t is the end of its sample period t.

    Attributes:
        exposure: whether an exposure is due then.
        half_width: of the bands of (Δtip, γtip) around the predicted tip, mm, before that exposure.
    """

    exposure: Bool[np.ndarray, "samples"]
    half_width: Float[np.ndarray, "samples 2"]


def read_calibration(method: str, model: str | Path | None, devices: int) -> Calibration:
    """Return the calibration of the model that predicts a plan's tip: the run that makes it, or else the agent's wires.

    Args:
        method: of the plan; it says whether a network makes it.
        model: the trained run, if any.
        devices: 1 for a wire alone, 2 with a catheter.

    Raises:
        InputError: there is no such run, or it has no calibration, or a damaged one.
    """
    if model is not None and _by_networks(method, model):
        read_run(model)
        return Calibration.read(Path(model))
    return read_agent_calibration("assumed", devices)


def plan_xray(plan: Plan, *, calibration: Calibration | None = None) -> PlannedXray:
    """Return the X-ray that a plan will need if all goes as planned; the tip is observed at the start.

    Args:
        plan: the plan.
        calibration: of the model that predicts its tip; if not given, that of the plan's model, or of the agent's
            simulated wires where no network made the plan.

    Raises:
        InputError: the plan's model has no calibration, or a damaged one.
    """
    if calibration is None:
        calibration = read_calibration(plan.config.method, plan.model, len(plan.navigation.devices))
    networks = _by_networks(plan.config.method, plan.model)
    model: _Model = _Networks(plan) if networks else _Wires(plan)
    alone = not networks and not plan.navigation.catheters
    watch = Watch(calibration, AdviserConfig(), plan.navigation.device.tip_radius_mm, model.start(), alone=alone)
    exposure, half_width = np.zeros(len(plan.control), dtype=bool), np.zeros((len(plan.control), 2))
    for period in range(len(plan.control)):
        at = model.move(period)
        watch.move(at)
        exposure[period], half_width[period] = watch.advise(at), watch.half_width
        if exposure[period]:
            watch.exposed(float(at.tip[1]), at)
            model.observe(period)
    return PlannedXray(exposure=exposure, half_width=half_width)


def _by_networks(method: str, model: str | Path | None) -> bool:
    return method == "inverse" and model is not None and str(model) != WIRES


class _Model(Protocol):
    """Predicts the tip along a plan."""

    def start(self) -> Predicted:
        """Return where the tip is before the first period."""
        ...

    def move(self, period: int) -> Predicted:
        """Return where it is predicted to be at the end of the next period."""
        ...

    def observe(self, period: int) -> None:
        """Take what an exposure shows at the end of that period."""
        ...


class _Wires:
    def __init__(self, plan: Plan) -> None:
        config = AgentConfig.of(plan.navigation).belief
        self._plan, self._belief = plan, Belief(plan.navigation, Belief.around(config), config)

    def start(self) -> Predicted:
        return predicted_tip(self._belief)

    def move(self, period: int) -> Predicted:
        self._belief.follow(
            tuple((inserted, turn) for inserted, turn in self._plan.trajectory.proximal[0, period].tolist())
        )
        return predicted_tip(self._belief)

    def observe(self, period: int) -> None:
        tip = self._plan.tip[:, 0]
        self._belief.weigh(
            TipMeasurement(
                position=self._plan.trajectory.tip_position[0, period, 0],
                abscissa=float(tip.abscissa[period]),
                offset=float(tip.offset[period]),
                branch=int(tip.branch[period]),
            )
        )


class _Networks:
    def __init__(self, plan: Plan) -> None:
        from endopilot.control.network_plan import RestingStart  # brings torch, which is slow to import
        from endopilot.models.checkpoint import load_model

        assert plan.model is not None
        run, navigation = Path(plan.model), plan.navigation
        episodes = RestingStart(navigation).episodes(plan.predicted[None], plan.control[None, :, 0])
        self._model = online_predictor(load_model(run), episodes)
        self._route = Route.to(navigation.anatomy, navigation.target)
        self._proximal = episodes.proximal[0]

    def start(self) -> Predicted:
        return self._at(WINDOW - 1)

    def move(self, period: int) -> Predicted:
        return self._at(WINDOW + period)

    def observe(self, period: int) -> None:
        sample = WINDOW + period
        tip = self._model.tip[:, sample].copy()
        self._model.observe(np.array([0]), sample, tip, self._route.branch(tip[:, 0]))

    def _at(self, sample: int) -> Predicted:
        tip = self._model.tip[:, sample]
        radius_mm = float(self._route.radius(tip[:, 0])[0])
        return Predicted(self._proximal[sample], tip[0], self._model.spread[0, sample], radius_mm)
