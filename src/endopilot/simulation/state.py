"""What `Simulator` takes and returns: its worlds' set-up, a step's results and a saved state."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from zipfile import BadZipFile

import numpy as np
from jaxtyping import Float

from endopilot.devices.stack import Stack
from endopilot.errors import InputError
from endopilot.files import regular, writing
from endopilot.simulation.config import Actuation, SimulatorConfig
from endopilot.simulation.motion import Motion
from endopilot.simulation.signals import SolvedOutputs, described
from endopilot.types import Anatomy


@dataclass(frozen=True, eq=False)
class SimulationSetUp:
    """What worlds are simulated with: a `Simulator` made of it and the same commands give the same bits.

    Attributes:
        anatomies: the vessel of each world; `stacks` its devices.
        initial: Δ (mm) and φ (rad) that the devices are brought to before the first command; NaN in a world that was
            on its way already.
        friction: Coulomb coefficient of each device on the wall.
        actuation: what commands are: "velocity" (mm/s, rad/s) or "force" (N, N·mm).
        motion: how every vessel moves with time; None where they lie still.
    """

    anatomies: Sequence[Anatomy]
    stacks: Sequence[Stack]
    initial: Float[np.ndarray, "worlds devices 2"]
    friction: Float[np.ndarray, "worlds devices"]
    actuation: Actuation
    motion: Motion | None
    config: SimulatorConfig

    @property
    def largest(self) -> Float[np.ndarray, "worlds devices 2"]:
        """Largest magnitudes that commands may have: mm/s and rad/s, or N and N·mm, with a hair for rounding."""
        fastest = np.array([stack.fastest for stack in self.stacks]) * (1 + 1e-6)
        return np.full_like(fastest, np.finfo(float).max) if self.actuation == "force" else fastest


@described
@dataclass(frozen=True, eq=False, kw_only=True)
class Step(SolvedOutputs):
    """What all worlds did in one call of `Simulator.step`: one sample of a `Trajectory`, with a row a world."""


@dataclass(frozen=True, eq=False)
class SimulatorState:
    """All that the worlds' future depends on: restored, also in another process, they go on with the same bits.
    `values` is an array for each pair of anatomy and device, a row a world; `fingerprint` a hash of what it belongs to.
    """

    values: tuple[Float[np.ndarray, "_ _"], ...]
    fingerprint: str

    def write(self, path: Path | str) -> None:
        """Write the state to an .npz file, whole or not at all."""
        arrays = {f"values_{k}": v for k, v in enumerate(self.values)}
        with writing(Path(path)) as temporary, temporary.open("wb") as file:
            np.savez(file, fingerprint=np.array(self.fingerprint), **arrays)  # pyright: ignore[reportArgumentType]

    @staticmethod
    def read(path: Path | str) -> SimulatorState:
        """Read a state; InputError if the file is missing or is no saved state."""
        try:
            with np.load(regular(path), allow_pickle=False) as stored:
                count = sum(name.startswith("values_") for name in stored.files)
                return SimulatorState(tuple(stored[f"values_{k}"] for k in range(count)), str(stored["fingerprint"]))
        except (OSError, ValueError, KeyError, BadZipFile) as error:
            raise InputError(
                f"{path}: no saved state of a simulator ({error}); write one with SimulatorState.write"
            ) from None
