"""What tests of the agent and of its belief share: settings that are quick, and what an exposure of a member shows."""

from __future__ import annotations

from endopilot.belief.belief import Belief, BeliefConfig
from endopilot.control.agent_config import AgentConfig
from endopilot.xray.fluoroscope import TipMeasurement

QUICK = AgentConfig(belief=BeliefConfig(members=6, time_step_s=0.05), decision_evaluations=10**12)
"""An agent of few wires, whose decisions wait for the whole search."""


def measured(belief: Belief, member: int) -> TipMeasurement:
    """Return the exposure that shows the tip of one simulated wire."""
    tip = belief.tip
    return TipMeasurement(
        position=belief.simulator.position[member, 0],
        abscissa=float(tip.abscissa[member]),
        offset=float(tip.offset[member]),
        branch=int(tip.branch[member]),
    )
