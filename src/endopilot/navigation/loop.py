"""One navigation in the simulator: a policy decides, a robot moves the wire, an exposure shows the tip where asked.

`NavigationLoop.run` drives it to its end, `step` by one decision.
"""

from __future__ import annotations

import time
from dataclasses import field, replace
from typing import Annotated, Any

import numpy as np
from pydantic import model_validator

from endopilot.devices.drive_limits import DriveLimits
from endopilot.devices.robot import RobotConfig
from endopilot.errors import InputError
from endopilot.navigation.policies import make_policy
from endopilot.navigation.policy import BelievedTip, Believer, Decision, Led, Observation, Policy
from endopilot.navigation.record import NavigationRecord, Track
from endopilot.robot.robot import CYCLE_S, SimulatedRobot
from endopilot.settings import Within, settings
from endopilot.simulation.config import SimulatorConfig
from endopilot.simulation.engine_simulator import ENGINES
from endopilot.simulation.motion import Motion
from endopilot.simulation.robots import in_grip
from endopilot.simulation.simulator import Simulator
from endopilot.simulation.world import World
from endopilot.tasks.navigation import DECISION_PERIOD_S, SUCCESS_MM, Navigation, Target, XrayKind
from endopilot.xray.fluoroscope import FluoroscopeConfig, make_c_arm


@settings
class LoopConfig:
    """Robot and C-arm of a navigation loop, and the settings of the simulated reality."""

    robot: RobotConfig = field(default_factory=RobotConfig)
    """The robot as it truly is; a seed draws gains and plays if their spreads are given. `Navigation.robot` is what is
    known of it."""
    fluoroscope: FluoroscopeConfig = field(default_factory=FluoroscopeConfig)
    """The C-arm."""
    xray: XrayKind = "assumed"
    """What an exposure is: assumed (the tip, with the C-arm's errors of detection) or images (the tip is found in X-ray
    images of a patient whose pose is registered by one injection of contrast)."""
    simulator: SimulatorConfig = field(default_factory=lambda: SimulatorConfig(threads=1))
    """The rod core."""
    motion: Motion | None = None
    """How heart and breath truly move the vessel and its guiding catheter; they lie still if not given. The navigation
    says what of it is known; the rest an exposure shows as an error."""
    measure_motion: bool = False
    """Before the wire goes in, a run of contrast shows how the patient moves, and the navigation knows that instead. It
    takes X-ray images."""
    cycle_s: Annotated[float, Within(1e-4, CYCLE_S)] = CYCLE_S
    """Period of the drives' loop, s; it divides the time between two decisions."""

    @model_validator(mode="after")
    def _consistent(self) -> LoopConfig:
        if abs(self.cycles * self.cycle_s - DECISION_PERIOD_S) > 1e-9:
            raise ValueError(f"cycle_s: {self.cycle_s}; give what divides {DECISION_PERIOD_S} s, such as {CYCLE_S}")
        return self

    @property
    def cycles(self) -> int:
        """Number of the drives' cycles between two decisions."""
        return round(DECISION_PERIOD_S / self.cycle_s)


