"""Volumes and masks in files, grids that they are resampled to, and the picture of a mask over its CT."""

from __future__ import annotations

import gzip
import json
import subprocess
import sys

import matplotlib.image
import numpy as np
import pytest
import SimpleITK as sitk
from scipy import ndimage
from shapes import BLOOD_HU, FAT_HU, dice, empty_grid, inside_tube, positions, scan

from endopilot.errors import InputError
from endopilot.imaging.overlay_picture import draw_overlay
from endopilot.imaging.vessel_tracking import lumen_at_half_height
from endopilot.imaging.volume import check_output, read_mask, read_volume, write_mask, write_volume
from endopilot.imaging.voxels import dilated
from endopilot.types import Insertion, LumenMask, Volume


def _oblique_volume(dtype=np.int16) -> Volume:
    """Return an anisotropic volume turned by 20° about z, with the values of a linear ramp in LPS mm."""
    c, s = np.cos(np.radians(20)), np.sin(np.radians(20))
    direction = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
    volume = Volume(np.zeros((5, 6, 7)), np.array([0.4, 0.5, 1.25]), np.array([-30.0, 12.0, 700.0]), direction)
    k, j, i = np.indices((5, 6, 7))
    world = volume.index_to_world(np.stack([i, j, k], axis=-1).astype(float))
    ramp = np.round(world @ [10.0, -7.0, 1.0])
    return Volume(ramp.astype(dtype), volume.spacing_mm, volume.origin_mm, direction)


def _image(voxels: np.ndarray, **keywords) -> sitk.Image:
    return sitk.GetImageFromArray(voxels, **keywords)


@pytest.mark.parametrize("suffix", [".nii.gz", ".nii", ".nrrd", ".mha"])
def test_a_volume_survives_writing_and_reading(tmp_path, suffix):
    volume = _oblique_volume()
    write_volume(volume, tmp_path / f"ct{suffix}")
    again = read_volume(tmp_path / f"ct{suffix}")
    assert again.voxels.dtype == np.int16
    np.testing.assert_array_equal(again.voxels, volume.voxels)
    np.testing.assert_allclose(again.spacing_mm, volume.spacing_mm, atol=1e-5)
    np.testing.assert_allclose(again.origin_mm, volume.origin_mm, atol=1e-3)
    np.testing.assert_allclose(again.direction, volume.direction, atol=1e-5)


def test_bad_volumes_are_refused_in_one_line(tmp_path):
    sitk.WriteImage(_image(np.zeros((3, 4, 5, 6), np.int16), isVector=False), tmp_path / "four.nii.gz")
    sitk.WriteImage(_image(np.zeros((1, 4, 5, 6), np.int16), isVector=False), tmp_path / "one.nii.gz")
    assert read_volume(tmp_path / "one.nii.gz").voxels.shape == (4, 5, 6)
    sitk.WriteImage(_image(np.zeros((4, 5, 6, 3), np.uint8), isVector=True), tmp_path / "rgb.nrrd")
    sitk.WriteImage(_image(np.zeros((6, 6), np.int16)), tmp_path / "slice.mha")
    write_volume(_oblique_volume(), tmp_path / "cut.nii.gz")
    (tmp_path / "cut.nii.gz").write_bytes((tmp_path / "cut.nii.gz").read_bytes()[:-60])
    (tmp_path / "text.nii.gz").write_bytes(gzip.compress(b"not an image"))
    (tmp_path / "photo.jpg").write_bytes(b"\xff\xd8\xff")
    nan = _oblique_volume(np.float32)
    nan.voxels[1, 2, 3] = np.nan
    write_volume(nan, tmp_path / "nan.nrrd")
    (tmp_path / "empty").mkdir()
    for name, expected in {
        "nowhere.nii.gz": "no such file",
        "four.nii.gz": "4-D .6×5×4×3.*3-D volume",
        "rgb.nrrd": "3 values in every voxel",
        "slice.mha": "no volume",
        "cut.nii.gz": "truncated or damaged",
        "text.nii.gz": "does not match its suffix",
        "photo.jpg": "unknown format",
        "nan.nrrd": "not finite",
        "empty": "no DICOM image",
    }.items():
        with pytest.raises(InputError, match=rf"{name}: .*{expected}"):
            read_volume(tmp_path / name)


