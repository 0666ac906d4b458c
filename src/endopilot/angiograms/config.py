"""Settings of a data set of angiograms, `AngiogramsConfig`, and what stands where in it: `Layout`, from `lay_out`."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Annotated, Any

from endopilot import __version__
from endopilot.dataset.layout import assign_splits, check_names, identify, settled
from endopilot.devices.stack import Stack
from endopilot.errors import InputError
from endopilot.files import input_hash, sha256
from endopilot.imaging.segment import SegmentConfig
from endopilot.settings import Ascending, Finite, Positive, Seed, Share, Text, Within, settings
from endopilot.simulation.motion import MotionName
from endopilot.xray.image import ImageConfig

RANDOM = "random"
"""Drives the devices at random."""

CINE_IMAGE = ImageConfig(
    scatter=1.0,
    scintillator_mm=0.36,
    focal_spot_mm=0.8,
    iodine_mm=0.265,
    edge_weight=0.3,
    temporal_weight=0.2,
    coil_mm=1.1,
)
"""Detector and beam of a cine. Behind a cardiac grid scatter is 1 to 1.3 of the primary light (Niklason 1981, Altunbas
2016). Scintillator and noise filter blur by 1.2 pixels, which gives the noise of real cines: neighbours' correlation
0.85, power at 0.25 over 0.09 a pixel 0.056. Edges are enhanced by 25 to 32 % there, and the focal spot is 0.8 mm.
Contrast of 350 mg iodine/ml takes the blood's place: 7.58 cm²/g at 60 keV (NIST). The coil has a contrast of 0.08 to
0.2 then."""


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
    dose: Annotated[tuple[Positive, Positive], Ascending] = (3.0, 10.0)
    """Range of the dose of a frame, as multiples of fluoroscopy's 0.03 µGy at the detector: 0.1 to 0.3 µGy is usual for
    cines. The logarithm is drawn evenly."""
    view_angles_deg: tuple[tuple[Finite, Finite], ...] = ()
    """LAO (positive) or RAO, and cranial (positive) or caudal angles that are drawn from, degrees; the views of clinics
    if not given."""
    anatomy_shares: tuple[Share, Share, Share] | None = None
    """Shares of the patients that train, calibrate and test; 0.6 0.2 0.2 if not given, and a single patient trains."""
    segmentation: SegmentConfig = field(default_factory=SegmentConfig)
    """How the vessel is segmented where a CT is given."""
    image: ImageConfig = field(default_factory=lambda: CINE_IMAGE)
    """Detector and beam."""

    @property
    def frames(self) -> int:
        """Number of frames of a cine."""
        return max(round(self.seconds * self.frames_per_second), 1)


FORMAT_VERSION = 2
"""Counts changes of the files or of their meaning."""
ANATOMY_FILE = "anatomy.json"
CT_FILE = "ct.nii.gz"
"""The CT in a patient's folder, HU."""
SAMPLES_FILE, MANIFEST_FILE = "samples.png", "manifest.json"
_SUFFIXES = (".nii.gz", ".nii", ".nrrd", ".mha", ".mhd")


@dataclass(frozen=True, eq=False)
class Layout:
    """The patients of a data set, each of whom comes from a folder of an anatomy or a CT, and trains, calibrates or
    tests, and where everything stands. A resumed run must share its `settings`, which the `key` marks."""

    output: Path
    config: AngiogramsConfig
    stack: Stack
    sources: tuple[Path, ...]
    names: tuple[str, ...]
    splits: tuple[str, ...]
    settings: dict[str, Any]
    key: str

    @property
    def patients(self) -> list[Path]:
        """The patients' folders."""
        return [self.output / "patients" / name for name in self.names]

    @property
    def cines(self) -> list[Path]:
        """The cines' folders, those of one patient after each other."""
        return [
            self.output / "cines" / f"{name}-{number:04d}" for name in self.names for number in range(self.config.cines)
        ]


def lay_out(sources: Sequence[Path], output: Path, stack: Stack, config: AngiogramsConfig) -> Layout:
    """Read who the patients are, and share them among the splits. Raises InputError for no source, or one that cannot
    be read; two of one name; too few for the splits."""
    if not sources:
        raise InputError("anatomies: none given; name folders made by `endopilot anatomy` or `endopilot atlas`, or CTs")
    found = [_identified(path) for path in sources]
    names = tuple(name for name, _ in found)
    check_names(names)
    for name in names:
        if Path(name).name != name or name.startswith("."):
            raise InputError(f"anatomies: '{name}' names no folder; give the patient another name")
    splits = assign_splits(names, 1, anatomy_shares=config.anatomy_shares, seen_test_share=0.0)[:, 0]
    settings = {
        "config": asdict(config),
        "device": asdict(stack.wire),
        "catheters": [asdict(catheter) for catheter in stack.catheters],
        "patients": dict(found),
        "version": f"endopilot {__version__}, format {FORMAT_VERSION}",
    }
    there = tuple(path.resolve() for path in sources)  # a cluster's workers may stand elsewhere
    return Layout(Path(output).resolve(), config, stack, there, names, tuple(splits.tolist()), *settled(settings))


def is_anatomy(path: Path) -> bool:
    """Return whether this is the folder of an anatomy, and not a CT."""
    return (path / ANATOMY_FILE).exists()


def _identified(path: Path) -> tuple[str, str]:
    """Return a patient's name, and the hash of the vessel and of its CT. Raises InputError for no such file or folder,
    an empty one, or one with a damaged anatomy."""
    if is_anatomy(path):
        name, identity = identify(path)
        ct = path / CT_FILE
        return name, f"{identity} {sha256(ct)}" if ct.exists() else identity
    if not path.exists() or (path.is_dir() and not any(path.iterdir())):
        raise InputError(f"{path}: is no anatomy and no CT; give a folder made by `endopilot atlas`, or a CT angiogram")
    name = next((path.name.removesuffix(end) for end in _SUFFIXES if path.name.endswith(end)), path.name)
    return name, next(iter(input_hash(path).values()))
