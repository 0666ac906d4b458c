"""Settings of a dataset: `DatasetConfig`."""

from __future__ import annotations

from dataclasses import field
from typing import Annotated

from pydantic import model_validator

from endopilot.settings import Ascending, NonNegative, Seconds, Seed, Share, ShareBelowOne, Within, settings
from endopilot.simulation.config import Actuation, SimulatorConfig
from endopilot.simulation.controls import ControlConfig
from endopilot.simulation.motion import MotionName
from endopilot.types import SAMPLE_PERIOD_S


def dataset_simulator() -> SimulatorConfig:
    """Return the settings that datasets are simulated with: the default's elements and a coarser Newton, whose cost in
    accuracy stands in docs/evidence/dataset.md. Longer elements would catch in the hairpins of real vessels."""
    return SimulatorConfig(tolerance_mm=1e-2)


_Stiffness = Annotated[float, Within(0.05, 100)]


@settings
class DatasetConfig:
    """How many navigations, how long, how they are driven and how they are split."""

    sequences: Annotated[int, Within(1, 10**7)] = 1000
    """Random navigations of each anatomy."""
    seconds: Seconds = 60.0
    """Length of a navigation, s; one sample every 0.5 s."""
    seed: Seed = 0
    """Seed of the random controls and parameters."""
    control: Actuation = "velocity"
    """What is drawn: the drive's velocity, or its force and torque."""
    navigation: ControlConfig = field(default_factory=ControlConfig)
    """Distribution of the random controls."""
    simulator: SimulatorConfig = field(default_factory=dataset_simulator)
    """Settings of the rod simulation."""
    friction: Annotated[tuple[NonNegative, NonNegative], Ascending] | None = None
    """Range that each navigation's friction coefficient is drawn from uniformly; the device's own if not given."""
    tip_bend_factor: Annotated[tuple[NonNegative, NonNegative], Ascending] | None = None
    """Range of a factor on the angle of the device's bent tip, drawn uniformly for each eight navigations."""
    tip_stiffness_factor: Annotated[tuple[_Stiffness, _Stiffness], Ascending] | None = None
    """Range of a factor on the stiffness of the distal 10 mm, drawn likewise."""
    motion: MotionName = "still"
    """How heart and breath move the vessel and the guiding catheter: still, breathing, heartbeat or both. The
    amplitudes of each anatomy are drawn from the published distributions."""
    anatomy_shares: tuple[Share, Share, Share] | None = None
    """Shares of the anatomies that train, calibrate and test; 0.6 0.2 0.2 if not given, and a single anatomy is then
    split by sequence alone. 0 0 1 makes a dataset to test on."""
    seen_test_share: ShareBelowOne = 0.2
    """Share of the navigations of a train anatomy that are held out as the split seen_test."""
    sequences_per_file: Annotated[int, Within(1, 100000)] = 500
    """Navigations stored in one file; an interrupted run loses at most one file's work a processor core."""

    @model_validator(mode="after")
    def _consistent(self) -> DatasetConfig:
        samples = self.seconds / SAMPLE_PERIOD_S
        if samples != int(samples):
            raise ValueError(f"seconds: {self.seconds} is no multiple of {SAMPLE_PERIOD_S} s; give e.g. 60")
        shares = self.anatomy_shares
        if shares is not None and abs(sum(shares) - 1) >= 1e-3:
            raise ValueError(f"anatomy_shares: {shares}; give three shares that add up to 1, such as 0.6 0.2 0.2")
        return self

    @property
    def samples(self) -> int:
        """Number of samples of a navigation."""
        return round(self.seconds / SAMPLE_PERIOD_S)
