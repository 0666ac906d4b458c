"""`plan`: the controls that bring a tip along the vessel to a target, found before wire and catheter move."""

from __future__ import annotations

import time
from dataclasses import asdict, replace
from pathlib import Path

import numpy as np
import pandas as pd
from jaxtyping import Float

from endopilot.anatomy.io import read_anatomy
from endopilot.control.agent import OraclePolicy
from endopilot.control.agent_config import AgentConfig
from endopilot.control.course import Controls
from endopilot.control.plan_config import Plan, PlanConfig, Steps
from endopilot.control.set_up import choose_tip
from endopilot.devices.device import Wire, read_wire
from endopilot.devices.drive_limits import DriveLimits
from endopilot.devices.stack import Stack
from endopilot.errors import InputError
from endopilot.extras import extra_named
from endopilot.models.config import WINDOW, WIRES, read_run
from endopilot.progress import progress
from endopilot.settings import from_record, public
from endopilot.simulation.config import SimulatorConfig
from endopilot.simulation.csv_file import read_columns
from endopilot.simulation.simulate import simulate
from endopilot.simulation.simulator import Simulator
from endopilot.simulation.trajectory import Trajectory
from endopilot.tasks.navigation import DECISION_PERIOD_S, Navigation, Target
from endopilot.tasks.route import Route, check_passable
from endopilot.tasks.targets import find_target
from endopilot.types import Anatomy

_TRIALS = 3
"""Searches at most: a path that does not hold in the rod core at its own settings is searched again there."""
_MARGIN_S, _SAFE_RATIO = 5.0, 0.8
"""Time that desired tips rest at the target, s, and their safety ratio γ/(r − r_w)."""


@public
def plan(
    anatomy: Anatomy | str | Path,
    target: str,
    *,
    device: Wire | Stack | str | Path | None = None,
    model: str | Path | None = None,
    config: PlanConfig | None = None,
) -> Plan:
    """Plan a navigation.

    Args:
        anatomy: the vessel, or its folder.
        target: a section such as "4" or "PDA", a point "X,Y,Z" in LPS mm, or the path of a CSV of desired tips.
        device: the wire, its name or its YAML file; or the wire and a catheter, which is then planned for too, by the
            method search. The model's wire if not given, the workhorse if there is no model.
        model: run made by `endopilot train`, for the method inverse; the simulated wires, named "wires", if not given.
        config: method, time and limits.

    Raises:
        InputError: a target outside the tree, behind an occlusion or too far for the time; a model of another device or
            without the network that the method needs; with the method search, no path found, or one that in the rod
            core at its own settings breaks the force limit or does not reach the target; more than one catheter, or
            what is for a wire alone with one.
    """
    config = config or PlanConfig()
    vessel = anatomy if isinstance(anatomy, Anatomy) else read_anatomy(anatomy)
    run = None if model is None or str(model) == WIRES else Path(model)
    stack, tips = _stack(run, device), None
    if stack.catheters:
        _check_for_stack(config, target, run)
    if target.endswith(".csv"):
        tips = read_tips(Path(target), stack.wire.max_velocity_mm_s, config.start_inserted_length_mm)
    goal = find_target(vessel.tree, target) if tips is None else last_place(vessel, tips, target)
    navigation, choice = config.navigation(vessel, stack, goal), None
    for each in navigation.devices:
        check_passable(Route.to(vessel, goal), each)
    if run is None:
        choice = choose_tip(navigation, tip=config.tip, catheter_tilt_deg=config.catheter_tilt_deg)
        navigation = choice.navigation
    elif config.tip not in ("auto", "own"):
        raise InputError(f"tip: {config.tip}; {run} was trained with the wire's own tip: give own, or leave --tip out")
    desired = None
    if tips is not None:
        navigation = replace(navigation, seconds=len(tips) * DECISION_PERIOD_S)
        desired = tips[["abscissa", "offset"]].to_numpy(float)
    else:
        _check_time(navigation, config)
        if config.method == "inverse":
            desired = tips_along(navigation, config.speed_mm_s)
    trials = _TRIALS if config.method == "search" and tips is None else 1
    made, began = None, time.process_time()
    for trial in range(min(trials, 2) if stack.catheters else trials):  # nothing of a pair's is drawn at random
        control, predicted = _find(navigation, config, run, desired, trial)
        seconds = time.process_time() - began
        trajectory = _driven(navigation, control.reshape(len(control), -1, 2), predicted, desired)
        made = Plan(navigation, config, None if run is None else str(run), trajectory, choice, seconds)
        if made.reached and made.within_force_limit:
            break
    assert made is not None
    if config.method == "search":
        _check_kept(made)
    return made


