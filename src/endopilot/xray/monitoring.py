"""X-ray advice on patients not seen: do the bands hold, what is missed, and how many exposures does it take?"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int

from endopilot.anatomy.io import read_anatomy
from endopilot.anatomy.projection import safety_ratio
from endopilot.dataset.loader import Dataset
from endopilot.errors import InputError
from endopilot.models.config import WINDOW
from endopilot.models.open_loop import Predictor
from endopilot.progress import progress
from endopilot.simulation.device import Device
from endopilot.types import SAMPLE_PERIOD_S, VesselTree
from endopilot.xray.adviser import AdviserConfig, XrayAdviser, count_events, near_exposures
from endopilot.xray.bands import Calibration, conformal_scale, fit_spread, spread_of
from endopilot.xray.fluoroscope import Fluoroscope, FluoroscopeConfig
from endopilot.xray.online_predictors import OnlinePredictor, online_predictor

FLUOROSCOPY_HZ = 7.5
"""Frame rate of the fluoroscopy that advice is compared with."""
_GRID_MM = 0.25
Decide = Callable[[int, Float[np.ndarray, "n 2"], Float[np.ndarray, "n 2"]], Bool[np.ndarray, "n"]]
"""From sample, foretold tip and its spread (mm), for which navigations X-ray is on."""


@dataclass(frozen=True, kw_only=True)
class AdviseConfig:
    """What is advised, and how far what the model is told is from the truth."""

    adviser: AdviserConfig = field(default_factory=AdviserConfig)
    """What X-ray must not miss."""
    fluoroscope: FluoroscopeConfig = field(default_factory=FluoroscopeConfig)
    """The C-arm."""
    ostium_mm: float = 0.3
    """Each patient's ostium lies up to this much deeper or less deep than the model is told, mm."""
    seed: int = 0
    """Seed of the detection errors and of the ostia."""

    def __post_init__(self) -> None:
        """Check every field.

        Raises:
            InputError: a field is out of its range.
        """
        if not 0 <= self.ostium_mm < np.inf:
            raise InputError(f"ostium_mm: {self.ostium_mm}; give 0 or a length in mm")
        if self.seed < 0:
            raise InputError(f"seed: {self.seed} is negative; give 0 or more")


@dataclass(frozen=True, eq=False)
class Monitored:
    """The navigations of one split, as they are and as they are told.

    Attributes:
        truth: true (Δtip, γtip), mm.
        ratio: true γtip/(lumen radius − wire radius).
        told: the episodes with tips as X-ray would show them and Δ as the encoder says it.
        model: what foretells them.
        lumen: radii of the lumen, to look up.
        wire_radius_mm: radius of the wire, mm.
    """

    truth: Float[np.ndarray, "episodes samples 2"]
    ratio: Float[np.ndarray, "episodes samples"]
    told: Dataset
    model: OnlinePredictor
    lumen: Lumen
    wire_radius_mm: float

    @property
    def proximal(self) -> Float[np.ndarray, "episodes samples 2"]:
        """(Δ mm, φ rad) by the encoder."""
        return np.stack([self.told.inserted_length, self.told.rotation], axis=-1).astype(float)

    @property
    def since(self) -> tuple[Float[np.ndarray, "episodes later"], Float[np.ndarray, "episodes later"]]:
        """Time, s, and travel, mm, since the last of the given samples, at the samples after it."""
        length = self.told.inserted_length[:, WINDOW - 1 :].astype(float)
        travel = np.abs(np.diff(length, axis=1)).cumsum(axis=1)
        return SAMPLE_PERIOD_S * np.arange(1, length.shape[1]) + 0 * travel, travel


class Lumen:
    """The lumen's radius where a tip is foretold: on the way through the branch that it was last seen in."""

    def __init__(self, trees: Sequence[VesselTree], owner: Int[np.ndarray, "episodes"]) -> None:
        """Tabulate the radii.

        Args:
            trees: of the patients.
            owner: of each episode, the index of its patient.
        """
        lines = [[_onwards(tree, branch) for branch in range(len(tree.branches))] for tree in trees]
        longest = max(line[0][-1] for branches in lines for line in branches)
        grid = np.arange(0.0, longest + _GRID_MM, _GRID_MM)
        self._table = np.zeros((len(trees), max(len(branches) for branches in lines), len(grid)))
        for index, branches in enumerate(lines):
            for branch, (abscissa, radius) in enumerate(branches):
                self._table[index, branch] = np.interp(grid, abscissa, radius)
        self._owner = owner

    def radius(
        self, branch: Int[np.ndarray, "episodes"], abscissa_mm: Float[np.ndarray, "episodes"]
    ) -> Float[np.ndarray, "episodes"]:
        """Return the radius, mm, at a Δtip, mm, on the way through a branch."""
        place = np.clip(np.rint(np.nan_to_num(abscissa_mm) / _GRID_MM).astype(int), 0, self._table.shape[2] - 1)
        return self._table[self._owner, branch, place]


