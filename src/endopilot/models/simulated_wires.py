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
from pathlib import Path
from weakref import WeakKeyDictionary
from zipfile import BadZipFile

import numpy as np
from jaxtyping import Float

from endopilot.files import json_text, writing
from endopilot.models.ensemble import NOMINAL, Ensemble
from endopilot.models.episodes import Episodes, EpisodeSetUp
from endopilot.parallel import CORES
from endopilot.progress import progress

FRICTION_FACTORS = (0.8, 1.0, 1.25)
"""Friction of the simulated wires, as factors of the device's."""
_KEPT = 4096
"""Navigations of a setup whose wires are kept in memory."""
_FORMAT_VERSION = 2
WireTips = Float[np.ndarray, "episodes samples wires 2"]
"""(Δtip, γtip) of the simulated wires, mm; NaN from where a simulation fails."""


@dataclass(frozen=True, eq=False)
class SimulatedWires:
    """Simulates the wires of navigations, once for the same controls.

    Attributes:
        known: tips of navigations that were simulated before, by setup and by a digest of patient and controls.
    """

    known: WeakKeyDictionary[EpisodeSetUp, dict[bytes, np.ndarray]] = field(
        default_factory=WeakKeyDictionary, repr=False
    )

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
            for i, tip in zip(unknown, simulated_tips(episodes.select(unknown)), strict=True):
                known[digests[i]] = tip
        return np.stack([known[digest] for digest in digests])


def _digest(episodes: Episodes, i: int) -> bytes:
    """Return what identifies the simulation of an episode within its setup."""
    parts = (str(episodes.anatomy[i]).encode(), episodes.initial[i].tobytes(), episodes.command[i].tobytes())
    return hashlib.sha256(b"\0".join(parts)).digest()


def simulated_tips(episodes: Episodes) -> WireTips:
    """Simulate the wires of `FRICTION_FACTORS` under the commanded controls of each episode.

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
        for chosen, found in zip(each, pool.map(_of_one_patient, map(episodes.select, each)), strict=True):
            tips[chosen] = found
            advance(1)
    return tips


def _of_one_patient(episodes: Episodes) -> WireTips:
    setup, name, count = episodes.setup, str(episodes.anatomy[0]), len(FRICTION_FACTORS)
    parameters = np.tile(NOMINAL, (count * len(episodes), 1))
    parameters[:, 0] = np.tile(FRICTION_FACTORS, len(episodes))
    data = episodes.select(np.repeat(np.arange(len(episodes)), count))
    ensemble = Ensemble(
        setup.anatomies[name](),
        setup.device,
        parameters,
        start=data.initial[:, None],
        config=replace(setup.simulator, threads=1),
        motion=setup.known_motions.get(name),
    )
    tip = ensemble.replay(data.command)
    return np.moveaxis(tip.reshape(len(episodes), count, *tip.shape[1:]), 1, 2)


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
