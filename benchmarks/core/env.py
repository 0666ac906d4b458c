"""Speed of the learning environments, and the error of the settings that they simulate with: `bench_env`."""

from __future__ import annotations

import time
from typing import Any

import numpy as np
from jaxtyping import Float

from benchmarks.core.reference import CONVERGED
from benchmarks.figures import spread
from endopilot.env.observation import CONTROL_PERIOD_S
from endopilot.env.vector import ROTATION_RAD_S, TRANSLATION_MM_S, NavigateVectorEnv
from endopilot.files import processor_name
from endopilot.simulation.config import SimulatorConfig
from endopilot.simulation.controls import ControlConfig, random_controls
from endopilot.simulation.simulator import Simulator
from endopilot.tasks.task import CORE, reference_navigation
from endopilot.types import SAMPLE_PERIOD_S

MANY = 256
SECONDS = 60.0
"""Length of the navigations that are timed, s: an episode."""
SINGLES = 4
"""Episodes of a single environment that are timed."""
CATHETER = "microcatheter-1.7f"
"""Around the wire of the coaxial environments, whose drive is moved like the wire's and independently of it."""
EXPOSE_EVERY = 15
"""Steps from one exposure to the next where seeing costs: 2 s."""
SEEN, SEEN_SECONDS = 64, 8.0
"""Environments whose exposures are timed, and for how long, s."""
COMPARED, COMPARED_SECONDS = 8, 30.0
"""Navigations that the error is measured on, and their length, s."""


def bench_env() -> dict[str, Any]:
    """Measure the steps per second of the learning environments in the reference anatomy, and the tip's error.

    There are two kinds of actions: the random navigations of datasets (`simulation.controls`: pushes, pulls, turns and
    pauses of 1 to 6 s, from the ostium to the distal ends), and actions drawn independently at every step, for which
    the core cannot extrapolate its last step.

    Returns:
        `steps_per_second_256` and `steps_per_second_1`, of 256 environments together and of one, over a minute's
        navigations, on all cores and with all overhead; the same with the prefix `random_actions_` for actions drawn
        independently, with `coaxial_` for a wire in a catheter, and with `xray_` where seeing costs and an exposure is
        taken every 2 s; `exposures_per_second_64`, of the tip, one at every step of 64 environments, the steps
        included; `images_per_second_64` and `images_per_second_128`, X-ray images of so many pixels a side, two at
        every step, likewise; all these with `processor_` for a second of processor
        time; the median, the mean, the 95th percentile and the maximum of the tip's distance from that of a core with
        the settings of the reference (`reference.CONVERGED`), mm, with the environments' settings and with the
        simulator's default ones; and the share of worlds that stayed valid.
    """
    figures: dict[str, Any] = {}
    valid = []
    kinds: tuple[tuple[str, dict[str, Any], bool], ...] = (
        ("", {}, False),
        ("random_actions_", {}, True),
        ("coaxial_", {"catheter": CATHETER}, False),
        ("xray_", {"observation": "xray"}, False),
    )
    for prefix, given, independent in kinds:
        for count, episodes in ((MANY, 1), (1, SINGLES)):
            wall, processor, kept = _timed(NavigateVectorEnv(count, **given), episodes, independent=independent)
            steps = count * episodes * round(SECONDS / CONTROL_PERIOD_S)
            figures[f"{prefix}steps_per_second_{count}"] = round(steps / wall, 1)
            figures[f"{prefix}processor_steps_per_second_{count}"] = round(steps / processor, 1)
            valid.append(kept)
    seen: tuple[tuple[str, int, dict[str, Any]], ...] = (
        ("exposures_per_second_64", 1, {"observation": "xray"}),
        ("images_per_second_64", 2, {"observation": "image", "pixels": 64}),
        ("images_per_second_128", 2, {"observation": "image", "pixels": 128}),
    )
    for name, images, given in seen:
        env = NavigateVectorEnv(SEEN, **given)
        wall, processor, _ = _timed(env, 1, independent=False, seconds=SEEN_SECONDS, expose_every=1)
        images *= SEEN * round(SEEN_SECONDS / CONTROL_PERIOD_S)
        figures |= {name: round(images / wall, 1), f"processor_{name}": round(images / processor, 1)}
    exact = _tips(CONVERGED)
    for prefix, config in (("", CORE), ("default_", SimulatorConfig())):
        error = np.linalg.norm(_tips(config) - exact, axis=-1)
        figures |= spread(f"{prefix}true_tip_error", error, digits=4)
    return figures | {"valid_worlds": round(float(np.mean(valid)), 5), "processor": processor_name()}


