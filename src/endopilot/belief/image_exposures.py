"""What X-ray images show of a dataset's navigations: each patient registered, each exposure an image of every view.

The wire's shape comes from simulating each navigation again. Images take their time, so they are kept in the dataset's
folder; another model that is advised by the same C-arm finds them there.
"""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import asdict, astuple, dataclass, fields
from functools import partial
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float, Int

from endopilot.anatomy.io import read_anatomy
from endopilot.dataset.loader import Dataset, read_dataset
from endopilot.errors import InputError
from endopilot.files import json_text, writing
from endopilot.models.config import WINDOW
from endopilot.parallel import each
from endopilot.simulation.motion import Motion, place
from endopilot.types import Anatomy
from endopilot.xray.fluoroscope import FluoroscopeConfig, TipMeasurement
from endopilot.xray.image_fluoroscope import ImageFluoroscope, NotRegistered
from endopilot.xray.moving_patient import seen_in_episodes

EXPOSURES_FOLDER = "exposures"
"""Folder of a dataset in which what images show of its navigations is kept."""
_FORMAT_VERSION = 5


@dataclass(frozen=True, eq=False)
class Exposures:
    """What an exposure at each sample of some navigations would show.

    Where no wire is found, or no image was made, slack and offset are those of the last one before; a wire that was
    never found lies straight.

    Attributes:
        tip: (Δtip, γtip), mm.
        branch: of that tip.
        sd_mm: standard deviations of (Δtip, γtip) as the detector states them, mm; 0 where it states none.
        motion: the patient's motion as a run of contrast shows it, the numbers of `Motion` in their order; empty for a
            patient who lies still.
    """

    tip: Float[np.ndarray, "episodes samples 2"]
    branch: Int[np.ndarray, "episodes samples"]
    sd_mm: Float[np.ndarray, "episodes samples 2"]
    found: Bool[np.ndarray, "episodes samples"]
    motion: Float[np.ndarray, "numbers"]

    @property
    def known_motion(self) -> Motion | None:
        """What the images are taken to know of the patient's motion; None for a patient who lies still."""
        names = (field.name for field in fields(Motion))
        return Motion(**dict(zip(names, self.motion.tolist(), strict=True))) if len(self.motion) else None


@dataclass(frozen=True)
class ImageSettings:
    """What the images of a dataset's navigations follow from, beside the dataset.

    Attributes:
        ostium_mm: each patient's ostium lies up to this much deeper or less deep than in the model, mm.
        seed: of poses, noise and ostia.
        samples: images are made of so many samples of each navigation, from the first on.
    """

    fluoroscope: FluoroscopeConfig
    ostium_mm: float
    seed: int
    samples: int


def deeper_ostium_mm(name: str, largest_mm: float, seed: int) -> float:
    """Return how much deeper a patient's ostium lies than in the model, mm, drawn with the seed."""
    return largest_mm * float(np.random.default_rng([seed, 4, *name.encode()]).uniform(-1.0, 1.0))


def image_exposures(dataset: Dataset, settings: ImageSettings) -> tuple[dict[str, Exposures], tuple[str, ...]]:
    """Return what images show of navigations: those that are kept, and those that are made now and kept.

    Returns:
        What is shown, by the patient's name; and the names of the patients who cannot be registered.

    Raises:
        InputError: an anatomy is missing or damaged, or no patient can be registered.
    """
    split = str(dataset.split[0])
    key = json_text((_FORMAT_VERSION, dataset.manifest["key"], split, asdict(settings)))
    folder = dataset.folder / EXPOSURES_FOLDER / hashlib.sha256(key.encode()).hexdigest()[:12]
    paths = {name: folder / f"{name}.npz" for name in sorted(set(dataset.anatomy.tolist()))}
    work = partial(_expose_patient, dataset=dataset.folder, split=split, settings=settings)
    bad = each("Making images", [path for path in paths.values() if not path.exists()], work)
    for path, error in bad.items():
        if not isinstance(error, NotRegistered):
            raise InputError(f"{path.stem}: {error}")
    if len(bad) == len(paths):
        first = next(iter(bad.values()))
        raise InputError(f"{dataset.folder}: no patient of its split '{split}' can be registered; the first: {first}")
    found = {}
    for name, path in paths.items():
        if path not in bad:
            with np.load(path, allow_pickle=False) as stored:
                found[name] = Exposures(**{field.name: stored[field.name] for field in fields(Exposures)})
    return found, tuple(path.stem for path in bad)


