"""Plans by trained networks: desired tips into the inverse network, or samples through the forward network.

A plan begins with a wire at rest, and the networks want 30 states before the first that they foretell: 15 s of rest at
the start stand in for them.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from jaxtyping import Float
from scipy.ndimage import convolve1d

from endopilot.anatomy.projection import safety_ratio
from endopilot.control.plan_config import PlanConfig, Steps
from endopilot.control.route import Route
from endopilot.dataset.loader import Dataset
from endopilot.dataset.study import identify
from endopilot.models.config import WINDOW, read_run
from endopilot.models.open_loop import Predictor
from endopilot.models.rollout import load_model
from endopilot.progress import progress
from endopilot.simulation.config import SimulatorConfig
from endopilot.simulation.drive_limits import DriveLimits
from endopilot.simulation.simulator import Simulator
from endopilot.tasks.navigation import Navigation
from endopilot.types import SAMPLE_PERIOD_S

_SMOOTH = np.array([0.25, 0.5, 0.25])
"""Neighbouring samples of what is drawn are mixed, as a drive's ramps mix them."""


def network_planner(
    navigation: Navigation, folder: Path, model: Path, desired: Steps, route: Route, config: PlanConfig
) -> Callable[[], tuple[Steps, Steps]]:
    """Load networks and return what finds controls with them, and the tips that they foretell.

    Args:
        navigation: what is to be done.
        folder: of the anatomy.
        model: run made by `endopilot train`.
        desired: tips (Δtip, γtip), mm.
        route: the way to the target.
        config: method, cost and sampling.

    Raises:
        InputError: the run is unfinished or damaged, or has not the network that the method needs.
    """
    predictor, rest = load_model(model), Rest(navigation, folder, model)
    predictor.rollout_forward(rest.episodes(desired[None, :1], np.zeros((1, 1, 2))))  # a causal model learns the vessel
    ask = _ask if config.method == "inverse" else _sample
    return lambda: ask(predictor, rest, desired, route, config)


def _ask(predictor: Predictor, rest: Rest, desired: Steps, route: Route, config: PlanConfig) -> tuple[Steps, Steps]:
    """Ask the inverse network for the controls of the desired tips; the forward one foretells what they make."""
    with progress("plan: asking the inverse network", total=1) as advance:
        found = predictor.rollout_dual(rest.episodes(desired[None], np.zeros((1, len(desired), 2))))
        advance()
    return found.control[0], found.tip[0]


def _sample(predictor: Predictor, rest: Rest, desired: Steps, route: Route, config: PlanConfig) -> tuple[Steps, Steps]:
    """Sample control sequences around the one that would lead a tip without slack, through the forward network."""
    navigation, sampling = rest.navigation, config.sample
    limits = DriveLimits.of(navigation.device, navigation.anatomy)
    random = np.random.default_rng([config.seed, 0x3991])
    mean = np.zeros((len(desired), 2))
    mean[:, 0] = np.diff(desired[:, 0], prepend=rest.tip[0]) / SAMPLE_PERIOD_S
    sd = np.array([sampling.translation_sd_mm_s, sampling.rotation_sd_rad_s])
    best, found = np.inf, (mean, desired)
    with progress("plan: sampling the forward network", total=sampling.iterations) as advance:
        for _ in range(sampling.iterations):
            drawn = random.standard_normal((sampling.candidates, *mean.shape))
            drawn = convolve1d(drawn, _SMOOTH, axis=1, mode="constant") * sd
            drawn[0] = 0.0
            control = limits.clip_sequence(mean + drawn, navigation.start_inserted_mm, SAMPLE_PERIOD_S)
            wanted = np.repeat(desired[None], len(control), axis=0)
            tip = predictor.rollout_forward(rest.episodes(wanted, control)).tip
            cost = _cost(tip, control, desired, route, limits.fastest, navigation.device.tip_radius_mm, config)
            if cost.min() < best:
                best, found = float(cost.min()), (control[cost.argmin()], tip[cost.argmin()])
            scale = sampling.temperature * max(float(cost.std()), 1e-9)
            weight = np.exp(-(cost - cost.min()) / scale)
            mean = np.einsum("c,cst->st", weight / weight.sum(), control)
            advance()
    return found


