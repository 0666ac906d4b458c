"""What the scanner adds to a phantom: motion of the heart, steps between heart beats, noise and blur."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float, Float32
from scipy.ndimage import gaussian_filter1d, shift

from endopilot.phantom.painter import SLAB, Painter

_PHASES = 7  # positions of a moving heart that are averaged
_HELD_MM = 4.0  # the motion fades over this depth below the pericardium, mm


def smear(
    image: Float32[np.ndarray, "nz ny nx"],
    painter: Painter,
    heart: Float[np.ndarray, "mz my mx"],
    spacing_mm: tuple[float, float, float],
    motion_mm: float,
    generator: np.random.Generator,
) -> None:
    """Average the heart over the path of its motion during the scan, in a random direction about the anatomy, in place;
    it rests longest at the ends. `heart` is the depth below the pericardium on the painter's coarse grid, mm; voxel
    sizes are along k, j and i."""
    path = generator.normal(size=3)
    path *= motion_mm / (np.linalg.norm(path) * np.array(spacing_mm))
    still = image.copy()
    places, weights = np.linspace(-0.5, 0.5, _PHASES), np.linspace(0.5, 1.5, _PHASES)
    places = places - (weights @ places) / weights.sum()
    image[...] = 0
    for place, weight in zip(places, weights / weights.sum(), strict=True):
        image += np.float32(weight) * shift(still, place * path, order=1, mode="nearest")
    _hold_chest(image, still, painter, heart)


def misregister(
    image: Float32[np.ndarray, "nz ny nx"],
    painter: Painter,
    heart: Float[np.ndarray, "mz my mx"],
    spacing_mm: tuple[float, float, float],
    step_mm: float,
    slab_mm: float,
    generator: np.random.Generator,
) -> None:
    """Displace the heart from slab to slab, in place, as differing heart beats do: in turn half of `step_mm` to either
    side of its mean along one random direction; the first slab's height is random. `heart` is as for `smear`."""
    path = generator.normal(size=3)
    path *= 0.5 * step_mm / (np.linalg.norm(path) * np.array(spacing_mm))
    still = image.copy()
    slab = np.floor((np.arange(len(image)) * spacing_mm[0] + generator.uniform(0, slab_mm)) / slab_mm).astype(int)
    for parity, sign in ((0, 1.0), (1, -1.0)):
        rows = slab % 2 == parity
        image[rows] = shift(still, sign * path, order=1, mode="nearest")[rows]
    _hold_chest(image, still, painter, heart)


def _hold_chest(image: np.ndarray, still: np.ndarray, painter: Painter, heart: np.ndarray) -> None:
    """Put back what does not move with the heart: the change fades out towards the pericardium."""
    for begin in range(0, len(image), SLAB):
        rows = slice(begin, begin + SLAB)
        found = painter.fine(heart, rows)
        moves = np.zeros(image[rows].shape, dtype=np.float32)
        if found is not None:
            fine, (box_y, box_x) = found
            moves[:, box_y, box_x] = np.clip(fine / np.float32(_HELD_MM), 0, 1)
        image[rows] = still[rows] + moves * (image[rows] - still[rows])


def scan(
    image: Float32[np.ndarray, "nz ny nx"],
    spacing_mm: tuple[float, float, float],
    psf_mm: float,
    noise_hu: float,
    grain_mm: float,
    generator: np.random.Generator,
) -> None:
    """Add noise and blur, in place, both shaped by the reconstruction kernel; iterative reconstruction's grain is
    coarser. `psf_mm` and the additional `grain_mm` are widths at half height; `noise_hu` is the result's SD."""
    sigmas = [psf_mm / np.sqrt(8 * np.log(2)) / step for step in spacing_mm]
    if grain_mm == 0:
        gain = _gain(sigmas)
        for begin in range(0, len(image), SLAB):
            slab = image[begin : begin + SLAB]
            slab += generator.standard_normal(slab.shape, dtype=np.float32) * np.float32(noise_hu / gain)
    for axis, sigma in enumerate(sigmas):
        gaussian_filter1d(image, sigma, axis=axis, truncate=3.0, output=image)
    if grain_mm > 0:
        noise = generator.standard_normal(image.shape, dtype=np.float32)
        wider = [np.hypot(psf_mm, grain_mm) / np.sqrt(8 * np.log(2)) / step for step in spacing_mm]
        for axis, sigma in enumerate(wider):
            gaussian_filter1d(noise, sigma, axis=axis, truncate=3.0, output=noise)
        noise *= np.float32(noise_hu / _gain(wider))
        image += noise


def _gain(sigmas: Sequence[float]) -> float:
    """Return by which factor the blur lessens the standard deviation of white noise."""
    impulse = np.zeros(33)
    impulse[16] = 1.0
    return float(np.prod([np.linalg.norm(gaussian_filter1d(impulse, sigma, truncate=3.0)) for sigma in sigmas]))
