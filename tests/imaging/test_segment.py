from __future__ import annotations

import numpy as np
import pytest
from shapes import empty_grid

from endopilot.errors import InputError
from endopilot.imaging import segment as segmentation
from endopilot.imaging.segment import SegmentConfig, available_methods, segment
from endopilot.types import LumenMask


def test_a_method_is_a_module_of_the_methods_package():
    assert available_methods() == ("aorta", "coronary")


@pytest.mark.parametrize(
    ("values", "expected"),
    [
        ({"method": "magic"}, "method='magic' is unknown; choose one of aorta, coronary"),
        ({"seeds": ((0.0, float("nan"), 0.0),)}, "three finite numbers"),
    ],
)
def test_a_bad_configuration_is_refused(values, expected):
    with pytest.raises(InputError, match=expected):
        SegmentConfig(**values)


@pytest.mark.parametrize("method", ["aorta", "coronary"])
def test_a_seed_outside_the_volume_is_told_with_the_volume_s_extent(method):
    grid = empty_grid((10, 20, 30), (1.0, 2.0, 3.0), (-5.0, 0.0, 100.0))
    with pytest.raises(InputError, match=r"outside the volume.*x -5…24, y 0…38, z 100…127"):
        segment(grid, SegmentConfig(method=method, seeds=((0.0, 50.0, 110.0),)))


def test_the_registry_calls_the_method_and_names_it(monkeypatch):
    """A method that finds nothing is an error; one that finds a voxel is named in the mask."""
    from endopilot.imaging.methods import aorta

    grid = empty_grid((4, 4, 4), 1.0, (0.0, 0.0, 0.0))
    found = grid.voxels.astype(bool)

    def stand_in(volume, config):
        return LumenMask(type(volume)(found, volume.spacing_mm, volume.origin_mm, volume.direction))

    monkeypatch.setattr(aorta, "segment_lumen", stand_in)
    with pytest.raises(InputError, match="found no lumen"):
        segment(grid, SegmentConfig(method="aorta"))
    found[1, 2, 3] = True
    mask = segment(grid, SegmentConfig(method="aorta"))
    assert mask.method == "aorta"
    assert np.argwhere(mask.volume.voxels).tolist() == [[1, 2, 3]]


def test_importing_the_stage_loads_no_method():
    assert not hasattr(segmentation, "MCP_Geometric")
