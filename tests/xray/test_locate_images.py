"""X-ray images of one's own: their geometry, times and light, and the tip in cines whose truth is known."""

from __future__ import annotations

import warnings
from dataclasses import replace
from pathlib import Path

import numpy as np
import pydicom
import pytest
from PIL import Image
from pydicom.uid import ExplicitVRLittleEndian

from endopilot import make_angiograms
from endopilot.angiograms.config import AngiogramsConfig
from endopilot.atlas.atlas import AtlasConfig, make_patient
from endopilot.cli import command_of
from endopilot.errors import InputError
from endopilot.xray.carm import CArmGeometry, Pose
from endopilot.xray.cine import XrayCine, read_cine
from endopilot.xray.image import ImageConfig, XrayImager
from endopilot.xray.locate_images import locate_in_images

VIEW = (-20.0, 25.0)
CONFIG = AngiogramsConfig(
    cines=1, seconds=1.5, frames_per_second=4, injected_share=1.0, device_share=1.0, dose=(4.0, 6.0), seed=3,
    injection_ml_s=(0.5, 1.0), motion="still", view_angles_deg=(VIEW,),
    image=ImageConfig(pixels=256, geometry=CArmGeometry(pixel_mm=0.45)),
)  # fmt: skip


@pytest.fixture(scope="module")
def made(vessel, tmp_path_factory) -> Path:
    """Return a cine of `endopilot angiograms`, of a patient who lies in a drawn pose."""
    output = tmp_path_factory.mktemp("cine") / "made"
    make_angiograms([vessel], output=output, device="workhorse-014", config=CONFIG)
    return output / "cines" / "fork-0000"


def changed(made: Path, path: Path, **values) -> Path:
    """Return the cine with other tags; None takes a tag away."""
    header = pydicom.dcmread(made / "cine.dcm")
    for name, value in values.items():
        if value is None:
            del header[name]
        else:
            setattr(header, name, value)
    header.save_as(path)
    return path


def otherwise(made: Path, path: Path) -> Path:
    """Return the cine as others might store it: 8 bits as a monitor shows them, mirrored, lower, with other tags."""
    header = pydicom.dcmread(made / "cine.dcm")
    frames = np.stack([np.asarray(Image.open(one)) for one in sorted((made / "frames").iterdir())])
    frames = np.ascontiguousarray(frames[:, 8:-8, ::-1])
    del header.DistanceSourceToPatient, header.FrameTime, header.WindowCenter, header.WindowWidth
    header.FrameTimeVector = [0, *[250] * (len(frames) - 1)]
    header.FrameIncrementPointer, header.PixelIntensityRelationship = 0x00181065, "DISP"
    header.BitsAllocated, header.BitsStored, header.HighBit = 8, 8, 7
    header.Rows, header.PatientOrientation = frames.shape[1], ["R", "F"]
    header.PixelData, header.file_meta.TransferSyntaxUID = frames.tobytes(), ExplicitVRLittleEndian
    header.save_as(path)
    return path


def test_a_cine_of_ones_own_is_read_back_and_the_tip_is_found(made, fork, tmp_path) -> None:
    given = [str(made.parents[1] / "patients" / "fork"), str(made / "cine.dcm"), "-o", str(tmp_path / "tips.csv")]
    figures = command_of("locate").run([*given, "--page", str(tmp_path / "tips.html")], shown=False)
    assert figures["agreement"] > 0.9 and figures["registered"].startswith("by contrast")
    table = np.genfromtxt(tmp_path / "tips.csv", delimiter=",", names=True, dtype=None, encoding="utf-8")
    found = np.column_stack([table[f"tip_{axis}_mm"] for axis in "xyz"])
    truth = np.load(made / "truth.npz")["wire_mm"][:, 0]
    assert np.median(np.linalg.norm(found - truth, axis=1)) < 1.0
    assert "data:image/png" in (tmp_path / "tips.html").read_text()


def test_nothing_is_seen_behind_the_collimator(made) -> None:
    cine, header = read_cine(made / "cine.dcm"), pydicom.dcmread(made / "cine.dcm")
    rows, columns = (np.flatnonzero(cine.field().any(axis=axis)) for axis in (1, 0))
    upper, lower = header.ShutterUpperHorizontalEdge, header.ShutterLowerHorizontalEdge
    edges = np.array([upper, lower, header.ShutterLeftVerticalEdge, header.ShutterRightVerticalEdge])
    inside = np.array([rows[0], rows[-1], columns[0], columns[-1]])
    assert ((inside - edges) * [1, -1, 1, -1] >= 2).all() and np.abs(inside - edges).max() <= 10


def test_what_another_c_arm_stores_is_read_alike(made, fork, wire, tmp_path) -> None:
    own, other = read_cine(made / "cine.dcm"), read_cine(otherwise(made, tmp_path / "other.dcm"))
    assert other.camera.geometry.source_to_isocenter_mm == pytest.approx(765, abs=0.1)
    assert other.times_s.tolist() == pytest.approx(own.times_s.tolist())
    assert other.signals.shape == own.signals.shape
    shown = (np.abs(own.signals) < 0.8)[:, 8:-8]  # a monitor shows 0.9 powers of e either way, and 0.007 a grey value
    assert np.abs(other.signals - own.signals)[:, 8:-8][shown].max() < 0.02
    assert any("mirrored" in note for note in other.notes) and any("padded" in note for note in other.notes)
    linear = np.exp(own.signals) * 1000  # and rounded down
    path = changed(
        made, tmp_path / "linear.dcm", PixelIntensityRelationship="LIN", PixelData=linear.astype("<u2").tobytes()
    )
    assert np.abs(read_cine(path).signals - own.signals).max() < 0.01


