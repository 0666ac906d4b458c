"""One wire driven to a named place of one patient's vessel, in closed loop: `navigate`.

The vessel is read, X-ray shows how the guiding catheter lies, the wire is shaped, and reality is made to differ from
what the policy is given. Then `NavigationLoop` drives. The whole wire is kept, as it truly was and as the policy
believed it to be.
"""

from __future__ import annotations

import time
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import numpy as np
from jaxtyping import Float

from endopilot.anatomy.catheter_axis import lean_between, with_axis
from endopilot.anatomy.io import read_anatomy
from endopilot.control.agent import AgentPolicy, OraclePolicy
from endopilot.control.agent_config import AgentConfig
from endopilot.control.set_up import GivenConfig, TipChoice, choose_tip, tip_name
from endopilot.devices.catheter import list_catheters
from endopilot.devices.device import Wire
from endopilot.devices.device_files import list_wires
from endopilot.devices.robot import ASSUMED, RobotConfig, read_robot
from endopilot.devices.stack import Stack
from endopilot.errors import InputError
from endopilot.navigation.loop import LoopConfig, NavigationLoop, XrayKind
from endopilot.navigation.policies import POLICIES, make_policy
from endopilot.navigation.policy import Believer, Led, Observation, Policy
from endopilot.navigation.record import NavigationRecord
from endopilot.progress import progress
from endopilot.settings import Seed, Text, public, settings
from endopilot.simulation.config import SimulatorConfig
from endopilot.simulation.motion import Motion, MotionName, motion_named, published_mean
from endopilot.simulation.trajectory import Trajectory
from endopilot.simulation.world import NOMINAL, World, read_world
from endopilot.tasks.navigation import DECISION_PERIOD_S, Navigation
from endopilot.tasks.route import Route, check_passable
from endopilot.tasks.targets import find_target
from endopilot.types import Anatomy
from endopilot.xray.fluoroscope import Fluoroscope

MotionKnown = Literal["nothing", "published", "measured", "exact"]


@settings
class NavigateConfig(GivenConfig):
    """Limits, X-ray, and how reality differs from what the policy is given."""

    robot: Text = ASSUMED
    """Name of the robot that drives them, such as assumed, ideal or kweon-2021-2d (docs/concepts/robot.md), or a YAML
    file. Policies are given it, not what the seed draws of it."""
    world: Text = NOMINAL
    """Name of the world that reality is, such as nominal, drawn or wide-lumen (docs/concepts/worlds.md), or a YAML
    file. The policy does not know it."""
    xray: XrayKind = "assumed"
    """What an exposure is: assumed (the tip, with the C-arm's errors of detection) or images (the tip is found in X-ray
    images of a patient whose pose is registered by one injection of contrast)."""
    motion: MotionName = "still"
    """How heart and breath move the vessel and the guiding catheter: still, breathing, heartbeat or both."""
    motion_seed: Seed | None = None
    """Draws the patient's amplitudes from the published distributions; their means if not given."""
    motion_known: MotionKnown = "published"
    """What is known of that motion, with the phase of heart and breath: nothing, the published mean, what a run of
    contrast has measured (where exposures are images), or exactly the patient's own. The C-arm takes it off what it
    measures, and agents simulate it."""


@dataclass(frozen=True, eq=False)
class SetUp:
    """A navigation that is ready to begin.

    Attributes:
        config: its settings.
        target: as it was asked for.
        folder: of the patient's anatomy; None if it was given in memory.
        anatomy: the patient's vessel as it was given; that of `navigation` has its catheter as X-ray shows it, and
            as it was turned.
        navigation: as the policy is given it.
        choice: of the tip's shape and the catheter's axis.
        world: what reality is, from where the navigation's catheter lies.
        robot: what drives, as it is given; `World.real_robot` is the true one.
        snapped_mm: distance from a target that was given as a point to the centerline, mm; None for a section.
        policy: what decides.
        policy_name: its name, or that of its class.
        policy_origin: where it comes from: package and version, or file and hash.
        simulator: settings of the simulated reality.
    """

    config: NavigateConfig
    target: str
    folder: Path | None
    anatomy: Anatomy
    navigation: Navigation
    choice: TipChoice
    world: World
    robot: RobotConfig
    snapped_mm: float | None
    policy: Policy
    policy_name: str
    policy_origin: str
    simulator: SimulatorConfig

    @property
    def true_anatomy(self) -> Anatomy:
        """The vessel with its guiding catheter as it truly lies."""
        return self.world.anatomy(self.navigation.anatomy)

    @property
    def motion(self) -> Motion | None:
        """How the vessel moves; None if it lies still."""
        return self.world.motion or motion_named(self.config.motion, self.config.motion_seed)


