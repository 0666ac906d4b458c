"""How likely each pixel lies on a wire, from ridges: dark lines as wide as a wire, seen at three scales."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, Float32
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
        self, signal: Float32[np.ndarray, "rows columns"], photons: float
    ) -> Float32[np.ndarray, "rows columns"]:
        """Return the logarithm of how much likelier each pixel is on a wire than off it.

        Args:
            signal: from `XrayImager.signal`.
            photons: that a pixel of usual brightness counts.
        """
        found = features(signal, photons)
        count = found.shape[-1]
        square = np.zeros((count, count), dtype=np.float32)
        square[np.triu_indices(count)] = self.weight[count:] / _MOST
        # The same as `products` times the weights, without an image for each product.
        terms = found @ square + self.weight[:count].astype(np.float32)
        return np.einsum("...f,...f->...", terms, found) + np.float32(self.offset)


def features(signal: Float32[np.ndarray, "rows columns"], photons: float) -> Float32[np.ndarray, "rows columns f"]:
    """Return the features of every pixel: ridges and darkness over the noise, and the noise itself."""
    from skimage.feature import hessian_matrix, hessian_matrix_eigvals  # slow to import

    around = gaussian_filter(signal, _AROUND_PX)
    noise = np.exp(-0.5 * around) / np.float32(np.sqrt(photons))
    found = []
    for scale in SCALES_PX:
        sigma: Any = scale  # its annotation says int; it takes floats
        second = hessian_matrix(signal, sigma, mode="nearest", order="rc", use_gaussian_derivatives=False)
        largest, smallest = hessian_matrix_eigvals(second)
        # The Hessian of white noise, smoothed, falls with the third power of the scale.
        found += [scale**3 * largest / noise, scale**3 * smallest / noise]
    dark = around - gaussian_filter(signal, SCALES_PX[0])
    found += [dark / noise * SCALES_PX[0], np.log(noise)]
    return np.clip(np.stack(found, axis=-1), -_MOST, _MOST).astype(np.float32)


def products(values: Float32[np.ndarray, "*n f"]) -> Float32[np.ndarray, "*n terms"]:
    """Return features and the products of any two."""
    rows, columns = np.triu_indices(values.shape[-1])
    return np.concatenate([values, values[..., rows] * values[..., columns] / np.float32(_MOST)], axis=-1)