def _cost(
    tip: Float[np.ndarray, "c s 2"],
    control: Float[np.ndarray, "c s 2"],
    desired: Steps,
    route: Route,
    bound: Float[np.ndarray, "2"],
    wire_radius_mm: float,
    config: PlanConfig,
) -> Float[np.ndarray, "c"]:
    """Return the cost of each candidate; the networks foretell no force."""
    error = np.abs(tip - desired)
    ratio = safety_ratio(tip[..., 1], route.radius(tip[..., 0]), wire_radius_mm)
    running = config.cost.running(error=error.sum(axis=-1), ratio=ratio).sum(axis=1) * SAMPLE_PERIOD_S
    rough = config.cost.roughness(control[:, :-1], control[:, 1:], bound).sum(axis=1)
    cost = error[:, -1, 0] + running + rough
    return np.where(np.isfinite(cost), cost, 1e9)


class Rest:
    """A wire at rest at the start, as the beginning of episodes.

    Attributes:
        navigation: what is to be done.
        tip: (Δtip, γtip) at rest, mm.
    """

    def __init__(self, navigation: Navigation, folder: Path, model: Path) -> None:
        self.navigation, vessel = navigation, str(Path(folder).resolve())
        self._scratch = TemporaryDirectory(prefix="endopilot-plan-")  # where a model keeps what it makes of the patient
        record = read_run(model)
        self._manifest = {
            "key": f"plan in {vessel}",
            "device": asdict(navigation.device),
            "config": {"simulator": record.get("simulator", {})},
            "anatomies": [{"name": navigation.anatomy.name, "folder": vessel, "sha256": identify(folder)[1]}],
        }
        simulator = Simulator(navigation.anatomy, navigation.device, config=SimulatorConfig(threads=1))
        simulator.reset(inserted_length=[navigation.start_inserted_mm], rotation=[navigation.start_rotation])
        tip = simulator.project()
        self.tip = np.array([tip.abscissa[0], tip.offset[0]])
        self._start = np.array([navigation.start_inserted_mm, navigation.start_rotation])

    def episodes(self, tips: Float[np.ndarray, "n s 2"], control: Float[np.ndarray, "n s 2"]) -> Dataset:
        """Return episodes of 15 s of rest and then some tips and controls, as predictors take them."""
        count, samples = len(tips), WINDOW + tips.shape[1]
        before = np.zeros((count, WINDOW, 2))
        control = np.concatenate([before, control], axis=1)
        tip = np.concatenate([before + self.tip, tips], axis=1)
        proximal = self._start + SAMPLE_PERIOD_S * np.cumsum(control, axis=1)
        device, zeros = self.navigation.device, np.zeros((count, samples))
        names = ("base_force", "base_torque", "drive_force", "drive_torque", "contact_force_max", "contact_force_sum")
        return Dataset(
            folder=Path(self._scratch.name),
            manifest=self._manifest,
            sample_period_s=SAMPLE_PERIOD_S,
            anatomy=np.full(count, self.navigation.anatomy.name),
            sequence=np.arange(count),
            split=np.full(count, "plan"),
            device=np.full(count, device.name),
            friction=np.full(count, device.friction),
            tip_bend=np.full(count, device.tip_bend_rad),
            tip_stiffness_factor=np.ones(count),
            initial_inserted_length=np.full(count, self._start[0]),
            initial_rotation=np.full(count, self._start[1]),
            control=control,
            inserted_length=proximal[..., 0],
            rotation=proximal[..., 1],
            tip_abscissa=tip[..., 0],
            tip_offset=tip[..., 1],
            tip_position=np.zeros((count, samples, 3)),
            tip_direction=np.zeros((count, samples, 3)),
            branch=np.zeros((count, samples), dtype=np.int64),
            lumen_radius=zeros,
            slip=zeros,
            valid=np.ones((count, samples), dtype=bool),
            **dict.fromkeys(names, zeros),
        )
