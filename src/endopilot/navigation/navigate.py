"""One navigation in the simulator: a policy decides, a robot moves the wire, an exposure shows the tip where asked.

`navigate` drives it to its end. `NavigationLoop` is the same, one step at a time.
"""

from __future__ import annotations

from dataclasses import field, replace
from typing import Any

import numpy as np
from jaxtyping import Float

from endopilot.devices.drive_limits import DriveLimits
from endopilot.errors import InputError
from endopilot.navigation.policies import make_policy
from endopilot.navigation.policy import BelievedTip, Believer, Decision, Led, Observation, Policy
from endopilot.navigation.record import NavigationRecord, Track
from endopilot.robot.robot import CYCLE_S, RobotConfig, SimulatedRobot
from endopilot.settings import settings
from endopilot.simulation.config import SimulatorConfig
from endopilot.simulation.mismatch import ModelMismatch
from endopilot.simulation.motion import Motion, place
from endopilot.simulation.simulator import Simulator
from endopilot.tasks.navigation import DECISION_PERIOD_S, SUCCESS_MM, Navigation, XrayKind, check_wire_alone
from endopilot.xray.fluoroscope import Fluoroscope, FluoroscopeConfig, TipMeasurement
from endopilot.xray.moving_patient import seen, turned

_CYCLES = round(DECISION_PERIOD_S / CYCLE_S)


@settings
class NavigateConfig:
    """Robot and C-arm of the policy, and the settings of the simulated reality."""

    robot: RobotConfig = field(default_factory=RobotConfig)
    """The drive."""
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


