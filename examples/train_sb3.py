"""Train Stable-Baselines3's PPO for five minutes to bring a wire into the posterior descending artery.

    pip install -c constraints.txt -e '.[rl]'
    python examples/train_sb3.py --minutes 5 --picture train_sb3.png
    python examples/train_sb3.py --minutes 30 --xray                # where seeing costs

64 environments are stepped together, as `endopilot.env.sb3.make_vec` gives them to Stable-Baselines3. The figure shows
return and success of the episodes against time; the run ends with an error if nothing was learned.
"""

from __future__ import annotations

import argparse
import time
from pathlib import Path

import numpy as np
import torch
from matplotlib.figure import Figure
from stable_baselines3 import PPO
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.vec_env import VecMonitor

import endopilot
from endopilot.env.sb3 import make_vec

ENVIRONMENTS, STEPS = 64, 64
MOST_MM_S = 12.0
"""Of an action of 1."""


class Clock(BaseCallback):
    """Keeps what became of every episode, and stops when the time is over."""

    def __init__(self, seconds: float) -> None:
        super().__init__()
        self.seconds, self.episodes = seconds, []

    def _on_training_start(self) -> None:
        self.began = time.monotonic()

    def _on_step(self) -> bool:
        now = time.monotonic() - self.began
        infos = [info for info in self.locals["infos"] if "episode" in info]
        self.episodes += [(now, info["episode"]["r"], info["is_success"]) for info in infos]
        return now < self.seconds


def pushing() -> float:
    """Return the share of safe successes of an agent that only pushes, at 5 mm/s, for comparison."""
    worlds = endopilot.NavigateVectorEnv(ENVIRONMENTS)
    worlds.reset(seed=0)
    ended, safe = np.zeros(ENVIRONMENTS, dtype=bool), np.zeros(ENVIRONMENTS, dtype=bool)
    for _ in range(300):
        push = np.where(ended, 0.0, 5.0 / MOST_MM_S)
        _, _, terminations, truncations, infos = worlds.step(np.column_stack([push, np.zeros(ENVIRONMENTS)]))
        safe |= ~ended & infos["success"] & infos["safe"]
        ended |= terminations | truncations
    return float(safe.mean())


def main() -> None:
    """Train, draw the curve and check that it rises."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--minutes", type=float, default=5.0)
    parser.add_argument("--xray", action="store_true", help="observe the tip only where an action asks for an exposure")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--picture", type=Path, default=Path("train_sb3.png"))
    asked = parser.parse_args()
    print(f"pushing alone: safe success {100 * pushing():.0f} %")
    torch.set_num_threads(1)
    env = VecMonitor(make_vec(f"endopilot/Navigate{'Xray' if asked.xray else ''}-v0", num_envs=ENVIRONMENTS))
    env.seed(asked.seed)
    model = PPO(
        "MlpPolicy",
        env,
        n_steps=STEPS,
        batch_size=1024,
        n_epochs=5,
        gamma=0.995,
        learning_rate=5e-4,
        policy_kwargs={"net_arch": [128, 128], "log_std_init": -0.5},
        seed=asked.seed,
        device="cpu",
    )
    if asked.xray:  # at first one step in twenty asks for an exposure, and not one in two
        model.policy.action_net.bias.data[-1] = -1.0
    clock = Clock(60.0 * asked.minutes)
    model.learn(total_timesteps=10**9, callback=clock)
    seconds, returns, success = (np.array(column, dtype=float) for column in zip(*clock.episodes, strict=True))
    fifth = max(len(seconds) // 5, 1)
    print(f"{model.num_timesteps} steps, {len(seconds)} episodes in {seconds[-1]:.0f} s")
    for name, part in (("first", slice(None, fifth)), ("last", slice(-fifth, None))):
        print(f"{name} fifth: mean return {returns[part].mean():.2f}, safe success {100 * success[part].mean():.0f} %")
    draw(seconds, returns, success, asked.picture)
    assert returns[-fifth:].mean() > returns[:fifth].mean() + 1.0, "nothing was learned; give it more minutes"


def draw(seconds: np.ndarray, returns: np.ndarray, success: np.ndarray, path: Path) -> None:
    """Draw the running means over 100 episodes."""
    width = min(100, len(returns))
    mean = np.ones(width) / width
    figure = Figure(figsize=(7, 3.2), layout="constrained")
    for ax, values, title in zip(
        figure.subplots(1, 2), (returns, 100 * success), ("return of an episode", "safe success, %"), strict=True
    ):
        ax.plot(seconds[width - 1 :] / 60, np.convolve(values, mean, mode="valid"))
        ax.set(xlabel="minutes", ylabel=title)
        ax.grid(alpha=0.3)
    figure.suptitle(f"PPO, {ENVIRONMENTS} environments, running mean over {width} episodes", fontsize=10)
    figure.savefig(path, dpi=110)


if __name__ == "__main__":
    main()
