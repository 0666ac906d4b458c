"""Simulated wires that follow a navigation's own controls: what the causal forward network starts from.

Nominal push–pull envelopes know nothing of a wire that turns while it moves. A few wires, each with another friction,
simulated under the commanded controls do. None of them has quite the true wire's friction and stiffness: the network
learns from the observed tips which to trust, and where the wires part, the true one may jump. In a patient who moves
they are simulated in a vessel that moves as far as that is known.
"""

from __future__ import annotations

import hashlib
import warnings
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass, field, replace
from functools import partial
from itertools import pairwise
from pathlib import Path
from weakref import WeakKeyDictionary
from zipfile import BadZipFile

import numpy as np
from jaxtyping import Float

from endopilot.files import json_text, writing
from endopilot.models.config import WINDOW
from endopilot.models.ensemble import NOMINAL, Ensemble
from endopilot.models.episodes import Episodes, EpisodeSetUp
from endopilot.parallel import CORES
from endopilot.progress import progress
from endopilot.simulation.state import SimulatorState
from endopilot.types import SAMPLE_PERIOD_S

FRICTION_FACTORS = (0.8, 1.0, 1.25)
"""Friction of the simulated wires, as factors of the device's."""
_KEPT = 4096
"""Navigations of a setup whose wires' tips are kept in memory."""
_KEPT_WORLDS = 1024
"""Wires of a setup whose states are kept in memory."""
_STATE_EVERY = 20
"""Samples from one kept state to the next, from the given states on."""
_FORMAT_VERSION = 2
WireTips = Float[np.ndarray, "episodes samples wires 2"]
"""(Δtip, γtip) of the simulated wires, mm; NaN from where a simulation fails."""


@dataclass(frozen=True, eq=False)
class SimulatedWires:
    """Simulates the wires of navigations, once for the same controls.

    A plan is often another end of one that was simulated before: then wires go on from a state on its way.

    Attributes:
        known: tips of navigations that were simulated before, by setup and by a digest of patient and controls.
        courses: the wires themselves as they were driven last, by setup and by a digest of patient and starts.
    """

    known: WeakKeyDictionary[EpisodeSetUp, dict[bytes, np.ndarray]] = field(
        default_factory=WeakKeyDictionary, repr=False
    )
    courses: WeakKeyDictionary[EpisodeSetUp, dict[bytes, Course]] = field(default_factory=WeakKeyDictionary, repr=False)

    def tips(self, episodes: Episodes) -> WireTips:
        """Return the tips of the wires that follow the controls of each episode.

        Raises:
            InputError: an anatomy is missing or damaged.
        """
        known = self.known.setdefault(episodes.setup, {})
        digests = [_digest(episodes, i) for i in range(len(episodes))]
        unknown = np.array([i for i, digest in enumerate(digests) if digest not in known], dtype=int)
        if len(known) + len(unknown) > _KEPT:
            known.clear()
            unknown = np.arange(len(episodes))
        if len(unknown):
            courses = self.courses.setdefault(episodes.setup, {})
            for i, tip in zip(unknown, simulated_tips(episodes.select(unknown), courses), strict=True):
                known[digests[i]] = tip
            while sum(len(course.command) for course in courses.values()) > _KEPT_WORLDS:
                del courses[next(iter(courses))]
        return np.stack([known[digest] for digest in digests])


def _digest(episodes: Episodes, i: int) -> bytes:
    """Return what identifies the simulation of an episode within its setup."""
    parts = (str(episodes.anatomy[i]).encode(), episodes.initial[i].tobytes(), episodes.command[i].tobytes())
    return hashlib.sha256(b"\0".join(parts)).digest()


class Course:
    """Wires of one patient as they were driven last, with states to go on from where the next course is the same.

    Attributes:
        command: mm/s and rad/s of each wire and sample.
        tips: at the end of each sample, mm; NaN from where a simulation fails.
        states: by the sample that follows.
    """

    def __init__(self, ensemble: Ensemble, reach_mm: float, samples: int) -> None:
        """Bring the wires to their start, laid out for an inserted length, mm."""
        self.reach_mm, self._simulator = reach_mm, ensemble.started(reach_mm)
        self.command, self.tips = np.full((2, len(ensemble.parameters), samples, 2), np.nan)
        self.states: dict[int, SimulatorState] = {0: self._simulator.state}

    def drive(self, command: Float[np.ndarray, "wires samples 2"]) -> None:
        """Drive the wires by other commands, from the last state before which they are the same."""
        samples = command.shape[1]
        shared = int((command == self.command).all(axis=(0, 2)).cumprod().sum())
        self.states = {at: state for at, state in self.states.items() if at <= shared}
        begin, self.command = max(self.states), command
        self._simulator.set_state(self.states[begin])
        stops = [at for at in range(WINDOW, samples, _STATE_EVERY) if at > begin]
        for start, end in pairwise([begin, *stops, samples]):
            made = self._simulator.run(command[:, start:end, None])
            tip = np.stack([made.tip.abscissa, made.tip.offset], axis=-1)[:, :, 0]
            self.tips[:, start:end] = np.where(made.valid[..., None], tip, np.nan)
            if end < samples:
                self.states[end] = self._simulator.state


