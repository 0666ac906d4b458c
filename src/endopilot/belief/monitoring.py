"""X-ray advice on new patients: do the bands hold, which events are missed, and how many exposures does it take?"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int

from endopilot.anatomy.projection import safety_ratio
from endopilot.belief.adviser import AdviserConfig, Predicted
from endopilot.belief.bands import Calibration, conformal_scale, fit_spread, narrowest, spread_of, surely_missed
from endopilot.belief.events import Counted, count_events, near_exposures
from endopilot.belief.image_exposures import Exposures, ImageSettings, deeper_ostium_mm, image_exposures
from endopilot.belief.online_predictors import OnlinePredictor, online_predictor
from endopilot.belief.watch import Watch
from endopilot.dataset.loader import Dataset
from endopilot.devices.device import Wire
from endopilot.models.config import WINDOW
from endopilot.models.episodes import Episodes, Predictor
from endopilot.progress import progress
from endopilot.settings import NonNegative, Seed, from_record, settings
from endopilot.tasks.navigation import XrayKind
from endopilot.types import SAMPLE_PERIOD_S, VesselTree
from endopilot.xray.fluoroscope import Fluoroscope, FluoroscopeConfig

FLUOROSCOPY_HZ = 7.5
"""Frame rate of the fluoroscopy that advice is compared with."""
OFFSET_SHARES = (1.0, 0.9, 0.8, 0.7, 0.6, 0.5, 0.4, 0.3, 0.2, 0.1, 0.0)
"""Shares of γtip's band that are tried when an adviser is calibrated."""
ExposurePolicy = Callable[[int, Float[np.ndarray, "n 2"], Float[np.ndarray, "n 2"]], Bool[np.ndarray, "n"]]
"""From sample, predicted tip and its spread (mm), which navigations are exposed."""


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


@dataclass(frozen=True, eq=False)
class Monitored:
    """The navigations of one split, as they are and as the model is given them.

    Attributes:
        truth: true (Δtip, γtip), mm.
        ratio: true γtip/(lumen radius − wire radius).
        episodes: Δ by the encoder, and tips as X-ray would show them.
        found: at which samples X-ray would show a tip.
        unregistered: names of the patients who could not be registered in X-ray images, and were left out.
        lumen: radii of the lumen, to look up.
    """

    truth: Float[np.ndarray, "episodes samples 2"]
    ratio: Float[np.ndarray, "episodes samples"]
    episodes: Episodes
    found: Bool[np.ndarray, "episodes samples"]
    unregistered: tuple[str, ...]
    model: OnlinePredictor
    lumen: Lumen
    wire_radius_mm: float
    dataset: str

    @property
    def proximal(self) -> Float[np.ndarray, "episodes samples 2"]:
        """(Δ mm, φ rad) by the encoder."""
        return self.episodes.proximal.astype(float)

    @property
    def since(self) -> tuple[Float[np.ndarray, "episodes later"], Float[np.ndarray, "episodes later"]]:
        """Time, s, and travel, mm, since the last of the given samples, at the samples after it."""
        length = self.proximal[:, WINDOW - 1 :, 0]
        travel = np.abs(np.diff(length, axis=1)).cumsum(axis=1)
        return SAMPLE_PERIOD_S * np.arange(1, length.shape[1]) + 0 * travel, travel


class Lumen:
    """The lumen's radius at a predicted tip: on the path through the branch that it was last observed in."""

    def __init__(self, trees: Sequence[VesselTree], owner: Int[np.ndarray, "episodes"]) -> None:
        """Take the lines.

        Args:
            owner: of each episode, the index of its patient.
        """
        self._lines = [[_onwards(tree, branch) for branch in range(len(tree.branches))] for tree in trees]
        self._owner = owner

    def radius(
        self, branch: Int[np.ndarray, "episodes"], abscissa_mm: Float[np.ndarray, "episodes"]
    ) -> Float[np.ndarray, "episodes"]:
        """Return the radius, mm, at a Δtip, mm, on the path through a branch."""
        lines = [self._lines[k][along] for k, along in zip(self._owner.tolist(), branch.tolist(), strict=True)]
        return np.array([np.interp(at, *line) for at, line in zip(np.nan_to_num(abscissa_mm), lines, strict=True)])


def _onwards(tree: VesselTree, branch: int) -> tuple[np.ndarray, np.ndarray]:
    """Return abscissa and radius of the path through a branch that follows the widest child to an end."""
    while children := tree.children(branch):
        branch = max(children, key=lambda child: float(np.median(tree.branches[child].centerline.radius)))
    line = tree.path(branch)
    return line.abscissa, line.radius


