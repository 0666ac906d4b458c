"""Which shipped devices an agent names that has given up, and how long its decisions took."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from endopilot.control.navigate import NavigateConfig, navigate, propose_devices
from endopilot.control.outcome import decision_times, tell_outcome
from endopilot.tasks.targets import find_target


def test_a_tip_that_enters_the_fork_is_named_and_nothing_where_nothing_does(side_branch) -> None:
    straight = replace(side_branch.device, tip_bend_rad=0.0, tip_bend_length_mm=0.0)
    given = replace(side_branch, device=straight)
    assert propose_devices(given).startswith(f"{straight.name} with a tip of ")
    assert propose_devices(replace(given, force_limit_n=1e-4), seconds=1e-6) == ""


def test_the_outcome_names_it_and_each_decision_is_timed(side_branch) -> None:
    """A straight tip cannot be shaped by hand here, so the target behind the fork is given up."""
    straight = replace(side_branch.device, tip_bend_rad=0.0, tip_bend_length_mm=0.0)
    point = ",".join(f"{each:.2f}" for each in side_branch.target.position(side_branch.anatomy))
    assert find_target(side_branch.anatomy.tree, point).branch == 2
    found = navigate(side_branch.anatomy, point, device=straight, config=NavigateConfig(tip="own", seconds=20.0))
    assert found.record.gives_up and found.proposal
    assert f"in a search {found.proposal} reaches it" in tell_outcome(found)
    times = decision_times(found)
    assert len(found.decision_s) == len(found.record.time_s) - 1 and (found.decision_s > 0).all()
    assert times["median"] <= times["p99"] <= times["longest"] == round(float(np.max(found.decision_s)), 3)
