"""The belief about the wire between X-ray exposures: an ensemble of simulated wires, driven like the real one.

Each follows the robot's encoders, in a vessel that moves as it is known to. Catheters around the real wire are around
each simulated one too, and driven like the real ones. A measurement of the tip weights the members by their errors.

Where the encoders sit in front of the drives' play, a measurement first says where the proximal end of the wire is: its
tip is compared with that of the likeliest wire, turned to all sides and moved along the vessel. All members are then
brought to where the device most likely is.
"""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Annotated, Any

import numpy as np
from jaxtyping import Float, Int

from endopilot.anatomy.projection import TipProjector
from endopilot.belief.drives import Drives, force_sd_n
from endopilot.belief.moved_copies import SIDES, MovedCopies, shifted, turn_to_all_sides, turned
from endopilot.belief.thought import Budget
from endopilot.belief.vessels import SharedVessels
from endopilot.devices.device import lateral_reach
from endopilot.devices.drive_limits import DriveLimits
from endopilot.devices.stack import Proximals
from endopilot.models.hypotheses import likelihoods
from endopilot.settings import NonNegative, Positive, ShareBelowOne, Within, settings
from endopilot.simulation.config import PRESETS, SimulatorConfig
from endopilot.simulation.motion import Motion
from endopilot.simulation.simulator import Simulator
from endopilot.simulation.world import World
from endopilot.tasks.navigation import DECISION_PERIOD_S, Navigation
from endopilot.types import TipProjection
from endopilot.xray.fluoroscope import TipMeasurement

_PLACED_MM = 0.5, 0.15
"""Scales of the errors, along and across the wire, of a tip whose proximal end is where it is believed, mm."""
_SURE_SDS = 3.0
"""A measured tip is taken for another than the simulated ones beyond this many of its own standard deviations."""
_SURE_RAD = 0.08
"""A rotation that is known as well is not looked for, rad."""


@settings
class BeliefConfig:
    """The ensemble, and the accuracy of measurements."""

    members: Annotated[int, Within(1, 4096)] = 12
    """Simulated wires."""
    stiffness_levels: Annotated[int, Within(1, 100)] = 3
    """Different stiffnesses of the tip among them."""
    friction_spread: ShareBelowOne = 0.2
    """The friction coefficient may differ from the given one by this share, up or down."""
    stiffness_spread: ShareBelowOne = 0.2
    """The stiffness of the tip may differ from the given one by this share, up or down."""
    ostium_spread_mm: NonNegative = 0.5
    """The ostium may lie this much deeper or less deep along the catheter's axis, mm."""
    along_sd_mm: Positive = 0.6
    """Scale of a good member's error along the wire, mm: X-ray shows the end of a tip badly."""
    across_sd_mm: Positive = 0.3
    """The same across the wire, mm."""
    lost_along_mm: Positive = 4.0
    """A measured tip this far along the wire from all simulated ones is explained by none, mm."""
    lost_across_mm: Positive = 1.5
    """The same across the wire, mm."""
    lost_across_radii: NonNegative = 0.0
    """The same in radii of the lumen, where that is more."""
    copies: Annotated[int, Within(0, 4096)] = 0
    """Copies of the likeliest devices that are moved to and fro where no member explains a measurement, until one does;
    none if 0, or where members differ in more than friction and ostium."""
    element_mm: Annotated[float, Within(0.02, 5)] = 0.75
    """Length of the rod core's elements at the wire's tip, mm: longer ones catch in hairpin bends."""
    time_step_s: Annotated[float, Within(1e-5, 0.5)] = 0.05
    """Time step of the rod core, s."""

    @property
    def core(self) -> SimulatorConfig:
        """Settings of the rod core: Newton's method ends as early as for many rollouts; snaps are followed closely."""
        fast = PRESETS["fast"]
        return SimulatorConfig(
            element_mm=self.element_mm,
            time_step_s=self.time_step_s,
            tolerance_mm=fast.tolerance_mm,
            sample_tolerance_mm=fast.sample_tolerance_mm,
        )