@dataclass(frozen=True, eq=False)
class PatientNavigation:
    """A navigation in a patient, as it truly went and as the policy believed it to go.

    Attributes:
        set_up: what it began with.
        record: what happened, at the start and after each decision period.
        episode: the true motion at the end of each decision period, at rest from the end of the navigation until its
            limit, so that all episodes of a task are of one length.
        wires: the wires that the policy held possible at the end of each period, the likeliest first: nodes from the
            tip on, LPS mm; None for a policy that does not tell.
        plans: how often the policy searched a course; None for one that does not count.
        planning_s: time that its searches took, s; None likewise.
        decision_s: wall time that each decision took, s.
        proposal: shipped devices that a search brings to the target where the agent gave up; empty if there are none.
    """

    set_up: SetUp
    record: NavigationRecord
    episode: Trajectory
    wires: tuple[Float[np.ndarray, "wires nodes 3"], ...] | None
    plans: int | None
    planning_s: float | None
    decision_s: Float[np.ndarray, "decisions"]
    proposal: str


@public
def navigate(
    anatomy: Anatomy | str | Path,
    target: str,
    *,
    policy: Policy | str = "agent",
    device: Wire | Stack | str | Path = "workhorse-014",
    config: NavigateConfig | None = None,
) -> PatientNavigation:
    """Let a policy drive a wire to a place of a patient's vessel, in closed loop, and return what happened.

    A robot moves the devices, and X-ray shows the tip where the policy asks for it. `write_navigation` writes the
    result into a folder. `NavigationLoop` drives a `Navigation` of one's own, one decision at a time if wanted.

    Args:
        anatomy: the vessel, or its folder.
        target: a section such as "4" or "LAD", or a point "X,Y,Z" in LPS mm, which is moved to the centerline.
        policy: what decides, or its name: agent, oracle (which is given the truth), open-loop, forward, spin,
            retract-rotate, with a catheter in-turn or catheter-alone, or MODULE:OBJECT of your own.
        device: the wire, its name or its YAML file, or the wire and its catheters.
        config: limits, X-ray, and how reality differs from what the policy is given.

    Raises:
        InputError: no such section, a point outside the vessel, a target behind an occlusion; no such policy, device,
            robot or tip; devices that do not fit; a motion that is measured without X-ray images.
    """
    return drive(set_up_navigation(anatomy, target, policy=policy, device=device, config=config))


