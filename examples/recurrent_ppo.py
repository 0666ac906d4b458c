"""Train a recurrent policy where seeing costs, by PPO in one file: it decides by itself when to take an X-ray image.

    pip install -c constraints.txt -e '.[env,learn]'
    python examples/recurrent_ppo.py --minutes 4
    python examples/recurrent_ppo.py --minutes 60 --environment endopilot/Crux-v2 --patients 20

Between two exposures only encoders and loads of the drives are observed, so the policy has a memory, a GRU. The loop is
that of CleanRL's `ppo_atari_lstm.py` (Huang et al., JMLR 23, 2022) with continuous actions. The run ends with an error
if nothing was learned.
"""

from __future__ import annotations

import argparse
import time

import gymnasium
import numpy as np
import torch
from gymnasium.vector import AutoresetMode
from torch import nn

STEPS, EPOCHS, MINIBATCHES = 64, 4, 4
GAMMA, LAMBDA, CLIP, LEARNING_RATE, LARGEST_GRADIENT = 0.995, 0.95, 0.2, 5e-4, 0.5
HIDDEN = 128


class Agent(nn.Module):
    """What it observed goes into a memory, and what it remembers decides."""

    def __init__(self, observed: int, actions: int) -> None:
        super().__init__()
        self.encoder = nn.Sequential(nn.Linear(observed, HIDDEN), nn.Tanh())
        self.memory = nn.GRUCell(HIDDEN, HIDDEN)
        self.actor, self.critic = nn.Linear(HIDDEN, actions), nn.Linear(HIDDEN, 1)
        self.log_std = nn.Parameter(torch.full((actions,), -0.5))
        with torch.no_grad():
            self.actor.weight.mul_(0.01)
            self.actor.bias.zero_()
            self.actor.bias[-1] = -1.0  # at first one step in twenty asks for an exposure, and not one in two

    def remember(self, observation: torch.Tensor, memory: torch.Tensor, begun: torch.Tensor) -> torch.Tensor:
        """Return the memory after an observation; where an episode has begun, nothing is remembered from before."""
        return self.memory(self.encoder(observation), memory * (1.0 - begun[:, None]))

    def decide(self, memory: torch.Tensor) -> tuple[torch.distributions.Normal, torch.Tensor]:
        """Return the distribution of actions, and the value."""
        return torch.distributions.Normal(self.actor(memory), self.log_std.exp()), self.critic(memory)[..., 0]


class Rollout:
    """STEPS steps of all worlds, and the memory at their begin."""

    def __init__(self, worlds: int, observed: int, actions: int) -> None:
        self.observations = torch.zeros(STEPS, worlds, observed)
        self.actions = torch.zeros(STEPS, worlds, actions)
        self.begun, self.log_prob, self.values, self.rewards, self.ended = torch.zeros(5, STEPS, worlds)
        self.memory = torch.zeros(worlds, HIDDEN)

    def advantages(self, last_value: torch.Tensor) -> torch.Tensor:
        """Return generalised advantages. Time is observed, so its end is an end like any other."""
        found, after, value_after = torch.zeros_like(self.rewards), torch.zeros_like(last_value), last_value
        for t in reversed(range(STEPS)):
            goes_on = 1.0 - self.ended[t]
            error = self.rewards[t] + GAMMA * value_after * goes_on - self.values[t]
            found[t] = after = error + GAMMA * LAMBDA * goes_on * after
            value_after = self.values[t]
        return found


class Player:
    """Plays episodes in many worlds, and keeps what became of each: seconds, return, safe success, exposures."""

    def __init__(self, worlds: gymnasium.vector.VectorEnv, seed: int) -> None:
        self.worlds, self.episodes, self.began = worlds, [], time.monotonic()
        self.observation = torch.as_tensor(worlds.reset(seed=seed)[0])
        self.begun = torch.ones(worlds.num_envs)
        self.memory = torch.zeros(worlds.num_envs, HIDDEN)
        self.returns = np.zeros(worlds.num_envs)

    @torch.no_grad()
    def play(self, agent: Agent, rollout: Rollout) -> torch.Tensor:
        """Fill a rollout; return the values of what comes after it."""
        rollout.memory = self.memory
        for t in range(STEPS):
            rollout.observations[t], rollout.begun[t] = self.observation, self.begun
            self.memory = agent.remember(self.observation, self.memory, self.begun)
            chances, rollout.values[t] = agent.decide(self.memory)
            rollout.actions[t] = action = chances.sample()
            rollout.log_prob[t] = chances.log_prob(action).sum(-1)
            rollout.rewards[t], rollout.ended[t] = self._step(action.numpy())
        _, value = agent.decide(agent.remember(self.observation, self.memory, self.begun))
        return value

    def _step(self, action: np.ndarray) -> tuple[torch.Tensor, torch.Tensor]:
        observation, reward, terminated, truncated, info = self.worlds.step(action)
        ended = terminated | truncated
        self.returns += reward
        for world in np.flatnonzero(ended):
            safe, now = bool(info["success"][world] and info["safe"][world]), time.monotonic() - self.began
            self.episodes.append((now, self.returns[world], safe, int(info["exposures"][world])))
        if ended.any():
            self.returns[ended] = 0.0
            observation, _ = self.worlds.reset(options={"reset_mask": ended})
        self.observation, self.begun = torch.as_tensor(observation), torch.as_tensor(ended, dtype=torch.float32)
        return torch.as_tensor(reward, dtype=torch.float32), self.begun