def monitor(predictor: Predictor, dataset: Dataset, config: AdviseConfig, *, samples: int | None = None) -> Monitored:
    """Return the navigations of a split with an online predictor of their tips.

    Args:
        dataset: the navigations as they truly went; encoders and exposures err as its world says.
        config: the C-arm, and the model mismatch.
        samples: exposures of so many samples are needed, from the first on; of all if not given. Images take time.

    Raises:
        InputError: no patient of the split can be registered in X-ray images.
    """
    images: dict[str, Exposures] = {}
    unregistered: tuple[str, ...] = ()
    if config.xray == "images":
        count = dataset.valid.shape[1] if samples is None else samples
        settings = ImageSettings(config.fluoroscope, config.ostium_mm, config.seed, count)
        images, unregistered = image_exposures(dataset, settings)
        dataset = dataset[~np.isin(dataset.anatomy, unregistered)]
    names, owner = np.unique(dataset.anatomy, return_inverse=True)
    wire_radius = from_record(Wire, dataset.manifest["device"]).tip_radius_mm
    world = dataset.world
    deeper = np.array([deeper_ostium_mm(str(name), config.ostium_mm, config.seed) for name in names]) + world.ostium_mm
    by_encoder = np.zeros((len(dataset), 2))
    by_encoder[:, 0] = -deeper[owner]
    true = Episodes.of_dataset(dataset)
    proximal, trees = true.proximal + by_encoder[:, None], []
    tip, branch = true.tip.astype(float), true.branch.copy()
    sd_mm, found = np.zeros(tip.shape), np.ones(branch.shape, dtype=bool)
    known_motions = dict(true.setup.known_motions)
    with progress("Exposing", len(names)) as advance:
        for index, name in enumerate(names):
            anatomy = true.setup.anatomies[str(name)]()  # one at a time: a distance map takes memory
            trees.append(anatomy.tree)
            mine = np.flatnonzero(owner == index)
            if config.xray == "images":
                seen = images[str(name)]
                tip[mine], branch[mine], sd_mm[mine], found[mine] = seen.tip, seen.branch, seen.sd_mm, seen.found
                if seen.known_motion is not None:
                    known_motions[str(name)] = seen.known_motion
            else:
                arm = Fluoroscope(
                    anatomy, wire_radius, config=config.fluoroscope, registration_mm=world.registration_mm
                )
                shown = arm.expose_episodes(dataset[mine], proximal[mine, :, 0], config.seed)
                tip[mine], branch[mine] = np.stack([shown.abscissa, shown.offset], axis=-1), shown.branch
            advance()
    measured = {"proximal": proximal, "tip": tip, "branch": branch, "tip_sd": sd_mm}
    setup = replace(true.setup, known_motions=known_motions)
    episodes = replace(true, initial=true.initial + by_encoder, setup=setup, **measured)
    return Monitored(
        truth=true.tip.astype(float),
        ratio=safety_ratio(dataset.tip_offset[:, :, 0], dataset.lumen_radius[:, :, 0], wire_radius).astype(float),
        episodes=episodes,
        found=found,
        unregistered=unregistered,
        model=online_predictor(predictor, episodes, found),
        lumen=Lumen(trees, owner),
        wire_radius_mm=wire_radius,
        dataset=dataset.manifest["key"],
    )


def calibrate(fitted: Monitored, own: Monitored, config: AdviserConfig) -> Calibration:
    """Return the calibration of a model.

    Args:
        fitted: navigations that the terms of the spread are fitted to; they need be no calibration patients.
        config: how many of the intervals the bands shall hold throughout, and how many events the adviser may miss.

    Raises:
        InputError: there are too few calibration patients for that level.
    """
    fitted.model.reset()
    seconds, travel = fitted.since
    error = (fitted.model.tip - fitted.truth)[:, WINDOW:]
    terms = fit_spread(error, seconds, travel, fitted.model.spread[:, WINDOW:])
    terms = narrowest(terms, _worst(fitted, terms), config.level)
    score = _worst(own, terms).max(axis=1)
    bands = Calibration(
        level=config.level,
        scale=conformal_scale(score, own.episodes.anatomy, config.level),
        abscissa_terms=terms[0],
        offset_terms=terms[1],
        anatomies=len(np.unique(own.episodes.anatomy)),
        intervals=len(score),
        dataset=own.dataset,
        offset_share=1.0,
        longest_s=SAMPLE_PERIOD_S * (own.truth.shape[1] - WINDOW),
    )
    return replace(bands, offset_share=least_offset_share(own, bands, config))


