"""Train a recurrent policy by PPO in one file, and score it in patients that it was not trained in.

    pip install -c constraints.txt -e '.[env,learn]'
    python examples/recurrent_ppo.py --minutes 4
    python examples/recurrent_ppo.py --minutes 60 --tasks 8 --observation state --output state.pt
    python examples/recurrent_ppo.py --score state.pt

Without `--tasks` it learns one task in one patient; with it the lowest tasks of the ladder, in 20 training patients
each. With the observation `xray` seeing costs: between two exposures only encoders and loads of the drives are
observed, and the policy decides by itself when to take one. So it has a memory, a GRU. The loop is that of CleanRL's
`ppo_atari_lstm.py` (Huang et al., JMLR 23, 2022) with continuous actions. The run ends with an error if nothing was
learned. `--score` lets the mean motions of a saved policy drive the ladder's own patients.
"""

from __future__ import annotations

import argparse
import time
from pathlib import Path

import numpy as np
import torch
from gymnasium.vector import AutoresetMode
from torch import nn

import endopilot
from endopilot.tasks.task import list_tasks

STEPS, EPOCHS, MINIBATCHES = 64, 4, 4
GAMMA, LAMBDA, CLIP, LEARNING_RATE, LARGEST_GRADIENT = 0.995, 0.95, 0.2, 5e-4, 0.5
HIDDEN = 128
PATIENTS, WORLDS_EACH = 20, 8
"""Patients of each task, and worlds of each patient: worlds of one patient are stepped side by side."""


class Agent(nn.Module):
    """What it observed goes into a memory, and what it remembers decides."""

    def __init__(self, observed: int, actions: int) -> None:
        super().__init__()
        self.given = observed, actions
        self.encoder = nn.Sequential(nn.Linear(observed, HIDDEN), nn.Tanh(), nn.Linear(HIDDEN, HIDDEN), nn.Tanh())
        self.memory = nn.GRUCell(HIDDEN, HIDDEN)
        self.actor, self.critic = nn.Linear(HIDDEN, actions), nn.Linear(HIDDEN, 1)
        self.log_std = nn.Parameter(torch.full((actions,), -0.5))
        with torch.no_grad():
            self.actor.weight.mul_(0.01)
            self.actor.bias.zero_()
            if actions == 3:
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

    def __init__(self, worlds: endopilot.NavigateVectorEnv, seed: int) -> None:
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
            last, now = info["final_info"], time.monotonic() - self.began
            safe = bool(last["success"][world] and last["safe"][world])
            exposures = int(last["exposures"][world]) if "exposures" in last else 0
            self.episodes.append((now, self.returns[world], safe, exposures))
        self.returns[ended] = 0.0
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


def train(worlds: endopilot.NavigateVectorEnv, seconds: float, seed: int) -> tuple[Agent, np.ndarray]:
    """Train for some seconds, at least one rollout; return the agent, and a row for each episode (see `Player`)."""
    torch.manual_seed(seed)
    observed, actions = worlds.single_observation_space.shape[0], worlds.single_action_space.shape[0]
    agent, rollout = Agent(observed, actions), Rollout(worlds.num_envs, observed, actions)
    optimizer = torch.optim.Adam(agent.parameters())
    player, steps, said, now = Player(worlds, seed), 0, 0.0, 0.0
    while steps == 0 or now < seconds:
        optimizer.param_groups[0]["lr"] = LEARNING_RATE * max(1.0 - now / max(seconds, 1.0), 0.05)
        improve(agent, optimizer, rollout, player.play(agent, rollout))
        steps += STEPS * worlds.num_envs
        now = time.monotonic() - player.began
        if player.episodes and now > said + 30.0:
            said = now
            last = np.array(player.episodes[-worlds.num_envs :], dtype=float)
            print(f"{now:5.0f} s, {steps} steps: {_described(last)}", flush=True)
    return agent, np.array(player.episodes, dtype=float).reshape(-1, 4)


