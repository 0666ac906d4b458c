"""Recorded navigations that a model follows under X-ray: what it misses, calibrated (`calibrate`) and measured."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from jaxtyping import Bool, Float

from endopilot.anatomy.io import read_anatomy
from endopilot.anatomy.projection import safety_ratio
from endopilot.belief.bands import (
    AdviserConfig,
    Calibration,
    conformal_scale,
    fit_spread,
    narrowest,
    spread_of,
    surely_missed,
)
from endopilot.belief.events import Counted, astray_mm, count_events
from endopilot.belief.monitor import BelievedTip, Monitor
from endopilot.belief.network_monitor import NetworkMonitor
from endopilot.dataset.loader import Dataset
from endopilot.errors import InputError
from endopilot.models.config import WINDOW
from endopilot.progress import progress
from endopilot.settings import NonNegative, Seed, settings
from endopilot.simulation.motion import place, published_mean
from endopilot.tasks.navigation import Navigation, Target, XrayKind, is_safe
from endopilot.types import SAMPLE_PERIOD_S
from endopilot.xray.fluoroscope import FluoroscopeConfig, TipMeasurement, make_c_arm, seen_in_episodes, turned
from endopilot.xray.image_fluoroscope import NotRegistered

FLUOROSCOPY_HZ = 7.5
"""Frame rate of the fluoroscopy that advice is compared with."""
ONSETS = (0.05, 0.1, 0.2, 0.3, 0.5)
"""How likely an unseen event may be: what is tried when an adviser is calibrated."""


@settings
class AdviseConfig:
    """What the adviser must not miss, and how far the model is from the truth."""

    adviser: AdviserConfig = field(default_factory=AdviserConfig)
    """What X-ray must not miss."""
    fluoroscope: FluoroscopeConfig = field(default_factory=FluoroscopeConfig)
    """The C-arm."""
    xray: XrayKind = "assumed"
    """What an exposure is: assumed (the tip, with the C-arm's errors of detection) or images (the tip is found in X-ray
    images of patients whose pose is registered by one injection of contrast)."""
    ostium_mm: NonNegative = 0.3
    """Each patient's ostium lies up to this much deeper or less deep than in the model, mm."""
    seed: Seed = 0
    """Seed of the detection errors, of the ostia, and of the patients' poses."""


Follower = Monitor | NetworkMonitor
"""What follows a wire that somebody drives."""
Follows = Callable[[Navigation, Calibration | None, AdviserConfig], Follower]
"""Makes what follows the wire of a navigation; without a calibration it only predicts."""
Rows = Float[np.ndarray, "samples 2"]


@dataclass(frozen=True, eq=False)
class Followed:
    """A navigation as it was followed: a row for the last given sample, and for each after it.

    Attributes:
        patient: their name.
        length_mm: Δ by the encoder.
        true: (Δtip, γtip), mm.
        predicted: the same, as predicted.
        spread: the model's estimate of its own error, mm.
        half_width: of the bands, mm; NaN without a calibration.
        exposed: whether X-ray was on.
        events: what X-ray must not miss, by name: that the tip comes to the wall, is astray, or is pressed too hard.
    """

    patient: str
    length_mm: Float[np.ndarray, "samples"]
    true: Rows
    predicted: Rows
    spread: Rows
    half_width: Rows
    exposed: Bool[np.ndarray, "samples"]
    events: dict[str, Counted]

    @property
    def error(self) -> Rows:
        """Size of the errors after the given samples, mm."""
        return np.abs(self.predicted - self.true)[1:]

    @property
    def grown(self) -> tuple[Float[np.ndarray, "later"], Float[np.ndarray, "later"], Rows]:
        """What a band without X-ray grows by after the given samples: time, s, travel, mm, and the model's spread."""
        travel = np.abs(np.diff(self.length_mm)).cumsum()
        return SAMPLE_PERIOD_S * np.arange(1.0, len(travel) + 1), travel, self.spread[1:]


