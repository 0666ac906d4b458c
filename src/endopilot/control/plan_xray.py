"""The X-ray that a plan will need if all goes as planned: `plan_xray`.

Who foretells the tip is watched, as on the way. The ladder's agent believes in an ensemble of simulated wires; they
follow the plan's proximal end, and each exposure shows them the tip where the plan has it. A run that made the plan is
shown what it foretold itself.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

import numpy as np
from jaxtyping import Bool, Float

from endopilot.control.agent import CALIBRATED, AdviserInput, AgentPolicy
from endopilot.control.plan_config import NETWORK_METHODS, Plan, PlanConfig
from endopilot.control.route import Route
from endopilot.models.config import WINDOW, run_path
from endopilot.xray.adviser import AdviserConfig, XrayAdviser
from endopilot.xray.bands import Calibration
from endopilot.xray.fluoroscope import TipMeasurement
from endopilot.xray.online_predictors import online_predictor


@dataclass(frozen=True, eq=False)
class PlannedXray:
    """X-ray along a plan; row t is the end of its sample period t.

    Attributes:
        exposure: whether an exposure is due then.
        half_width: of the bands of (Δtip, γtip) around what is foretold, mm, before that exposure.
    """

    exposure: Bool[np.ndarray, "samples"]
    half_width: Float[np.ndarray, "samples 2"]


def read_calibration(config: PlanConfig, model: Path | None) -> Calibration:
    """Return the calibration of what foretells a plan: of the run that makes it, or else of the agent's wires.

    Args:
        config: what is asked of the plan; its method says whether a network makes it.
        model: the trained run, or "pretrained".

    Raises:
        InputError: the run has no calibration, or a damaged one.
    """
    if config.method in NETWORK_METHODS and model is not None:
        return Calibration.read(run_path(model))
    return Calibration.read(CALIBRATED)


def plan_xray(plan: Plan, folder: Path, calibration: Calibration) -> PlannedXray:
    """Return the X-ray that a plan will need if all goes as planned; the tip is seen as it starts.

    Args:
        plan: the plan.
        folder: of the anatomy.
        calibration: of what foretells it, see `read_calibration`.
    """
    watched: _Watched = _Networks(plan, folder) if plan.config.method in NETWORK_METHODS else _Wires(plan)
    adviser = XrayAdviser(calibration, AdviserConfig(), plan.navigation.device.tip_radius_mm)
    proximal, tip, _, radius = watched.start()
    adviser.start(proximal, tip, radius)
    exposure, half_width = np.zeros(len(plan.control), dtype=bool), np.zeros((len(plan.control), 2))
    for period in range(len(plan.control)):
        exposure[period] = adviser.advise(*watched.move(period))[0]
        half_width[period] = adviser.half_width[0]
        if exposure[period]:
            watched.show(period)
    return PlannedXray(exposure=exposure, half_width=half_width)


class _Watched(Protocol):
    """Foretells the tip along a plan."""

    def start(self) -> AdviserInput:
        """Say where the tip is before the first period."""
        ...

    def move(self, period: int) -> AdviserInput:
        """Say where it is at the end of a period, the one after the last."""
        ...

    def show(self, period: int) -> None:
        """Take what an exposure shows at the end of that period."""
        ...


class _Wires:
    def __init__(self, plan: Plan) -> None:
        self._plan, self._agent = plan, AgentPolicy()
        self._agent.start(plan.navigation, seed=0)

    def start(self) -> AdviserInput:
        return self._agent.foretold()

    def move(self, period: int) -> AdviserInput:
        inserted, rotation = self._plan.proximal[period]
        self._agent.belief.follow(inserted, rotation)
        return self._agent.foretold()

    def show(self, period: int) -> None:
        tip = self._plan.simulated
        self._agent.belief.weigh(
            TipMeasurement(
                position=self._plan.position[period],
                abscissa=float(tip.abscissa[period]),
                offset=float(tip.offset[period]),
                branch=int(tip.branch[period]),
            )
        )


class _Networks:
    def __init__(self, plan: Plan, folder: Path) -> None:
        from endopilot.control.network_plan import Rest  # brings torch, which is slow to import
        from endopilot.models.rollout import load_model

        assert plan.model is not None
        run, navigation = Path(plan.model), plan.navigation
        rest = Rest(navigation, folder, run)
        episodes = rest.episodes(plan.predicted[None], plan.control[None])
        self._model = online_predictor(load_model(run), episodes)
        self._route = Route.to(navigation.anatomy, navigation.target)
        self._proximal = np.column_stack([episodes.inserted_length[0], episodes.rotation[0]])

    def start(self) -> AdviserInput:
        return self._at(WINDOW - 1)

    def move(self, period: int) -> AdviserInput:
        return self._at(WINDOW + period)

    def show(self, period: int) -> None:
        sample = WINDOW + period
        self._model.show(np.array([0]), sample, self._model.tip[:, sample].copy())

    def _at(self, sample: int) -> AdviserInput:
        tip = self._model.tip[:, sample]
        return self._proximal[None, sample], tip, self._model.spread[:, sample], self._route.radius(tip[:, 0])