def set_up_navigation(
    anatomy: Anatomy | str | Path,
    target: str,
    *,
    policy: Policy | str = "agent",
    device: Wire | Stack | str | Path = "workhorse-014",
    config: NavigateConfig | None = None,
) -> SetUp:
    """Prepare a navigation in a patient; the arguments, and what is raised, are those of `navigate`."""
    config = config or NavigateConfig()
    if config.motion_known == "measured" and config.xray != "images":
        raise InputError("motion_known: measured; only X-ray images measure it: give xray: images, or published")
    vessel = anatomy if isinstance(anatomy, Anatomy) else read_anatomy(anatomy)
    stack, goal = Stack.of(device), find_target(vessel.tree, target)
    seen, world = _see_catheter(vessel, stack.wire, read_world(config.world).drawn(vessel, config.seed), config)
    name = policy if isinstance(policy, str) else type(policy).__qualname__
    origin = POLICIES.origin(policy) if isinstance(policy, str) else type(policy).__module__
    if isinstance(policy, str):
        policy = OraclePolicy(world) if policy == "oracle" else make_policy(policy)
    given = config.navigation(seen, stack, goal, _known_motion(config, world))
    check_passable(Route.to(seen, goal), given.devices[given.arriving])
    choice = choose_tip(given, tip=config.tip, catheter_tilt_deg=config.catheter_tilt_deg)
    place, parts = goal.position(vessel), target.split(",")
    return SetUp(
        config=config,
        target=target,
        folder=None if isinstance(anatomy, Anatomy) else Path(anatomy),
        anatomy=vessel,
        navigation=choice.navigation,
        choice=choice,
        world=world,
        robot=read_robot(config.robot),
        snapped_mm=float(np.linalg.norm(place - np.array(parts, dtype=float))) if len(parts) == 3 else None,
        policy=policy,
        policy_name=name,
        policy_origin=origin,
        simulator=SimulatorConfig(threads=1),
    )


def drive(set_up: SetUp) -> PatientNavigation:
    """Let the policy drive the devices in the simulated reality, and return what happened."""
    navigation, policy = set_up.navigation, set_up.policy
    config = LoopConfig(
        robot=set_up.robot,
        simulator=set_up.simulator,
        xray=set_up.config.xray,
        motion=set_up.motion,
        measure_motion=set_up.config.motion_known == "measured",
    )
    loop = NavigationLoop(navigation, policy, config=config, seed=set_up.config.seed, world=set_up.world)
    wires: list[Float[np.ndarray, "wires nodes 3"]] = []
    with progress(f"Navigating, {set_up.policy_name}", total=navigation.seconds) as advance:
        while loop.reason is None:
            loop.step()
            if loop.gives_up:
                loop.stop()
            advance(DECISION_PERIOD_S, f"{loop.simulator.inserted_length[0, 0]:.0f} mm inserted")
            if isinstance(policy, Believer) and loop.time_s > DECISION_PERIOD_S:
                wires.append(policy.believed_wires())  # at the decision, which ended the period before
    if isinstance(policy, Led):
        state = loop.robot.proximal_state()
        policy.watch(Observation(loop.time_s, state.devices, None, state.load))
    if isinstance(policy, Believer):
        wires.append(policy.believed_wires())
    record = loop.record()
    if record.seconds < navigation.seconds:
        loop.robot.stop()
        loop.robot.run(navigation.seconds - record.seconds)
    return PatientNavigation(
        set_up=set_up,
        record=record,
        episode=loop.robot.recorder.trajectory().every(loop.config.cycles),
        wires=tuple(wires) if wires else None,
        plans=getattr(policy, "plans", None),
        planning_s=getattr(policy, "planning_s", None),
        decision_s=np.array(loop.decision_s),
        proposal=propose_devices(navigation) if loop.gives_up and isinstance(policy, AgentPolicy) else "",
    )


def _known_motion(config: NavigateConfig, world: World) -> Motion | None:
    """Return what is known of how the vessel moves before it is measured."""
    if config.motion_known == "nothing":
        return None
    if world.motion is not None:
        return world.motion if config.motion_known == "exact" else published_mean(world.motion)
    return motion_named(config.motion, config.motion_seed if config.motion_known == "exact" else None)


def _see_catheter(vessel: Anatomy, device: Wire, world: World, config: NavigateConfig) -> tuple[Anatomy, World]:
    """Return the vessel with its guiding catheter as an exposure shows it, and the world from there.

    A catheter that lies as it is given, and one that X-ray does not show, stays as it is given.
    """
    if world.axis_deg == 0 or config.xray == "images":
        return vessel, world
    real = world.axis(vessel)
    c_arm = Fluoroscope(vessel, device.tip_radius_mm)
    axis = c_arm.catheter_axis(real, np.random.default_rng([config.seed, 4]))
    unseen_deg, side_deg = lean_between(axis, real)
    return with_axis(vessel, axis), replace(world, axis_deg=unseen_deg, axis_side_deg=side_deg)


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
