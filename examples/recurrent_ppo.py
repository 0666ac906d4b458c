"""Train a recurrent policy by PPO in one file, and score it in patients that it was not trained in.

    pip install -c constraints.txt -e '.[env,learn]'
    python examples/recurrent_ppo.py --minutes 4
    python examples/recurrent_ppo.py --minutes 60 --tasks 8 --observation state --output state.npz
    python examples/recurrent_ppo.py --score state.npz --tasks 12

Without `--tasks` it learns one task in one patient; with it the lowest tasks of the ladder, in 20 training patients
each. With the observation `xray` seeing costs: between two exposures only encoders and loads of the drives are
observed, and the policy decides by itself when to take one. So it has a memory, a GRU. The loop is that of CleanRL's
`ppo_atari_lstm.py` (Huang et al., JMLR 23, 2022) with continuous actions. The run ends with an error if nothing was
learned. `--score` lets the mean motions of a saved policy drive the ladder's own patients, of the tasks that it has
learned or of so many.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch
from gymnasium.vector import AutoresetMode
from torch import nn

import endopilot
from endopilot.tasks.task import NEWEST, Task, list_tasks, training_navigations

PERIOD_S = 0.5
"""Time between two decisions, s, as on the ladder."""
STEPS, EPOCHS, MINIBATCHES = 16, 4, 4
GAMMA, LAMBDA, CLIP, LEARNING_RATE, LARGEST_GRADIENT = 0.98, 0.9, 0.2, 5e-4, 0.5
HIDDEN = 128
PATIENTS, WORLDS_EACH = 20, 4
"""Patients of each task, and worlds of each patient: worlds of one patient are stepped side by side."""
TOLD = {"distance_mm": 100.0, "tip_offset": 1.0, "contact_force_max": 0.1, "tip_abscissa": 100.0}
"""What the critic is told of the truth besides, and a usual size of each: the actor has to do with what it sees."""


class Agent(nn.Module):
    """What it observed goes into a memory, and what it remembers decides."""

    def __init__(self, observed: int, actions: int) -> None:
        super().__init__()
        self.encoder = nn.Sequential(nn.Linear(observed, HIDDEN), nn.Tanh(), nn.Linear(HIDDEN, HIDDEN), nn.Tanh())
        self.memory = nn.GRUCell(HIDDEN, HIDDEN)
        self.actor = nn.Linear(HIDDEN, actions)
        self.critic = nn.Sequential(nn.Linear(HIDDEN + len(TOLD), HIDDEN), nn.Tanh(), nn.Linear(HIDDEN, 1))
        self.log_std = nn.Parameter(torch.tensor([-1.2, -1.2, -0.5][:actions]))  # of moves, and of when to look
        with torch.no_grad():
            self.actor.weight.mul_(0.01)
            self.actor.bias.zero_()
            if actions == 3:
                self.actor.bias[-1] = -0.3  # at first one step in three asks for an exposure

    def remember(self, observation: torch.Tensor, memory: torch.Tensor, begun: torch.Tensor) -> torch.Tensor:
        """Return the memory after an observation; where an episode has begun, nothing is remembered from before."""
        return self.memory(self.encoder(observation), memory * (1.0 - begun[:, None]))

    def decide(self, memory: torch.Tensor) -> torch.distributions.Normal:
        """Return the distribution of actions."""
        return torch.distributions.Normal(self.actor(memory), self.log_std.exp())

    def value(self, memory: torch.Tensor, told: torch.Tensor) -> torch.Tensor:
        """Return what is expected of the rest of the episode, by one who is told how it stands."""
        return self.critic(torch.cat([memory, told], dim=-1))[..., 0]


class Rollout:
    """STEPS steps of all worlds, and the memory at their begin."""

    def __init__(self, worlds: int, observed: int, actions: int) -> None:
        self.observations = torch.zeros(STEPS, worlds, observed)
        self.actions = torch.zeros(STEPS, worlds, actions)
        self.begun, self.log_prob, self.values, self.rewards, self.ended = torch.zeros(5, STEPS, worlds)
        self.memory, self.told = torch.zeros(worlds, HIDDEN), torch.zeros(STEPS, worlds, len(TOLD))

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

    def __init__(self, worlds: endopilot.NavigateVectorEnv, seed: int, dearer: float) -> None:
        self.worlds, self.dearer, self.episodes, self.began = worlds, dearer, [], time.monotonic()
        observation, info = worlds.reset(seed=seed)
        self.observation, self.told = torch.as_tensor(observation), _told(info)
        self.begun = torch.ones(worlds.num_envs)
        self.memory = torch.zeros(worlds.num_envs, HIDDEN)
        self.returns = np.zeros(worlds.num_envs)

    @torch.no_grad()
    def play(self, agent: Agent, rollout: Rollout) -> torch.Tensor:
        """Fill a rollout; return the values of what comes after it."""
        rollout.memory = self.memory
        for t in range(STEPS):
            rollout.observations[t], rollout.told[t], rollout.begun[t] = self.observation, self.told, self.begun
            self.memory = agent.remember(self.observation, self.memory, self.begun)
            chances, rollout.values[t] = agent.decide(self.memory), agent.value(self.memory, self.told)
            rollout.actions[t] = action = chances.sample()
            rollout.log_prob[t] = chances.log_prob(action).sum(-1)
            rollout.rewards[t], rollout.ended[t] = self._step(action.numpy())
        return agent.value(agent.remember(self.observation, self.memory, self.begun), self.told)

    def _step(self, action: np.ndarray) -> tuple[torch.Tensor, torch.Tensor]:
        observation, reward, terminated, truncated, info = self.worlds.step(action)
        reward = reward - self.dearer * (action[:, 2:] > 0.0).sum(axis=-1)
        ended = terminated | truncated
        self.returns += reward
        for world in np.flatnonzero(ended):
            last, now = info["final_info"], time.monotonic() - self.began
            safe = bool(last["success"][world] and last["safe"][world])
            exposures = int(last["exposures"][world]) if "exposures" in last else 0
            self.episodes.append((now, self.returns[world], safe, exposures))
        self.returns[ended] = 0.0
        self.observation, self.told = torch.as_tensor(observation), _told(info)
        self.begun = torch.as_tensor(ended, dtype=torch.float32)
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
            known = torch.stack(remembered)
            chances, values = agent.decide(known), agent.value(known, rollout.told[:, part])
            log_prob = chances.log_prob(rollout.actions[:, part]).sum(-1)
            ratio, advantage = (log_prob - rollout.log_prob[:, part]).exp(), advantages[:, part]
            gain = torch.minimum(ratio * advantage, ratio.clamp(1 - CLIP, 1 + CLIP) * advantage)
            loss = 0.5 * (values - wanted[:, part]).square().mean() - gain.mean()
            optimizer.zero_grad()
            loss.backward()
            nn.utils.clip_grad_norm_(agent.parameters(), LARGEST_GRADIENT)
            optimizer.step()


def train(worlds: endopilot.NavigateVectorEnv, asked: argparse.Namespace) -> np.ndarray:
    """Train as asked, at least one rollout; return a row for each episode (see `Player`).

    Every half minute the agent and these are written, so that an end before the end loses little.
    """
    seconds = 60.0 * asked.minutes
    torch.manual_seed(asked.seed)
    observed, actions = worlds.single_observation_space.shape[0], worlds.single_action_space.shape[0]
    agent, rollout = Agent(observed, actions), Rollout(worlds.num_envs, observed, actions)
    if asked.start:
        agent.load_state_dict(read(asked.start)[0])
    optimizer = torch.optim.Adam(agent.parameters())
    player, steps, said, now = Player(worlds, asked.seed, asked.dearer), 0, 0.0, 0.0
    while steps == 0 or now < seconds:
        optimizer.param_groups[0]["lr"] = LEARNING_RATE * max(1.0 - now / max(seconds, 1.0), 0.05)
        improve(agent, optimizer, rollout, player.play(agent, rollout))
        steps += STEPS * worlds.num_envs
        now = time.monotonic() - player.began
        if player.episodes and now > said + 30.0:
            said = now
            write(agent, player.episodes, asked.tasks, asked.output)
            last = np.array(player.episodes[-worlds.num_envs :], dtype=float)
            print(f"{now:5.0f} s, {steps} steps: {_described(last)}", flush=True)
    write(agent, player.episodes, asked.tasks, asked.output)
    return np.array(player.episodes, dtype=float).reshape(-1, 4)


def write(agent: Agent, episodes: list[tuple], tasks: int, path: Path | None) -> None:
    """Write a policy and what became of its episodes, if a path is given."""
    if path is not None:
        kept = {name: values.numpy() for name, values in agent.state_dict().items()}
        np.savez_compressed(path, tasks=tasks, period_s=PERIOD_S, **kept)
        header = "s,return,safe,exposures"
        np.savetxt(path.with_suffix(".csv"), np.array(episodes), "%.4g", ",", header=header, comments="")


def read(path: Path) -> tuple[dict[str, torch.Tensor], int, float]:
    """Return the weights of a policy, the number of tasks that it has learned, and the time between its decisions."""
    with np.load(path) as file:
        weights = {name: torch.as_tensor(file[name]) for name in file.files}
    return weights, int(weights.pop("tasks")), float(weights.pop("period_s"))


@torch.no_grad()
def score(path: Path, tasks: Sequence[Task]) -> list[tuple[str, int, int, int, float]]:
    """Let the mean motions of a saved policy drive the ladder's patients of tasks.

    Returns:
        For each task its name, safe successes, successes, navigations, and mean exposures (0 where all is observed).
    """
    torch.manual_seed(0)
    saved, _, period_s = read(path)
    actions = len(saved["log_std"])
    agent, scores = Agent(saved["encoder.0.weight"].shape[1], actions), []
    agent.load_state_dict(saved, strict=False)
    observation = "xray" if actions == 3 else "state"
    for task in tasks:
        given = [task.ladder_navigation(place) for place in range(len(task.ladder.numbers))]
        worlds = _worlds(len(given), observation, period_s, navigations=given)
        seen, begun = torch.as_tensor(worlds.reset(seed=0)[0]), torch.ones(len(given))
        memory, going = torch.zeros(len(given), HIDDEN), np.ones(len(given), dtype=bool)
        exposures = np.zeros(len(given))
        success, safe = np.zeros((2, len(given)), dtype=bool)
        while going.any():
            memory, begun = agent.remember(seen, memory, begun), torch.zeros_like(begun)
            chances = agent.decide(memory)
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


def _worlds(count: int, observation: str, period_s: float, **given: object) -> endopilot.NavigateVectorEnv:
    mode = AutoresetMode.SAME_STEP
    return endopilot.NavigateVectorEnv(count, observation=observation, autoreset_mode=mode, period_s=period_s, **given)


def _told(info: dict[str, np.ndarray]) -> torch.Tensor:
    values = np.stack([info[name] / size for name, size in TOLD.items()], axis=-1)
    return torch.as_tensor(np.clip(values, -5.0, 5.0), dtype=torch.float32)


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
    parser.add_argument("--start", type=Path, help="go on from a policy that was written before")
    parser.add_argument("--dearer", type=float, default=0.0, help="what an exposure costs besides the reward's 0.05")
    parser.add_argument("--score", type=Path)
    parser.add_argument("--version", default=NEWEST, help="folder of tasks to score in (examples/steve_tasks.py)")
    asked = parser.parse_args()
    if asked.output and not asked.tasks:
        parser.error("--output: what learned one task in one patient has no tasks to be scored on; give --tasks too")
    torch.set_num_threads(1)
    if asked.score:
        tasks = list_tasks(asked.version)[: asked.tasks or read(asked.score)[1]]
        for name, safe, success, count, exposures in score(asked.score, tasks):
            print(f"{name}: safe success {safe} of {count}, success {success}, exposures {exposures:.1f}", flush=True)
        return
    if asked.output:
        asked.output.parent.mkdir(parents=True, exist_ok=True)
    if asked.tasks:
        names = [task.name for task in list_tasks()[: asked.tasks]]
        given = [each for name in names for each in training_navigations(name, 0, PATIENTS, NEWEST)]
        worlds = _worlds(WORLDS_EACH * len(given), asked.observation, PERIOD_S, navigations=given)
    else:
        worlds = _worlds(64, asked.observation, PERIOD_S)
    episodes = train(worlds, asked)
    fifth = max(len(episodes) // 5, 1)
    for name, part in (("first", episodes[:fifth]), ("last", episodes[-fifth:])):
        print(f"{name} fifth of {len(episodes)} episodes: {_described(part)}")
    risen = episodes[-fifth:, 1].mean() > episodes[:fifth, 1].mean() + 1.0
    assert risen or asked.start, "nothing was learned; give it more minutes"


if __name__ == "__main__":
    main()
