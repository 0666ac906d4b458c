"""The policy that a network alone decides observes and remembers as the environments and torch do."""

from __future__ import annotations

import runpy
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch

from endopilot.env.vector import ROTATION_RAD_S, TRANSLATION_MM_S
from endopilot.navigation.loop import NavigationLoop
from endopilot.tasks.task import reference_navigation

EXAMPLES = Path(__file__).parents[2] / "examples"


def test_it_decides_what_the_network_does_in_an_environment() -> None:
    """Twice made by others: the observations of a recorded navigation, and the network by torch."""
    given = runpy.run_path(str(EXAMPLES / "recurrent_policy.py"))
    navigation = replace(reference_navigation(), start_rotation_rad=0.5)
    record = NavigationLoop(navigation, given["Recurrent"](), seed=1).run()
    observed = runpy.run_path(str(EXAMPLES / "offline_sets.py"))["_observed"]
    seen = torch.as_tensor(observed(navigation, record))
    learner = runpy.run_path(str(EXAMPLES / "recurrent_ppo.py"))
    agent = learner["Agent"](seen.shape[1], 3)
    agent.load_state_dict(learner["read"](given["WEIGHTS"])[0])
    memory, moves, random = torch.zeros(1, len(agent.memory.weight_hh[0])), [], np.random.default_rng(1)
    with torch.no_grad():
        for each in seen[:-1]:
            memory = agent.remember(each[None], memory, torch.zeros(1))
            chances = agent.decide(memory)
            moves.append((chances.mean + chances.stddev * torch.as_tensor(random.standard_normal(3)))[0].numpy())
    wanted = np.clip(np.array(moves)[:, :2], -1.0, 1.0) * [TRANSLATION_MM_S, ROTATION_RAD_S]
    np.testing.assert_array_equal(record.exposed[1 : len(moves)], np.array(moves)[:-1, 2] > 0.0)
    decided = record.control[: len(wanted)].reshape(-1, 2)
    assert len(wanted) > 5 and np.ptp(decided, axis=0).min() > 0.1
    np.testing.assert_allclose(decided, wanted, atol=1e-4)
