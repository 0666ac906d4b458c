"""Masks of lines, and COCO's code of masks."""

from __future__ import annotations

import numpy as np
import pytest

from endopilot.angiograms.cine import box_of, encoded, laid_together, stroke


def test_a_stroke_covers_the_pixels_within_its_half_width():
    mask = stroke(np.array([[5.0, 10.0], [20.0, 10.0]]), np.array([2.0, 2.0]), 32)
    assert mask[8:13, 5:21].all() and not mask[[7, 13]].any()
    assert mask[10, 3] and not mask[10, 2]  # its end is round
    assert box_of(mask) == [3, 8, 20, 5]


def test_a_thin_line_has_no_gaps_and_what_lies_outside_is_left_out():
    line = np.array([[-40.0, -3.0], [10.3, 17.2], [80.0, 60.0]])
    mask = stroke(line, np.full(3, 0.1), 48)
    assert mask[:, :11].any(axis=0).all() and mask.sum() < 4 * 96
    assert not stroke(line + 500, np.full(3, 0.1), 48).any()


@pytest.mark.parametrize("kind", ["empty", "full", "random", "bar"])
def test_pycocotools_reads_what_was_encoded(kind):
    coco = pytest.importorskip("pycocotools.mask", reason="pip install pycocotools")
    mask = np.zeros((40, 300), dtype=bool)
    if kind == "full":
        mask[:] = True
    elif kind == "random":
        mask = np.random.default_rng(0).random(mask.shape) < 0.3
    elif kind == "bar":
        mask[3:5, 20:290] = True
        mask[:, 7] = True
    np.testing.assert_array_equal(coco.decode(coco.frPyObjects(encoded(mask), *mask.shape)), mask)


def test_masks_lie_together_as_bits():
    a, b = np.eye(3, dtype=bool), np.ones((3, 3), dtype=bool)
    together = laid_together({"vessel": a, "wire": b})
    assert together[0, 0] == 17 and together[0, 1] == 16
