"""Simulated wires that follow a navigation's own controls: what the causal forward network starts from.

Nominal push–pull envelopes know nothing of a wire that turns while it moves. A few wires, each with another friction,
simulated under the commanded controls do. The middle one is the wire that retraces the given tips best
(`fitted_wires`): the network learns from the observed tips which to trust, and where the wires part, the true one may
jump. In a patient who moves they are simulated in a vessel that moves, and the fitted one once more with the heart at
rest: the difference is what the motion does to the tip, and networks see every patient without it.
"""

from __future__ import annotations

import hashlib
import warnings
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass, field, replace
from itertools import pairwise
from pathlib import Path
from weakref import WeakKeyDictionary
from zipfile import BadZipFile

import numpy as np
from jaxtyping import Float, Int

from endopilot.files import json_text, writing
from endopilot.models.config import WINDOW
from endopilot.models.ensemble import Ensemble
from endopilot.models.episodes import EachObserved, Episodes, EpisodeSetUp
from endopilot.models.fitted_wires import Wires, by_motion, ensemble_of, fitted
from endopilot.parallel import CORES
from endopilot.progress import progress
from endopilot.simulation.state import SimulatorState
from endopilot.types import SAMPLE_PERIOD_S

FRICTION_FACTORS = (0.8, 1.0, 1.25)
"""Friction of the simulated wires, as factors of the fitted one's."""
_KEPT = 4096
"""Navigations of a setup whose wires' tips are kept in memory."""
_KEPT_WORLDS = 1024
"""Wires of a setup whose states are kept in memory."""
_STATE_EVERY = 20
"""Samples from one kept state to the next, from the given states on."""
_FORMAT_VERSION = 4


@dataclass(frozen=True, eq=False)
class WireTips:
    """What simulated wires did in some navigations.

    Attributes:
        tip: (Δtip, γtip) of each wire, mm; NaN from where a simulation fails.
        moved: by how much the patient's motion displaces the tip in its vessel, mm; 0 in a vessel that lies still.
    """

    tip: Float[np.ndarray, "episodes samples wires 2"]
    moved: Float[np.ndarray, "episodes samples 2"]

    @staticmethod
    def of(tips: Float[np.ndarray, "episodes samples simulated 2"]) -> WireTips:
        """Return them from the tips of all simulated wires: the last is the fitted one with the heart at rest."""
        wires = len(FRICTION_FACTORS)
        moved = tips[:, :, FRICTION_FACTORS.index(1.0)] - tips[:, :, wires]
        return WireTips(tips[:, :, :wires], np.nan_to_num(moved))

    def halves(self) -> tuple[WireTips, WireTips]:
        """Return those of the first half of the navigations, and those of the second."""
        tip, moved = np.split(self.tip, 2), np.split(self.moved, 2)
        return WireTips(tip[0], moved[0]), WireTips(tip[1], moved[1])


@dataclass(frozen=True, eq=False)
class SimulatedWires:
    """Simulates the wires of navigations, once for the same controls and given tips.

    A plan is often another end of one that was simulated before: then wires go on from a state on its way.

    Attributes:
        fits: parameters of fitted wires, by setup and by a digest of patient, controls and tips of the given samples.
        known: tips of navigations that were simulated before, by setup and by a digest of patient, controls and fit.
        courses: the wires themselves as they were driven last, by setup and by a digest of patient, starts and fits.
    """

    fits: WeakKeyDictionary[EpisodeSetUp, dict[bytes, np.ndarray]] = field(
        default_factory=WeakKeyDictionary, repr=False
    )
    known: WeakKeyDictionary[EpisodeSetUp, dict[bytes, np.ndarray]] = field(
        default_factory=WeakKeyDictionary, repr=False
    )
    courses: WeakKeyDictionary[EpisodeSetUp, dict[bytes, Course]] = field(default_factory=WeakKeyDictionary, repr=False)

    def tips(self, episodes: Episodes, observed: EachObserved) -> WireTips:
        """Return the tips of the wires that follow the controls of each episode.

        Args:
            episodes: their controls, and their tips where `observed` among the first `WINDOW` samples.

        Raises:
            InputError: an anatomy is missing or damaged.
        """
        given = [_digest(episodes, i, observed) for i in range(len(episodes))]
        fits = self.fits.setdefault(episodes.setup, {})
        new = _unknown(fits, given)
        for i, wire in zip(new, fitted_wires(episodes.select(new), observed[new]), strict=True):
            fits[given[i]] = wire
        wires = np.array([fits[digest] for digest in given])
        known = self.known.setdefault(episodes.setup, {})
        digests = [_digest(episodes, i) + wires[i].tobytes() for i in range(len(episodes))]
        new = _unknown(known, digests)
        if len(new):
            courses = self.courses.setdefault(episodes.setup, {})
            for i, tip in zip(new, simulated_tips(episodes.select(new), wires[new], courses), strict=True):
                known[digests[i]] = tip
            while sum(course.command.shape[0] for course in courses.values()) > _KEPT_WORLDS:
                del courses[next(iter(courses))]
        return WireTips.of(np.stack([known[digest] for digest in digests]))