def _onwards(tree: VesselTree, branch: int) -> tuple[np.ndarray, np.ndarray]:
    """Return abscissa and radius of the path through a branch that follows the widest child to an end."""
    while children := tree.children(branch):
        branch = max(children, key=lambda child: float(np.median(tree.branches[child].centerline.radius)))
    line = tree.path(branch)
    return line.abscissa, line.radius


def watch(predictor: Predictor, episodes: Dataset, config: AdviseConfig) -> Monitored:
    """Return the navigations of a split, with the model that watches them.

    Args:
        predictor: the model.
        episodes: the navigations as they truly went.
        config: how they are told.
    """
    names, owner = np.unique(episodes.anatomy, return_inverse=True)
    wire_radius = Device.from_record(episodes.manifest["device"]).tip_radius_mm
    trees = []
    deeper = np.array(
        [np.random.default_rng([config.seed, 4, *str(name).encode()]).uniform(-1.0, 1.0) for name in names]
    )
    off = (config.ostium_mm * deeper)[owner]
    told = replace(
        episodes,
        initial_inserted_length=episodes.initial_inserted_length - off,
        inserted_length=episodes.inserted_length - off[:, None],
        tip_abscissa=episodes.tip_abscissa.astype(float),
        tip_offset=episodes.tip_offset.astype(float),
        branch=episodes.branch.copy(),
    )
    with progress("Exposing", len(names)) as advance:
        for index, name in enumerate(names):
            anatomy = read_anatomy(episodes.anatomy_folder(str(name)))  # one at a time: a distance map takes memory
            trees.append(anatomy.tree)
            mine = np.flatnonzero(owner == index)
            arm = Fluoroscope(anatomy, wire_radius, config.fluoroscope)
            tip = arm.expose_episodes(told.select(mine), config.seed)
            told.tip_abscissa[mine], told.tip_offset[mine], told.branch[mine] = tip.abscissa, tip.offset, tip.branch
            advance()
    return Monitored(
        truth=np.stack([episodes.tip_abscissa, episodes.tip_offset], axis=-1).astype(float),
        ratio=safety_ratio(episodes.tip_offset, episodes.lumen_radius, wire_radius).astype(float),
        told=told,
        model=online_predictor(predictor, told),
        lumen=Lumen(trees, owner),
        wire_radius_mm=wire_radius,
    )


def calibrate(fitted: Monitored, own: Monitored, level: float) -> Calibration:
    """Return the calibration of a model.

    Args:
        fitted: navigations that the terms of the spread are fitted to; they need be no calibration patients.
        own: navigations of the calibration patients.
        level: share of the intervals that the bands shall hold throughout.

    Raises:
        InputError: there are too few calibration patients for that level.
    """
    fitted.model.restart()
    seconds, travel = fitted.since
    error = (fitted.model.tip - fitted.truth)[:, WINDOW:]
    terms = fit_spread(error, seconds, travel, fitted.model.spread[:, WINDOW:])
    own.model.restart()
    score = np.abs((own.model.tip - own.truth)[:, WINDOW:] / spread_of(terms, *own.since, own.model.spread[:, WINDOW:]))
    return Calibration(
        level=level,
        scale=conformal_scale(score.max(axis=(1, 2)), own.told.anatomy, level),
        abscissa_terms=terms[0],
        offset_terms=terms[1],
        anatomies=len(np.unique(own.told.anatomy)),
        intervals=len(score),
        dataset=own.told.manifest["key"],
    )


def coverage(watched: Monitored, calibration: Calibration) -> dict[str, Any]:
    """Return how often the bands hold: over whole intervals of 45 s, sample by sample, and in the worst patients."""
    watched.model.restart()
    half = calibration.half_width(*watched.since, watched.model.spread[:, WINDOW:])
    inside: np.ndarray = np.less_equal(np.abs((watched.model.tip - watched.truth)[:, WINDOW:]), half)
    whole: np.ndarray = np.asarray(inside.all(axis=(1, 2)))
    anatomy = watched.told.anatomy
    each = np.sort([whole[anatomy == name].mean() for name in np.unique(anatomy)])
    worst = each[: max(1, round(len(each) / 10))]
    return {
        "simultaneous": float(np.mean(each)),
        "worst_decile_of_patients": float(worst.mean()),
        "samplewise": float(inside.all(axis=2).mean()),
        "median_half_width_mm": np.median(half, axis=(0, 1)).tolist(),
        "error_mae_mm": np.abs((watched.model.tip - watched.truth)[:, WINDOW:]).mean(axis=(0, 1)).tolist(),
        "intervals": len(whole),
        "patients": len(each),
    }


