"""One navigation in the simulator: a policy decides, a robot moves the wire, an exposure shows the tip where asked."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
from jaxtyping import Bool, Float

from endopilot.anatomy.projection import project_tip
from endopilot.control.policies import make_policy
from endopilot.control.policy import Observation, Policy
from endopilot.control.robot import RobotConfig, SimulatedRobot
from endopilot.settings import Finite, NonNegative, Positive, settings
from endopilot.simulation.config import SimulatorConfig
from endopilot.simulation.drive_limits import DriveLimits
from endopilot.simulation.simulator import Simulator
from endopilot.tasks.navigation import DECISION_PERIOD_S, SUCCESS_MM, Navigation
from endopilot.types import TipProjection
from endopilot.xray.fluoroscope import Fluoroscope, FluoroscopeConfig, TipMeasurement


@settings
class NavigateConfig:
    """Robot and C-arm of the policy, and the settings of the simulated reality."""

    robot: RobotConfig = field(default_factory=RobotConfig)
    """The drive."""
    fluoroscope: FluoroscopeConfig = field(default_factory=FluoroscopeConfig)
    """The C-arm."""
    simulator: SimulatorConfig = field(default_factory=lambda: SimulatorConfig(threads=1))
    """The rod core."""


@settings
class ModelMismatch:
    """How reality differs from the navigation that the policy is given."""

    friction_factor: NonNegative = 1.0
    """Factor on the friction coefficient."""
    stiffness_factor: Positive = 1.0
    """Factor on the stiffness of the wire's distal 10 mm."""
    ostium_mm: Finite = 0.0
    """The wire is inserted this much deeper than the encoder says, mm: the ostium lies elsewhere along the catheter."""
    latency_factor: NonNegative = 1.0
    """Factor on the robot's latency."""