def _find(
    navigation: Navigation, config: PlanConfig, run: Path | None, desired: Steps | None, trial: int
) -> tuple[Controls | Steps, Steps]:
    """Return controls, and the tips that whatever found them predicts, mm."""
    if config.method == "inverse" and run is not None and desired is not None:
        return _by_networks(navigation, run, desired)
    return _search(navigation, config, trial) if desired is None else _track(navigation, desired)


def _check_for_stack(config: PlanConfig, target: str, run: Path | None) -> None:
    """Raise `InputError` where a plan with a catheter asks for what a wire alone can do."""
    if run is not None:
        raise InputError(f"--model {run}: models are of a wire alone; leave --model or --catheter out")
    if config.method != "search":
        raise InputError(f"method: {config.method}; a wire in a catheter is planned by search: give search")
    if target.endswith(".csv"):
        raise InputError(
            f"target: {target}; desired tips are followed by a wire alone: give a section or a point X,Y,Z"
        )


def _stack(run: Path | None, device: Wire | Stack | str | Path | None) -> Stack:
    """Return the devices: those that are asked for, else the model's wire; both must have the same."""
    asked = None if device is None else Stack.of(device)
    if run is None or (asked is not None and asked.catheters):
        return asked or Stack(read_wire("workhorse-014"))
    trained = from_record(Wire, read_run(run)["device"])
    if asked is not None and asked.wire.constants != trained.constants:
        raise InputError(
            f"--device {asked.name}: {run} was trained with {trained.name}; leave --device out or train anew"
        )
    return Stack(trained)


def _check_time(navigation: Navigation, config: PlanConfig) -> None:
    length_mm = navigation.target.abscissa - navigation.start_inserted_length_mm
    fastest = min(navigation.device.max_velocity_mm_s, config.speed_mm_s)
    if length_mm / fastest > navigation.seconds:
        raise InputError(
            f"seconds: {navigation.seconds:g} s are too few for the {length_mm:.0f} mm to the target at {fastest:g} "
            f"mm/s; give {length_mm / fastest:.0f} s or more, or a larger speed_mm_s (the device's limit is "
            f"{navigation.device.max_velocity_mm_s:g} mm/s)"
        )


def _search(navigation: Navigation, config: PlanConfig, trial: int) -> tuple[Controls, Steps]:
    """Search a course in the rod core: with the settings of the agent, then with those that a plan is checked with."""
    fine, agent = SimulatorConfig(), AgentConfig.of(navigation)
    speed_mm_s = min(agent.search.speed_mm_s, config.speed_mm_s) if navigation.catheters else config.speed_mm_s
    search = replace(agent.search, speed_mm_s=speed_mm_s)
    fine_belief = replace(agent.belief, element_mm=fine.element_mm, time_step_s=fine.time_step_s)
    policy = OraclePolicy(config=replace(agent, search=search, belief=fine_belief if trial else agent.belief))
    policy.start(navigation, config.seed + trial)
    with progress("plan: searching in the rod core", total=navigation.target.abscissa) as advance:
        course = policy.find_course(navigation.seconds, advance)
    to = f"branch {navigation.target.branch} of {navigation.anatomy.name}"
    if course.reached < 0.5:
        came = float(course.tip.abscissa[-1, 0]) if len(course.control) else navigation.start_inserted_length_mm
        raise InputError(
            f"target: no path found to {to} in {navigation.seconds:g} s under {navigation.force_limit_n:g} N with "
            f"{navigation.stack.name}; the tip came to {came:.0f} of {navigation.target.abscissa:.0f} mm; {policy.halt}"
        )
    needed_s = DECISION_PERIOD_S * len(course.control)
    if needed_s > navigation.seconds:
        raise InputError(
            f"seconds: {navigation.seconds:g} s are too few for the course found to {to} with {navigation.stack.name}; "
            f"give {needed_s:g} s or more"
        )
    return course.control, np.column_stack([course.tip.abscissa[:, 0], course.tip.offset[:, 0]])


