"""What is computed on a grid, against SciPy."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import ndimage

from endopilot.imaging.grid import dilated


@pytest.mark.parametrize("reach", [0, 1, 4, (2, 3, 7), 30])
@pytest.mark.parametrize("shape", [(9, 12, 25), (1, 3, 2)])
def test_a_dilated_mask_is_scipys_maximum_in_a_box(shape, reach):
    random = np.random.default_rng(0)
    for share in (0.003, 0.05, 0.9):
        mask = random.random(shape) < share
        before, size = mask.copy(), 2 * np.broadcast_to(reach, 3) + 1
        np.testing.assert_array_equal(dilated(mask, reach), ndimage.maximum_filter(mask, size))
        np.testing.assert_array_equal(mask, before)
