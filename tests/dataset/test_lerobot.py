"""`lerobot` itself reads a dataset."""

from __future__ import annotations

import numpy as np

from endopilot.dataset.loader import read_dataset
from read_by_lerobot import read_by_lerobot


def test_lerobot_reads_a_dataset(toy_dataset):
    read, data = read_by_lerobot(toy_dataset, 250), read_dataset(toy_dataset)
    assert (read["samples"], read["episodes"], read["fps"]) == (144 * 120, 144, 2)
    assert read["task"] == "random navigation" and read["images"] == {}
    assert read["names"] == ["translation_mm_s", "rotation_rad_s"]
    assert read["episode"] == 2
    np.testing.assert_array_equal(np.float32(read["action"]), data.control[2, 10, 0])
    np.testing.assert_array_equal(
        np.float32(read["state"][2:]), [data.tip_abscissa[2, 10, 0], data.tip_offset[2, 10, 0]]
    )
    np.testing.assert_allclose(read["mean"], data.control.reshape(-1, 2).mean(axis=0), rtol=1e-3, atol=1e-5)
