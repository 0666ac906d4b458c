"""The belief about the wire between X-ray exposures: an ensemble of simulated wires, driven like the real one.

Each follows the robot's encoders, in a vessel that moves as it is known to. Catheters around the real wire are around
each simulated one too, and driven like the real ones. A measurement of the tip weights the members by their errors.

Where the encoders sit in front of the drives' play, a measurement first says where the proximal end of the wire is: its
tip is compared with that of the likeliest wire, turned to all sides and moved along the vessel. All members are then
brought to where the device most likely is.
"""

from __future__ import annotations

import warnings
from typing import Annotated

import numpy as np
from jaxtyping import Float, Int
from scipy.stats import qmc

from endopilot.belief.drives import Drives
from endopilot.devices.drive_limits import DriveLimits
from endopilot.devices.stack import Proximals
from endopilot.models.ensemble import Ensemble, likelihoods
from endopilot.settings import NonNegative, Positive, ShareBelowOne, Within, settings
from endopilot.simulation.config import PRESETS, SimulatorConfig
from endopilot.simulation.simulator import Simulator
from endopilot.tasks.navigation import DECISION_PERIOD_S, Navigation
from endopilot.types import TipProjection
from endopilot.xray.fluoroscope import TipMeasurement

_SIDES = 16
"""Angles that a wire is turned to where its rotation is looked for."""
_PLACED_MM = 0.5, 0.15
"""Scales of the errors, along and across the wire, of a tip whose proximal end is where it is believed, mm."""
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
            threads=1,
        )


