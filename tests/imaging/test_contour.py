"""The wall at half height, beside fat and beside calcium."""

from __future__ import annotations

import numpy as np
import pytest
from shapes import BLOOD_HU, FAT_HU, dice, empty_grid, inside_tube, positions, scan

from endopilot.imaging.contour import lumen_at_half_height

RADIUS_MM = 1.6
AXIS = np.linspace([0.0, 0.0, -12.0], [0.0, 0.0, 12.0], 97)


def lumen_of(plaque_hu: float | None, seed: int = 0, noise_hu: float = 20.0):
    grid = empty_grid((50, 36, 36), (0.4, 0.4, 0.5), (-7.0, -7.0, -12.2))
    x = positions(grid)
    lumen = inside_tube(grid, AXIS, RADIUS_MM)
    hu = np.where(inside_tube(grid, AXIS, RADIUS_MM + 0.5), 40.0, FAT_HU)
    if plaque_hu is not None:
        hu[np.linalg.norm((x - [RADIUS_MM + 0.5, 0.0, 0.0]) / [0.9, 1.2, 3.0], axis=-1) < 1] = plaque_hu
    hu[lumen] = BLOOD_HU
    volume = scan(grid, hu, noise_hu=noise_hu, seed=seed)
    found = lumen_at_half_height(
        volume, AXIS, np.full(len(AXIS), RADIUS_MM), BLOOD_HU, np.zeros(lumen.shape, dtype=bool)
    )
    return found, lumen, np.hypot(x[..., 0], x[..., 1])


@pytest.mark.parametrize("noise_hu", [10.0, 40.0])
def test_the_wall_of_a_tube_in_fat(noise_hu):
    found, lumen, _ = lumen_of(None, noise_hu=noise_hu)
    assert dice(found, lumen) > 0.93


@pytest.mark.parametrize("plaque_hu", [700.0, 1200.0])
def test_calcium_and_its_blurred_rim_are_not_lumen(plaque_hu):
    found, lumen, off_axis = lumen_of(plaque_hu)
    assert (found & (off_axis > RADIUS_MM + 0.6)).sum() < 10
    assert dice(found, lumen) > 0.9
    assert found[off_axis < RADIUS_MM - 0.7].mean() > 0.97