def test_angles_of_another_sign_and_a_mirrored_image_are_found_out(made, wire) -> None:
    anatomy = make_patient(AtlasConfig(seed=5), 0)
    imager = XrayImager(anatomy, wire, config=CONFIG.image)
    plane = imager.plane((-30.0, 20.0))
    signals = np.stack([imager.signal(plane, np.zeros((0, 3)), contrast=float(k), seed=k) for k in (0, 1)])
    known = read_cine(made / "cine.dcm").camera
    cine = XrayCine(made, signals[..., ::-1], np.arange(2.0), replace(known, angles_deg=(-30.0, -20.0)), ())
    found = locate_in_images(anatomy, cines=[cine], device=wire)
    (said,) = found.notes
    assert "PositionerSecondaryAngle has the other sign" in said and "mirrored left to right" in said
    assert found.cines[0].camera.angles_deg == (-30.0, 20.0)
    assert found.registration is not None and found.registration.correlation > 0.95
    assert [one.status for one in found.tips] == ["not found"] * 2


def test_two_planes_are_read_together(made, fork, wire) -> None:
    imager, known = XrayImager(fork, wire, config=CONFIG.image), read_cine(made / "cine.dcm").camera
    at, cines = np.arange(30.0, -30.0, -0.5), []
    nodes = np.stack([0.0 * at, 0.4 + 0.0 * at, at], axis=-1)
    for angles in ((-30.0, 0.0), (60.0, 0.0)):
        plane = imager.plane(angles, pose=Pose(translation_mm=np.array([8.0, -3.0, 6.0])))
        frames = [imager.signal(plane, nodes, contrast=k, dose=4.0, seed=int(k)) for k in (0.0, 1.0)]
        cines.append(XrayCine(made, np.stack(frames), np.arange(2.0), replace(known, angles_deg=angles), ()))
    found = locate_in_images(fork, cines=cines, device=wire)
    assert [float(np.linalg.norm(one.position - nodes[0])) for one in found.tips] == pytest.approx([0, 0], abs=1.0)
    short = replace(cines[1], signals=cines[1].signals[:1], times_s=cines[1].times_s[:1])
    with pytest.raises(InputError, match="1 frames, and 2 in"):
        locate_in_images(fork, cines=[cines[0], short], device=wire)


def test_a_landmark_registers_a_png(made, fork, tmp_path) -> None:
    camera = tmp_path / "c-arm.yaml"
    camera.write_text(
        f"angles_deg: {list(VIEW)}\nisocenter_mm: [0, 0, 0]\ncentre_px: [127.5, 127.5]\ngeometry: {{pixel_mm: 0.45}}\n"
    )
    truth = np.load(made / "truth.npz")
    place, pixel = truth["centerline_mm"][30], truth["centerline_px"][0, 30]
    given = [str(made.parents[1] / "patients" / "fork"), str(made / "frames" / "0000.png"), "--camera", str(camera)]
    options = [*given, "-o", str(tmp_path / "tips.csv"), "--landmark-mm", *map(str, place)]
    figures = command_of("locate").run([*options, "--landmark-px", *map(str, pixel)], shown=False)
    table = np.genfromtxt(tmp_path / "tips.csv", delimiter=",", names=True, dtype=None, encoding="utf-8")
    found = np.array([table[f"tip_{axis}_mm"] for axis in "xyz"])
    assert figures["registered"] == "by landmark" and np.linalg.norm(found - truth["wire_mm"][0, 0]) < 2.0


@pytest.mark.parametrize(
    ("tags", "said"),
    [
        ({"PositionerPrimaryAngle": None}, r"PositionerPrimaryAngle \(0018,1510\): missing; give the C-arm's file"),
        ({"ImagerPixelSpacing": None}, r"ImagerPixelSpacing \(0018,1164\): missing"),
        ({"ImagerPixelSpacing": [0.4, 0.5]}, "give an image of square pixels"),
        ({"DistanceSourceToPatient": 1200}, "the patient lies between source and detector"),
        ({"PositionerMotion": "DYNAMIC"}, "PositionerMotion .* = DYNAMIC; give a cine in which"),
        ({"FrameTimeVector": [250.0, 250.0]}, r"FrameTimeVector \(0018,1065\): 2 times of 6 frames"),
        ({"Modality": "CT"}, r"Modality \(0008,0060\) = CT; give X-ray images"),
    ],
)
def test_what_lacks_is_named(made, tmp_path, tags, said) -> None:
    with pytest.raises(InputError, match=said):
        read_cine(changed(made, tmp_path / "bad.dcm", **tags))


def test_what_is_no_image_is_refused(made, fork, wire, tmp_path) -> None:
    text = tmp_path / "text.dcm"
    text.write_text("no image")
    with pytest.raises(InputError, match="is neither DICOM nor PNG"):
        read_cine(text)
    with pytest.raises(InputError, match="a PNG says nothing of the C-arm; give its file"):
        read_cine(made / "frames" / "0000.png")
    empty = np.full((6, 256, 256), 2048, dtype="<u2").tobytes()
    cine = read_cine(changed(made, tmp_path / "empty.dcm", PixelData=empty))
    with warnings.catch_warnings(), pytest.raises(InputError, match=r"fork cannot be registered in frame 0.*the same"):
        warnings.simplefilter("error")
        locate_in_images(fork, cines=[cine], device=wire)