def _unknown(kept: dict[bytes, np.ndarray], digests: list[bytes]) -> Int[np.ndarray, "new"]:
    """Return which of some digests are not kept; all of them, and nothing is kept, where there is no room."""
    new = np.array([i for i, digest in enumerate(digests) if digest not in kept], dtype=int)
    if len(kept) + len(new) <= _KEPT:
        return new
    kept.clear()
    return np.arange(len(digests))


def _digest(episodes: Episodes, i: int, observed: EachObserved | None = None) -> bytes:
    """Return what identifies an episode within its setup: all its controls, or the observed part of the given states"""
    samples = None if observed is None else WINDOW
    parts = [str(episodes.anatomy[i]).encode(), episodes.initial[i].tobytes(), episodes.command[i, :samples].tobytes()]
    if observed is not None:
        seen = observed[i, :WINDOW]
        signals = (np.packbits(seen), episodes.tip[i, :WINDOW][seen], episodes.tip_sd[i, :WINDOW][seen])
        parts.extend(signal.tobytes() for signal in signals)
    return hashlib.sha256(b"\0".join(parts)).digest()


class Course:
    """Wires of one patient as they were driven last, with states to go on from where the next course is the same.

    Attributes:
        command: mm/s and rad/s of each wire and sample.
        tips: at the end of each sample, mm; NaN from where a simulation fails.
        states: of the simulations, by the sample that follows.
    """

    def __init__(
        self, ensembles: list[tuple[Int[np.ndarray, "some"], Ensemble]], reach_mm: float, samples: int
    ) -> None:
        """Bring the wires to their start, laid out for an inserted length, mm.

        Args:
            ensembles: rows of the wires that are simulated together, and the wires.
        """
        self.reach_mm = reach_mm
        self._parts = [(rows, ensemble.started(reach_mm)) for rows, ensemble in ensembles]
        self.command, self.tips = np.full((2, sum(len(rows) for rows, _ in ensembles), samples, 2), np.nan)
        self.states: dict[int, list[SimulatorState]] = {0: [simulator.state for _, simulator in self._parts]}

    def drive(self, command: Float[np.ndarray, "wires samples 2"]) -> None:
        """Drive the wires by other commands, from the last state before which they are the same."""
        samples = command.shape[1]
        shared = int((command == self.command).all(axis=(0, 2)).cumprod().sum())
        self.states = {at: state for at, state in self.states.items() if at <= shared}
        begin, self.command = max(self.states), command
        stops = [at for at in range(WINDOW, samples, _STATE_EVERY) if at > begin]
        for (_, simulator), state in zip(self._parts, self.states[begin], strict=True):
            simulator.set_state(state)
        for start, end in pairwise([begin, *stops, samples]):
            for rows, simulator in self._parts:
                made = simulator.run(command[rows, start:end, None])
                tip = np.stack([made.tip.abscissa, made.tip.offset], axis=-1)[:, :, 0]
                self.tips[rows, start:end] = np.where(made.valid[..., None], tip, np.nan)
            if end < samples:
                self.states[end] = [simulator.state for _, simulator in self._parts]


def _each_patient(episodes: Episodes, what: str, found: np.ndarray, of_one, *, parts: int = 1) -> np.ndarray:
    """Fill the rows of an array, one an episode, by a function of rows of one patient, on all cores.

    Args:
        parts: into which each patient's episodes are split; fewer if there are fewer episodes.
    """
    patients = [np.flatnonzero(episodes.anatomy == name) for name in np.unique(episodes.anatomy)]
    each = [part for rows in patients for part in np.array_split(rows, min(parts, len(rows)))]
    with (
        progress(what, total=len(each)) as advance,
        warnings.catch_warnings(),  # around the threads, which change what all of them see
        ThreadPoolExecutor(CORES) as pool,  # few wires leave threads of one simulation idle
    ):
        warnings.simplefilter("ignore")  # a wire that fails is left out
        for chosen, made in zip(each, pool.map(of_one, each), strict=True):
            found[chosen] = made
            advance(1)
    return found