def improve(agent: Agent, optimizer: torch.optim.Optimizer, rollout: Rollout, last_value: torch.Tensor) -> None:
    """Take PPO's steps; a minibatch is some worlds, from the rollout's begin to its end."""
    advantages = rollout.advantages(last_value)
    wanted = advantages + rollout.values
    advantages = (advantages - advantages.mean()) / (advantages.std() + 1e-8)
    for _ in range(EPOCHS):
        for part in torch.randperm(rollout.memory.shape[0]).chunk(MINIBATCHES):
            memory, remembered = rollout.memory[part], []
            for t in range(STEPS):
                memory = agent.remember(rollout.observations[t, part], memory, rollout.begun[t, part])
                remembered.append(memory)
            chances, values = agent.decide(torch.stack(remembered))
            log_prob = chances.log_prob(rollout.actions[:, part]).sum(-1)
            ratio, advantage = (log_prob - rollout.log_prob[:, part]).exp(), advantages[:, part]
            gain = torch.minimum(ratio * advantage, ratio.clamp(1 - CLIP, 1 + CLIP) * advantage)
            loss = 0.5 * (values - wanted[:, part]).square().mean() - gain.mean()
            optimizer.zero_grad()
            loss.backward()
            nn.utils.clip_grad_norm_(agent.parameters(), LARGEST_GRADIENT)
            optimizer.step()


def train(worlds: gymnasium.vector.VectorEnv, seconds: float, seed: int) -> tuple[Agent, np.ndarray]:
    """Train for some seconds, at least one rollout; return the agent, and a row for each episode (see `Player`)."""
    torch.manual_seed(seed)
    observed, actions = worlds.single_observation_space.shape[0], worlds.single_action_space.shape[0]
    agent, rollout = Agent(observed, actions), Rollout(worlds.num_envs, observed, actions)
    optimizer = torch.optim.Adam(agent.parameters(), lr=LEARNING_RATE)
    player, steps, said = Player(worlds, seed), 0, 0.0
    while steps == 0 or time.monotonic() - player.began < seconds:
        improve(agent, optimizer, rollout, player.play(agent, rollout))
        steps += STEPS * worlds.num_envs
        now = time.monotonic() - player.began
        if player.episodes and now > said + 30.0:
            said = now
            print(
                f"{now:5.0f} s, {steps} steps: {_described(np.array(player.episodes[-100:], dtype=float))}", flush=True
            )
    return agent, np.array(player.episodes, dtype=float).reshape(-1, 4)


def _described(episodes: np.ndarray) -> str:
    _, value, safe, exposures = episodes.mean(axis=0)
    return f"mean return {value:.2f}, safe success {100 * safe:.0f} %, exposures {exposures:.1f}"


def main() -> None:
    """Train, and check that the return has risen."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--minutes", type=float, default=4.0)
    parser.add_argument("--environment", default="endopilot/NavigateXray-v0")
    parser.add_argument("--patients", type=int, default=1)
    parser.add_argument("--worlds", type=int, default=64)
    parser.add_argument("--seed", type=int, default=0)
    asked = parser.parse_args()
    torch.set_num_threads(1)
    given = {"patients": asked.patients} if asked.patients > 1 else {}
    worlds = gymnasium.make_vec(
        f"endopilot.env:{asked.environment}",
        num_envs=asked.worlds,
        observation="xray",
        autoreset_mode=AutoresetMode.DISABLED,
        **given,
    )
    _, episodes = train(worlds, 60.0 * asked.minutes, asked.seed)
    fifth = max(len(episodes) // 5, 1)
    for name, part in (("first", episodes[:fifth]), ("last", episodes[-fifth:])):
        print(f"{name} fifth of {len(episodes)} episodes: {_described(part)}")
    assert episodes[-fifth:, 1].mean() > episodes[:fifth, 1].mean() + 1.0, "nothing was learned; give it more minutes"


if __name__ == "__main__":
    main()
