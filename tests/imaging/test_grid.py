"""Grids that volumes are resampled to, outlines on them, and the picture of a mask over its CT."""

from __future__ import annotations

import matplotlib.image
import numpy as np
import pytest
from scipy import ndimage
from shapes import BLOOD_HU, FAT_HU, dice, empty_grid, inside_tube, positions, scan

from endopilot.imaging.overlay_picture import draw_overlay
from endopilot.imaging.vessel_tracking import lumen_at_half_height
from endopilot.imaging.voxels import dilated
from endopilot.types import LumenMask, Volume


@pytest.mark.parametrize("reach", [0, 1, 4, (2, 3, 7), 30])
@pytest.mark.parametrize("shape", [(9, 12, 25), (1, 3, 2)])
def test_a_dilated_mask_is_scipys_maximum_in_a_box(shape, reach):
    random = np.random.default_rng(0)
    for share in (0.003, 0.05, 0.9):
        mask = random.random(shape) < share
        before, size = mask.copy(), 2 * np.broadcast_to(reach, 3) + 1
        np.testing.assert_array_equal(dilated(mask, reach), ndimage.maximum_filter(mask, size))
        np.testing.assert_array_equal(mask, before)


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


def test_the_wall_of_a_tube_in_fat():
    found, lumen, _ = lumen_of(None, noise_hu=40.0)
    assert dice(found, lumen) > 0.93


@pytest.mark.parametrize("plaque_hu", [700.0, 1200.0])
def test_calcium_and_its_blurred_rim_are_not_lumen(plaque_hu):
    found, lumen, off_axis = lumen_of(plaque_hu)
    assert (found & (off_axis > RADIUS_MM + 0.6)).sum() < 10
    assert dice(found, lumen) > 0.9
    assert found[off_axis < RADIUS_MM - 0.7].mean() > 0.97


def test_mask_and_reference_are_outlined_in_green_and_red(tmp_path):
    grid = empty_grid((20, 24, 28), (1.0, 1.0, 2.0), (0.0, 0.0, 0.0))
    for radius, name in ((8.0, "large"), (5.0, "small")):
        ball = np.linalg.norm(positions(grid) - [14.0, 12.0, 20.0], axis=-1) < radius
        mask = LumenMask(Volume(ball, grid.spacing_mm, grid.origin_mm, grid.direction))
        draw_overlay(grid, mask, tmp_path / f"{name}.png", reference=mask if name == "small" else None)
    large, small = (matplotlib.image.imread(tmp_path / f"{name}.png")[..., :3] for name in ("large", "small"))
    green = (large[..., 1] > 0.9) & (large[..., 0] < 0.3)
    red = (small[..., 0] > 0.9) & (small[..., 1] < 0.3)
    assert green.sum() > 300
    assert red.sum() > 200
    assert sorted(file.name for file in tmp_path.iterdir()) == ["large.png", "small.png"]
