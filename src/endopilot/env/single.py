"""Navigation as a learning environment, one world: `NavigateEnv`."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
from gymnasium.vector import AutoresetMode
from jaxtyping import UInt8
from numpy.typing import ArrayLike

from endopilot.devices.robot import RobotConfig
from endopilot.env.episodes import NavigationState
from endopilot.env.observation import Observed
from endopilot.env.vector import NavigateVectorEnv, Observations
from endopilot.simulation.config import SimulatorConfig
from endopilot.simulation.motion import Motion
from endopilot.simulation.simulator import Simulator
from endopilot.simulation.world import World
from endopilot.tasks.navigation import Navigation
from endopilot.tasks.task import CORE, LadderVersion
from endopilot.xray.fluoroscope import FluoroscopeConfig


class NavigateEnv(gymnasium.Env):
    """Bring a guidewire to a target in a vessel tree: `NavigateVectorEnv` with one world.

    Spaces, reward, start and ends are as `NavigateVectorEnv` says; info holds numbers in place of arrays. After the end
    of an episode it waits for `reset`.

    ## Version history

    - v0: first version.
    """

    metadata: dict[str, Any] = NavigateVectorEnv.metadata

    def __init__(
        self,
        *,
        navigation: Navigation | None = None,
        task: str | None = None,
        patient: int = 0,
        catheter: str | None = None,
        version: LadderVersion = 1,
        observation: Observed = "state",
        pixels: int = 64,
        c_arm: FluoroscopeConfig | None = None,
        world: World | str | Path | Sequence[World | str | Path] | None = None,
        robot: RobotConfig | str | Path | Sequence[RobotConfig | str | Path] | None = None,
        motion: Motion | None = None,
        config: SimulatorConfig = CORE,
        render_mode: str | None = None,
    ) -> None:
        """Lay the wire out; `reset` starts the first episode.

        Args:
            navigation: what is to be done.
            task: in its place, the name of a task of the ladder.
            patient: which of its training patients.
            catheter: name of a catheter around the wire, or a YAML file; its tip is to arrive then.
            version: of the ladder that the task is of, or a folder of tasks of one's own, of which the first is done if
                none is named.
            observation: what is observed.
            pixels: rows and columns of an image, 64 to 128.
            c_arm: its views, one or two, and errors of detection.
            world: what reality is where it differs from the navigation, or its name or YAML file; or "random".
            robot: what drives, likewise; the device does as commanded if not given, or where X-ray shows the tip, the
                robot is as assumed.
            motion: how heart and breath move the vessel and its guiding catheter; they lie still if not given.
            config: settings of the rod core.
            render_mode: "rgb_array" lets `render` return pictures.
        """
        self._worlds = NavigateVectorEnv(
            navigations=navigation,
            task=task,
            patient=patient,
            catheter=catheter,
            autoreset_mode=AutoresetMode.DISABLED,
            version=version,
            observation=observation,
            pixels=pixels,
            c_arm=c_arm,
            world=world,
            robot=robot,
            motion=motion,
            config=config,
            render_mode=render_mode,
        )
        self.render_mode = render_mode
        self.action_space = self._worlds.single_action_space
        self.observation_space = self._worlds.single_observation_space

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observations, dict[str, Any]]:
        """Start an episode; `options` are not used."""
        super().reset(seed=seed)
        self._worlds.draw_from(self.np_random)
        observations, infos = self._worlds.reset()
        return _of_first(observations), _first(infos)

    def step(self, action: ArrayLike) -> tuple[Observations, float, bool, bool, dict[str, Any]]:
        """Drive the wire for a control period."""
        row = np.asarray(action, dtype=float)[None]
        observations, rewards, terminations, truncations, infos = self._worlds.step(row)
        ended = bool(terminations[0]), bool(truncations[0])
        return _of_first(observations), float(rewards[0]), *ended, _first(infos)

    def render(self) -> UInt8[np.ndarray, "256 256 3"] | None:
        """Return a picture with `render_mode="rgb_array"`: vessel, target, wire and catheters."""
        pictures = self._worlds.render()
        return None if pictures is None else pictures[0]

    @property
    def simulator(self) -> Simulator:
        """The world, for pictures of the wire; stepping it bypasses the environment."""
        return self._worlds.simulator

    @property
    def state(self) -> NavigationState:
        """All that the future depends on, to be kept and given to `set_state`."""
        return self._worlds.state

    def set_state(self, state: NavigationState) -> None:
        """Go back to a state, bit by bit."""
        self._worlds.draw_from(self.np_random)
        self._worlds.set_state(state)


def _of_first(observations: Observations) -> Observations:
    if isinstance(observations, dict):
        return {name: values[0] for name, values in observations.items()}
    return observations[0]


def _first(infos: dict[str, Any]) -> dict[str, Any]:
    return {name: values[0].item() for name, values in infos.items() if not name.startswith("_")}
