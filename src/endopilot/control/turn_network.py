"""The network that says how a wire is turned before a fork, in place of a search: `TurnNetwork`.

It is given a fork as `ForkView` has it, and returns how likely the wire passes into the route's branch when its tip
points to each side: a Fourier series of the azimuth, so that turning the fork turns the answer. `python -m benchmarks
turn-network` trains it by what became of trials in the rod core.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float

from endopilot.control.fork_view import ForkView
from endopilot.errors import InputError
from endopilot.files import writing

SIDES = 72
"""Azimuths for which it is asked, evenly from −π on."""
AZIMUTH = 2 * np.pi * (np.arange(SIDES) / SIDES - 0.5)
"""These, rad."""
_LIMIT = 4.0
"""No feature is taken to be farther from the training's mean than this, standard deviations."""


@dataclass(frozen=True, eq=False)
class TurnNetwork:
    """Several dense networks of the same kind, whose answers are averaged.

    Attributes:
        mean, scale: of the features of the training.
        layers: weights and biases of each layer, of all networks: (networks, in, out) and (networks, out).
    """

    mean: Float[np.ndarray, "features"]
    scale: Float[np.ndarray, "features"]
    layers: tuple[tuple[np.ndarray, np.ndarray], ...]

    def passes(self, view: ForkView) -> Float[np.ndarray, "sides"]:
        """Return how likely the wire passes with its tip at each of `AZIMUTH`, by a fork and its mirror image."""
        mirrored = self._passes(view.mirrored())
        return 0.5 * (self._passes(view) + np.roll(mirrored[::-1], 1))

    def _passes(self, view: ForkView) -> Float[np.ndarray, "sides"]:
        hidden = np.clip((view.features - self.mean) / self.scale, -_LIMIT, _LIMIT)[None]
        for k, (weight, bias) in enumerate(self.layers):
            hidden = np.einsum("ni,nio->no", np.broadcast_to(hidden, (len(weight), hidden.shape[-1])), weight) + bias
            if k < len(self.layers) - 1:
                hidden = hidden / (1 + np.exp(-hidden))
        return np.mean(1 / (1 + np.exp(-hidden @ fourier(AZIMUTH, hidden.shape[-1]).T)), axis=0)

    def write(self, path: Path) -> None:
        """Write it as an .npz file."""
        arrays = {
            f"{name}{k}": each for k, pair in enumerate(self.layers) for name, each in zip("wb", pair, strict=True)
        }
        with writing(path) as partial:
            np.savez_compressed(partial, mean=self.mean, scale=self.scale, **arrays)  # pyright: ignore[reportArgumentType]

    @staticmethod
    def read(path: Path) -> TurnNetwork:
        """Read one.

        Raises:
            InputError: there is none.
        """
        try:
            with np.load(path) as held:
                count = sum(name.startswith("w") for name in held.files)
                layers = tuple((held[f"w{k}"].astype(float), held[f"b{k}"].astype(float)) for k in range(count))
                return TurnNetwork(held["mean"].astype(float), held["scale"].astype(float), layers)
        except (OSError, KeyError, ValueError) as error:
            raise InputError(f"{path}: no network of turns; make one by python -m benchmarks turn-network") from error


def fourier(azimuth: Float[np.ndarray, "*n"], terms: int) -> Float[np.ndarray, "*n terms"]:
    """Return the terms of a Fourier series: 1, then cosine and sine of each multiple of an azimuth, rad."""
    order = np.arange(1, (terms - 1) // 2 + 1)
    angle = azimuth[..., None] * order
    waves = np.stack([np.cos(angle), np.sin(angle)], axis=-1).reshape(*azimuth.shape, -1)
    return np.concatenate([np.ones((*azimuth.shape, 1)), waves], axis=-1)
