"""What a search may spend: it ends with what it has, and by evaluations the bits repeat."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from endopilot.control.agent import OraclePolicy
from endopilot.control.trials import Budget, OutOfBudgetError
from endopilot.navigation.loop import NavigationLoop
from toy_belief import QUICK


def test_seconds_or_evaluations_end_a_budget() -> None:
    for budget in (Budget(0.0), Budget(1e9, evaluations=5)):
        with pytest.raises(OutOfBudgetError):
            for _ in range(3):
                budget.spend(2)
        assert budget.over
        budget.begin()
        assert not budget.over


def test_a_search_ends_with_what_it_has(side_branch) -> None:
    """With little it comes to before the fork, and with less nowhere; the words say why."""
    free, few, none = (OraclePolicy(config=replace(QUICK, evaluations=each)) for each in (10**6, 40, 1))
    lengths = []
    for policy in (free, few, none):
        policy.start(side_branch, 0)
        lengths.append(len(policy.find_course(side_branch.seconds).control))
    assert lengths[0] > lengths[1] >= 0 == lengths[2] and free.halt == ""
    assert "in its budget; give more (AgentConfig.evaluations)" in few.halt


def test_by_evaluations_a_navigation_repeats(side_branch) -> None:
    records = [NavigationLoop(side_branch, OraclePolicy(config=replace(QUICK, evaluations=3000))).run() for _ in "ab"]
    assert records[0].reason == "reached" and np.array_equal(records[0].control, records[1].control)
