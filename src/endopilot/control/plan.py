"""`plan`: the controls that bring a tip along the vessel to a target, found before wire and catheter move."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
from jaxtyping import Float

from endopilot.anatomy.io import read_anatomy
from endopilot.control.agent import OraclePolicy
from endopilot.control.agent_config import AgentConfig
from endopilot.control.course import Controls
from endopilot.control.plan_config import Plan, PlanConfig, Steps
from endopilot.control.set_up import TipChoice, choose_tip
from endopilot.devices.device import Wire, read_wire
from endopilot.devices.drive_limits import DriveLimits
from endopilot.devices.robot import IDEAL, read_robot
from endopilot.devices.stack import Stack
from endopilot.errors import InputError
from endopilot.extras import extra_named
from endopilot.models.config import WIRES, read_run
from endopilot.navigation.loop import LoopConfig, NavigationLoop
from endopilot.progress import progress
from endopilot.settings import from_record, public
from endopilot.simulation.config import SimulatorConfig
from endopilot.simulation.csv_file import read_columns
from endopilot.simulation.simulate import simulate
from endopilot.tasks.navigation import DECISION_PERIOD_S, Navigation, Target
from endopilot.tasks.route import Route, check_passable
from endopilot.tasks.targets import find_target
from endopilot.types import Anatomy

_TRIALS = 3
"""Searches at most: a path that does not hold in the rod core at its own settings is searched again there."""


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
        config: method, time, limits and cost.

    Raises:
        InputError: a target outside the tree, behind an occlusion or too far for the time; a model of another device or
            without the network that the method needs; with the method search, no path found, or one that in the rod
            core at its own settings breaks the force limit or does not reach the target; more than one catheter, or
            what is for a wire alone with one.
    """
    config = config or PlanConfig()
    vessel = anatomy if isinstance(anatomy, Anatomy) else read_anatomy(anatomy)
    model = None if model is None or str(model) == WIRES else Path(model)
    catheters = device.catheters if isinstance(device, Stack) else ()
    if catheters:
        _check_for_stack(config, target, model)
    wire = _wire(model, device)
    tips = (
        read_tips(Path(target), wire.max_velocity_mm_s, config.start_inserted_length_mm)
        if target.endswith(".csv")
        else None
    )
    goal = find_target(vessel.tree, target) if tips is None else last_place(vessel, tips, target)
    navigation = Navigation(
        anatomy=vessel,
        device=wire,
        target=goal,
        catheters=catheters,
        arrives=config.arrives,
        start_inserted_length_mm=config.start_inserted_length_mm,
        start_rotation_rad=config.start_rotation_rad,
        seconds=config.seconds if tips is None else len(tips) * DECISION_PERIOD_S,
        force_limit_n=config.force_limit_n,
    )
    route = Route.to(vessel, goal)
    for each in navigation.devices:
        check_passable(route, each)
    choice, began = None, _clock()
    if model is None:
        choice = choose_tip(navigation, tip=config.tip, catheter_tilt_deg=config.catheter_tilt_deg)
        navigation = choice.navigation
        route = Route.to(navigation.anatomy, goal)
    elif config.tip not in ("auto", "own"):
        raise InputError(
            f"tip: {config.tip}; {model} was trained with the wire's own tip: give own, or leave --tip out"
        )
    spent = _clock() - began
    if tips is None:
        _check_time(navigation, config)
        desired = tips_along(
            route,
            wire.tip_radius_mm,
            start_mm=config.start_inserted_length_mm,
            speed_mm_s=config.speed_mm_s,
            seconds=config.seconds,
            safe_ratio=config.cost.safe_ratio,
        )
    else:
        desired = tips[["abscissa", "offset"]].to_numpy(float)
    made, trials = None, _TRIALS if config.method == "search" and tips is None else 1
    trials = min(trials, 2) if catheters else trials  # nothing of theirs is drawn at random
    for trial in range(trials):
        find = _method(navigation, config, model, desired, follow=tips is not None, trial=trial)
        began = _clock()
        control, predicted = find()
        control = control.reshape(len(control), -1, 2)
        spent += _clock() - began
        made = _checked(navigation, config, model, choice, desired, control, predicted, spent)
        if made.reached and made.within_force_limit:
            break
    assert made is not None
    if config.method == "search":
        _check_kept(made)
    return made