class NavigationLoop:
    """One navigation in closed loop: it owns the world, the robot and the C-arm.

    Every `DECISION_PERIOD_S` the policy is given the encoders' readings and, where its last decision asked for it, what
    X-ray shows; at the first decision X-ray is always on. The navigation ends when the target is reached at the end of
    a period, when the time is over, or when the simulation fails. `run` drives to the end, and records what happens::

        record = NavigationLoop(navigation, "agent", seed=1).run()

    `navigate`, the ladder and the cockpit are plain loops over `step`. Somebody else may drive, such as a `Hand`: the
    policy watches then, and goes on with X-ray on once it is handed back to::

        loop = NavigationLoop(navigation, "agent", seed=1)
        while loop.reason is None:
            loop.step()                                      # the policy decides
        loop.hand_over(Hand(((2.0, 0.5),)))
        loop.step()                                          # somebody else does
        record = loop.record()

    The parts of a step are `observe`, `decide` and `take`, or `begin` for all three, and `advance` until the period is
    over. Hands that move faster than twice a second call `robot.command` between two cycles.

    Attributes:
        navigation: what is to be done, as the policy is given it; `aim` gives it another target.
        world: what reality is, with what a seed draws.
        policy: what decides, or watches while somebody else does.
        simulator: the world as it truly is; its one wire is the real one.
        robot: what moves it, and its catheters.
        c_arm: what shows its tip.
        observation: what was observed last; None before the first decision.
        believed: what the policy believed at the last decision; None for a policy that does not tell.
        reason: why the navigation is over, as in `NavigationRecord`; None while it goes on.
        gives_up: where and why the policy gave up at the last decision, in words; empty if it goes on.
        decision_s: wall time that each decision took, s.
    """

    def __init__(
        self,
        navigation: Navigation,
        policy: Policy | str,
        *,
        config: LoopConfig | None = None,
        seed: int = 0,
        world: World | None = None,
    ) -> None:
        """Bring the wire to the start.

        Args:
            navigation: as the policy is given it.
            policy: what decides, or the name of a policy, such as "agent".
            config: robot, C-arm and rod core.
            seed: of encoder noise, detection errors and the policy.
            world: what reality is; as the navigation and `config` say if not given.

        Raises:
            InputError: there is no such policy, or the wire does not fit the vessel, or starts deeper than it is long,
                or the vessel is not recognised in X-ray images.
        """
        self.config = config = config or LoopConfig()
        self.world = world = (world or World()).drawn(navigation.anatomy, seed)
        known = navigation.robot or config.robot
        self.navigation = navigation = replace(navigation, xray=config.xray, robot=known)
        self.policy = make_policy(policy) if isinstance(policy, str) else policy
        real, motion = world.real_robot(config.robot), world.motion or config.motion
        self.simulator = start_world(navigation, world, config.simulator, robot=real, motion=motion)
        limits = [DriveLimits.of(device, navigation.anatomy) for device in navigation.devices]
        self.robot = SimulatedRobot(
            self.simulator,
            limits,
            real,
            seed=seed,
            ostium_mm=world.ostium_mm,
            backs_out=(world.backs_out_after_s, world.backs_out_mm),
            cycle_s=config.cycle_s,
        )
        self.c_arm = make_c_arm(navigation, config=config.fluoroscope, seed=seed, registration_mm=world.registration_mm)
        if config.measure_motion:
            measured = self.c_arm.measure_motion(motion, np.random.default_rng([seed, 6]))
            self.navigation = navigation = replace(navigation, known_motion=measured)
            self.c_arm.known_motion = measured
        self._random = np.random.default_rng([seed, 2])
        self._track = Track()
        self._moved(float(self.simulator.contacts.max()))
        self._periods = navigation.periods(DECISION_PERIOD_S)
        self._period, self._cycles_left, self._peak_n = 0, 0, 0.0
        self._driver: Policy | None = None
        self._expose, self._exposed = True, False
        self.observation: Observation | None = None
        self.believed: BelievedTip | None = None
        self.reason: str | None = None
        self.gives_up = ""
        self.decision_s: list[float] = []
        self.policy.start(navigation, seed)

    @property
    def time_s(self) -> float:
        """Time since the start of the navigation, s."""
        return DECISION_PERIOD_S * self._period - self.config.cycle_s * self._cycles_left

    @property
    def between_periods(self) -> bool:
        """Whether a decision is due: the last period is over."""
        return self._cycles_left == 0

    @property
    def reached(self) -> bool:
        """Whether the target is reached now; the tip is only projected, which takes time, where it is near."""
        navigation, simulator = self.navigation, self.simulator
        line = navigation.anatomy.tree.branches[navigation.target.branch].centerline
        at, arriving = navigation.target.abscissa, navigation.arriving
        width = float(line.radius[np.abs(line.abscissa - at) <= SUCCESS_MM + 1.0].max())
        away = np.linalg.norm(simulator.tip_position[0, arriving] - navigation.target.position(navigation.anatomy))
        if away > SUCCESS_MM + 3 * width:
            return False
        return bool(navigation.reached(simulator.project())[0])

    def hand_over(self, to: Policy | None) -> None:
        """Let somebody else drive from the next decision on, without X-ray; or the policy again (None), with X-ray."""
        self._driver, self._expose = to, to is None

    def aim(self, target: Target) -> None:
        """Let the navigation go to another target, of which a policy that has begun does not learn."""
        self.navigation = replace(self.navigation, target=target)

    def run(self) -> NavigationRecord:
        """Let the policy drive to the end, which is also where it gives up, and return what has happened."""
        while self.reason is None:
            self.step()
            if self.gives_up:
                self.stop()
        return self.record()

    def step(self) -> Decision:
        """Decide, and let the robot move for one period; return the decision as `take` does."""
        decision = self.begin()
        self.advance(DECISION_PERIOD_S)
        return decision

    def begin(self) -> Decision:
        """Begin a period: observe, decide and command the robot. `advance` lets it move."""
        return self.take(self.decide(self.observe()))

    def observe(self) -> Observation:
        """Read encoders and loads, and expose where the last decision asked for it; ValueError where none is due."""
        if self.reason is not None or not self.between_periods:
            raise ValueError("the navigation is over" if self.reason else "the period is not over; call advance")
        state, tip = self.robot.proximal_state(), None
        if self._expose:
            inserted, _ = state.devices[0]
            self.c_arm.registration_mm = self.world.registered_mm(self.time_s)
            tip = self.c_arm.expose(self.simulator, inserted, self._random, time_s=self.time_s)
        self._exposed = self._expose
        self.observation, self.believed = Observation(self.time_s, state.devices, tip, state.load), None
        return self.observation

    def decide(self, observation: Observation) -> Decision:
        """Return what who drives decides, or raise `InputError`; the policy watches where that is somebody else."""
        driver, began = self._driver or self.policy, time.perf_counter()
        if driver is not self.policy:
            if isinstance(self.policy, Led):
                self.policy.watch(observation)
            else:
                self.policy.decide(observation)  # what it answers is not done
        decision = _checked(driver.decide(observation), type(driver).__name__)
        self.decision_s.append(time.perf_counter() - began)
        self.believed = self.policy.believed() if isinstance(self.policy, Believer) else None
        return decision

    def take(self, decision: Decision) -> Decision:
        """Command the robot for a period; return the decision within its limits, with velocities of all devices."""
        taken = self.robot.command(decision.devices)
        seen = self.observation
        tip = None if seen is None else seen.tip
        # An image in which no wire was found is taken again.
        self._expose = bool(decision.expose) or (self._exposed and tip is None)
        self.gives_up = decision.gives_up
        self._track.faults += taken[: len(decision.devices)] != decision.devices
        self._track.decided.append((taken, seen, self.believed))
        self._track.exposures.append(int(self._exposed))
        self._period, self._cycles_left, self._peak_n = self._period + 1, self.config.cycles, 0.0
        return Decision(taken, expose=self._expose, gives_up=self.gives_up)

    def exposed(self) -> None:
        """Count an exposure that was taken for whoever drives by hand."""
        self._track.exposures[-1] += 1

    def advance(self, seconds: float) -> float:
        """Let robot and wire move for a multiple of the drives' cycle, no farther than to the end of the period.

        The largest wall force on a node, N, is returned.
        """
        cycle_s = self.config.cycle_s
        cycles, peak_n = min(round(seconds / cycle_s), self._cycles_left), 0.0
        for _ in range(cycles):  # one by one, so that no rounding depends on how a period is cut
            peak_n = max(peak_n, self.robot.run(cycle_s))
        self._peak_n, self._cycles_left = max(self._peak_n, peak_n), self._cycles_left - cycles
        if cycles and self._cycles_left == 0:
            self._end_period()
        return peak_n

    def stop(self) -> None:
        """End the navigation where it is."""
        self.reason = self.reason or ("gave up" if self.gives_up else "stopped")

    def go_on(self) -> None:
        """Go on after the end, from now on without a limit of time."""
        self.reason, self._periods = None, -1

    def record(self) -> NavigationRecord:
        """Return what has happened up to the end of the last whole period."""
        return self._track.record(
            self.navigation, self.world, self.simulator, self.robot, self.reason or "stopped", self.gives_up
        )

    def _moved(self, peak_n: float) -> None:
        simulator = self.simulator
        self._track.moved.append((self.robot.proximal, simulator.tip_position[0], simulator.position[0], peak_n))

    def _end_period(self) -> None:
        self._moved(self._peak_n)
        if not self.simulator.valid[0]:
            self.reason = "invalid"
        elif self.reached:
            self.reason = "reached"
        elif self._period == self._periods:
            self.reason = "time"


