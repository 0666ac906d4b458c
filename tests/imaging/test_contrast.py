"""Contrast on the real CT angiogram: blood counts, bone does not, at any noise."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from endopilot.errors import InputError
from endopilot.imaging.segment import refuse_without_contrast
from endopilot.imaging.volume import read_volume
from endopilot.types import Volume

_SAMPLE = Path(__file__).parents[2].parent / "shared" / "data" / "cta_thorax" / "cta_thorax_1p5mm.nii.gz"


@pytest.fixture(scope="module")
def thorax() -> Volume:
    if not _SAMPLE.exists():
        pytest.skip(f"{_SAMPLE} is absent: the real CT angiogram is not part of the repository")
    return read_volume(_SAMPLE)


@pytest.mark.parametrize("noise_hu", [0.0, 40.0])
def test_blood_is_distinguished_from_bone(thorax, noise_hu):
    """The whole thorax holds contrast; a box around ten vertebrae, in front of which the aorta is cut off, does not."""
    noise = np.random.default_rng(0).normal(0.0, noise_hu, thorax.voxels.shape)
    noisy = Volume(thorax.voxels + noise, thorax.spacing_mm, thorax.origin_mm, thorax.direction)
    refuse_without_contrast(noisy)
    corners = noisy.world_to_index(np.array([[-45.0, -122.0, 560.0], [8.0, -70.0, 760.0]])).round().astype(int)
    box = tuple(slice(a, b) for a, b in zip(corners[0, ::-1], corners[1, ::-1], strict=True))
    spine = Volume(noisy.voxels[box], noisy.spacing_mm, noisy.index_to_world(corners[0].astype(float)), noisy.direction)
    assert (spine.voxels > 130).mean() > 0.15  # bone
    with pytest.raises(InputError, match="no contrast: homogeneous soft tissue peaks at"):
        refuse_without_contrast(spine)


@pytest.mark.parametrize("thickness_mm", [4.0, 8.0, 16.0])
def test_a_thin_slab_of_an_aorta_holds_contrast(thickness_mm):
    """Its cross-section of 7 cm² is that of any pool; its volume is what the slab leaves of it."""
    shape = (round(thickness_mm / 0.5), 160, 160)
    j, i = np.indices(shape[1:]) * 0.4
    inside = np.hypot(j - 32.0, i - 32.0) < 15.0
    noise = np.random.default_rng(0).normal(0.0, 25.0, shape)
    for blood_hu in (400.0, 45.0):
        voxels = (np.where(inside, blood_hu, -90.0) + noise).astype(np.int16)
        slab = Volume(voxels, np.array([0.4, 0.4, 0.5]), np.zeros(3), np.eye(3))
        if blood_hu > 130.0:
            refuse_without_contrast(slab)
            continue
        with pytest.raises(
            InputError, match=rf"only {thickness_mm:.0f} mm thick.*too little to recognise blood"
        ) as caught:
            refuse_without_contrast(slab)
        assert "no contrast" not in str(caught.value)