@torch.no_grad()
def score(path: Path) -> list[tuple[str, int, int, int, float]]:
    """Let the mean motions of a saved policy drive the ladder's patients of the tasks that it was trained on.

    Returns:
        For each task its name, safe successes, successes, navigations, and mean exposures (0 where all is observed).
    """
    torch.manual_seed(0)
    saved, scores = torch.load(path), []
    agent, observation = Agent(*saved["given"]), "xray" if saved["given"][1] == 3 else "state"
    agent.load_state_dict(saved["weights"])
    for task in list_tasks()[: saved["tasks"]]:
        given = [task.ladder_navigation(place) for place in range(len(task.ladder.numbers))]
        worlds = _worlds(len(given), observation, navigations=given)
        seen, begun = torch.as_tensor(worlds.reset(seed=0)[0]), torch.ones(len(given))
        memory, going, exposures = (
            torch.zeros(len(given), HIDDEN),
            np.ones(len(given), dtype=bool),
            np.zeros(len(given)),
        )
        success, safe = np.zeros((2, len(given)), dtype=bool)
        while going.any():
            memory, begun = agent.remember(seen, memory, begun), torch.zeros_like(begun)
            chances, _ = agent.decide(memory)
            action = chances.mean
            action[:, 2:] = chances.sample()[:, 2:]  # when to look is drawn: the mean would look always or never
            after, _, terminated, truncated, info = worlds.step(action.numpy())
            seen, ends = torch.as_tensor(after), going & (terminated | truncated)
            if ends.any():
                last = info["final_info"]
                success[ends], safe[ends] = last["success"][ends], last["safe"][ends]
                exposures[ends] = last["exposures"][ends] if "exposures" in last else 0
                going &= ~ends
        scores.append((task.name, int((success & safe).sum()), int(success.sum()), len(given), float(exposures.mean())))
    return scores


def _worlds(count: int, observation: str, **given: object) -> endopilot.NavigateVectorEnv:
    return endopilot.NavigateVectorEnv(count, observation=observation, autoreset_mode=AutoresetMode.SAME_STEP, **given)


def _described(episodes: np.ndarray) -> str:
    _, value, safe, exposures = episodes.mean(axis=0)
    return f"mean return {value:.2f}, safe success {100 * safe:.0f} %, exposures {exposures:.1f}"


def main() -> None:
    """Train, and check that the return has risen; or score."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--minutes", type=float, default=4.0)
    parser.add_argument("--tasks", type=int, default=0)
    parser.add_argument("--observation", choices=("xray", "state"), default="xray")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--output", type=Path)
    parser.add_argument("--score", type=Path)
    asked = parser.parse_args()
    if asked.output and not asked.tasks:
        parser.error("--output: what learned one task in one patient has no tasks to be scored on; give --tasks too")
    torch.set_num_threads(1)
    if asked.score:
        for name, safe, success, count, exposures in score(asked.score):
            print(f"{name}: safe success {safe} of {count}, success {success}, exposures {exposures:.1f}", flush=True)
        return
    if asked.output:
        asked.output.parent.mkdir(parents=True, exist_ok=True)
    if asked.tasks:
        given = [task.learning_navigation(place) for task in list_tasks()[: asked.tasks] for place in range(PATIENTS)]
        worlds = _worlds(WORLDS_EACH * len(given), asked.observation, navigations=given)
    else:
        worlds = _worlds(64, asked.observation)
    agent, episodes = train(worlds, 60.0 * asked.minutes, asked.seed)
    if asked.output:
        torch.save({"given": agent.given, "tasks": asked.tasks, "weights": agent.state_dict()}, asked.output)
        np.savetxt(
            asked.output.with_suffix(".csv"), episodes, "%.4g", ",", header="s,return,safe,exposures", comments=""
        )
    fifth = max(len(episodes) // 5, 1)
    for name, part in (("first", episodes[:fifth]), ("last", episodes[-fifth:])):
        print(f"{name} fifth of {len(episodes)} episodes: {_described(part)}")
    assert episodes[-fifth:, 1].mean() > episodes[:fifth, 1].mean() + 1.0, "nothing was learned; give it more minutes"


if __name__ == "__main__":
    main()
