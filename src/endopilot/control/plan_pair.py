"""What a plan for a wire in a catheter needs besides that of a wire alone: what is refused, and the search.

The search is that of the coaxial agent, in the world as it is given.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from endopilot.control.coaxial_copies import CoaxialSearchConfig
from endopilot.control.coaxial_search import CoaxialSearch
from endopilot.control.period import drive_period
from endopilot.control.plan_config import Controls, PlanConfig, Steps
from endopilot.devices.catheter import Catheter
from endopilot.errors import InputError
from endopilot.navigation.navigate import start_world
from endopilot.progress import progress
from endopilot.simulation.config import SimulatorConfig
from endopilot.simulation.mismatch import ModelMismatch
from endopilot.tasks.navigation import DECISION_PERIOD_S, Navigation


def check_pair(catheters: Sequence[Catheter], config: PlanConfig, target: str, model: Path | None) -> None:
    """Check that a plan with catheters asks for what the search for them can do.

    Args:
        catheters: around the wire.
        config: of the plan.
        target: as it is given.
        model: the run, if one is given.

    Raises:
        InputError: two catheters, a trained model, another method than twin, or desired tips.
    """
    if not catheters:
        return
    if len(catheters) > 1:
        raise InputError(f"catheter: {len(catheters)}; a plan drives one catheter: give one")
    if model is not None:
        raise InputError(f"--model {model}: models are of a wire alone; leave --model or --catheter out")
    if config.method != "twin":
        raise InputError(f"method: {config.method}; a wire in a catheter is planned by twin: give twin")
    if target.endswith(".csv"):
        raise InputError(
            f"target: {target}; desired tips are followed by a wire alone: give a section or a point X,Y,Z"
        )


def search_pair(navigation: Navigation, config: PlanConfig, trial: int) -> tuple[Controls, Steps]:
    """Search a course of wire and catheter in the rod core.

    Args:
        navigation: with one catheter.
        config: of the plan.
        trial: 0 for the settings of the agent's search, else those that a plan is checked with.

    Returns:
        Controls of the wire, then of the catheter, and the wire's tips (Δtip, γtip) that the search predicts.

    Raises:
        InputError: no course was found, or none in the given time.
    """
    own = CoaxialSearchConfig()
    settings = replace(
        own,
        speed_mm_s=min(own.speed_mm_s, config.speed_mm_s),
        core=SimulatorConfig(threads=1) if trial else own.core,
    )
    start = start_world(navigation, ModelMismatch(), settings.core)
    search = CoaxialSearch(navigation, settings, sharing=start)
    with progress("plan: searching for wire and catheter", total=1) as advance:
        course = search.find(start)
        advance(1)
    names = f"{navigation.device.name} in {navigation.catheters[0].name}"
    place = f"branch {navigation.target.branch} of {navigation.anatomy.name}"
    if not course.reached:
        at = "before it" if search.halted_mm is None else f"past {search.halted_mm:.0f} mm of the route"
        raise InputError(
            f"target: no course found to {place} under {navigation.force_limit_n:g} N with {names}: none goes on {at}; "
            "give another catheter, wire or tip"
        )
    needed_s = DECISION_PERIOD_S * len(course.control)
    if needed_s > navigation.seconds:
        raise InputError(
            f"seconds: {navigation.seconds:g} s are too few for the course found to {place} with {names}; give "
            f"{needed_s:g} s or more"
        )
    tips = []
    for control in course.control:
        drive_period(start, control[None])
        tip = start.project()[0, 0]
        tips.append((tip.abscissa, tip.offset))
    return course.control.reshape(len(tips), -1), np.array(tips)