class Patient:
    """A patient's recorded navigations, and the C-arm that shows them.

    Attributes:
        name: the patient's.
        navigations: as a model is given them.
    """

    def __init__(self, data: Dataset, config: AdviseConfig) -> None:
        """Take the navigations of one patient.

        Raises:
            NotRegistered: the patient cannot be registered in X-ray images.
            InputError: the anatomy is missing or damaged.
        """
        self.name, self._config, self._sequence = str(data.anatomy[0]), config, data.sequence.tolist()
        anatomy, world, motion = read_anatomy(data.anatomy_folder(self.name)), data.world, data.motion(self.name)
        given = Navigation(
            anatomy=anatomy,
            device=data.stack.wire,
            target=Target(branch=0, abscissa=float(anatomy.tree.branches[0].centerline.abscissa[0])),
            known_motion=None if motion is None else published_mean(motion),
            xray=config.xray,
        )
        seed = int(self._random(5).integers(2**31))
        self._arm: Any = make_c_arm(given, config=config.fluoroscope, seed=seed)
        if config.xray == "images" and motion is not None:
            self._arm.known_motion = self._arm.measure_motion(motion, self._random(6))
        self._world, known, ostium = world, self._arm.known_motion, np.asarray(anatomy.insertion.position)
        self._moves = seen_in_episodes(motion, known, ostium, data.valid.shape[1], SAMPLE_PERIOD_S)
        self._tree, self._true = anatomy.tree, data
        self._shape = data.driven(anatomy=anatomy, record_shape=True).shape if config.xray == "images" else None
        deeper_mm = world.ostium_mm + config.ostium_mm * float(self._random(4).uniform(-1.0, 1.0))
        self._encoders = np.stack([data.inserted_length, data.rotation], axis=-1)[:, :, 0] - [deeper_mm, 0.0]
        self.navigations = [
            replace(
                given,
                start_inserted_length_mm=max(length - deeper_mm, 0.0),
                start_rotation_rad=turn,
                known_motion=known,
            )
            for length, turn in data.initial[:, 0].tolist()
        ]

    def _random(self, *purpose: int) -> np.random.Generator:
        return np.random.default_rng([self._config.seed, *purpose, *self.name.encode()])

    def _exposed(self, number: int, sample: int) -> TipMeasurement | None:
        """Return what an exposure at a sample of a navigation shows; None where no wire is found."""
        true, at, moves = self._true, (number, sample), self._moves
        beside_mm = np.array(self._world.registered_mm(SAMPLE_PERIOD_S * (sample + 1)))

        def seen(points: Float[np.ndarray, "*n 3"]) -> Float[np.ndarray, "*n 3"]:
            return points + beside_mm if moves is None else place(moves[sample], points + beside_mm)

        length, random = float(self._encoders[number, sample, 0]), self._random(3, self._sequence[number], sample)
        if self._shape is not None:
            return self._arm.measure(seen(self._shape[at]), length, random)
        tip, heading = (each[at][0].astype(float) for each in (true.tip_position, true.tip_direction))
        heading = heading if moves is None else turned(moves[sample], heading)
        return self._arm.measure(seen(tip), heading, length, random)

    def follow(self, number: int, follower: Follower, *, asked: bool) -> Followed:
        """Follow a navigation: X-ray is on at the first `WINDOW` samples, and then as it is asked for, if `asked`."""
        true, navigation, advice = self._true, self.navigations[number], self._config.adviser
        if self._config.xray == "images":
            self._arm.forget_wires()
        follower.step(((navigation.start_inserted_length_mm, navigation.start_rotation_rad),))
        believed, spread, exposures, on = list[BelievedTip](), list[np.ndarray](), list[tuple[bool, bool]](), True
        for sample, (length, turn) in enumerate(self._encoders[number].tolist()):
            seen = self._exposed(number, sample) if on else None
            believed.append(follower.step(((length, turn),), (), seen))
            spread.append(follower.predicted.spread)
            exposures.append((on, seen is not None))
            on = sample + 1 < WINDOW or (asked and bool(believed[-1].asks)) or (on and seen is None)
        exposed, shown = np.array(exposures).T
        branch, predicted = zip(*((each.branch, (each.abscissa, each.offset)) for each in believed), strict=True)
        where, of_wire = np.array(predicted), (number, slice(None), 0)
        abscissa, offset, radius = (
            each[of_wire].astype(float) for each in (true.tip_abscissa, true.tip_offset, true.lumen_radius)
        )
        off = astray_mm(self._tree, (np.array(branch), where[:, 0]), (true.branch[of_wire], abscissa))
        states = {
            "wall": safety_ratio(offset, radius, navigation.device.tip_radius_mm) >= advice.wall_ratio,
            "astray": off >= advice.abscissa_mm,
            "force": ~is_safe(true.contact_force_max[number], navigation.force_limit_n),
        }
        rows = slice(WINDOW - 1, None)
        return Followed(
            patient=self.name,
            length_mm=self._encoders[number, rows, 0],
            true=np.stack([abscissa, offset], axis=-1)[rows],
            predicted=where[rows],
            spread=np.array(spread)[rows],
            half_width=np.array([each.half_width for each in believed])[rows],
            exposed=exposed[rows],
            events={name: count_events(state[rows], shown[rows]) for name, state in states.items()},
        )