def _parts(episodes: Episodes) -> int:
    """Return into how many parts each patient's episodes are split, so that a few patients keep all cores busy."""
    return -(-CORES // max(1, len(np.unique(episodes.anatomy))))


def fitted_wires(episodes: Episodes, observed: EachObserved) -> Wires:
    """Return the wires that retrace best what was observed of each episode among the first `WINDOW` samples.

    Raises:
        InputError: an anatomy is missing or damaged.
    """

    def of_one(chosen: Int[np.ndarray, "chosen"]) -> Wires:
        return fitted(episodes.select(chosen), observed[chosen, :WINDOW])

    return _each_patient(episodes, "Fitted wires", np.ones((len(episodes), 4)), of_one, parts=_parts(episodes))


def simulated_tips(
    episodes: Episodes, wires: Wires, courses: dict[bytes, Course] | None = None
) -> Float[np.ndarray, "episodes samples simulated 2"]:
    """Simulate wires under the commanded controls of each episode.

    Args:
        wires: the fitted wire of each.
        courses: of the same wires before, which are brought up to date.

    Returns:
        Their tips, mm: of `FRICTION_FACTORS`, and of the fitted wire with the heart at rest.

    Raises:
        InputError: an anatomy is missing or damaged.
    """
    tips = np.full((*episodes.branch.shape, len(FRICTION_FACTORS) + 1, 2), np.nan)
    courses = {} if courses is None else courses

    def of_one(chosen: Int[np.ndarray, "chosen"]) -> np.ndarray:
        return _of_one_patient(episodes.select(chosen), wires[chosen], courses)

    return _each_patient(episodes, "Simulated wires", tips, of_one, parts=_parts(episodes))


def _of_one_patient(
    episodes: Episodes, wires: Wires, courses: dict[bytes, Course]
) -> Float[np.ndarray, "episodes samples simulated 2"]:
    name = str(episodes.anatomy[0])
    moves = episodes.setup.known_motions.get(name) is not None
    own = FRICTION_FACTORS.index(1.0)
    count = len(FRICTION_FACTORS) + moves
    theta = np.repeat(wires[:, None], count, axis=1)
    theta[:, : len(FRICTION_FACTORS), 0] *= FRICTION_FACTORS
    theta[:, len(FRICTION_FACTORS) :, 2:] = 0.0
    theta = theta.reshape(-1, 4)
    command = np.repeat(episodes.command, count, axis=0)
    start, samples = np.repeat(episodes.initial, count, axis=0), command.shape[1]
    reach_mm = float((start[:, 0] + np.maximum(command[..., 0], 0.0).sum(axis=1) * SAMPLE_PERIOD_S).max())
    key = f"{name} {samples} ".encode() + start.tobytes() + theta.tobytes()
    course = courses.pop(key, None)
    if course is None or course.reach_mm < reach_mm:
        anatomy = episodes.setup.anatomies[name]()
        parts = [(rows, ensemble_of(episodes.setup, anatomy, theta[rows], start[rows])) for rows in by_motion(theta)]
        course = Course(parts, 1.2 * reach_mm + 1.0, samples)  # other ends may push farther
    course.drive(command)
    courses[key] = course
    tips = np.moveaxis(course.tips.reshape(len(episodes), count, samples, 2), 1, 2)
    return tips if moves else np.concatenate([tips, tips[:, :, own : own + 1]], axis=2)


def read_or_simulate(folder: Path | None, episodes: Episodes, observed: EachObserved) -> WireTips:
    """Return the tips of the wires of a dataset's episodes: read from a folder, or simulated now and kept there.

    Args:
        folder: where they are kept, one file for each patient with these episodes; nowhere if None.
        episodes: the navigations; one may be there several times, with other samples observed.
        observed: samples at which the tip was observed; wires are fitted to those among the first `WINDOW`.

    Raises:
        InputError: an anatomy is missing or damaged.
    """

    def of_one(chosen: Int[np.ndarray, "chosen"]) -> np.ndarray:
        part, seen = episodes.select(chosen), observed[chosen]
        each = [_digest(part, i) + _digest(part, i, seen) for i in range(len(part))]
        path = None if folder is None else folder / f"{part.anatomy[0]}-wires-{_key(part, each)}.npz"
        try:
            with np.load(path or "", allow_pickle=False) as stored:
                return stored["tips"]
        except (OSError, ValueError, KeyError, BadZipFile):
            first = {digest: i for i, digest in reversed(list(enumerate(each)))}
            some = np.array(sorted(first.values()))
            few = part.select(some)
            made = _of_one_patient(few, fitted(few, seen[some, :WINDOW]), {})
            tips = made[np.searchsorted(some, [first[digest] for digest in each])]
        if path is not None:
            with writing(path) as partial, partial.open("wb") as stream:
                np.savez_compressed(stream, tips=tips)
        return tips

    tips = np.empty((*episodes.branch.shape, len(FRICTION_FACTORS) + 1, 2))
    return WireTips.of(_each_patient(episodes, "Fitted and simulated wires", tips, of_one))


def _key(episodes: Episodes, each: list[bytes]) -> str:
    """Return what identifies wires of one patient: the patient, the device, and a digest of each navigation."""
    setup, name = episodes.setup, str(episodes.anatomy[0])
    settings = (_FORMAT_VERSION, FRICTION_FACTORS, asdict(replace(setup.simulator, threads=0)))
    vessel = (setup.identities or {}).get(name), setup.known_motions.get(name)
    text = json_text((settings, asdict(setup.device), vessel))
    return hashlib.sha256(text.encode() + b"".join(each)).hexdigest()[:16]