def least_offset_share(own: Monitored, bands: Calibration, config: AdviserConfig) -> float:
    """Return the smallest share of γtip's band by which the adviser surely misses no more events than it may.

    Events of Δtip are too few to find a share for: the adviser uses the whole of that band.

    The shares of `OFFSET_SHARES` are tried from the largest on. The last one before the first that misses too many is
    taken, so that chance among many shares favours none; 1, where even the whole band misses too many.
    """
    names, owner = np.unique(own.episodes.anatomy, return_inverse=True)
    least = OFFSET_SHARES[0]
    with progress("Using less of the bands", len(OFFSET_SHARES)) as advance:
        for share in OFFSET_SHARES:
            found = follow_policy(own, adviser_policy(own, replace(bands, offset_share=share), config), config)
            counts = np.array([np.sum(found.count(owner == index), axis=0) for index in range(len(names))])
            if surely_missed(counts[:, 1], counts[:, 0]) > config.missed:
                break
            least = share
            advance()
    return least


def _worst(monitored: Monitored, terms: tuple[tuple[float, ...], tuple[float, ...]]) -> Float[np.ndarray, "episodes 2"]:
    """Return the largest error over the spread in each interval, of Δtip and of γtip."""
    monitored.model.reset()
    spread = spread_of(terms, *monitored.since, monitored.model.spread[:, WINDOW:])
    return np.abs((monitored.model.tip - monitored.truth)[:, WINDOW:] / spread).max(axis=1)


def coverage(monitored: Monitored, calibration: Calibration) -> dict[str, Any]:
    """Return how often the bands hold: over whole intervals of 45 s, sample by sample, and in the worst patients."""
    monitored.model.reset()
    half = calibration.half_width(*monitored.since, monitored.model.spread[:, WINDOW:])
    inside: np.ndarray = np.less_equal(np.abs((monitored.model.tip - monitored.truth)[:, WINDOW:]), half)
    whole: np.ndarray = np.asarray(inside.all(axis=(1, 2)))
    anatomy = monitored.episodes.anatomy
    each = np.sort([whole[anatomy == name].mean() for name in np.unique(anatomy)])
    worst = each[: max(1, round(len(each) / 10))]
    return {
        "simultaneous": float(np.mean(each)),
        "each_band": inside.all(axis=1).mean(axis=0).tolist(),
        "worst_decile_of_patients": float(worst.mean()),
        "samplewise": float(inside.all(axis=2).mean()),
        "median_half_width_mm": np.median(half, axis=(0, 1)).tolist(),
        "error_mae_mm": np.abs((monitored.model.tip - monitored.truth)[:, WINDOW:]).mean(axis=(0, 1)).tolist(),
        "intervals": len(whole),
        "patients": len(each),
    }


@dataclass(frozen=True, eq=False)
class Followed:
    """Navigations in which a policy decided when X-ray is on, from the last given sample on.

    Attributes:
        shown: which have one that shows the tip.
        astray: whether the predicted Δtip errs by δ.
    """

    exposed: Bool[np.ndarray, "episodes samples"]
    shown: Bool[np.ndarray, "episodes samples"]
    wall: Bool[np.ndarray, "episodes samples"]
    astray: Bool[np.ndarray, "episodes samples"]

    def count(self, episodes: Bool[np.ndarray, "episodes"] | slice = slice(None)) -> list[Counted]:
        """Return the events at the wall and of Δtip."""
        return [count_events(state[episodes], self.shown[episodes]) for state in (self.wall, self.astray)]


def follow_policy(monitored: Monitored, policy: ExposurePolicy, config: AdviserConfig) -> Followed:
    """Let a policy decide when X-ray is on, and let the model observe what it shows."""
    model, truth = monitored.model, monitored.truth
    model.reset()
    exposed = np.zeros(truth.shape[:2], dtype=bool)
    episodes = monitored.episodes
    for sample in range(WINDOW, truth.shape[1]):
        exposed[:, sample] = policy(sample, model.tip[:, sample], model.spread[:, sample])
        on = np.flatnonzero(exposed[:, sample] & monitored.found[:, sample])
        if len(on):
            seen = episodes.tip[on, sample], episodes.branch[on, sample], episodes.tip_sd[on, sample]
            model.observe(on, sample, *seen)
    wall = monitored.ratio >= config.wall_ratio
    astray = np.abs(model.tip[..., 0] - truth[..., 0]) >= config.abscissa_mm
    astray[:, WINDOW - 1] = False
    return Followed(*(part[:, WINDOW - 1 :] for part in (exposed, exposed & monitored.found, wall, astray)))


def measure_policy(monitored: Monitored, policy: ExposurePolicy, config: AdviserConfig) -> dict[str, float]:
    """Return what a policy costs and misses: see `follow_policy`."""
    found = follow_policy(monitored, policy, config)
    (wall_events, missed_wall, _), (abscissa_events, missed_abscissa, _) = found.count()
    unseen = found.wall & ~near_exposures(found.shown)
    exposed, unseen, wall = (part[:, 1:] for part in (found.exposed, unseen, found.wall))
    minutes = exposed.size * SAMPLE_PERIOD_S / 60
    events = wall_events + abscissa_events
    rate = float(exposed.sum() / minutes)
    return {
        "exposures_per_minute": rate,
        "missed_share": (missed_wall + missed_abscissa) / max(events, 1),
        "events_per_minute": events / minutes,
        "wall_events_per_minute": wall_events / minutes,
        "missed_wall_share": missed_wall / max(wall_events, 1),
        "missed_abscissa_share": missed_abscissa / max(abscissa_events, 1),
        "fewer_frames_than_fluoroscopy": 1 - rate / (60 * FLUOROSCOPY_HZ),
        "wall_samples_without_exposure_share": float(unseen.sum() / max(wall.sum(), 1)),
    }