def _expose_patient(path: Path, *, dataset: Path, split: str, settings: ImageSettings) -> None:
    """Write what images show of one patient's navigations to a file that bears the patient's name.

    Raises:
        NotRegistered: the patient cannot be registered.
        InputError: the anatomy is missing or damaged.
    """
    data, name = read_dataset(dataset).of_split(split), path.stem
    data = data[data.anatomy == name]
    made = expose_navigations(data, read_anatomy(data.anatomy_folder(name)), settings)
    with writing(path) as partial_path, partial_path.open("wb") as stream:
        np.savez_compressed(stream, **{field.name: getattr(made, field.name) for field in fields(Exposures)})  # pyright: ignore[reportArgumentType]


def expose_navigations(data: Dataset, anatomy: Anatomy, settings: ImageSettings) -> Exposures:
    """Register a patient and how they move, and return what images show of their navigations.

    The C-arm takes the motion that it has measured off where it sees the wire. Each navigation refines the patient's
    pose anew by the wires of its first `WINDOW` samples. Later exposures take the pose from these, so that what one
    shows does not depend on which others were taken.

    Args:
        data: the patient's navigations.

    Raises:
        NotRegistered: the patient cannot be registered.
    """
    seed, name = settings.seed, anatomy.name
    pose_seed = int(np.random.default_rng([seed, 5, *name.encode()]).integers(2**31))
    world = data.world
    arm = ImageFluoroscope(anatomy, data.stack.wire, config=settings.fluoroscope, seed=pose_seed)
    shape = data.valid.shape
    ostium, samples = np.asarray(anatomy.insertion.position), min(shape[1], settings.samples)
    known, motion = None, data.motion(name)
    if motion is not None:
        known = arm.measure_motion(motion, np.random.default_rng([seed, 6, *name.encode()]))
        arm.known_motion = known
    shown = seen_in_episodes(motion, known, ostium, shape[1], data.sample_period_s)
    encoder = data.inserted_length[:, :, 0].astype(float) - deeper_ostium_mm(name, settings.ostium_mm, seed)
    encoder = encoder - world.ostium_mm
    measured: list[list[TipMeasurement | None]] = [[] for _ in data.sequence]
    again = data.driven(anatomy=anatomy, record_shape=True)
    assert again.shape is not None
    for index, nodes in enumerate(again.shape):
        arm.forget_wires()
        sequence = int(data.sequence[index])
        for sample in range(samples):
            there = nodes[sample] + world.registration_mm if any(world.registration_mm) else nodes[sample]
            there = there if shown is None else place(shown[sample], there)
            random = np.random.default_rng([seed, 3, sequence, sample, *name.encode()])
            depth, given = float(encoder[index, sample]), sample < WINDOW
            measured[index].append(arm.measure(there, depth, random, refine=given))
    return _held(measured, encoder, known)


def _held(
    measured: Sequence[Sequence[TipMeasurement | None]], encoder: Float[np.ndarray, "episodes s"], known: Motion | None
) -> Exposures:
    """Return measurements of the first samples of each navigation as arrays, with what is held where there is none.

    Args:
        encoder: Δ, mm.
        known: the patient's motion as it was measured.
    """
    tip = np.stack([encoder, np.zeros_like(encoder)], axis=-1)
    branch, found, sd_mm = np.zeros(encoder.shape, dtype=np.int64), np.zeros(encoder.shape, dtype=bool), 0 * tip
    for index, navigation in enumerate(measured):
        for sample, one in enumerate(navigation):
            if one is not None:
                later = slice(sample, None)
                tip[index, later, 0] = encoder[index, later] - (encoder[index, sample] - one.abscissa)
                tip[index, later, 1], branch[index, later] = one.offset, one.branch
                sd_mm[index, sample], found[index, sample] = one.tip_sd_mm, True
    return Exposures(tip, branch, sd_mm, found, np.array(astuple(known) if known else (), dtype=float))
