"""The policies by name: `make_policy`."""

from __future__ import annotations

import contextlib
import functools
from collections.abc import Callable
from typing import Any

from endopilot.errors import InputError
from endopilot.navigation.policy import Policy
from endopilot.plugins import Registry

POLICIES = Registry(
    setting="policy",
    shipped={
        "forward": "endopilot.navigation.baseline_policies:Forward",
        "spin": "endopilot.navigation.baseline_policies:Spin",
        "retract-rotate": "endopilot.navigation.baseline_policies:RetractRotate",
        "catheter-alone": "endopilot.navigation.baseline_policies:CatheterAlone",
        "in-turn": "endopilot.navigation.baseline_policies:InTurn",
        "oracle": "endopilot.control.agent:OraclePolicy",
        "agent": "endopilot.control.agent:AgentPolicy",
        "cloned": "endopilot.control.cloned:ClonedPolicy",
        "open-loop": "endopilot.control.agent:OpenLoopPolicy",
    },
    group="endopilot.policies",
)
"""Where the classes of policies are. Each is made without arguments."""
_METHODS = ("start", "decide")
_MORE_METHODS = ("believed", "watch")


def make_policy(name: str) -> Policy:
    """Return a new policy: one of `POLICIES`, or of MODULE:OBJECT, a class or function of one's own that makes it.

    InputError where there is none, it cannot be made without arguments, or has no `start` or `decide`.
    """
    kind = POLICIES.load(name)
    if not callable(kind):
        raise InputError(f"policy: {name!r} is no class and no function; name what makes the policy")
    with POLICIES.running(name, "cannot be made without arguments"):
        policy: Any = kind()
    lacking = [method for method in _METHODS if not callable(getattr(policy, method, None))]
    if lacking:
        raise InputError(f"policy: {name!r} has no {' and no '.join(lacking)}; add it, as endopilot's Policy has it")
    if name not in POLICIES.shipped:
        for method in (*_METHODS, *(method for method in _MORE_METHODS if callable(getattr(policy, method, None)))):
            with contextlib.suppress(AttributeError):  # an object of slots alone cannot be watched
                object.__setattr__(policy, method, _watched(name, method, getattr(policy, method)))
    return policy


def _watched(name: str, method: str, call: Callable[..., Any]) -> Callable[..., Any]:
    """Return a method of a user's policy, whose exceptions name the policy."""

    @functools.wraps(call)
    def watched(*args: Any, **kwargs: Any) -> Any:
        with POLICIES.running(name, f"{method} failed"):
            return call(*args, **kwargs)

    return watched