class Belief(Ensemble):
    """An ensemble of simulated wires that follow a navigation, and how likely each is.

    Attributes:
        tip: of each member's wire.
        drives: where the proximal ends are.
        error: of each member at the last measurement, along and across its wire, mm.
    """

    def __init__(
        self, navigation: Navigation, parameters: Float[np.ndarray, "members 3"], config: BeliefConfig
    ) -> None:
        """Bring every member's wire to the start of the navigation."""
        super().__init__(
            navigation.anatomy,
            navigation.stack,
            parameters,
            start=np.tile(navigation.start, (len(parameters), 1, 1)),
            config=config.core,
            motion=navigation.known_motion,
        )
        self._accuracy_mm = config.along_sd_mm, config.across_sd_mm
        self._limits = [DriveLimits.of(each, navigation.anatomy) for each in navigation.devices]
        fastest = np.array([limits.fastest for limits in self._limits])
        self.drives = Drives(navigation.robot, navigation.start, fastest)
        self._navigation, self._fans = navigation, dict[float, Simulator]()
        self.error = np.zeros((len(parameters), 2))
        self._score, self._coaxial = np.zeros(len(parameters)), bool(navigation.catheters)
        self.tip = self.simulator.project()[:, 0]

    @staticmethod
    def around(given: Float[np.ndarray, "3"], config: BeliefConfig) -> Float[np.ndarray, "members 3"]:
        """Return members evenly around given parameters: friction and ostium from a Sobol sequence, every stiffness."""
        levels = np.linspace(-1.0, 1.0, config.stiffness_levels) if config.stiffness_levels > 1 else np.zeros(1)
        unit = 2 * qmc.Sobol(2, scramble=False).random_base2(config.members.bit_length())[1 : config.members + 1] - 1
        parameters = np.tile(given, (config.members, 1)).astype(float)
        parameters[:, 0] *= 1 + config.friction_spread * unit[:, 0]
        parameters[:, 1] *= 1 + config.stiffness_spread * np.resize(levels, config.members)
        parameters[:, 2] += config.ostium_spread_mm * unit[:, 1]
        return parameters

    @property
    def weight(self) -> Float[np.ndarray, "members"]:
        """Likelihoods of the members; a member whose simulation failed has none."""
        score = np.where(self.simulator.valid, self._score, -1e6)
        return likelihoods(score)

    def follow(self, devices: Proximals, load: Proximals = ()) -> None:
        """Move every member's proximal ends to where they are by the encoders, in one decision period.

        Args:
            devices: inserted length (mm) and rotation (rad) of the wire, then of each catheter, as encoders read them.
            load: force (N) and torque (N·mm) of each drive; empty for a robot that measures none.
        """
        self.drives.follow(devices)
        if load and self.drives.lose:
            core, pushed_n = self.simulator.config, self.simulator.base_load[np.argmax(self.weight), 0, 0]
            valve = core.introducer_friction_n, core.introducer_drag_n_s_mm
            self.drives.feel(0, load[0][0], pushed_n=float(pushed_n), valve=valve)
        self._move()

    def _move(self) -> None:
        """Move every member's proximal ends to where they are believed to be, in one decision period."""
        simulator = self.simulator
        now, control = simulator.at_drive, np.empty((simulator.worlds, simulator.devices, 2))
        for k, (length, turn) in enumerate(self.drives.proximal.tolist()):
            ahead = self._deeper(np.full(len(now), length)) - now[:, k, 0]
            motion = np.column_stack([ahead, turn - now[:, k, 1]])
            control[:, k] = self._limits[k].clip(motion / DECISION_PERIOD_S, now[:, k, 0], DECISION_PERIOD_S)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # a member that fails has no weight
            simulator.step(control, DECISION_PERIOD_S)
        self.tip = simulator.project()[:, 0]

    def errors(self, position: Float[np.ndarray, "3"]) -> Float[np.ndarray, "members 2"]:
        """Return the distances of the members' tips from a place, along and across each wire, mm."""
        if self._coaxial:  # the first nodes are the foremost tube's
            end, along = self.simulator.tip_position[:, 0], self.simulator.tip_direction[:, 0]
        else:
            nodes = self.simulator.position[:, :2]
            end, along = nodes[:, 0], nodes[:, 0] - nodes[:, 1]
            along /= np.linalg.norm(along, axis=1, keepdims=True)
        error = position - end
        shift = np.einsum("mi,mi->m", error, along)
        return np.column_stack([np.abs(shift), np.linalg.norm(error - shift[:, None] * along, axis=1)])

    def weigh(self, measured: TipMeasurement) -> None:
        """Update the likelihoods by a measurement, and before them where the proximal end of the wire is believed.

        The density is a Cauchy density. Its tails are heavy: a tip that snapped a moment too early says little about
        friction. Its scales are no smaller than the measurement's own standard deviations.
        """
        position = measured.position - self._relocate(measured) if self.drives.lose else measured.position
        self.error = self.errors(position)
        scaled = self.error / np.maximum(self._accuracy_mm, measured.sd_mm)
        self._score = self._score - np.log1p((scaled**2).sum(axis=1))
        if self.drives.lose and self.set_up.motion is None:  # a vessel that moves takes them there in the next period
            self._move()

    def play_spread(self) -> Float[np.ndarray, "2"]:
        """Return the standard deviations of (Δtip, γtip) that the plays of the wire's drive make, mm."""
        along, turn = self.drives.sd[0].tolist()
        wire = self._navigation.device
        bend = max(abs(wire.tip_bend_rad), 1e-9)
        reach = wire.tip_bend_length_mm * (1 - np.cos(bend)) / bend
        return np.array([along, reach * min(turn, 1.0)])

    def _relocate(self, measured: TipMeasurement) -> Float[np.ndarray, "3"]:
        """Update where the wire's proximal end is believed; return how far the likeliest tip moves by that, mm."""
        best, drives = int(np.argmax(self.weight)), self.drives
        before = drives.proximal[0].copy()
        fan = self._fan(best) if drives.sd[0, 1] > _SURE_RAD else None
        left = drives.samples(0) - before
        tip, along = self._turned(best, left[:, 1], fan)
        error = measured.position - tip - self._shifted(best, left[:, 0])
        shift = np.einsum("si,si->s", error, along)
        across = np.linalg.norm(error - shift[:, None] * along, axis=1)
        scaled = np.column_stack([shift, across]) / np.maximum(_PLACED_MM, measured.sd_mm)
        drives.weigh(0, -np.log1p(scaled**2).sum(axis=1))
        moved = (drives.proximal[0] - before)[:, None]
        return (self._turned(best, moved[1], fan)[0] - self._end(self.simulator)[best] + self._shifted(best, moved[0]))[
            0
        ]

    def _turned(
        self, best: int, turn: Float[np.ndarray, "n"], fan: Simulator | None
    ) -> tuple[Float[np.ndarray, "n 3"], Float[np.ndarray, "n 3"]]:
        """Return the end of a member's wire, turned by some angles, rad, and its direction there; LPS mm."""
        if fan is None:
            end, direction = self._end(self.simulator)[best], self.simulator.tip_direction[best, 0]
            return np.tile(end, (len(turn), 1)), np.tile(direction, (len(turn), 1))
        ends, directions = self._end(fan), fan.tip_direction[:, 0]
        place = (turn % (2 * np.pi)) * _SIDES / (2 * np.pi)
        low = place.astype(int) % _SIDES
        share = (place % 1.0)[:, None]
        mixed = [(1 - share) * each[low] + share * each[(low + 1) % _SIDES] for each in (ends, directions)]
        return mixed[0], mixed[1] / np.maximum(np.linalg.norm(mixed[1], axis=1, keepdims=True), 1e-9)

    def _end(self, simulator: Simulator) -> Float[np.ndarray, "worlds 3"]:
        """Return the end that X-ray shows of each world's devices, LPS mm."""
        return simulator.tip_position[:, 0]

    def _fan(self, best: int) -> Simulator:
        """Return copies of a member, each turned by another angle, those to more than half a turn backwards."""
        factor = float(self.parameters[best, 1])
        if factor not in self._fans:
            stack = self.set_up.stacks[best]
            self._fans[factor] = Simulator(
                self.set_up.anatomies[best],
                stack,
                worlds=_SIDES,
                motion=self.set_up.motion,
                config=self.simulator.config,
                sharing=self.simulator,
            )
        fan, side = self._fans[factor], 2 * np.pi * np.arange(_SIDES) / _SIDES
        fan.copy_worlds(np.full(_SIDES, best), of=self.simulator)
        control = np.zeros((_SIDES, fan.devices, 2))
        control[:, 0, 1] = np.where(side > np.pi, side - 2 * np.pi, side) / DECISION_PERIOD_S
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # one that fails stays where it was
            fan.step(control, DECISION_PERIOD_S)
        return fan

    def _shifted(self, best: int, along_mm: Float[np.ndarray, "n"]) -> Float[np.ndarray, "n 3"]:
        """Return how far a member's tip moves, mm, that goes some way along the vessel."""
        line = self._navigation.anatomy.tree.path(int(self.tip.branch[best]))
        at = float(self.tip.abscissa[best])
        insertion = self._navigation.anatomy.insertion
        behind = np.array([-20.0, -10.0])
        abscissa = np.concatenate([behind, line.abscissa])
        points = np.concatenate([insertion.position + behind[:, None] * insertion.direction, line.points])
        there, here = (
            np.column_stack([np.interp(x, abscissa, axis) for axis in points.T])
            for x in (at + along_mm, np.array([at]))
        )
        return there - here

    def likeliest(self) -> tuple[Int[np.ndarray, "levels"], Float[np.ndarray, "levels"]]:
        """Return the likeliest member of every stiffness, and how likely each stiffness is."""
        weight = self.weight
        groups = [np.flatnonzero(self.parameters[:, 1] == factor) for factor in self.wires]
        best = np.array([members[np.argmax(weight[members])] for members in groups])
        share = np.array([weight[members].sum() for members in groups])
        return best, share / share.sum()

    def tip_spread(self) -> Float[np.ndarray, "2"]:
        """Return the members' weighted standard deviations of (Δtip, γtip), mm."""
        tip, weight = np.stack([self.tip.abscissa, self.tip.offset], axis=-1), self.weight
        return np.sqrt(weight @ (tip - weight @ tip) ** 2)

    def likeliest_tip(self) -> TipProjection:
        """Return where the tip of the likeliest member is, as arrays of one."""
        best = [int(np.argmax(self.weight))]
        return self.tip[best]