def _clock() -> Float[np.ndarray, "2"]:
    """Return wall time and processor time, s."""
    return np.array([time.perf_counter(), time.process_time()])


def _method(
    navigation: Navigation, config: PlanConfig, model: Path | None, desired: Steps, *, follow: bool, trial: int
) -> Callable[[], tuple[Controls | Steps, Steps]]:
    """Return a function that finds controls and predicts their tips; loading a model is done before it is called."""
    if config.method == "inverse" and model is not None:
        with extra_named(f"plan by {config.method}"):
            from endopilot.control.network_plan import network_planner  # torch is slow to import

        return network_planner(navigation, model, desired)
    if config.method == "inverse" or (config.method == "search" and follow):
        return lambda: _track(navigation, desired)
    return lambda: _search(navigation, config, trial) if config.method == "search" else _by_policy(navigation, config)


def _check_for_stack(config: PlanConfig, target: str, model: Path | None) -> None:
    """Check that a plan with a catheter asks for nothing that a wire alone can do.

    Raises:
        InputError: a trained model, another method than search, or desired tips.
    """
    if model is not None:
        raise InputError(f"--model {model}: models are of a wire alone; leave --model or --catheter out")
    if config.method != "search":
        raise InputError(f"method: {config.method}; a wire in a catheter is planned by search: give search")
    if target.endswith(".csv"):
        raise InputError(
            f"target: {target}; desired tips are followed by a wire alone: give a section or a point X,Y,Z"
        )


def _wire(model: Path | None, device: Wire | Stack | str | Path | None) -> Wire:
    """Return the wire: the one that is asked for, else the model's; both must be the same."""
    asked = None if device is None else Stack.of(device).wire
    if model is None:
        return asked or read_wire("workhorse-014")
    trained = from_record(Wire, read_run(model)["device"])
    if asked is not None and asked.constants != trained.constants:
        raise InputError(
            f"--device {asked.name}: {model} was trained with {trained.name}; leave --device out or train anew"
        )
    return trained


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
    """Check that a plan which was found in the rod core keeps the force limit there, and reaches the target.

    Raises:
        InputError: it does not; the line says which.
    """
    navigation, wire = made.navigation, made.navigation.device.name
    goal = f"branch {navigation.target.branch} of {navigation.anatomy.name} with {wire}"
    if not made.within_force_limit:
        raise InputError(
            f"force_limit_n: {navigation.force_limit_n:g} N is exceeded on the path found to {goal}, which presses "
            f"with {made.force.max():.3g} N; give a larger force_limit_n, another seed or a softer wire"
        )
    if not made.reached:
        tip = made.arriving_tip
        far, branch = float(tip.abscissa[-1]), int(tip.branch[-1])
        where = f"at {far:.1f} of {navigation.target.abscissa:.1f} mm"
        if branch != navigation.target.branch:
            where += f", in branch {branch}"
        raise InputError(
            f"target: not reached on the path found to {goal}: in the rod core the tip ends {where}; give another seed "
            "or another tip"
        )


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


def _by_policy(navigation: Navigation, config: PlanConfig) -> tuple[Steps, Steps]:
    """Let a policy drive the rod core with an ideal drive, and record what it did."""
    from endopilot.navigation.policies import make_policy

    ideal = LoopConfig(robot=read_robot(IDEAL))
    record = NavigationLoop(navigation, make_policy(config.method), config=ideal, seed=config.seed).run()
    proximal, tip = np.column_stack([record.inserted_length[:, 0], record.rotation[:, 0]]), record.tip[:, 0]
    control = np.diff(proximal, axis=0) / DECISION_PERIOD_S
    return control, np.column_stack([tip.abscissa, tip.offset])[1:]