def follow_all(
    data: Dataset, follows: Follows, config: AdviseConfig, calibration: Calibration | None = None
) -> tuple[list[Followed], list[str]]:
    """Follow all navigations of a split: without X-ray after the first `WINDOW` samples, or as a calibrated adviser
    asks for it.

    Returns:
        The navigations, and the names of the patients who cannot be registered in X-ray images.

    Raises:
        InputError: no patient can be registered.
    """
    names, found, bad = np.unique(data.anatomy).tolist(), list[Followed](), dict[str, NotRegistered]()
    with progress("Following", len(names)) as advance:
        for name in names:
            try:
                patient = Patient(data[data.anatomy == name], config)
            except NotRegistered as error:
                bad[name] = error
            else:
                for number, navigation in enumerate(patient.navigations):
                    follower = follows(navigation, calibration, config.adviser)
                    found.append(patient.follow(number, follower, asked=calibration is not None))
            advance(remark=name)
    if not found:
        first = next(iter(bad.values()))
        raise InputError(f"{data.folder}: no patient of its split '{data.split[0]}' can be registered; first: {first}")
    return found, list(bad)


def calibrate(fitted: Sequence[Followed], own: Sequence[Followed], level: float, dataset: str) -> Calibration:
    """Return the calibration of a model, by navigations that were followed without X-ray.

    Args:
        fitted: those that the terms of the spread are fitted to; they need be of no calibration patients.
        own: those by which it is scaled.
        level: share of the intervals that the bands shall hold throughout.
        dataset: key of their dataset.

    Raises:
        InputError: there are too few calibration patients for that level.
    """
    seconds, travel, spread = (np.concatenate(column) for column in zip(*(each.grown for each in fitted), strict=True))
    terms = fit_spread(np.concatenate([each.error for each in fitted]), seconds, travel, spread)

    def worst(some: Sequence[Followed]) -> Float[np.ndarray, "navigations 2"]:
        return np.array([(each.error / spread_of(terms, *each.grown)).max(axis=0) for each in some])

    terms = narrowest(terms, worst(fitted), level)
    owner = np.array([each.patient for each in own])
    return Calibration(
        level=level,
        scale=conformal_scale(worst(own).max(axis=1), owner, level),
        abscissa_terms=terms[0],
        offset_terms=terms[1],
        anatomies=len(np.unique(owner)),
        intervals=len(own),
        dataset=dataset,
        onset=ONSETS[0],
        longest_s=SAMPLE_PERIOD_S * len(own[0].error),
    )


