"""Settings of a data set of angiograms: `AngiogramsConfig`."""

from __future__ import annotations

from dataclasses import field
from typing import Annotated

from endopilot.imaging.segment import SegmentConfig
from endopilot.settings import Ascending, Finite, Positive, Seed, Share, Text, Within, settings
from endopilot.simulation.motion import MotionName
from endopilot.xray.image import ImageConfig

RANDOM = "random"
"""Drives the devices at random."""


@settings
class AngiogramsConfig:
    """How many cines of each patient, and what they show."""

    cines: Annotated[int, Within(1, 100000)] = 8
    """Cines of each patient."""
    seconds: Annotated[float, Within(0.1, 60)] = 4.0
    """Length of a cine, s."""
    frames_per_second: Annotated[int, Within(1, 60)] = 15
    """Frames a second."""
    seed: Seed = 0
    """Seed of all that is drawn. A cine depends on it, the patient's name and the cine's number alone."""
    drive: Text = RANDOM
    """What drives the devices: random, or a policy that goes to a drawn place, such as agent or MODULE:OBJECT."""
    device_share: Share = 0.8
    """Share of the cines that show wire and catheters; the others show the vessel alone."""
    injected_share: Share = 0.7
    """Share of the cines in which contrast is injected."""
    injection_ml_s: Annotated[tuple[Positive, Positive], Ascending] = (3.0, 5.0)
    """Range of the rate of injection, ml/s: usual in coronary arteries."""
    injection_s: Annotated[tuple[Positive, Positive], Ascending] = (1.0, 2.5)
    """Range of the time for which contrast is injected, s."""
    blood_mm_s: Annotated[tuple[Positive, Positive], Ascending] = (80.0, 220.0)
    """Range of the blood's velocity behind the ostium, mean over the section, mm/s: such that contrast reaches the ends
    of coronary arteries as fast as published (docs/evidence/angiograms.md)."""
    motion: MotionName = "both"
    """How heart and breath move vessel, catheter and wire: still, breathing, heartbeat or both. The amplitudes of each
    patient are drawn from the published distributions."""
    dose: Annotated[tuple[Positive, Positive], Ascending] = (1.0, 6.0)
    """Range of the dose of a frame, as multiples of fluoroscopy's; the logarithm is drawn evenly."""
    view_angles_deg: tuple[tuple[Finite, Finite], ...] = ()
    """LAO (positive) or RAO, and cranial (positive) or caudal angles that are drawn from, degrees; the views of clinics
    if not given."""
    anatomy_shares: tuple[Share, Share, Share] | None = None
    """Shares of the patients that train, calibrate and test; 0.6 0.2 0.2 if not given, and a single patient trains."""
    segmentation: SegmentConfig = field(default_factory=SegmentConfig)
    """How the vessel is segmented where a CT is given."""
    image: ImageConfig = field(default_factory=ImageConfig)
    """Detector and beam."""

    @property
    def frames(self) -> int:
        """Number of frames of a cine."""
        return max(round(self.seconds * self.frames_per_second), 1)
