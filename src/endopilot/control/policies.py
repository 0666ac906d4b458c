"""The policies by name: `make_policy`."""

from __future__ import annotations

from typing import Any

from endopilot.control.policy import Policy
from endopilot.errors import InputError
from endopilot.plugins import Registry, described

POLICIES = Registry(
    setting="policy",
    shipped={
        "forward": "endopilot.control.baseline_policies:Forward",
        "spin": "endopilot.control.baseline_policies:Spin",
        "retract-rotate": "endopilot.control.baseline_policies:RetractRotate",
        "catheter-alone": "endopilot.control.coaxial_policies:CatheterAlone",
        "in-turn": "endopilot.control.coaxial_policies:InTurn",
        "coaxial-agent": "endopilot.control.coaxial_agent:CoaxialAgent",
        "twin": "endopilot.control.agent:TwinPolicy",
        "agent": "endopilot.control.agent:AgentPolicy",
        "open-loop": "endopilot.control.agent:OpenLoopPolicy",
    },
    group="endopilot.policies",
)
"""Where the classes of policies are. Each is made without arguments."""
_METHODS = ("start", "decide")


def make_policy(name: str) -> Policy:
    """Return a new policy.

    Args:
        name: a name of `POLICIES`, or MODULE:OBJECT of a class or function of one's own that makes a policy.

    Raises:
        InputError: there is no such policy, it cannot be made without arguments, or it has no `start` or `decide`.
    """
    kind = POLICIES.load(name)
    if not callable(kind):
        raise InputError(f"policy: {name!r} is no class and no function; name what makes the policy")
    try:
        policy: Any = kind()
    except Exception as error:
        raise InputError(f"policy: {name!r} cannot be made without arguments ({described(error)}); mend it") from error
    lacking = [method for method in _METHODS if not callable(getattr(policy, method, None))]
    if lacking:
        raise InputError(f"policy: {name!r} has no {' and no '.join(lacking)}; add it, as endopilot's Policy has it")
    return policy