def test_what_a_format_has_not_is_refused(tmp_path):
    for write in (
        lambda path: write_volume(_oblique_volume(), path),
        lambda path: write_mask(_mask(), path, manifest={}),
    ):
        with pytest.raises(InputError, match="unknown format"):
            write(tmp_path / "ct.png")
    assert not list(tmp_path.iterdir())
    write_volume(_oblique_volume(), tmp_path / "ct.nrrd")
    with pytest.raises(InputError, match="only DICOM has series"):
        read_volume(tmp_path / "ct.nrrd", series="3")


_ON_A_FULL_DISK = """
import resource, sys
import numpy as np
from pathlib import Path
from endopilot.errors import InputError
from endopilot.imaging.volume import write_mask, write_volume
from endopilot.types import LumenMask, Volume
noise = np.random.default_rng(0).integers(0, 2, (40, 60, 70)) > 0
volume = Volume(noise, np.ones(3), np.zeros(3), np.eye(3))
resource.setrlimit(resource.RLIMIT_FSIZE, (9000, 9000))
for name in sys.argv[2:]:
    path = Path(sys.argv[1]) / name
    for write in (write_volume, lambda volume, path: write_mask(LumenMask(volume), path, manifest={})):
        try:
            write(volume, path)
        except InputError as error:
            assert "ulimit -f" in str(error), error
        else:
            raise SystemExit(f"{name} was written whole to a disk that has no room for it")
"""


def test_a_file_that_does_not_arrive_whole_is_refused_and_leaves_nothing(tmp_path):
    """ITK's writer of NIfTI reports nothing on a full disk: half a file was left, and the command ended well."""
    names = ["v.nii", "v.nii.gz", "v.nrrd", "v.mha"]
    subprocess.run([sys.executable, "-c", _ON_A_FULL_DISK, str(tmp_path), *names], check=True)
    assert not list(tmp_path.iterdir())


def _mask() -> LumenMask:
    ramp = _oblique_volume()
    inside = Volume(ramp.voxels > np.median(ramp.voxels), ramp.spacing_mm, ramp.origin_mm, ramp.direction)
    ostium = Insertion(np.array([1.0, 2.0, 3.0]), np.array([0.6, 0.0, 0.8]))
    return LumenMask(inside, ostium, "coronary")


def test_a_mask_keeps_its_ostium_and_method(tmp_path):
    mask = _mask()
    write_mask(mask, tmp_path / "rca.nii.gz", manifest={"seed": 7})
    again = read_mask(tmp_path / "rca.nii.gz")
    assert again.volume.voxels.dtype == bool
    np.testing.assert_array_equal(again.volume.voxels, mask.volume.voxels)
    assert again.ostium is not None and mask.ostium is not None
    np.testing.assert_allclose(again.ostium.position, mask.ostium.position)
    np.testing.assert_allclose(again.ostium.direction, mask.ostium.direction)
    assert again.method == "coronary"
    assert json.loads((tmp_path / "rca.json").read_text())["manifest"] == {"seed": 7}


def test_a_mask_without_sidecar_or_with_a_stranger_beside_it_has_no_ostium(tmp_path):
    write_volume(_mask().volume, tmp_path / "rca.nrrd")
    assert read_mask(tmp_path / "rca.nrrd").ostium is None
    (tmp_path / "rca.json").write_text('{"Modality": "CT"}')
    assert read_mask(tmp_path / "rca.nrrd").method == "given"


