"""The policies by name."""

from __future__ import annotations

import importlib

from endopilot.control.policy import Policy
from endopilot.errors import InputError

POLICIES = {
    "forward": "endopilot.control.baseline_policies:Forward",
    "spin": "endopilot.control.baseline_policies:Spin",
    "retract-rotate": "endopilot.control.baseline_policies:RetractRotate",
    "twin": "endopilot.control.agent:TwinPolicy",
    "agent": "endopilot.control.agent:AgentPolicy",
    "open-loop": "endopilot.control.agent:OpenLoopPolicy",
}
"""Name of each policy and where its class is, which is made without arguments; only the one that is asked for is
imported."""


def make_policy(name: str) -> Policy:
    """Return a new policy by its name.

    Raises:
        InputError: there is no such policy.
    """
    if name not in POLICIES:
        raise InputError(f"policy: {name!r}; choose from {', '.join(POLICIES)}")
    module, _, kind = POLICIES[name].partition(":")
    return getattr(importlib.import_module(module), kind)()
