"""Which shipped devices reach a target that an agent has given up: `propose_devices`."""

from __future__ import annotations

import time
from collections.abc import Iterator
from dataclasses import replace

from endopilot.control.agent import OraclePolicy
from endopilot.control.agent_config import AgentConfig
from endopilot.control.set_up import choose_tip, tip_name
from endopilot.devices.catheter import list_catheters
from endopilot.devices.device_files import list_wires
from endopilot.devices.stack import Stack
from endopilot.errors import InputError
from endopilot.tasks.navigation import Navigation


def propose_devices(navigation: Navigation, *, seconds: float = 60.0) -> str:
    """Return the first shipped devices, and their tip, that a search brings to the target; empty if it finds none.

    The wire with a tip for the forks of the route comes first, then the other wires, then the wire in each catheter.
    They are simulated as given: reality may differ. All searches take so much wall time, s, each a quarter at most.
    """
    until = time.perf_counter() + seconds
    for stack in _stacks(navigation):
        if time.perf_counter() > until:
            return ""
        try:
            stack.check(navigation.anatomy)
            given = replace(navigation, device=stack.wire, catheters=stack.catheters, arrives="wire")
            chosen = choose_tip(given, catheter_tilt_deg=0.0)
            if chosen.refused is not None and not stack.catheters:
                continue
            config = replace(AgentConfig.of(chosen.navigation), planning_s=seconds / 4)
            policy = OraclePolicy(config=config)
            policy.start(chosen.navigation, 0)
        except InputError:  # they do not fit into one another, or into the lumen
            continue
        if policy.find_course(navigation.seconds).reached > 0.5:
            return f"{stack.name} with a tip of {tip_name(chosen.navigation.device)}"
    return ""


def _stacks(navigation: Navigation) -> Iterator[Stack]:
    """Yield the devices that are tried, which are read one by one."""
    yield Stack(navigation.device)
    for wire in list_wires():
        if wire != navigation.device.name:
            yield Stack.of(wire)
    for catheter in list_catheters():
        try:
            yield Stack.of(navigation.device, catheter)
        except InputError:
            continue
