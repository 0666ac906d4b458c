"""The X-ray that a plan will need if all goes as planned: `plan_xray`.

The adviser monitors the ensemble of simulated wires of the ladder's agent, as it does during a navigation, whatever
made the plan: they follow the plan's proximal end, and each exposure shows the tip where the plan has it. What their
bands allow for beside is as in a navigation.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float

from endopilot.belief.bands import AdviserConfig
from endopilot.belief.belief import Belief
from endopilot.belief.monitor import predicted_tip
from endopilot.belief.watch import Watch
from endopilot.control.agent_config import AgentConfig, read_agent_calibration
from endopilot.control.plan_config import Plan
from endopilot.xray.fluoroscope import TipMeasurement


@dataclass(frozen=True, eq=False)
class PlannedXray:
    """X-ray along a plan; row t is the end of its sample period t.

    Attributes:
        exposure: whether an exposure is due then.
        half_width: of the bands of (Δtip, γtip) around the predicted tip, mm, before that exposure.
    """

    exposure: Bool[np.ndarray, "samples"]
    half_width: Float[np.ndarray, "samples 2"]


def plan_xray(plan: Plan) -> PlannedXray:
    """Return the X-ray that a plan will need if all goes as planned; the tip is observed at the start."""
    navigation, tip = plan.navigation, plan.tip[:, 0]
    calibration = read_agent_calibration("assumed", len(navigation.devices))
    config = AgentConfig.of(navigation).belief
    wires = Belief(navigation, Belief.around(config), config)
    start, alone = predicted_tip(wires), not navigation.catheters
    watch = Watch(calibration, AdviserConfig(), navigation.device.tip_radius_mm, start, alone=alone)
    exposure, half_width = np.zeros(len(plan.control), dtype=bool), np.zeros((len(plan.control), 2))
    for period in range(len(plan.control)):
        wires.follow(tuple((inserted, turn) for inserted, turn in plan.trajectory.proximal[0, period].tolist()))
        at = predicted_tip(wires)
        watch.move(at)
        exposure[period], half_width[period] = watch.advise(at), watch.half_width
        if exposure[period]:
            watch.exposed(float(at.tip[1]), at)
            shown = (float(tip.abscissa[period]), float(tip.offset[period]), int(tip.branch[period]))
            position = plan.trajectory.tip_position[0, period, 0]
            wires.weigh(TipMeasurement(position, *shown))
    return PlannedXray(exposure=exposure, half_width=half_width)
