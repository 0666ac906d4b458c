"""Navigation as a learning environment, one world: `NavigateEnv`."""

from __future__ import annotations

from pathlib import Path
from typing import Any, Literal

import gymnasium
import numpy as np
from gymnasium.vector import AutoresetMode
from jaxtyping import UInt8
from numpy.typing import ArrayLike

from endopilot.env.observation import NavigationState
from endopilot.env.vector import NavigateVectorEnv, Observations, of_world, refuse_options
from endopilot.simulation.simulator import Simulator
from endopilot.tasks.targets import Place
from endopilot.types import Anatomy


class NavigateEnv(gymnasium.Env):
    """Bring a guidewire to a target in a vessel tree: `NavigateVectorEnv` with one world.

    Spaces, reward, start and ends are as `NavigateVectorEnv` says; info holds numbers in place of arrays. After the end
    of an episode it waits for `reset`.
    """

    metadata: dict[str, Any] = NavigateVectorEnv.metadata

    def __init__(
        self,
        anatomy: Anatomy | str | Path | None = None,
        target: str | Place | None = None,
        *,
        render_mode: Literal["rgb_array"] | None = None,
        **given: Any,
    ) -> None:
        """Lay the wire out; `reset` starts the first episode.

        Args:
            anatomy: a vessel of your own, or its folder.
            target: where the tip is to go in it: a section such as "LAD", or a point.
            render_mode: "rgb_array" lets `render` return pictures.
            given: what else `NavigateVectorEnv` takes, and refuses by `InputError`; of several navigations or patients
                the first is done.
        """
        given |= {"render_mode": render_mode, "autoreset_mode": AutoresetMode.DISABLED}
        self._worlds = NavigateVectorEnv(1, anatomy, target, **given)
        self.render_mode = render_mode
        self.action_space = self._worlds.single_action_space
        self.observation_space = self._worlds.single_observation_space

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observations, dict[str, Any]]:
        """Start an episode; it knows no options, and refuses them by `InputError`."""
        refuse_options(options)
        super().reset(seed=seed)
        self._worlds.draw_from(self.np_random)
        observations, infos = self._worlds.reset()
        return of_world(observations, 0), _first(infos)

    def step(self, action: ArrayLike) -> tuple[Observations, float, bool, bool, dict[str, Any]]:
        """Drive the wire for a control period; `ResetNeeded` is raised before `reset` and after an episode's end."""
        row = np.asarray(action, dtype=float)[None]
        observations, rewards, terminations, truncations, infos = self._worlds.step(row)
        ended = bool(terminations[0]), bool(truncations[0])
        return of_world(observations, 0), float(rewards[0]), *ended, _first(infos)

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


def _first(infos: dict[str, Any]) -> dict[str, Any]:
    return {name: values[0].item() for name, values in infos.items() if not name.startswith("_")}