def _check_kept(made: Plan) -> None:
    """Raise `InputError` where a plan that was searched breaks the force limit in the rod core, or does not arrive."""
    navigation, wire = made.navigation, made.navigation.device.name
    goal = f"branch {navigation.target.branch} of {navigation.anatomy.name} with {wire}"
    if not made.within_force_limit:
        raise InputError(
            f"force_limit_n: {navigation.force_limit_n:g} N is exceeded on the path found to {goal}, which presses "
            f"with {made.force.max():.3g} N; give a larger force_limit_n, another seed or a softer wire"
        )
    if not made.reached:
        branch = int(made.tip.branch[-1, navigation.arriving])
        where = f"at {made.end_mm:.1f} of {navigation.target.abscissa:.1f} mm"
        if branch != navigation.target.branch:
            where += f", in branch {branch}"
        raise InputError(
            f"target: not reached on the path found to {goal}: in the rod core the tip ends {where}; give another seed "
            "or another tip"
        )


def _by_networks(navigation: Navigation, run: Path, desired: Steps) -> tuple[Steps, Steps]:
    """Return the controls (mm/s, rad/s) of a trained run for desired tips, and the tips that it predicts, mm.

    The networks need 30 states before the first that they predict. A plan begins with a wire at rest, so 15 s of rest
    come before it.

    Raises:
        InputError: the run is unfinished or damaged, or has not both networks.
    """
    with extra_named("plan by inverse"):
        from endopilot.models.checkpoint import load_model  # torch is slow to import
        from endopilot.models.episodes import Episodes

    predictor, config = load_model(run), SimulatorConfig(threads=1)
    simulator = Simulator(navigation.anatomy, navigation.device, config=config)
    simulator.reset(inserted_length=navigation.start[:, 0], rotation=navigation.start[:, 1])
    tip, rest = simulator.project(), np.zeros((1, WINDOW, 2))
    at_rest = np.tile([tip.abscissa[0, 0], tip.offset[0, 0]], (1, WINDOW, 1))
    episodes = Episodes.of_controls(
        navigation.anatomy,
        navigation.device,
        initial=navigation.start[0],
        control=np.concatenate([rest, np.zeros((1, *desired.shape))], axis=1),
        tip=np.concatenate([at_rest, desired[None]], axis=1),
    )
    with progress("plan: inverse network", total=1) as advance:
        found = predictor.rollout_dual(episodes)
        advance()
    return found.control[0], found.tip[0]


def _track(navigation: Navigation, desired: Steps) -> tuple[Steps, Steps]:
    """Track desired tips in the rod core, one sample at a time."""
    from endopilot.models.simulated_wires import track

    stack = Stack.of(navigation.device)
    tip, control = track(
        navigation.anatomy,
        [stack],
        friction=stack.frictions(np.array([navigation.device.friction])),
        start=np.array([[[navigation.start_inserted_length_mm, navigation.start_rotation_rad]]]),
        command=np.zeros((1, len(desired), 1, 2)),
        desired=desired[None],
        config=SimulatorConfig(threads=1),
    )
    return control[0], tip[0]


def _driven(navigation: Navigation, control: Controls, predicted: Steps, desired: Steps | None) -> Trajectory:
    """Return what the rod core makes of controls within the limits, with what was predicted and desired beside it."""
    start = navigation.start
    limits = [DriveLimits.of(device, navigation.anatomy) for device in navigation.devices]
    parts = [within_limits(control[:, k], each, start[k, 0]) for k, each in enumerate(limits)]
    command = np.stack(parts, axis=1)[None]
    trajectory = simulate(
        navigation.anatomy, navigation.stack, command, initial=start[None], config=SimulatorConfig(threads=1)
    )
    columns = {"predicted": predicted[None]} | ({} if desired is None else {"desired": desired[None, : len(control)]})
    return replace(trajectory, columns=columns, about={"target": asdict(navigation.target)})


