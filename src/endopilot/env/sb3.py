"""Environments that Stable-Baselines3's algorithms take: `make_vec`."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import gymnasium
import numpy as np
from gymnasium.vector import VectorEnv

from endopilot.extras import extra_named

with extra_named("endopilot.env.sb3"):
    from stable_baselines3.common.vec_env import VecEnv  # pyright: ignore[reportMissingImports]


def make_vec(name: str, num_envs: int = 1, **given: Any) -> VecEnv:
    """Return the worlds that `gymnasium.make_vec` makes, as Stable-Baselines3 takes them.

    A step's infos are empty but for worlds whose episode ends: they hold all that `NavigateVectorEnv` tells, and what
    Stable-Baselines3 looks for: `terminal_observation`, `TimeLimit.truncated`, and `is_success`, a safe success::

        model = PPO("MlpPolicy", make_vec("endopilot/Crux-v2", num_envs=64, patients=16))

    Args:
        name: of an environment.
        num_envs: number of worlds.
        given: what else `NavigateVectorEnv` takes, and refuses by `InputError`.
    """
    return _Worlds(gymnasium.make_vec(name, num_envs=num_envs, autoreset_mode="SameStep", **given))


class _Worlds(VecEnv):
    """An environment with `autoreset_mode="SameStep"`, whose worlds end as those of Stable-Baselines3."""

    def __init__(self, worlds: VectorEnv) -> None:
        self.worlds = worlds
        super().__init__(worlds.num_envs, worlds.single_observation_space, worlds.single_action_space)

    def reset(self) -> Any:
        observations, _ = self.worlds.reset(seed=self._seeds)  # which `seed` has set, or are none
        self._reset_seeds()
        return observations

    def step_async(self, actions: np.ndarray) -> None:
        self._actions = actions

    def step_wait(self) -> Any:
        observations, rewards, terminations, truncations, info = self.worlds.step(self._actions)
        ended, infos = terminations | truncations, list[dict[str, Any]]({} for _ in rewards)
        for world in np.flatnonzero(ended).tolist():
            final = {name: of[world].item() for name, of in info["final_info"].items() if not name.startswith("_")}
            infos[world] = final | {
                "terminal_observation": info["final_obs"][world],
                "TimeLimit.truncated": bool(truncations[world]),
                "is_success": final["success"] and final["safe"],
            }
        return observations, rewards.astype(np.float32), ended, infos

    def close(self) -> None:
        self.worlds.close()

    def get_images(self) -> Sequence[Any]:
        return self.worlds.render() or ()

    def get_attr(self, attr_name: str, indices: Any = None) -> list[Any]:
        return [getattr(self.worlds, attr_name) for _ in self._get_indices(indices)]

    def env_is_wrapped(self, wrapper_class: Any, indices: Any = None) -> list[bool]:
        return [False for _ in self._get_indices(indices)]

    def _refused(self, name: str, *_: Any, **__: Any) -> Any:
        raise NotImplementedError(f"{name}: the worlds are stepped together; give make_vec what they are to be")

    set_attr = env_method = _refused