def _timed(
    env: NavigateVectorEnv,
    episodes: int,
    *,
    independent: bool,
    seconds: float = SECONDS,
    expose_every: int = EXPOSE_EVERY,
) -> tuple[float, float, float]:
    """Return wall and processor seconds of some episodes, and the share of valid worlds at their end."""
    count, steps, numbers = env.num_envs, round(seconds / CONTROL_PERIOD_S), 2 * len(env.navigations[0].devices)
    if independent:
        actions = np.random.default_rng(0).uniform(-1.0, 1.0, (episodes, steps, count, numbers))
    else:
        drives = [_navigations(count * episodes, seconds, first=k * 2**32) for k in range(numbers // 2)]
        actions = np.concatenate(drives, axis=-1).reshape(episodes, count, steps, numbers).swapaxes(1, 2)
    if env.action_space.shape != (count, numbers):
        expose = np.where(np.arange(steps) % expose_every, -1.0, 1.0)[None, :, None, None]
        actions = np.concatenate([actions, np.broadcast_to(expose, (*actions.shape[:3], 1))], axis=-1)
    wall = processor = 0.0
    valid = np.ones(count, dtype=bool)
    for episode in range(episodes):
        env.reset(seed=episode)
        began = time.perf_counter(), time.process_time()
        for action in actions[episode]:
            valid &= env.step(action)[4]["valid"]
        wall, processor = wall + time.perf_counter() - began[0], processor + time.process_time() - began[1]
    return wall, processor, float(valid.mean())


def _navigations(count: int, seconds: float, *, first: int) -> Float[np.ndarray, "count steps 2"]:
    """Return random navigations as actions of one drive, from number `first` on."""
    longest = float(reference_navigation().anatomy.tree.longest_path().abscissa[-1])
    samples = int(np.ceil(seconds / SAMPLE_PERIOD_S))
    _, control = random_controls(
        ControlConfig(), n_sequences=count, n_samples=samples, seed=0, max_inserted_length_mm=longest, first=first
    )
    at = (np.arange(round(seconds / CONTROL_PERIOD_S)) * CONTROL_PERIOD_S / SAMPLE_PERIOD_S).astype(int)
    return control[:, at, 0] / (TRANSLATION_MM_S, ROTATION_RAD_S)


def _tips(config: SimulatorConfig) -> Float[np.ndarray, "steps worlds 3"]:
    """Return the tips of navigations from different initial states, simulated with some settings."""
    navigation = reference_navigation()
    longest = float(navigation.anatomy.tree.longest_path().abscissa[-1])
    initial, control = random_controls(
        ControlConfig(),
        n_sequences=COMPARED,
        n_samples=round(COMPARED_SECONDS / SAMPLE_PERIOD_S),
        seed=0,
        max_inserted_length_mm=longest,
    )
    simulator = Simulator(navigation.anatomy, navigation.device, worlds=COMPARED, config=config)
    simulator.reset(inserted_length=initial[..., 0], rotation=initial[..., 1])
    tips = []
    for step in range(round(COMPARED_SECONDS / CONTROL_PERIOD_S)):
        sample = int(step * CONTROL_PERIOD_S / SAMPLE_PERIOD_S)
        room = (longest - simulator.inserted_length) / CONTROL_PERIOD_S
        held = np.stack([np.minimum(control[:, sample, :, 0], room), control[:, sample, :, 1]], axis=-1)
        tips.append(simulator.step(held, CONTROL_PERIOD_S).tip_position[:, 0])
    return np.array(tips)
