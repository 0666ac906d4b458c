"""Train Stable-Baselines3's PPO or SAC for a minute of a core to bring a wire into the posterior descending artery.

    pip install -c constraints.txt -e '.[rl]'
    python examples/train_sb3.py
    python examples/train_sb3.py --algorithm sac
    python examples/train_sb3.py --minutes 30 --xray                # where seeing costs

64 environments are stepped together, as `endopilot.env.sb3.make_vec` gives them to Stable-Baselines3. Hyperparameters
stand in `rl_zoo/ALGORITHM.yml`, which RL Zoo reads, too. What was learned then drives 64 navigations from other
rotations; the run ends with an error if nothing was learned. `--output` writes what became of every episode.
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import torch
import yaml
from stable_baselines3 import PPO, SAC
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.vec_env import VecMonitor

from endopilot.env.sb3 import make_vec

ALGORITHMS = {"ppo": PPO, "sac": SAC}
MOST_MM_S = 12.0
"""Of an action of 1."""
DRIVEN, OTHER_ROTATIONS = 64, 1000
"""Navigations that judge what was learned, and what is added to the seed of the training's for their rotations."""


class Clock(BaseCallback):
    """Keeps what became of every episode: processor time, s, return, safe success; and stops when that time is over."""

    def __init__(self, seconds: float) -> None:
        super().__init__()
        self.seconds, self.episodes = seconds, []

    def _on_training_start(self) -> None:
        self.began = time.process_time()

    def _on_step(self) -> bool:
        now = time.process_time() - self.began
        infos = [info for info in self.locals["infos"] if "episode" in info]
        self.episodes += [(now, float(info["episode"]["r"]), info["is_success"]) for info in infos]
        return now < self.seconds


def make_model(algorithm: str, name: str, seed: int) -> BaseAlgorithm:
    """Return what is to learn in an environment, with the hyperparameters of its file."""
    path = Path(__file__).parent / "rl_zoo" / f"{algorithm}.yml"
    given: dict[str, Any] = yaml.safe_load(path.read_text(encoding="utf-8"))[name]
    del given["n_timesteps"]  # the clock ends the training
    env = VecMonitor(make_vec(name, num_envs=given.pop("n_envs")))
    env.seed(seed)
    model = ALGORITHMS[algorithm](given.pop("policy"), env, seed=seed, device="cpu", **given)
    if "Xray" in name:  # at first one step in twenty asks for an exposure, and not one in two
        moves = model.policy.action_net if algorithm == "ppo" else model.policy.actor.mu
        moves.bias.data[-1] = -1.0
    return model


def safe_share(name: str, decide: Callable[[np.ndarray], np.ndarray], seed: int, count: int = DRIVEN) -> float:
    """Return the share of safe successes of so many navigations, where actions follow from observations."""
    worlds = gymnasium.make_vec(name, num_envs=count)
    seen, _ = worlds.reset(seed=seed)
    ended, safe = np.zeros((2, count), dtype=bool)
    while not ended.all():
        seen, _, terminations, truncations, infos = worlds.step(decide(seen))
        ends = ~ended & (terminations | truncations)
        safe |= ends & infos["success"] & infos["safe"]
        ended |= ends
    return float(safe.mean())


def main() -> None:
    """Train, drive, and check that something was learned."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--minutes", type=float, default=1.0, help="of processor time")
    parser.add_argument("--algorithm", choices=ALGORITHMS, default="ppo")
    parser.add_argument("--xray", action="store_true", help="observe the tip only where an action asks for an exposure")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--output", type=Path, help="a .json of the episodes, which docs/figures/train_sb3.py draws")
    asked = parser.parse_args()
    torch.set_num_threads(1)
    name = f"endopilot/Navigate{'Xray' if asked.xray else ''}-v0"
    model, clock = make_model(asked.algorithm, name, asked.seed), Clock(60.0 * asked.minutes)
    push = np.zeros((DRIVEN, *model.action_space.shape), dtype=np.float32)
    push[:, 0] = 5.0 / MOST_MM_S
    pushed = safe_share(name, lambda _: push, OTHER_ROTATIONS + asked.seed)
    model.learn(total_timesteps=10**9, callback=clock)

    def decide(seen: np.ndarray) -> np.ndarray:
        return model.predict(seen, deterministic=not asked.xray)[0]  # the mean would look always or never

    safe = safe_share(name, decide, OTHER_ROTATIONS + asked.seed)
    print(f"{model.num_timesteps} steps, {len(clock.episodes)} episodes in {asked.minutes:g} minutes")
    print(f"safe success {100 * safe:.0f} %, pushing alone {100 * pushed:.0f} %")
    if asked.output:
        asked.output.parent.mkdir(parents=True, exist_ok=True)
        told = {"steps": model.num_timesteps, "safe": safe, "pushed": pushed, "episodes": clock.episodes}
        asked.output.write_text(json.dumps(told), encoding="utf-8")
    assert safe > pushed, "nothing was learned; give it more minutes"


if __name__ == "__main__":
    main()
