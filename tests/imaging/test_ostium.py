"""The ostium of an artery that leaves the aorta at a slant, as left coronary arteries do."""

from __future__ import annotations

import numpy as np
import pytest
from shapes import empty_grid, positions

from endopilot.imaging.aortic_root import find_ostium

AORTA_MM, ARTERY_MM, LENGTH_MM = 14.0, 2.8, 20.0


@pytest.mark.parametrize("slant_deg", [0.0, 40.0, 60.0])
def test_the_ostium_lies_on_the_aortas_wall_and_on_the_arterys_axis(slant_deg):
    grid = empty_grid((110, 90, 130), (0.5, 0.5, 0.5), (-33.0, -22.0, -25.0))
    place = positions(grid)
    slant = np.deg2rad(slant_deg)
    direction = np.array([np.cos(slant), 0.0, np.sin(slant)])  # the aorta's wall passes through the origin, normal to x
    aorta = np.hypot(place[..., 0] + AORTA_MM, place[..., 1]) < AORTA_MM
    along = np.clip(place @ direction, -AORTA_MM, LENGTH_MM)
    artery = np.linalg.norm(place - along[..., None] * direction, axis=-1) < ARTERY_MM
    # The tracked path begins at the artery's edge, where that comes nearest to the aorta.
    begin = 3.0 * direction + 1.2 * ARTERY_MM * np.array([-np.sin(slant), 0.0, np.cos(slant)])
    share = np.linspace(0.0, 1.0, 60)[:, None]
    path = (1 - share) * (begin + share * 12.0 * direction) + share * LENGTH_MM * direction
    ostium, _ = find_ostium(path, aorta | artery, aorta, grid)
    assert np.linalg.norm(ostium.position) < 0.5
    assert ostium.direction @ direction > 0.97
