"""The belief about the wire between X-ray exposures: an ensemble of simulated wires, driven like the real one.

Each follows the robot's encoders, in a vessel that moves as it is known to. Catheters around the real wire are around
each simulated one too, and driven like the real ones. A measurement of the tip weights the members by their errors.
"""

from __future__ import annotations

import warnings
from typing import Annotated

import numpy as np
from jaxtyping import Float, Int
from scipy.stats import qmc

from endopilot.devices.drive_limits import DriveLimits
from endopilot.devices.stack import Proximals
from endopilot.models.ensemble import Ensemble, likelihoods
from endopilot.settings import NonNegative, Positive, ShareBelowOne, Within, settings
from endopilot.simulation.config import PRESETS, SimulatorConfig
from endopilot.tasks.navigation import DECISION_PERIOD_S, Navigation
from endopilot.types import TipProjection
from endopilot.xray.fluoroscope import TipMeasurement


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

    def follow(self, devices: Proximals) -> None:
        """Move every member's proximal ends to where the encoders say that they are, in one decision period.

        Args:
            devices: inserted length (mm) and rotation (rad) of the wire, then of each catheter.
        """
        simulator = self.simulator
        now, control = simulator.proximal, np.empty((simulator.worlds, simulator.devices, 2))
        for k, (length, turn) in enumerate(devices):
            ahead = self._deeper(np.full(len(now), length)) - now[:, k, 0]
            motion = np.column_stack([ahead, turn - now[:, k, 1]])
            control[:, k] = self._limits[k].clip(motion / DECISION_PERIOD_S, now[:, k, 0], DECISION_PERIOD_S)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # a member that fails has no weight
            simulator.step(control, DECISION_PERIOD_S)
        self.tip = simulator.project()[:, 0]

    def errors(self, measured: TipMeasurement) -> Float[np.ndarray, "members 2"]:
        """Return the distances of the members' tips from a measured one, along and across each wire, mm."""
        if self._coaxial:  # the first nodes are the foremost tube's
            end, along = self.simulator.tip_position[:, 0], self.simulator.tip_direction[:, 0]
        else:
            nodes = self.simulator.position[:, :2]
            end, along = nodes[:, 0], nodes[:, 0] - nodes[:, 1]
            along /= np.linalg.norm(along, axis=1, keepdims=True)
        error = measured.position - end
        shift = np.einsum("mi,mi->m", error, along)
        return np.column_stack([np.abs(shift), np.linalg.norm(error - shift[:, None] * along, axis=1)])

    def weigh(self, measured: TipMeasurement) -> None:
        """Update the likelihoods by a measurement.

        The density is a Cauchy density. Its tails are heavy: a tip that snapped a moment too early says little about
        friction. Its scales are no smaller than the measurement's own standard deviations.
        """
        scaled = self.errors(measured) / np.maximum(self._accuracy_mm, measured.sd_mm)
        self._score = self._score - np.log1p((scaled**2).sum(axis=1))

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