@dataclass
class Past:
    """What became of a navigation so far.

    Attributes:
        proximal: where the proximal ends of the devices were believed at each decision, mm and rad.
        exposures: what X-ray showed, by the decision, as it was measured.
        measured: encoders and loads at each decision, and what the drives had been commanded.
    """

    proximal: list[Float[np.ndarray, "devices 2"]] = field(default_factory=list)
    exposures: dict[int, TipMeasurement] = field(default_factory=dict)
    measured: list[tuple[Proximals, Proximals, Proximals]] = field(default_factory=list)

    def copy(self) -> Past:
        """Return what became of it so far, to which nothing is added."""
        return Past(list(self.proximal), dict(self.exposures), list(self.measured))

    def by_encoders(self) -> Past:
        """Return the same with the proximal ends where the encoders read them."""
        return replace(self, proximal=[np.array(encoders, dtype=float) for encoders, _, _ in self.measured])


Errors = Float[np.ndarray, "n 2"]
"""Along and across each wire, mm."""


def _split(error: Float[np.ndarray, "n 3"], along: Float[np.ndarray, "n 3"]) -> tuple[Errors, np.ndarray]:
    """Return the sizes of errors along and across wires, mm, given their unit vectors, and the unit vectors of both."""
    shift = np.einsum("ni,ni->n", error, along)
    across = error - shift[:, None] * along
    size = np.linalg.norm(across, axis=1)
    axes = np.stack([along, across / np.maximum(size, 1e-9)[:, None]], axis=1)
    return np.column_stack([np.abs(shift), size]), axes


def _sds(axes: Float[np.ndarray, "n 2 3"], measured: TipMeasurement) -> Errors:
    """Return the standard deviations of a measured tip along axes, mm."""
    return np.sqrt(np.einsum("nai,ij,naj->na", axes, measured.covariance, axes))