def simulated_tips(episodes: Episodes, courses: dict[bytes, Course] | None = None) -> WireTips:
    """Simulate the wires of `FRICTION_FACTORS` under the commanded controls of each episode.

    Args:
        episodes: the navigations.
        courses: of the same wires before, which are brought up to date.

    Raises:
        InputError: an anatomy is missing or damaged.
    """
    tips = np.full((*episodes.branch.shape, len(FRICTION_FACTORS), 2), np.nan)
    names = np.unique(episodes.anatomy)
    with (
        progress("Simulated wires", total=len(names)) as advance,
        warnings.catch_warnings(),  # around the threads, which change what all of them see
        ThreadPoolExecutor(CORES) as pool,  # few wires leave threads of one simulation idle
    ):
        warnings.simplefilter("ignore")  # a wire that fails is left out
        each = [np.flatnonzero(episodes.anatomy == name) for name in names]
        of_one = partial(_of_one_patient, courses={} if courses is None else courses)
        for chosen, found in zip(each, pool.map(of_one, map(episodes.select, each)), strict=True):
            tips[chosen] = found
            advance(1)
    return tips


def _of_one_patient(episodes: Episodes, courses: dict[bytes, Course]) -> WireTips:
    setup, name, count = episodes.setup, str(episodes.anatomy[0]), len(FRICTION_FACTORS)
    command = np.repeat(episodes.command, count, axis=0)
    start, samples = np.repeat(episodes.initial, count, axis=0), command.shape[1]
    reach_mm = float((start[:, 0] + np.maximum(command[..., 0], 0.0).sum(axis=1) * SAMPLE_PERIOD_S).max())
    key = f"{name} {samples} ".encode() + start.tobytes()
    course = courses.pop(key, None)
    if course is None or course.reach_mm < reach_mm:
        parameters = np.tile(NOMINAL, (len(start), 1))
        parameters[:, 0] = np.tile(FRICTION_FACTORS, len(episodes))
        ensemble = Ensemble(
            setup.anatomies[name](),
            setup.device,
            parameters,
            start=start[:, None],
            config=replace(setup.simulator, threads=1),
            motion=setup.known_motions.get(name),
        )
        course = Course(ensemble, 1.2 * reach_mm + 1.0, samples)  # other ends may push farther
    course.drive(command)
    courses[key] = course
    return np.moveaxis(course.tips.reshape(len(episodes), count, samples, 2), 1, 2)


def read_or_simulate(folder: Path | None, episodes: Episodes) -> WireTips:
    """Return the tips of the wires of a dataset's episodes: read from a folder, or simulated now and kept there.

    Args:
        folder: where they are kept, one file for each set of episodes; nowhere if None.
        episodes: the navigations.
    """
    if folder is None:
        return simulated_tips(episodes)
    setup = episodes.setup
    settings = (_FORMAT_VERSION, FRICTION_FACTORS, asdict(replace(setup.simulator, threads=0)))
    names = np.unique(episodes.anatomy).tolist()
    vessels = [((setup.identities or {}).get(name), setup.known_motions.get(name)) for name in names]
    key = json_text((settings, asdict(setup.device), vessels))
    digest = hashlib.sha256(key.encode() + b"".join(_digest(episodes, i) for i in range(len(episodes))))
    path = folder / f"wires-{digest.hexdigest()[:16]}.npz"
    try:
        with np.load(path, allow_pickle=False) as stored:
            return stored["tips"]
    except (OSError, ValueError, KeyError, BadZipFile):
        tips = simulated_tips(episodes)
    with writing(path) as partial, partial.open("wb") as stream:
        np.savez_compressed(stream, tips=tips)
    return tips