def adviser_policy(monitored: Monitored, calibration: Calibration, config: AdviserConfig) -> ExposurePolicy:
    """Return the adviser as an exposure policy: a `Watch` of each navigation, which tests the model by innovations."""
    monitored.model.reset()
    episodes, last = monitored.episodes, WINDOW - 1
    branch = episodes.branch[:, last].astype(int)

    def at(sample: int, tip: np.ndarray, spread: np.ndarray) -> list[Predicted]:
        proximal, radius_mm = monitored.proximal[:, sample], monitored.lumen.radius(branch, tip[:, 0])
        return [Predicted(*each) for each in zip(proximal, tip, spread, radius_mm.tolist(), strict=True)]

    first = at(last, monitored.model.tip[:, last], monitored.model.spread[:, last])
    watches = [Watch(calibration, config, monitored.wire_radius_mm, each, alone=False) for each in first]

    def due(sample: int, tip: np.ndarray, spread: np.ndarray) -> np.ndarray:
        now = at(sample, tip, spread)
        return np.array([watch.advise(each) for watch, each in zip(watches, now, strict=True)])

    again = taken_again(monitored, due)

    def decide(sample: int, tip: np.ndarray, spread: np.ndarray) -> np.ndarray:
        on = again(sample, tip, spread)
        shown = np.flatnonzero(on & monitored.found[:, sample]).tolist()
        branch[shown] = episodes.branch[shown, sample]
        seen = episodes.tip[:, sample].astype(float)
        radius_mm = monitored.lumen.radius(branch, seen[:, 0])
        for k in shown:
            watches[k].compare(seen[k] - tip[k], tuple(episodes.tip_sd[k, sample].tolist()))
            at = Predicted(monitored.proximal[k, sample], seen[k], spread[k], float(radius_mm[k]))
            watches[k].exposed(float(seen[k, 1]), at)
        return on

    return decide


def taken_again(monitored: Monitored, policy: ExposurePolicy) -> ExposurePolicy:
    """Return a policy that takes an image in which no wire is found again at the next sample."""
    unseen = np.zeros(len(monitored.truth), dtype=bool)

    def decide(sample: int, tip: np.ndarray, spread: np.ndarray) -> np.ndarray:
        on = policy(sample, tip, spread) | unseen
        unseen[:] = on & ~monitored.found[:, sample]
        return on

    return decide


def periodic_policy(monitored: Monitored, period: int) -> ExposurePolicy:
    """Return periodic imaging, each navigation with a phase of its own; `period` counts samples."""
    phase = np.arange(len(monitored.truth))
    return taken_again(monitored, lambda sample, tip, spread: (sample + phase) % period == 0)


def measure_metronome(monitored: Monitored, per_minute: float, config: AdviserConfig) -> dict[str, float]:
    """Return what periodic imaging with about as many exposures a minute misses: see `measure_policy`."""
    period = max(1, round(60 / SAMPLE_PERIOD_S / max(per_minute, 1e-9)))
    return measure_policy(monitored, periodic_policy(monitored, min(period, monitored.truth.shape[1])), config)


def oracle_policy(monitored: Monitored, config: AdviserConfig) -> ExposurePolicy:
    """Return a policy that knows the truth, and exposes where an event begins."""
    wall = monitored.ratio >= config.wall_ratio
    was_astray = np.zeros(len(monitored.truth), dtype=bool)

    def decide(sample: int, tip: np.ndarray, spread: np.ndarray) -> np.ndarray:
        astray = np.abs(tip[:, 0] - monitored.truth[:, sample, 0]) >= config.abscissa_mm
        due = (wall[:, sample] & ~wall[:, sample - 1]) | (astray & ~was_astray)
        was_astray[:] = astray
        return due

    return taken_again(monitored, decide)


def periodic_equal(curve: Sequence[dict[str, float]], missed_share: float) -> float:
    """Return the exposures a minute at which the missed share of periodic imaging is no larger, between its points."""
    points = sorted((point["exposures_per_minute"], point["missed_share"]) for point in curve)
    rate, missed = (np.array(column) for column in zip(*points, strict=True))
    missed = np.minimum.accumulate(missed)  # np.interp needs it monotone
    return float(np.interp(-missed_share, -missed, rate)) if missed_share < missed[0] else float(rate[0])