class Belief:
    """An ensemble of simulated wires that follow a navigation, and how likely each is.

    Each member is a `World` of its own: wire, friction, lumen, wall and ostium as they may truly be.

    Attributes:
        members: what each takes reality to be; all have the same wall and registration.
        kinds: vessel and devices, those that differ; members share them.
        kind: the place among these of each member.
        ostium_mm: how much deeper each member's devices lie than the encoders say, mm.
        tip: of each member's wire.
        drives: where the proximal ends are.
        vessels: as members have them.
        error: of each member at the last measurement, along and across its wire, mm.
        motion: how the vessel was found to move, which the C-arm does not know; None if it was not.
        evidence: logarithm of how likely the measurements so far were, each before it was taken, up to what all beliefs
            share.
        shown: at each measurement that was replayed, every member's tip and the direction of its wire there, in the
            vessel as CT shows it, LPS mm.
        pushed: at each period that was replayed, the force that every member ahead of the valve takes of its drive, N.
        force: largest force of the wall on a node of each member at the end of the last period, N.
    """

    def __init__(
        self,
        navigation: Navigation,
        members: Sequence[World],
        config: BeliefConfig,
        *,
        drives: Drives | None = None,
        vessels: SharedVessels | None = None,
        motion: Motion | None = None,
        budget: Budget | None = None,
    ) -> None:
        """Bring every member's wire to the start of the navigation.

        Args:
            members: what each takes reality to be; all have the same kind of wall.
            drives: of another belief about the same devices; at rest at the start if not given.
        """
        self.motion, self._given, self.budget = motion, navigation, budget
        self.navigation = navigation if motion is None else replace(navigation, known_motion=motion)
        self.members, self.config = tuple(members), config
        self._accuracy_mm = config.along_sd_mm, config.across_sd_mm
        self._core = self.members[0].core(config.core)
        self._limits = [DriveLimits.of(each, navigation.anatomy) for each in navigation.devices]
        fastest = np.array([limits.fastest for limits in self._limits])
        self.drives = drives or Drives(navigation.robot, navigation.start, fastest)
        self.ostium_mm = np.array([each.ostium_mm for each in self.members])
        self.vessels = vessels or SharedVessels(navigation.anatomy)
        self.kinds, self.kind = self.vessels.kinds(navigation.stack, self.members, budget)
        self._fans = dict[int, Simulator]()
        self.error, self.force = np.zeros((len(self.members), 2)), np.zeros(len(self.members))
        self._error_sd = self.error
        self._score, self._coaxial = np.zeros(len(self.members)), bool(navigation.catheters)
        self.evidence = 0.0
        self.shown: list[tuple[Float[np.ndarray, "members 3"], Float[np.ndarray, "members 3"]]] = []
        self.pushed: list[Float[np.ndarray, "members"]] = []
        self.tip = self.simulator.project()[:, 0]

    def like(self, members: Sequence[World], **changed: Any) -> Belief:
        """Return a belief of other members about the same devices, at the start of the navigation.

        Args:
            changed: `drives` and `motion`, where they are not to be those of this belief.
        """
        kept = {"drives": self.drives, "vessels": self.vessels, "motion": self.motion, "budget": self.budget}
        return Belief(self._given, members, self.config, **kept | changed)

    @staticmethod
    def around(config: BeliefConfig) -> tuple[World, ...]:
        """Return members evenly around what is given: friction and ostium from a Sobol sequence, every stiffness."""
        from scipy.stats import qmc  # slow to import

        levels = np.linspace(-1.0, 1.0, config.stiffness_levels) if config.stiffness_levels > 1 else np.zeros(1)
        unit = 2 * qmc.Sobol(2, scramble=False).random_base2(config.members.bit_length())[1 : config.members + 1] - 1
        stiffness = 1 + config.stiffness_spread * np.resize(levels, config.members)
        return tuple(
            World(
                friction_factor=1 + config.friction_spread * float(friction),
                tip_stiffness_factor=float(factor),
                ostium_mm=config.ostium_spread_mm * float(ostium),
            )
            for (friction, ostium), factor in zip(unit, stiffness, strict=True)
        )

    @cached_property
    def simulator(self) -> Simulator:
        """The worlds of the members."""
        navigation, count = self.navigation, len(self.members)
        anatomies, stacks = zip(*(self.kinds[kind] for kind in self.kind), strict=True)
        simulator = Simulator(anatomies, stacks, motion=navigation.known_motion, config=self._core)
        self.vessels.prepared(simulator)
        start = np.tile(navigation.start, (count, 1, 1))
        factor = np.array([each.friction_factor for each in self.members])
        simulator.reset(
            inserted_length=self._deeper(start[..., 0]),
            rotation=start[..., 1],
            friction=navigation.stack.frictions(navigation.device.friction * factor),
        )
        return simulator

    def _deeper(self, given_mm: Float[np.ndarray, "members *devices"]) -> Float[np.ndarray, "members *devices"]:
        """Return inserted lengths from each member's ostium on, mm, of those from the given one on."""
        return np.maximum(given_mm + self.ostium_mm.reshape(-1, *[1] * (given_mm.ndim - 1)), 0.0)

    def in_vessel(self, measured: TipMeasurement, period: int) -> TipMeasurement:
        """Return a measurement less the motion that was found, in place of the known one, and less the registration's
        error.

        Args:
            measured: as the C-arm has it, less the known motion.
        """
        beside_mm = self.members[0].registered_mm(period * DECISION_PERIOD_S)
        if self.motion is None and not any(beside_mm):
            return measured
        position = self.unmoved(measured, period) - beside_mm
        tip = self._projector(position[None])
        at = {"abscissa": float(tip.abscissa[0]), "offset": float(tip.offset[0]), "branch": int(tip.branch[0])}
        return replace(measured, position=position, **at)

    def unmoved(self, measured: TipMeasurement, period: int) -> Float[np.ndarray, "3"]:
        """Return where a measurement shows a tip less the motion that was found, LPS mm."""
        if self.motion is None:
            return measured.position
        placed = self._placed(self.motion, period)
        return np.linalg.solve(placed[:, :3], self.in_laboratory(measured, period) - placed[:, 3])

    def in_laboratory(self, measured: TipMeasurement, period: int) -> Float[np.ndarray, "3"]:
        """Return where a tip was seen, LPS mm: the C-arm has taken the known motion off."""
        if self._given.known_motion is None:
            return measured.position
        placed = self._placed(self._given.known_motion, period)
        return placed[:, :3] @ measured.position + placed[:, 3]

    def _placed(self, motion: Motion, period: int) -> Float[np.ndarray, "3 4"]:
        """Return the map from the vessel as CT shows it to where a motion has taken it at a decision."""
        ostium = np.asarray(self._given.anatomy.insertion.position)
        return motion.core(ostium).placements(np.array([period * DECISION_PERIOD_S]))[0][0]

    @cached_property
    def _projector(self) -> TipProjector:
        return TipProjector(self.navigation.anatomy.tree, self.navigation.anatomy.insertion)

    @property
    def weight(self) -> Float[np.ndarray, "members"]:
        """Likelihoods of the members; a member whose simulation failed has none."""
        score = np.where(self.simulator.valid, self._score, -1e6)
        return likelihoods(score)

    @property
    def mean_ostium_mm(self) -> float:
        """How much deeper the devices are believed to lie than the encoders say, mm."""
        return float(self.weight @ self.ostium_mm)

    @property
    def best(self) -> int:
        """The likeliest member."""
        return int(np.argmax(self.weight))

    @property
    def wires(self) -> Float[np.ndarray, "members nodes 3"]:
        """The members' wires, the likeliest first: nodes from the foremost tip on, LPS mm."""
        return self.simulator.position[np.argsort(-self.weight, kind="stable")]

    def follow(self, devices: Proximals, load: Proximals = ()) -> None:
        """Move every member's proximal ends to where they are by the encoders, in one decision period.

        Args:
            devices: inserted length (mm) and rotation (rad) of the wire, then of each catheter, as encoders read them.
            load: force (N) and torque (N·mm) of each drive; empty for a robot that measures none.
        """
        self.drives.follow(devices)
        if load and self.drives.lose:
            self.drives.feel(0, load[0][0], pushed_n=self.pushed_n, valve=self.valve)
        self._move(self.drives.proximal)

    @property
    def pushed_n(self) -> float:
        """Force that the likeliest wire ahead of the introducer's valve takes of its drive, N."""
        return float(self.simulator.base_load[self.best, 0, 0])

    @property
    def pushed_sd_n(self) -> float:
        """How surely that is known, a standard deviation, N: wires err, and differ."""
        pushed, weight = self.simulator.base_load[:, 0, 0], self.weight
        return float(np.hypot(force_sd_n(self.pushed_n), np.sqrt(weight @ (pushed - weight @ pushed) ** 2)))

    @property
    def valve(self) -> tuple[float, float]:
        """Friction of the introducer's valve, N, and its drag, N·s/mm."""
        return self.simulator.config.introducer_friction_n, self.simulator.config.introducer_drag_n_s_mm

    def _move(self, proximal: Float[np.ndarray, "devices 2"]) -> None:
        """Move every member's proximal ends to where they are believed to be, in one decision period."""
        simulator = self.simulator
        now, control = simulator.at_drive, np.empty((simulator.worlds, simulator.devices, 2))
        for k, (length, turn) in enumerate(proximal.tolist()):
            ahead = self._deeper(np.full(len(now), length)) - now[:, k, 0]
            motion = np.column_stack([ahead, turn - now[:, k, 1]])
            control[:, k] = self._limits[k].clip(motion / DECISION_PERIOD_S, now[:, k, 0], DECISION_PERIOD_S)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # a member that fails has no weight
            step = simulator.step(control, DECISION_PERIOD_S)
        self.force = step.contact_force_max
        if self.budget is not None:
            self.budget.simulated(simulator, step)
        self.tip = simulator.project()[:, 0]

    def errors(
        self, position: Float[np.ndarray, "3"], simulator: Simulator | None = None
    ) -> tuple[Errors, Float[np.ndarray, "members 2 3"]]:
        """Return the distances of tips from a place, along and across each wire, mm, and these axes.

        Args:
            position: the place, LPS mm.
        """
        simulator = simulator or self.simulator
        if self._coaxial:  # the first nodes are the foremost tube's
            end, along = simulator.tip_position[:, 0], simulator.tip_direction[:, 0]
        else:
            nodes = simulator.position[:, :2]
            end, along = nodes[:, 0], nodes[:, 0] - nodes[:, 1]
            along /= np.linalg.norm(along, axis=1, keepdims=True)
        return _split(position - end, along)

    def weigh(self, measured: TipMeasurement) -> None:
        """Update the likelihoods by a measurement, and before them where the proximal end of the wire is believed.

        The density is a Cauchy density. Its tails are heavy: a tip that snapped a moment too early says little about
        friction. Its scales are no smaller than the measurement's own standard deviations.
        """
        if self.drives.lose:
            self._weigh(measured.position - self._relocate(measured), measured, None)
        else:
            self._weigh(measured.position, measured, self.weight)
        if self.drives.lose and self.navigation.known_motion is None:  # else the next period takes them there
            self._move(self.drives.proximal)

    def _weigh(
        self, position: Float[np.ndarray, "3"], measured: TipMeasurement, weight: Float[np.ndarray, "members"] | None
    ) -> None:
        """Weigh the members; with their weights before, the measurement counts as evidence."""
        self.error, axes = self.errors(position)
        self._error_sd = _sds(axes, measured)
        scaled = self.error / np.maximum(self._accuracy_mm, self._error_sd)
        density = 1 / (1 + (scaled**2).sum(axis=1))
        if weight is not None:
            self.evidence += float(np.log(np.nan_to_num(weight * density).sum() + 1e-9))
        self._score = self._score + np.log(density)

    def replay(self, past: Past, begun: int = 0) -> None:
        """Drive the members as the devices went so far, from the start or a later period, and weigh them alike."""
        for period, proximal in enumerate(past.proximal[begun:], begun):
            if period:
                self._move(proximal)
            self.pushed.append(self.simulator.base_load[:, 0, 0].copy())
            if period in past.exposures:
                self.shown.append((self.simulator.tip_position[:, 0].copy(), self.simulator.tip_direction[:, 0].copy()))
                self._weigh(
                    self.in_vessel(past.exposures[period], period).position, past.exposures[period], self.weight
                )

    def rerun(self, past: Past, begun: int = 0) -> list[Float[np.ndarray, "devices 2"]]:
        """Follow a navigation so far from its start, or a later period, with drives of its own.

        Returns:
            Where the proximal ends of the devices were believed at each decision, mm and rad.
        """
        proximal = []
        for period, (encoders, load, commanded) in enumerate(past.measured[begun:], begun):
            self.drives.sent(commanded)
            if period:
                self.follow(encoders, load)
            else:
                self.drives.begin(encoders)
            proximal.append(self.drives.proximal.copy())
            if period in past.exposures:
                self.weigh(self.in_vessel(past.exposures[period], period))
        return proximal

    @property
    def explains(self) -> bool:
        """Whether the likeliest wire explains the last measurement, which has weighed the members."""
        best = self.best
        return bool((self.error[best] <= self._allowed(self._error_sd[best])).all())

    def _allowed(self, sd_mm: Float[np.ndarray, "*n 2"]) -> Float[np.ndarray, "*n 2"]:
        """Return the errors that a wire may have which explains a measurement, mm, given its standard deviations."""
        config = self.config
        across_mm = max(config.lost_across_mm, config.lost_across_radii * float(self.tip.radius[self.best]))
        return np.maximum([config.lost_along_mm, across_mm], _SURE_SDS * sd_mm)

    def seek(self, measured: TipMeasurement) -> bool:
        """Look for devices that explain a measurement which none of the members does; return whether there are.

        Copies of the likeliest devices are moved to and fro. All members become the nearest of them, with the ostium
        that each has, also where it is nearer but does not explain the measurement: one may be found from there.
        """
        if self.config.copies == 0 or len(self.kinds) > 1:
            return False

        def misfit(simulator: Simulator) -> Float[np.ndarray, "worlds"]:
            error, axes = self.errors(measured.position, simulator)
            return (error / self._allowed(_sds(axes, measured))).max(axis=1)

        before, nearest = float(misfit(self.simulator)[self.best]), self._copies.seek(self.best, self.simulator, misfit)
        if nearest >= before:
            return False
        self.simulator.copy_worlds(np.full(len(self.members), self._copies.at), of=self._copies.simulator)
        self.tip, self._score = self.simulator.project()[:, 0], np.zeros(len(self.members))
        self.error, axes = self.errors(measured.position)
        self._error_sd = _sds(axes, measured)
        return self.explains

    def _worlds_of(self, kind: int, count: int) -> Simulator:
        """Return a simulator of so many worlds of a kind, for copies of its members."""
        return Simulator(*self.kinds[kind], worlds=count, motion=self.navigation.known_motion, config=self._core)

    @cached_property
    def _copies(self) -> MovedCopies:
        return MovedCopies(self._worlds_of(0, self.config.copies), self._limits)

    def play_spread(self) -> Float[np.ndarray, "2"]:
        """Return the standard deviations of (Δtip, γtip) that the plays of the wire's drive make, mm."""
        along, turn = self.drives.sd[0].tolist()
        wire = self.navigation.device
        reach = lateral_reach(wire.tip_bend_rad, wire.tip_bend_length_mm)
        return np.array([along, reach * min(turn, 1.0)])

    def _relocate(self, measured: TipMeasurement) -> Float[np.ndarray, "3"]:
        """Update where the wire's proximal end is believed; return how far the likeliest tip moves by that, mm."""
        best, drives = self.best, self.drives
        before = drives.proximal[0].copy()
        fan = None
        if drives.sd[0, 1] > _SURE_RAD:
            kind = int(self.kind[best])
            if kind not in self._fans:
                self._fans[kind] = self._worlds_of(kind, SIDES)
            fan = self._fans[kind]
            turn_to_all_sides(fan, best, self.simulator)
        place = self.navigation.anatomy, int(self.tip.branch[best]), float(self.tip.abscissa[best])
        left = drives.samples(0) - before
        tip, along = turned(self.simulator, best, left[:, 1], fan)
        error = measured.position - tip - shifted(*place, left[:, 0])
        errors, axes = _split(error, along)
        sd = _sds(axes, measured)
        likely = 1 / (1 + ((errors / np.maximum(self._accuracy_mm, sd)) ** 2).sum(axis=1))
        self.evidence += float(np.log(likely.mean()))
        scaled = errors / np.maximum(_PLACED_MM, sd)
        drives.weigh(0, -np.log1p(scaled**2).sum(axis=1))
        moved = (drives.proximal[0] - before)[:, None]
        end = turned(self.simulator, best, moved[1], fan)[0]
        return (end - self.simulator.tip_position[best, 0] + shifted(*place, moved[0]))[0]

    def likeliest(self) -> tuple[Int[np.ndarray, "kinds"], Float[np.ndarray, "kinds"]]:
        """Return the likeliest member of every kind, and how likely each kind is."""
        weight = self.weight
        groups = [np.flatnonzero(self.kind == kind) for kind in range(len(self.kinds))]
        best = np.array([members[np.argmax(weight[members])] for members in groups])
        share = np.array([weight[members].sum() for members in groups])
        return best, share / share.sum()

    def tip_spread(self) -> Float[np.ndarray, "2"]:
        """Return the members' weighted standard deviations of (Δtip, γtip), mm."""
        tip, weight = np.stack([self.tip.abscissa, self.tip.offset], axis=-1), self.weight
        return np.sqrt(weight @ (tip - weight @ tip) ** 2)

    def likeliest_tip(self) -> TipProjection:
        """Return where the tip of the likeliest member is, as arrays of one."""
        return self.tip[[self.best]]