def test_the_sidecar_of_another_mask_is_not_taken_and_a_warning_says_so(tmp_path):
    mask = _mask()
    write_mask(mask, tmp_path / "v.nii.gz", manifest={})
    write_volume(mask.volume, tmp_path / "v.nrrd")
    other = read_mask(tmp_path / "v.nrrd")
    assert other.ostium is None and other.method == "given"
    (told,) = other.warnings
    assert "v.json is the record of v.nii.gz, and was left out for v.nrrd" in told
    assert "--ostium-mm 1 2 3" in told
    # the same file with other voxels
    changed = mask.volume.voxels.copy()
    changed[0, 0, 0] ^= True
    write_volume(Volume(changed, *_grid(mask.volume)), tmp_path / "v.nii.gz")
    changed_mask = read_mask(tmp_path / "v.nii.gz")
    assert changed_mask.ostium is None and "of v.nii.gz before it was changed" in changed_mask.warnings[0]
    # one of a version that did not name the mask
    content = json.loads((tmp_path / "v.json").read_text())
    del content["mask"]
    (tmp_path / "v.json").write_text(json.dumps(content))
    assert "of a mask that it does not name" in read_mask(tmp_path / "v.nrrd").warnings[0]


def test_a_json_of_another_kind_is_not_replaced(tmp_path):
    own = tmp_path / "v.json"
    for content in ('{"Modality": "CT"}', "[1, 2", '{"ostium": null}'):
        own.write_text(content)
        for write in (
            lambda path: check_output(path, mask=True),
            lambda path: write_mask(_mask(), path, manifest={}),
        ):
            with pytest.raises(InputError, match=r"v\.json: is there already and is not the record of v\.nrrd"):
                write(tmp_path / "v.nrrd")
        assert own.read_text() == content
    own.unlink()
    write_mask(_mask(), tmp_path / "v.nrrd", manifest={"run": 1})
    write_mask(_mask(), tmp_path / "v.nrrd", manifest={"run": 2})
    assert json.loads(own.read_text())["manifest"] == {"run": 2}
    with pytest.raises(InputError, match=r"not the record of v\.mha"):
        check_output(tmp_path / "v.mha", mask=True)


def _grid(volume: Volume) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    return volume.spacing_mm, volume.origin_mm, volume.direction


def test_a_broken_sidecar_is_refused(tmp_path):
    write_volume(_mask().volume, tmp_path / "rca.nrrd")
    for ostium in ('{"position_mm": [1, 2]}', '{"position_mm": [1, 2, 3], "direction": [0, 0, 0]}', "5"):
        (tmp_path / "rca.json").write_text(f'{{"ostium": {ostium}}}')
        with pytest.raises(InputError, match=r"rca\.json: ostium needs position_mm and direction"):
            read_mask(tmp_path / "rca.nrrd")


def test_what_is_no_mask_is_refused(tmp_path):
    sitk.WriteImage(_image(np.zeros((5, 6, 7), np.uint8)), tmp_path / "empty.nii.gz")
    sitk.WriteImage(_image(np.full((5, 6, 7), -90, np.int16)), tmp_path / "ct.nii.gz")
    sitk.WriteImage(_image(np.full((5, 6, 7), 0.5, np.float32)), tmp_path / "probability.nii.gz")
    for name, expected in {"empty": "mask is empty", "ct": "are no mask", "probability": "are no mask"}.items():
        with pytest.raises(InputError, match=expected):
            read_mask(tmp_path / f"{name}.nii.gz")
    noise = np.random.default_rng(0).normal(0, 30, (5, 6, 7)).astype(np.int16)
    sitk.WriteImage(_image(noise), tmp_path / "noise.nii.gz")
    for label in (None, 1):
        with pytest.raises(InputError, match=r"are no mask of labels: a CT is segmented first"):
            read_mask(tmp_path / "noise.nii.gz", label=label)
    with pytest.raises(InputError, match="no such file"):
        read_mask(tmp_path / "nowhere.nii.gz")