def start_world(
    navigation: Navigation,
    world: World,
    config: SimulatorConfig,
    *,
    robot: RobotConfig | None = None,
    motion: Motion | None = None,
) -> Simulator:
    """Return the world as it truly is, with the wire and its catheters at the start of the navigation.

    Devices slip in the grip of `robot`, or at their own limits; the vessel lies still without `motion`. InputError
    where the wire does not fit the vessel, or starts deeper than it is long.
    """
    stack, config = world.stack(navigation.stack), world.core(config)
    if robot is not None:
        stack, config = in_grip(stack, robot, config)
    anatomy = world.anatomy(navigation.anatomy)
    simulator = ENGINES[world.engine](anatomy, stack, motion=motion, config=config)
    start = navigation.start
    simulator.reset(
        inserted_length=np.maximum(start[None, :, 0] + world.ostium_mm, 0.0),
        rotation=start[None, :, 1],
        friction=stack.frictions(np.array([stack.wire.friction])),
    )
    return simulator


def _checked(decision: Any, policy: str) -> Decision:
    """Refuse what a policy of one's own may return in place of a decision; the robot checks its numbers."""
    if not isinstance(decision, Decision):
        raise InputError(f"policy: {policy} decided {type(decision).__name__}; return a Decision")
    try:
        return replace(decision, devices=tuple((v, w) for v, w in decision.devices))
    except (TypeError, ValueError) as error:
        raise InputError(
            f"policy: {policy} decided devices = {decision.devices!r}; give a pair of velocities for each device, "
            "such as ((5.0, 0.5),)"
        ) from error