def run(watched: Monitored, decide: Decide, config: AdviserConfig) -> dict[str, float]:
    """Let something decide when X-ray is on, show the model what it shows, and count.

    An event begins where the true ratio reaches τ, or the error of the foretold Δtip δ, after a sample at which it had
    not. It is missed where no exposure is within 0.5 s, a sample, of its beginning.
    """
    model, truth, samples = watched.model, watched.truth, watched.truth.shape[1]
    model.restart()
    exposed = np.zeros(truth.shape[:2], dtype=bool)
    shown = np.stack([watched.told.tip_abscissa, watched.told.tip_offset], axis=-1)
    for sample in range(WINDOW, samples):
        on = np.flatnonzero(decide(sample, model.tip[:, sample], model.spread[:, sample]))
        exposed[on, sample] = True
        if len(on):
            model.show(on, sample, shown[on, sample])
    near = near_exposures(exposed)
    near[:, WINDOW] = True  # X-ray was on until the sample before
    wall = watched.ratio >= config.wall_ratio
    off = np.abs(model.tip[..., 0] - truth[..., 0]) >= config.abscissa_mm
    off[:, WINDOW - 1] = False
    counts = [count_events(state[:, WINDOW - 1 :], near[:, WINDOW - 1 :]) for state in (wall, off)]
    (at_wall, unseen_at_wall), (astray, unseen_astray) = counts
    minutes = exposed[:, WINDOW:].size * SAMPLE_PERIOD_S / 60
    events = at_wall + astray
    rate = float(exposed.sum() / minutes)
    return {
        "exposures_per_minute": rate,
        "missed_share": (unseen_at_wall + unseen_astray) / max(events, 1),
        "events_per_minute": events / minutes,
        "wall_events_per_minute": at_wall / minutes,
        "missed_wall_share": unseen_at_wall / max(at_wall, 1),
        "missed_abscissa_share": unseen_astray / max(astray, 1),
        "fewer_frames_than_fluoroscopy": 1 - rate / (60 * FLUOROSCOPY_HZ),
        "wall_samples_without_exposure_share": float((wall & ~near)[:, WINDOW:].sum() / max(wall[:, WINDOW:].sum(), 1)),
    }


def advised(watched: Monitored, calibration: Calibration, config: AdviserConfig) -> Decide:
    """Return the adviser as something that decides."""
    adviser = XrayAdviser(calibration, config, watched.wire_radius_mm)
    proximal, last = watched.proximal, WINDOW - 1
    branch = watched.told.branch[:, last].astype(int)
    tip = watched.model.tip[:, last]
    adviser.start(proximal[:, last], tip, watched.lumen.radius(branch, tip[:, 0]))

    def decide(sample: int, tip: np.ndarray, spread: np.ndarray) -> np.ndarray:
        radius = watched.lumen.radius(branch, tip[:, 0])
        due = adviser.advise(proximal[:, sample], tip, spread, radius)
        branch[due] = watched.told.branch[due, sample]
        return due

    return decide


def periodic(watched: Monitored, period: int) -> Decide:
    """Return periodic imaging, each navigation with a phase of its own."""
    phase = np.arange(len(watched.truth))
    return lambda sample, tip, spread: (sample + phase) % period == 0


def oracle(watched: Monitored, config: AdviserConfig) -> Decide:
    """Return what knows the truth, and exposes where an event begins."""
    wall = watched.ratio >= config.wall_ratio
    was_off = np.zeros(len(watched.truth), dtype=bool)

    def decide(sample: int, tip: np.ndarray, spread: np.ndarray) -> np.ndarray:
        off = np.abs(tip[:, 0] - watched.truth[:, sample, 0]) >= config.abscissa_mm
        due = (wall[:, sample] & ~wall[:, sample - 1]) | (off & ~was_off)
        was_off[:] = off
        return due

    return decide


def periodic_equal(curve: Sequence[dict[str, float]], missed_share: float) -> float:
    """Return the exposures a minute at which periodic imaging misses no more than a share, between its points."""
    points = sorted((point["exposures_per_minute"], point["missed_share"]) for point in curve)
    rate, missed = (np.array(column) for column in zip(*points, strict=True))
    missed = np.minimum.accumulate(missed)  # np.interp needs it monotone
    return float(np.interp(-missed_share, -missed, rate)) if missed_share < missed[0] else float(rate[0])
