from __future__ import annotations

import matplotlib.image
import numpy as np
from shapes import empty_grid, positions

from endopilot.imaging.overlay_picture import draw_overlay
from endopilot.types import LumenMask, Volume


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
