"""Vesselness: how much a place looks like the middle of a bright tube."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Bool, Float32
from scipy.ndimage import gaussian_filter


def vesselness(
    hu: Float32[np.ndarray, "nz ny nx"],
    where: Bool[np.ndarray, "nz ny nx"],
    *,
    spacing_mm: float,
    sigmas_mm: Sequence[float],
    contrast_hu: float,
) -> Float32[np.ndarray, "nz ny nx"]:
    """Return the largest response over scales: 0 where nothing is tube-like, about 1 in the middle of a bright tube.

    Of the Hessian's eigenvalues λ₁ ≤ λ₂ ≤ λ₃ at scale σ, a bright tube has λ₁ ≈ λ₂ ≪ 0; the surface of a chamber has
    only λ₁ ≪ 0. The response is therefore −σ²λ₂ (Sato et al. 1998), divided by e⁻¹ times the contrast, which is what a
    straight tube of radius √2·σ gives: its profile 1 − exp(−r²/2σ²) has −σ²·d²/dx² = u·exp(−u) with u = r²/2σ².

    Args:
        hu: image on an isotropic grid.
        where: where the response is wanted; it is 0 elsewhere. The voxels at the volume's border are left out.
        spacing_mm: distance between voxel centres, mm.
        sigmas_mm: widths of the Gaussians, mm; a tube of radius r answers most at r/√2.
        contrast_hu: HU of the lumen above its surroundings.
    """
    where = where.copy()
    for axis in range(3):
        border: list[slice | list[int]] = [slice(None)] * 3
        border[axis] = [0, -1]
        where[tuple(border)] = False
    k, j, i = np.nonzero(where)
    best = np.zeros(len(k), dtype=np.float32)
    for sigma in sigmas_mm:
        smooth = np.asarray(gaussian_filter(hu, sigma / spacing_mm, truncate=3.0))
        middle = _middle_eigenvalue(*_hessian(smooth, k, j, i))
        response = -middle * np.float32((sigma / spacing_mm) ** 2 * np.e / contrast_hu)
        np.maximum(best, response, out=best)
    result = np.zeros(hu.shape, dtype=np.float32)
    result[k, j, i] = best
    return result


def _hessian(smooth: np.ndarray, k: np.ndarray, j: np.ndarray, i: np.ndarray) -> tuple[np.ndarray, ...]:
    """Return the second differences xx, yy, zz, xy, xz, yz at some voxels, HU per voxel²."""

    def at(dk: int, dj: int, di: int) -> np.ndarray:
        return smooth[k + dk, j + dj, i + di]

    centre = 2 * at(0, 0, 0)
    return (
        at(0, 0, 1) + at(0, 0, -1) - centre,
        at(0, 1, 0) + at(0, -1, 0) - centre,
        at(1, 0, 0) + at(-1, 0, 0) - centre,
        (at(0, 1, 1) + at(0, -1, -1) - at(0, 1, -1) - at(0, -1, 1)) / 4,
        (at(1, 0, 1) + at(-1, 0, -1) - at(1, 0, -1) - at(-1, 0, 1)) / 4,
        (at(1, 1, 0) + at(-1, -1, 0) - at(1, -1, 0) - at(-1, 1, 0)) / 4,
    )


def _middle_eigenvalue(
    xx: np.ndarray, yy: np.ndarray, zz: np.ndarray, xy: np.ndarray, xz: np.ndarray, yz: np.ndarray
) -> np.ndarray:
    """Return the middle eigenvalue of symmetric 3×3 matrices, by the trigonometric solution (Smith 1961).

    `skimage.feature.hessian_matrix_eigvals` asks LAPACK matrix by matrix, which takes 25 times as long.
    """
    mean = (xx + yy + zz) / 3
    a, b, c = xx - mean, yy - mean, zz - mean
    spread = np.sqrt(np.maximum((a * a + b * b + c * c + 2 * (xy * xy + xz * xz + yz * yz)) / 6, 1e-12))
    determinant = a * (b * c - yz * yz) - xy * (xy * c - yz * xz) + xz * (xy * yz - b * xz)
    angle = np.arccos(np.clip(determinant / (2 * spread**3), -1, 1)) / 3
    return mean + 2 * spread * np.cos(angle - 2 * np.pi / 3)