def within_limits(control: Steps, limits: DriveLimits, inserted_length_mm: float) -> Steps:
    """Return controls (mm/s, rad/s) that are finite and within the drive's limits and its travel, whatever a model
    proposes for a device that is inserted so far at the start, mm.
    """
    finite = np.isfinite(control).all(axis=1, keepdims=True)
    return limits.clip_sequence(np.where(finite, control, 0.0), inserted_length_mm, DECISION_PERIOD_S)


def read_tips(path: Path, fastest_mm_s: float, start_mm: float) -> pd.DataFrame:
    """Read desired tip states: columns time_s (0.5, 1.0, ...), tip_abscissa_mm, tip_offset_mm and, optional, branch.

    A table is returned with columns abscissa, offset and branch (−1 where it is not given), a row a sample period.
    InputError where it is none, or asks for the end sooner than a drive of this speed can be there from Δ `start_mm`.
    """
    columns = ("time_s", "tip_abscissa_mm", "tip_offset_mm")
    read = read_columns(path, columns, ["branch"])
    late = np.flatnonzero(np.abs(read.values["time_s"] - DECISION_PERIOD_S * (np.arange(len(read.lines)) + 1)) > 1e-6)
    if len(late):
        raise read.fault(int(late[0]), "time_s", "; count 0.5, 1.0, 1.5, ...")
    for name, least in (("tip_abscissa_mm", 0), ("tip_offset_mm", 0), ("branch", -1)):
        low = np.flatnonzero(read.values.get(name, np.zeros(0)) < least)
        if len(low):
            raise read.fault(int(low[0]), name, f"; give {least} or more")
    table = pd.DataFrame({"branch": -1.0, **read.values}, index=range(len(read.lines)))
    length_mm, seconds = float(table["tip_abscissa_mm"].iloc[-1]) - start_mm, DECISION_PERIOD_S * len(table)
    if length_mm > fastest_mm_s * seconds:
        raise InputError(
            f"{path}: {seconds:g} s are too few for the {length_mm:.0f} mm to the last tip at the device's "
            f"{fastest_mm_s:g} mm/s; give rows up to {length_mm / fastest_mm_s:.1f} s or more"
        )
    return table.rename(columns={"tip_abscissa_mm": "abscissa", "tip_offset_mm": "offset"})


def last_place(anatomy: Anatomy, tips: pd.DataFrame, target: str) -> Target:
    """Return the place of the last desired tip, on its branch or else on the longest path; InputError where there is
    none.
    """
    tree, branch, abscissa = anatomy.tree, int(tips["branch"].iloc[-1]), float(tips["abscissa"].iloc[-1])
    if branch < 0:
        branch = [b for b in tree.route(tree.longest_leaf()) if tree.branches[b].centerline.abscissa[0] <= abscissa][-1]
    try:
        return find_target(tree, Target(branch=branch, abscissa=abscissa))
    except InputError as error:
        raise InputError(f"{target}: the last tip: {error}; correct tip_abscissa_mm or branch") from None


def tips_along(navigation: Navigation, speed_mm_s: float) -> Float[np.ndarray, "samples 2"]:
    """Return desired tips (Δtip, γtip), mm: along the route at some speed, as near to the wall as is safe, and at rest
    at its end.
    """
    route, start_mm = Route.to(navigation.anatomy, navigation.target), navigation.start_inserted_length_mm
    length_mm = max(route.target.abscissa - start_mm, 0.0)
    periods = int(np.ceil(min(length_mm / speed_mm_s + _MARGIN_S, navigation.seconds) / DECISION_PERIOD_S))
    ahead = start_mm + speed_mm_s * DECISION_PERIOD_S * np.arange(1, periods + 1)
    abscissa = np.minimum(ahead, route.target.abscissa)
    room = np.maximum(route.radius(abscissa) - navigation.device.tip_radius_mm, 0.0)
    return np.column_stack([abscissa, _SAFE_RATIO * room])