def greatest_onset(
    measured: Callable[[Calibration], Sequence[Followed]], bands: Calibration, missed: float
) -> tuple[float, list[dict[str, float]]]:
    """Return how likely an unseen event may be before X-ray is due, for a share of the events to be surely missed.

    Those of `ONSETS` are tried from the least on. The last one before the first that misses too many is taken, so that
    chance among many favours none; the least, where it misses too many too.

    Args:
        measured: the calibration patients' navigations as they were followed with some bands.

    Returns:
        The probability, and what was measured with each that was tried.
    """
    greatest, curve = ONSETS[0], list[dict[str, float]]()
    for onset in ONSETS:
        found = measured(replace(bands, onset=onset))
        curve.append({"onset": onset} | measure(found))
        names = sorted({each.patient for each in found})
        counts = np.array([counted([each for each in found if each.patient == name]) for name in names])
        if surely_missed(counts[:, 1], counts[:, 0]) > missed:
            break
        greatest = onset
    return greatest, curve


def counted(found: Sequence[Followed], kinds: Sequence[str] = ("wall", "astray", "force")) -> Float[np.ndarray, "3"]:
    """Return how many events of some kinds there are, how many are missed, and how many as many exposures at even times
    would miss."""
    return np.sum([each.events[kind] for each in found for kind in kinds], axis=0)


def measure(found: Sequence[Followed]) -> dict[str, float]:
    """Return what an adviser costs and misses, beside as many exposures at even times."""
    minutes = SAMPLE_PERIOD_S / 60 * sum(len(each.error) for each in found)
    rate = sum(int(each.exposed[1:].sum()) for each in found) / minutes
    events, missed, evenly = counted(found).tolist()
    share = missed / max(events, 1)
    shares = {}
    for kind in ("wall", "astray", "force"):
        happened, unseen, _ = counted(found, (kind,)).tolist()
        shares |= {f"{kind}_events_per_minute": happened / minutes, f"missed_{kind}_share": unseen / max(happened, 1)}
    return {
        "exposures_per_minute": rate,
        "missed_share": share,
        "missed_evenly_share": evenly / max(events, 1),
        "events_per_minute": events / minutes,
        **shares,
        "fewer_frames_than_fluoroscopy": 1 - rate / (60 * FLUOROSCOPY_HZ),
        "periodic_exposures_per_minute_with_the_same_missed_share": periodic_per_minute(share),
    }


def periodic_per_minute(missed_share: float) -> float:
    """Return the exposures a minute at which even times miss that share: each shows what began in two samples."""
    return 60 / SAMPLE_PERIOD_S * (1 - missed_share) / 2


def coverage(found: Sequence[Followed]) -> dict[str, Any]:
    """Return how often the bands hold: over whole intervals without X-ray, sample by sample, and in the worst patients;
    infinite ones hold nothing."""
    held, whole, owner = list[np.ndarray](), list[np.ndarray](), list[str]()
    for each in found:
        half, off = each.half_width[1:], ~each.exposed[1:]
        inside, interval = np.less_equal(each.error, half) & np.isfinite(half), np.cumsum(each.exposed[1:])
        numbers = np.unique(interval[off])
        whole += [inside[off & (interval == number)].all(axis=0) for number in numbers]
        owner += [each.patient] * len(numbers)
        held.append(inside[off])
    both, of = np.array(whole), np.array(owner)
    throughout = np.asarray(both.all(axis=1))
    patients = np.sort(np.array([throughout[of == name].mean() for name in set(owner)]))
    return {
        "simultaneous": float(throughout.mean()),
        "each_band": both.mean(axis=0).tolist(),
        "worst_decile_of_patients": float(patients[: max(1, round(len(patients) / 10))].mean()),
        "samplewise": float(np.concatenate(held).all(axis=1).mean()),
        "median_half_width_mm": np.median(np.concatenate([each.half_width[1:] for each in found]), axis=0).tolist(),
        "error_mae_mm": np.concatenate([each.error for each in found]).mean(axis=0).tolist(),
        "intervals": len(both),
        "patients": len(patients),
    }