def _checked(
    navigation: Navigation, config: PlanConfig, model: Path | None, choice: TipChoice | None,
    desired: Float[np.ndarray, "wanted 2"], control: Controls, predicted: Steps, spent: Float[np.ndarray, "2"],
) -> Plan:  # fmt: skip
    """Put the controls within the limits, drive the rod core with them, and return the plan."""
    start = navigation.start
    limits = [DriveLimits.of(device, navigation.anatomy) for device in navigation.devices]
    parts = [within_limits(control[:, k], each, start[k, 0]) for k, each in enumerate(limits)]
    control = np.stack(parts, axis=1)
    trajectory = simulate(
        navigation.anatomy, navigation.stack, control[None], initial=start[None], config=SimulatorConfig(threads=1)
    )
    wanted = np.concatenate([desired, np.repeat(desired[-1:], max(len(control) - len(desired), 0), axis=0)])
    return Plan(
        navigation=navigation,
        config=config,
        model=None if model is None else str(model),
        trajectory=trajectory,
        desired=wanted[: len(control)],
        predicted=predicted,
        reached=bool(navigation.reached(trajectory.tip[0]).any()),
        why=choice.why if choice else "",
        tilt_deg=choice.tilt_deg if choice else 0.0,
        seconds_to_plan=float(spent[0]),
        processor_seconds=float(spent[1]),
    )


def within_limits(control: Steps, limits: DriveLimits, inserted_length_mm: float) -> Steps:
    """Return controls that are finite and within the drive's limits and its travel, whatever a model proposes.

    Args:
        control: mm/s and rad/s of each period.
        limits: of the drive.
        inserted_length_mm: inserted length at the start, mm.
    """
    finite = np.isfinite(control).all(axis=1, keepdims=True)
    return limits.clip_sequence(np.where(finite, control, 0.0), inserted_length_mm, DECISION_PERIOD_S)


_MARGIN_S = 5.0
"""Time that desired tips rest at the target, s."""


def read_tips(path: Path, fastest_mm_s: float, start_mm: float) -> pd.DataFrame:
    """Read desired tip states: columns time_s (0.5, 1.0, ...), tip_abscissa_mm, tip_offset_mm and, optional, branch.

    Args:
        path: of the table.
        fastest_mm_s: translation of the drive, mm/s.
        start_mm: Δ at the start, mm.

    Returns:
        A table with columns abscissa, offset and branch (−1 where it is not given), a row a sample period.

    Raises:
        InputError: not such a table, or it asks for the end sooner than the drive can be there; the line names file,
            column, row and mend.
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
    """Return the place of the last desired tip, on its branch or else on the longest path.

    Raises:
        InputError: it lies outside the tree.
    """
    tree, branch, abscissa = anatomy.tree, int(tips["branch"].iloc[-1]), float(tips["abscissa"].iloc[-1])
    if branch < 0:
        branch = [b for b in tree.route(tree.longest_leaf()) if tree.branches[b].centerline.abscissa[0] <= abscissa][-1]
    try:
        return find_target(tree, Target(branch=branch, abscissa=abscissa))
    except InputError as error:
        raise InputError(f"{target}: the last tip: {error}; correct tip_abscissa_mm or branch") from None


def tips_along(
    route: Route, wire_radius_mm: float, *, start_mm: float, speed_mm_s: float, seconds: float, safe_ratio: float
) -> Float[np.ndarray, "samples 2"]:
    """Return desired tips that go along a route at some speed, as near to the wall as is safe, and rest at its end.

    Args:
        route: the path to the target.
        wire_radius_mm: of the wire, mm.
        start_mm: Δtip at the start, mm.
        speed_mm_s: mm/s.
        seconds: most time that they take, s.
        safe_ratio: γ/(r − r_w) of the desired tips.
    """
    length_mm = max(route.target.abscissa - start_mm, 0.0)
    periods = int(np.ceil(min(length_mm / speed_mm_s + _MARGIN_S, seconds) / DECISION_PERIOD_S))
    ahead = start_mm + speed_mm_s * DECISION_PERIOD_S * np.arange(1, periods + 1)
    abscissa = np.minimum(ahead, route.target.abscissa)
    room = np.maximum(route.radius(abscissa) - wire_radius_mm, 0.0)
    return np.column_stack([abscissa, safe_ratio * room])
