"""How likely each pixel lies on a wire, from ridges: dark lines as wide as a wire, seen at three scales."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float, Float32, Int
from scipy.ndimage import gaussian_filter

from endopilot.files import read_json

SCALES_PX = (1.0, 1.7, 2.8)
"""Standard deviations of the Gaussians whose second derivatives are taken; a coronary wire is some 1.7 pixels wide."""
_AROUND_PX = 8.0
_MOST = 12.0
"""Features are cut off here, in standard deviations of the quantum noise."""
PARAMETERS = Path(__file__).parent / "ridge.json"


@dataclass(frozen=True, eq=False)
class RidgeEvidence:
    """A logistic regression on ridges.

    Attributes:
        weight: of the features and of the products of any two.
        offset: constant term.
    """

    weight: Float[np.ndarray, "terms"]
    offset: float

    @classmethod
    def read(cls, path: Path = PARAMETERS) -> RidgeEvidence:
        """Read the parameters; those of the package if no file is given."""
        found = read_json(path)
        return cls(np.array(found["weight"]), float(found["offset"]))

    def __call__(
        self,
        signal: Float32[np.ndarray, "rows columns"],
        photons: float,
        where: Bool[np.ndarray, "rows columns"] | None = None,
    ) -> Float32[np.ndarray, "rows columns"]:
        """Return the logarithm of how much likelier each pixel is on a wire than off it.

        Args:
            signal: from `XrayImager.signal`.
            photons: that a pixel of usual brightness counts.
            where: pixels that it is wanted of; 0 elsewhere; all if not given.
        """
        pixels = None if where is None else np.flatnonzero(where)
        found = features(signal, photons, pixels)
        count = len(found)
        square = np.zeros((count, count), dtype=np.float32)
        square[np.triu_indices(count)] = self.weight[count:] / _MOST
        # The same as `products` times the weights, without an image for each product.
        terms = square @ found + self.weight[:count, None].astype(np.float32)
        likelier = np.einsum("fn,fn->n", terms, found) + np.float32(self.offset)
        if pixels is None:
            return likelier.reshape(signal.shape)
        evidence = np.zeros(signal.shape, dtype=np.float32)
        evidence.ravel()[pixels] = likelier
        return evidence


def features(
    signal: Float32[np.ndarray, "rows columns"], photons: float, pixels: Int[np.ndarray, "n"] | None = None
) -> Float32[np.ndarray, "f n"]:
    """Return the features of some pixels of the flat image, or of all: ridges and darkness over the noise, and that."""
    chosen = slice(None) if pixels is None else pixels
    smooth = [gaussian_filter(signal, scale, mode="nearest") for scale in SCALES_PX]
    around = _smoother(smooth[-1], SCALES_PX[-1], _AROUND_PX).ravel()[chosen]
    noise = np.exp(-0.5 * around) / np.float32(np.sqrt(photons))
    found = np.empty((2 * len(SCALES_PX) + 2, len(around)), dtype=np.float32)
    for number, (scale, image) in enumerate(zip(SCALES_PX, smooth, strict=True)):
        mean, half = _curvatures(image, pixels)
        # The Hessian of white noise, smoothed, falls with the third power of the scale.
        weight = np.float32(scale**3) / noise
        found[2 * number], found[2 * number + 1] = weight * (mean + half), weight * (mean - half)
    found[-2] = (around - smooth[0].ravel()[chosen]) / noise * np.float32(SCALES_PX[0])
    found[-1] = np.log(noise)
    return np.clip(found, -_MOST, _MOST, out=found)


def _curvatures(
    image: Float32[np.ndarray, "rows columns"], pixels: Int[np.ndarray, "n"] | None
) -> tuple[Float32[np.ndarray, "n"], Float32[np.ndarray, "n"]]:
    """Return the mean of the two principal curvatures of some pixels, and half their difference."""
    (rows, columns), padded = image.shape, np.pad(image, 2, mode="edge")
    width, flat = columns + 4, padded.ravel()
    at = None if pixels is None else (pixels // columns + 2) * width + pixels % columns + 2

    def beside(down: int, right: int) -> Float32[np.ndarray, "n"]:
        if at is None:
            return padded[2 + down : 2 + down + rows, 2 + right : 2 + right + columns].ravel()
        return flat[at + (down * width + right)]

    here = 2 * beside(0, 0)
    down, right = beside(2, 0) - here + beside(-2, 0), beside(0, 2) - here + beside(0, -2)
    mixed = beside(1, 1) - beside(1, -1) - beside(-1, 1) + beside(-1, -1)
    return 0.125 * (down + right), 0.125 * np.sqrt((down - right) ** 2 + 4 * mixed**2)


def _smoother(
    image: Float32[np.ndarray, "rows columns"], done_px: float, scale_px: float
) -> Float32[np.ndarray, "rows columns"]:
    """Return an image, smoothed already, smoothed to a larger standard deviation: every other pixel will do."""
    rows, columns = image.shape
    part = gaussian_filter(image[::2, ::2], 0.5 * float(np.sqrt(scale_px**2 - done_px**2)))
    part = np.pad(part, ((0, 1), (0, 1)), mode="edge")
    down = np.empty((2 * len(part) - 2, part.shape[1]), dtype=np.float32)
    down[::2], down[1::2] = part[:-1], 0.5 * (part[:-1] + part[1:])
    whole = np.empty((len(down), 2 * part.shape[1] - 2), dtype=np.float32)
    whole[:, ::2], whole[:, 1::2] = down[:, :-1], 0.5 * (down[:, :-1] + down[:, 1:])
    return whole[:rows, :columns]


def products(values: Float32[np.ndarray, "*n f"]) -> Float32[np.ndarray, "*n terms"]:
    """Return features and the products of any two."""
    rows, columns = np.triu_indices(values.shape[-1])
    return np.concatenate([values, values[..., rows] * values[..., columns] / np.float32(_MOST)], axis=-1)