def _depth() -> np.ndarray:
    """Return the depth inside a bent tube of 2.3 mm radius, on voxels of 0.6 mm, mm; negative outside."""
    k, j, i = np.indices((50, 34, 30)) * 0.6
    return 2.3 - np.hypot(j - 10.0 - 2.0 * np.sin(k / 5.0), i - 9.0)


@pytest.mark.parametrize(
    ("make", "threshold", "said"),
    [
        (lambda depth: 1 / (1 + np.exp(-4 * depth)), 0.5, "probabilities or a mask resampled"),
        (lambda depth: np.round(200 * np.clip(depth / 0.6 + 0.5, 0, 1)).astype(np.uint8), 100, "resampled"),
        (lambda depth: np.round(3000 * np.clip(depth / 0.6 + 0.5, 0, 1)).astype(np.int16), 1500, "a CT is segmented"),
        (lambda depth: np.clip(depth / 0.6 + 0.5, 0, 1).astype(np.float32), 0.5, "resampled"),
        (lambda depth: depth, 0, "signed distances or level sets"),
        (lambda depth: -depth.astype(np.float32), 0, "signed distances or level sets"),
        (lambda depth: np.round(100 * depth).astype(np.int16), 0, "signed distances or level sets"),
    ],
    ids=["probability", "resampled", "large numbers", "share", "distance", "level set", "whole distance"],
)
def test_a_grey_mask_is_named_with_the_threshold_that_takes_it(tmp_path, make, threshold, said):
    depth = _depth()
    write_volume(Volume(make(depth), np.full(3, 0.6), np.zeros(3), np.eye(3)), tmp_path / "grey.nrrd")
    with pytest.raises(InputError, match=rf"are no mask.*{said}.*threshold={threshold} \(--threshold {threshold}\)"):
        read_mask(tmp_path / "grey.nrrd")
    mask = read_mask(tmp_path / "grey.nrrd", threshold=float(threshold))
    wrong = mask.volume.voxels != (depth > 0)
    assert not wrong[np.abs(depth) > 0.01].any()
    for bad in (1e9, -1e9, float("nan")):
        with pytest.raises(InputError, match="give one between"):
            read_mask(tmp_path / "grey.nrrd", threshold=bad)
    with pytest.raises(InputError, match="give either"):
        read_mask(tmp_path / "grey.nrrd", threshold=float(threshold), label=1)


@pytest.mark.parametrize("top", [1, 255, 420])
@pytest.mark.parametrize("dtype", [np.uint16, np.int64, np.float32])
def test_a_mask_of_one_value_is_taken_whatever_its_type(tmp_path, top, dtype):
    inside = _depth() > 0
    write_volume(Volume((inside * top).astype(dtype), np.ones(3), np.zeros(3), np.eye(3)), tmp_path / "m.mha")
    np.testing.assert_array_equal(read_mask(tmp_path / "m.mha").volume.voxels, inside)
    write_volume(Volume(np.full((5, 6, 7), top, dtype), np.ones(3), np.zeros(3), np.eye(3)), tmp_path / "m.mha")
    assert read_mask(tmp_path / "m.mha").volume.voxels.all()


def test_label_maps_are_not_taken_for_grey_masks(tmp_path):
    depth = _depth()
    slices = 1 + np.indices(depth.shape)[0] // 5
    for labels in (np.where(depth > 0, slices, 0), np.where(depth > 0, 2, np.where(depth > -1.2, 1, 0))):
        labels[0, 0, 0] = -1  # what a network was to ignore
        write_volume(Volume(labels.astype(np.int16), np.ones(3), np.zeros(3), np.eye(3)), tmp_path / "labels.nrrd")
        with pytest.raises(InputError, match=r"labels \(-1, 1, 2"):
            read_mask(tmp_path / "labels.nrrd")
        np.testing.assert_array_equal(read_mask(tmp_path / "labels.nrrd", label=2).volume.voxels, labels == 2)


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