@dataclass(frozen=True, eq=False)
class NavigationRecord:
    """A navigation as it truly went: a sample at the start and one after each decision period.

    Attributes:
        time_s: s.
        inserted_length: Δ, mm.
        rotation: φ, rad.
        tip_position: LPS mm.
        tip: Δtip, γtip, branch and lumen radius.
        contact_force_max: largest wall force on one node over the period that ends here, N.
        exposed: whether X-ray was on at this moment.
        control: what was commanded from this moment on, within the limits, mm/s and rad/s; 0 at the end.
        measured: what X-ray showed at this moment, or None.
        success: the tip reached the target in time, at the end of a period.
        safe: the wall force never exceeded the navigation's limit.
        seconds: how long it took, s.
        peak_force_n: largest wall force on one node, N.
        exposures: their number, of both views together as one.
        path_mm: length of the tip's path, sample to sample, mm.
        faults: decisions that were not finite or beyond the drive's limits, and were mended.
        reason: "reached", "time" or "invalid" (the simulation failed).
    """

    time_s: Float[np.ndarray, "samples"]
    inserted_length: Float[np.ndarray, "samples"]
    rotation: Float[np.ndarray, "samples"]
    tip_position: Float[np.ndarray, "samples 3"]
    tip: TipProjection
    contact_force_max: Float[np.ndarray, "samples"]
    exposed: Bool[np.ndarray, "samples"]
    control: Float[np.ndarray, "samples 2"]
    measured: tuple[TipMeasurement | None, ...]
    success: bool
    safe: bool
    seconds: float
    peak_force_n: float
    exposures: int
    path_mm: float
    faults: int
    reason: str


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
    when the time is over, or when the simulation fails.

    Args:
        navigation: as the policy is given it.
        policy: what decides, or the name of a policy, such as "agent".
        config: robot, C-arm and rod core.
        seed: of encoder noise, detection errors and the policy.
        truth: how reality differs; not at all if not given.

    Raises:
        InputError: there is no such policy, or the wire does not fit the vessel, or starts deeper than it is long.
    """
    config, truth = config or NavigateConfig(), truth or ModelMismatch()
    policy = make_policy(policy) if isinstance(policy, str) else policy
    simulator = _start(navigation, truth, config.simulator)
    limits = DriveLimits.of(navigation.device, navigation.anatomy)
    drive = replace(config.robot, latency_s=config.robot.latency_s * truth.latency_factor)
    robot = SimulatedRobot(simulator, limits, drive, seed=seed, ostium_mm=truth.ostium_mm)
    fluoroscope = Fluoroscope(navigation.anatomy, navigation.device.tip_radius_mm, config.fluoroscope)
    random = np.random.default_rng([seed, 2])
    track, periods = _Track(simulator), int(np.ceil(navigation.seconds / DECISION_PERIOD_S - 1e-9))
    policy.start(navigation, seed)
    reason, expose, direction = "time", True, simulator.tip_direction[0]
    for period in range(periods):
        state, tip = robot.proximal_state(), None
        if expose:
            tip = fluoroscope.expose(simulator.position[0, 0], direction, state.inserted_length, random)
        observation = Observation(period * DECISION_PERIOD_S, state.inserted_length, state.rotation, tip)
        decision = policy.decide(observation)
        asked = (decision.translation, decision.rotation)
        control, expose = limits.safe(*asked), bool(decision.expose)
        track.decided(control, tip, fault=control != asked)
        robot.command(*control)
        peak = robot.run(DECISION_PERIOD_S)
        track.moved(simulator, peak)
        direction = simulator.tip_direction[0]
        if not simulator.valid[0]:
            reason = "invalid"
            break
        if _reached(navigation, simulator):
            reason = "reached"
            break
    return track.record(navigation, reason)


def _start(navigation: Navigation, truth: ModelMismatch, config: SimulatorConfig) -> Simulator:
    """Return the world as it truly is, with the wire at the start of the navigation."""
    device = navigation.device
    wire = device.with_tip(bend_rad=device.tip_bend_rad, stiffness_factor=truth.stiffness_factor)
    simulator = Simulator(navigation.anatomy, wire, config=config)
    simulator.reset(
        inserted_length=[max(navigation.start_inserted_mm + truth.ostium_mm, 0.0)],
        rotation=[navigation.start_rotation],
        friction=[device.friction * truth.friction_factor],
    )
    return simulator


def _reached(navigation: Navigation, simulator: Simulator) -> bool:
    """Return whether the tip has reached the target; it is only projected, which takes time, where it is near."""
    line = navigation.anatomy.tree.branches[navigation.target.branch].centerline
    at = navigation.target.abscissa
    width = float(line.radius[np.abs(line.abscissa - at) <= SUCCESS_MM + 1.0].max())
    away = np.linalg.norm(simulator.position[0, 0] - navigation.target.position(navigation.anatomy))
    return bool(away <= SUCCESS_MM + 3 * width and navigation.reached(simulator.project())[0])


class _Track:
    """Gathers what happens."""

    def __init__(self, simulator: Simulator) -> None:
        self._columns: dict[str, list] = {name: [] for name in ("proximal", "position", "force")}
        self._controls: list[tuple[float, float]] = []
        self._measured: list[TipMeasurement | None] = []
        self._faults = 0
        self.moved(simulator, float(simulator.contacts.max()))

    def decided(self, control: tuple[float, float], tip: TipMeasurement | None, *, fault: bool) -> None:
        self._controls.append(control)
        self._measured.append(tip)
        self._faults += fault

    def moved(self, simulator: Simulator, peak_n: float) -> None:
        self._columns["proximal"].append([simulator.inserted_length[0], simulator.rotation[0]])
        self._columns["position"].append(simulator.position[0, 0])
        self._columns["force"].append(peak_n)

    def record(self, navigation: Navigation, reason: str) -> NavigationRecord:
        anatomy = navigation.anatomy
        proximal, position = np.array(self._columns["proximal"]), np.array(self._columns["position"])
        force = np.array(self._columns["force"])
        measured = (*self._measured, None)
        return NavigationRecord(
            time_s=DECISION_PERIOD_S * np.arange(len(force)),
            inserted_length=proximal[:, 0],
            rotation=proximal[:, 1],
            tip_position=position,
            tip=project_tip(anatomy.tree, anatomy.insertion, position),
            contact_force_max=force,
            exposed=np.array([tip is not None for tip in measured]),
            control=np.array([*self._controls, (0.0, 0.0)]),
            measured=measured,
            success=reason == "reached",
            safe=bool(force.max() <= navigation.force_limit_n),
            seconds=DECISION_PERIOD_S * (len(force) - 1),
            peak_force_n=float(force.max()),
            exposures=sum(tip is not None for tip in measured),
            path_mm=float(np.linalg.norm(np.diff(position, axis=0), axis=1).sum()),
            faults=self._faults,
            reason=reason,
        )
