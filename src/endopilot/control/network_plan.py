"""Plans by trained networks: desired tips into the inverse network, or sampled controls through the forward network.

The networks need 30 states before the first that they predict. A plan begins with a wire at rest, so 15 s of rest come
before it.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
from jaxtyping import Float
from scipy.ndimage import convolve1d

from endopilot.anatomy.projection import safety_ratio
from endopilot.control.plan_config import PlanConfig, Steps
from endopilot.devices.drive_limits import DriveLimits
from endopilot.models.checkpoint import load_model
from endopilot.models.config import WINDOW, read_run
from endopilot.models.episodes import Episodes, EpisodeSetUp, Predictor
from endopilot.progress import progress
from endopilot.simulation.config import SimulatorConfig
from endopilot.simulation.simulator import Simulator
from endopilot.tasks.navigation import Navigation
from endopilot.tasks.route import Route
from endopilot.types import SAMPLE_PERIOD_S

_SMOOTH = np.array([0.25, 0.5, 0.25])
"""Weights by which neighbouring samples of a drawn control are mixed, as the ramps of a drive mix them."""


def network_planner(
    navigation: Navigation, model: Path, desired: Steps, route: Route, config: PlanConfig
) -> Callable[[], tuple[Steps, Steps]]:
    """Load networks and prepare the patient; return a function that finds controls and predicts their tips.

    Args:
        navigation: what is to be done.
        model: run made by `endopilot train`.
        desired: tips (Δtip, γtip), mm.
        route: to the target.
        config: method, cost and sampling.

    Raises:
        InputError: the run is unfinished or damaged, or has not the network that the method needs.
    """
    predictor, start = load_model(model), RestingStart(navigation, model)
    predictor.rollout_forward(start.episodes(desired[None, :1], np.zeros((1, 1, 2))))  # so that the patient is prepared
    find = _invert if config.method == "inverse" else _sample
    return lambda: find(predictor, start, desired, route, config)


def _invert(
    predictor: Predictor, start: RestingStart, desired: Steps, route: Route, config: PlanConfig
) -> tuple[Steps, Steps]:
    """Find the controls of the desired tips by the inverse network; the forward one predicts the tips they lead to."""
    with progress("plan: inverse network", total=1) as advance:
        found = predictor.rollout_dual(start.episodes(desired[None], np.zeros((1, len(desired), 2))))
        advance()
    return found.control[0], found.tip[0]


def _sample(
    predictor: Predictor, start: RestingStart, desired: Steps, route: Route, config: PlanConfig
) -> tuple[Steps, Steps]:
    """Sample control sequences around the one that would lead a tip without slack, through the forward network."""
    navigation, sampling = start.navigation, config.sample
    limits = DriveLimits.of(navigation.device, navigation.anatomy)
    random = np.random.default_rng([config.seed, 0x3991])
    mean = np.zeros((len(desired), 2))
    mean[:, 0] = np.diff(desired[:, 0], prepend=start.tip[0]) / SAMPLE_PERIOD_S
    sd = np.array([sampling.translation_sd_mm_s, sampling.rotation_sd_rad_s])
    best, found = np.inf, (mean, desired)
    with progress("plan: sampling the forward network", total=sampling.iterations) as advance:
        for _ in range(sampling.iterations):
            drawn = random.standard_normal((sampling.candidates, *mean.shape))
            drawn = convolve1d(drawn, _SMOOTH, axis=1, mode="constant") * sd
            drawn[0] = 0.0
            control = limits.clip_sequence(mean + drawn, navigation.start_inserted_length_mm, SAMPLE_PERIOD_S)
            wanted = np.repeat(desired[None], len(control), axis=0)
            tip = predictor.rollout_forward(start.episodes(wanted, control)).tip
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
    """Return the cost of each candidate; the networks predict no force, so its terms are left out."""
    error = np.abs(tip - desired)
    ratio = safety_ratio(tip[..., 1], route.radius(tip[..., 0]), wire_radius_mm)
    running = config.cost.running(error=error.sum(axis=-1), ratio=ratio).sum(axis=1) * SAMPLE_PERIOD_S
    rough = config.cost.roughness(control[:, :-1], control[:, 1:], bound).sum(axis=1)
    cost = error[:, -1, 0] + running + rough
    return np.where(np.isfinite(cost), cost, 1e9)


class RestingStart:
    """A wire at rest at the start of a navigation, as the given states of episodes.

    Attributes:
        navigation: what is to be done.
        tip: (Δtip, γtip) at rest, mm.
    """

    def __init__(self, navigation: Navigation, model: Path) -> None:
        """Simulate the wire at rest.

        Args:
            navigation: what is to be done.
            model: the trained run, whose settings of the rod core the patient is prepared with.
        """
        self.navigation = navigation
        config = SimulatorConfig(**read_run(model).get("simulator", {}))
        self._setup = EpisodeSetUp.of_anatomy(navigation.anatomy, navigation.device, config)
        simulator = Simulator(navigation.anatomy, navigation.device, config=SimulatorConfig(threads=1))
        simulator.reset(inserted_length=[navigation.start_inserted_length_mm], rotation=[navigation.start_rotation_rad])
        tip = simulator.project()[:, 0]
        self.tip = np.array([tip.abscissa[0], tip.offset[0]])

    def episodes(self, tips: Float[np.ndarray, "n s 2"], control: Float[np.ndarray, "n s 2"]) -> Episodes:
        """Return episodes of 15 s of rest and then some tips (mm) and controls (mm/s, rad/s)."""
        rest = np.zeros((len(tips), WINDOW, 2))
        return Episodes.of_controls(
            self._setup,
            initial=np.array([self.navigation.start_inserted_length_mm, self.navigation.start_rotation_rad]),
            control=np.concatenate([rest, control], axis=1),
            tip=np.concatenate([rest + self.tip, tips], axis=1),
        )