class NavigationLoop:
    """One navigation in closed loop, a decision period at a time: policy, robot, wire and X-ray.

    `navigate` is a plain loop over it. A program that shows the navigation starts, pauses and ends it by calling `step`
    or not. Whoever takes over gives decisions of their own; the policy watches. It goes on when none is given, with
    X-ray on at its first decision::

        loop = NavigationLoop(navigation, "agent", seed=1)
        while loop.reason is None:
            loop.step()                                      # the policy decides
            loop.step(by_hand=Decision(2.0, 0.5))            # somebody else does
        record = loop.record()

    Hands that move faster than twice a second call the parts of a step: `begin`, then `advance` in cycles of `CYCLE_S`
    until the period is over, with `robot.command` between them.

    Attributes:
        navigation: what is to be done, as the policy is given it.
        policy: what decides.
        simulator: the world as it truly is; its one wire is the real one.
        robot: what moves it, and its catheters.
        fluoroscope: the C-arm.
        observation: what was observed at the last decision; None before the first.
        believed: what the policy believed then; None for a policy that does not tell.
        reason: why the navigation is over, as in `NavigationRecord`; None while it goes on.
        gives_up: where and why the policy gave up at the last decision, in words; empty if it goes on. Somebody else
            may go on then.
    """

    def __init__(
        self,
        navigation: Navigation,
        policy: Policy | str,
        *,
        config: NavigateConfig | None = None,
        seed: int = 0,
        truth: ModelMismatch | None = None,
    ) -> None:
        """Bring the wire to the start; the arguments are those of `navigate`.

        Raises:
            InputError: there is no such policy, or the wire does not fit the vessel, or starts deeper than it is long,
                or the vessel is not recognised in X-ray images.
        """
        config, truth = config or NavigateConfig(), truth or ModelMismatch()
        self.navigation = navigation = replace(navigation, xray=config.xray)
        self.policy = make_policy(policy) if isinstance(policy, str) else policy
        self.simulator = start_world(navigation, truth, config.simulator, motion=config.motion)
        ostium = np.asarray(navigation.anatomy.insertion.position)
        self._moves = config.motion is not None
        self._limits = tuple(DriveLimits.of(device, navigation.anatomy) for device in navigation.devices)
        drive = replace(config.robot, latency_s=config.robot.latency_s * truth.latency_factor)
        self.robot = SimulatedRobot(self.simulator, self._limits, drive, seed=seed, ostium_mm=truth.ostium_mm)
        anatomy, device = navigation.anatomy, navigation.device
        if config.xray == "images":
            from endopilot.xray.image_fluoroscope import ImageFluoroscope  # slow to import

            check_wire_alone(navigation, "xray: images: the detector")
            self.fluoroscope = ImageFluoroscope(anatomy, device, config.fluoroscope, seed)
            if config.measure_motion and config.motion is not None:
                measured = self.fluoroscope.measure_motion(config.motion, np.random.default_rng([seed, 6]))
                self.navigation = navigation = replace(navigation, known_motion=measured)
        elif config.measure_motion:
            raise InputError("measure_motion: exposures of assumed errors show no contrast; give xray: images")
        else:
            self.fluoroscope = Fluoroscope(anatomy, device.tip_radius_mm, config.fluoroscope)
        known = navigation.known_motion
        self._known = None if known is None else known.core(ostium)
        self._random = np.random.default_rng([seed, 2])
        self._track = Track(self.simulator)
        self._periods = int(np.ceil(navigation.seconds / DECISION_PERIOD_S - 1e-9))
        self._period, self._cycles_left, self._peak_n, self._expose = 0, 0, 0.0, True
        self._by_hand = False
        self.observation: Observation | None = None
        self.believed: BelievedTip | None = None
        self.reason: str | None = None
        self.gives_up = ""
        self.policy.start(navigation, seed)

    @property
    def time_s(self) -> float:
        """Time since the start of the navigation, s."""
        return DECISION_PERIOD_S * self._period - CYCLE_S * self._cycles_left

    @property
    def between_periods(self) -> bool:
        """Whether a decision is due: the last period is over."""
        return self._cycles_left == 0

    def step(self, by_hand: Decision | None = None) -> Decision:
        """Decide, and let the robot move for one period; return the decision.

        Args:
            by_hand: what somebody else decides; the policy does if it is not given.
        """
        decision = self.begin(by_hand)
        self.advance(DECISION_PERIOD_S)
        return decision

    def begin(self, by_hand: Decision | None = None) -> Decision:
        """Begin a period: observe, decide and command the robot. `advance` lets it move.

        Args:
            by_hand: what somebody else decides; the policy does if it is not given.

        Returns:
            The decision, within the drives' limits.

        Raises:
            ValueError: the navigation is over, or the last period is not.
        """
        if self.reason is not None or not self.between_periods:
            raise ValueError("the navigation is over" if self.reason else "the period is not over; call advance")
        state, tip = self.robot.proximal_state(), None
        handed_back, self._by_hand = self._by_hand and by_hand is None, by_hand is not None
        exposed = self._expose or handed_back
        if exposed:
            tip = self._measure(state.inserted_length)
        observation = Observation(self.time_s, state.inserted_length, state.rotation, tip, state.catheters)
        decision = self._decide(observation, by_hand)
        asked = decision.velocities(len(self._limits))
        control = tuple(limits.safe(*pair) for limits, pair in zip(self._limits, asked, strict=False))
        # An image in which no wire was found is taken again.
        self._expose = bool(decision.expose) or (exposed and tip is None)
        self.observation, self.gives_up = observation, decision.gives_up
        self.believed = self.policy.believed() if isinstance(self.policy, Believer) else None
        self._track.decided(control, tip, self.believed, exposed=exposed, fault=control != asked)
        wire, *catheters = control
        self.robot.command(*wire, *catheters)
        self._period, self._cycles_left, self._peak_n = self._period + 1, _CYCLES, 0.0
        return Decision(*wire, expose=self._expose, gives_up=self.gives_up, catheters=tuple(catheters))

    def advance(self, seconds: float) -> float:
        """Let robot and wire move, no farther than to the end of the period.

        Args:
            seconds: a multiple of `CYCLE_S`.

        Returns:
            The largest wall force on a node, N.
        """
        cycles, peak_n = min(round(seconds / CYCLE_S), self._cycles_left), 0.0
        for _ in range(cycles):  # one by one, so that no rounding depends on how a period is cut
            peak_n = max(peak_n, self.robot.run(CYCLE_S))
        self._peak_n, self._cycles_left = max(self._peak_n, peak_n), self._cycles_left - cycles
        if cycles and self._cycles_left == 0:
            self._end_period()
        return peak_n

    def stop(self) -> None:
        """End the navigation where it is."""
        self.reason = self.reason or ("gave up" if self.gives_up else "stopped")

    def record(self) -> NavigationRecord:
        """Return what has happened up to the end of the last whole period."""
        return self._track.record(self.navigation, self.robot.driven, self.reason or "stopped", self.gives_up)

    def _measure(self, inserted_length: float) -> TipMeasurement | None:
        if isinstance(self.fluoroscope, Fluoroscope):
            tip, heading = self.simulator.tips()[0], self.simulator.tip_direction[0]
            if self._moves:
                shown = self._seen()
                tip, heading = place(shown, tip), turned(shown, heading)
            return self.fluoroscope.expose(tip, heading, inserted_length, self._random)
        nodes = self.simulator.position[0]
        if self._moves:
            nodes = place(self._seen(), nodes)
        return self.fluoroscope.expose(nodes, inserted_length, self._random)

    def _seen(self) -> Float[np.ndarray, "3 4"]:
        """Return where the C-arm takes points of the moving vessel to lie in the vessel as CT shows it."""
        return seen(self.simulator.vessel_to_laboratory[:1], self._known, np.array([self.time_s]))[0]

    def _decide(self, observation: Observation, by_hand: Decision | None) -> Decision:
        if by_hand is None:
            return _checked(self.policy.decide(observation), type(self.policy).__name__)
        if isinstance(self.policy, Led):
            self.policy.watch(observation)
        else:
            self.policy.decide(observation)  # what it answers is not done
        return by_hand

    def _end_period(self) -> None:
        self._track.moved(self.simulator, self._peak_n)
        if not self.simulator.valid[0]:
            self.reason = "invalid"
        elif _reached(self.navigation, self.simulator):
            self.reason = "reached"
        elif self._period == self._periods:
            self.reason = "time"


def navigate(
    navigation: Navigation,
    policy: Policy | str,
    *,
    config: NavigateConfig | None = None,
    seed: int = 0,
    truth: ModelMismatch | None = None,
) -> NavigationRecord:
    """Let a policy drive one navigation in the simulator, and record what truly happens.

    Every `DECISION_PERIOD_S` the policy is given the encoders' readings and, where its last decision asked for it, what
    X-ray shows; at the first decision X-ray is always on. It ends when the target is reached at the end of a period,
    when the time is over, when the policy gives up, or when the simulation fails.

    Args:
        navigation: as the policy is given it.
        policy: what decides, or the name of a policy, such as "agent".
        config: robot, C-arm and rod core.
        seed: of encoder noise, detection errors and the policy.
        truth: how reality differs; not at all if not given.

    Raises:
        InputError: there is no such policy, or the wire does not fit the vessel, or starts deeper than it is long.
    """
    loop = NavigationLoop(navigation, policy, config=config, seed=seed, truth=truth)
    while loop.reason is None:
        loop.step()
        if loop.gives_up:
            loop.stop()
    return loop.record()


def start_world(
    navigation: Navigation, truth: ModelMismatch, config: SimulatorConfig, *, motion: Motion | None = None
) -> Simulator:
    """Return the world as it truly is, with the wire and its catheters at the start of the navigation.

    Args:
        navigation: as a policy is given it.
        truth: how reality differs.
        config: settings of the rod core.
        motion: of the vessel; it lies still if not given.

    Raises:
        InputError: the wire does not fit the vessel, or starts deeper than it is long.
    """
    device = navigation.device
    wire = device.with_tip(bend_rad=device.tip_bend_rad, stiffness_factor=truth.stiffness_factor)
    catheters = truth.catheters(navigation.catheters)
    simulator = Simulator(truth.anatomy(navigation.anatomy), wire, catheters=catheters, motion=motion, config=config)
    simulator.reset(
        inserted_length=[max(navigation.start_inserted_mm + truth.ostium_mm, 0.0)],
        rotation=[navigation.start_rotation],
        friction=[device.friction * truth.friction_factor],
        catheter_inserted_length=np.full((1, len(catheters)), max(navigation.start_catheter_mm + truth.ostium_mm, 0.0)),
    )
    return simulator


def _checked(decision: Any, policy: str) -> Decision:
    """Refuse what a policy of one's own may return in place of a decision; the drives' limits check its numbers."""
    if not isinstance(decision, Decision):
        raise InputError(f"policy: {policy} decided {type(decision).__name__}; return a Decision")
    return decision


def _reached(navigation: Navigation, simulator: Simulator) -> bool:
    """Return whether the tip has reached the target; it is only projected, which takes time, where it is near."""
    line = navigation.anatomy.tree.branches[navigation.target.branch].centerline
    at = navigation.target.abscissa
    width = float(line.radius[np.abs(line.abscissa - at) <= SUCCESS_MM + 1.0].max())
    arriving = navigation.arriving
    away = np.linalg.norm(simulator.tips(arriving)[0] - navigation.target.position(navigation.anatomy))
    if away > SUCCESS_MM + 3 * width:
        return False
    return bool(navigation.reached(*(simulator.project(device) for device in range(arriving + 1)))[0])
