"""Tips located in a tree from lines in images: synthetic ones of known tip and motion, and a real patient's."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from endopilot.anatomy.tree import Line, tree_from_lines
from endopilot.errors import InputError
from endopilot.types import Anatomy, DistanceMap, Insertion
from endopilot.xray.camera import CArmCamera, PlanarCamera, read_camera
from endopilot.xray.frames import DeviceFrame, read_frames, write_locations
from endopilot.xray.tip_filter import LocateConfig, TipFilter, locate

LIVER = Path(__file__).parents[3] / "shared" / "data" / "liver_tace"
CAMERAS = [
    CArmCamera(angles_deg=(angle, 0.0), isocenter_mm=(0.0, 0.0, 0.0), centre_px=(512.0, 512.0)) for angle in (-30, 60)
]
OF_95 = 2.795
"""Standard deviations within which 95 % of normally distributed errors in space lie."""


@pytest.fixture(scope="module")
def anatomy() -> Anatomy:
    """Return a vessel that goes up and bends to the left, with two branches; coarse points, 4 mm apart."""
    at = np.linspace(0.0, 1.0, 30)[:, None]
    bend = np.hstack([60 * at**2, 15 * np.sin(3 * at), 100 * at - 50 - 25 * at**3])
    side = np.linspace(0.0, 1.0, 12)[:, None]
    up = bend[18] + side * [-10.0, 20.0, 40.0] + 6 * side**2 * [-1.0, 0, 0]
    down = bend[22] + side * [25.0, -15.0, -30.0]
    lines = [(bend, 2.0, -1, 0), (up, 1.5, 0, 18), (down, 1.5, 0, 22)]
    tree = tree_from_lines([Line(points, np.full(len(points), r), parent, at) for points, r, parent, at in lines])
    nothing = DistanceMap(np.zeros((2, 2, 2)), 1.0, np.zeros(3))
    return Anatomy("tree", tree, nothing, Insertion(bend[0], np.array([0.0, 0.0, 1.0])), 0.9)


def course(anatomy: Anatomy, leaf: int, frames: int = 12) -> tuple[list[np.ndarray], np.ndarray]:
    """Return a device's points in space that is pushed to the end of a branch, from its tip on, and where it is seen.

    The patient lies 12 mm off and breathes by 5 mm.
    """
    line = anatomy.tree.path(leaf)
    tips = np.linspace(45.0, line.abscissa[-1] - 2.0, frames)
    devices = []
    for tip in tips:
        at = np.arange(tip, 0.0, -1.0)
        devices.append(np.stack([np.interp(at, line.abscissa, axis) for axis in line.points.T], axis=-1))
    moved = np.array([8.0, 0.0, -9.0]) + 5.0 * np.sin(np.arange(frames))[:, None] * [0.0, 0.3, 1.0]
    return devices, moved


def chain(line: np.ndarray) -> np.ndarray:
    """Return the pixels that a line passes, each beside the one before, as a skeleton gives them."""
    at = np.linspace(0, len(line) - 1, 20 * len(line))
    whole = np.stack([np.rint(np.interp(at, np.arange(len(line)), axis)) for axis in line.T], axis=-1)
    return whole[np.concatenate([[True], np.any(np.diff(whole, axis=0) != 0, axis=1)])]


def frames_of(devices, moved, cameras, noise_px=0.5) -> list[DeviceFrame]:
    random, frames = np.random.default_rng(0), []
    for number, (device, shift) in enumerate(zip(devices, moved, strict=True)):
        lines = [camera.project(device + shift) for camera in cameras]
        frames.append(
            DeviceFrame(number, tuple(line + noise_px * random.standard_normal(line.shape) for line in lines))
        )
    return frames


@pytest.mark.parametrize("views", [1, 2])
def test_the_tip_is_followed_in_a_patient_who_breathes_and_is_not_registered(anatomy, views) -> None:
    for leaf in anatomy.tree.leaves():
        devices, moved = course(anatomy, leaf)
        frames = frames_of(devices, moved, CAMERAS[:views])
        found = locate(anatomy, frames=frames, cameras=CAMERAS[:views])
        errors = np.array([one.position - device[0] for one, device in zip(found, devices, strict=True)])
        off = [float(np.sqrt(e @ np.linalg.solve(one.covariance, e))) for e, one in zip(errors, found, strict=True)]
        assert np.median(np.linalg.norm(errors, axis=1)) < 3.0
        assert np.mean(np.array(off) < OF_95) >= 0.9
        assert np.median([one.residual_mm for one in found]) < 0.5
        assert found[-1].status == "found" and found[-1].branch == leaf


def test_a_chain_of_pixels_is_located_as_the_line_that_it_was_drawn_from(anatomy) -> None:
    """A chain of whole pixels, each beside the one before, is up to 8 % longer than its line."""
    devices, moved = course(anatomy, anatomy.tree.leaves()[0])
    chains = [
        DeviceFrame(frame.number, tuple(chain(line) for line in frame.lines if line is not None))
        for frame in frames_of(devices, moved, CAMERAS[:1], noise_px=0.0)
    ]
    found = locate(anatomy, frames=chains, cameras=CAMERAS[:1])
    errors = [float(np.linalg.norm(one.position - device[0])) for one, device in zip(found, devices, strict=True)]
    assert np.median(errors) < 3.0 and max(errors) < 5.0


def test_a_landmark_registers_the_first_frame(anatomy) -> None:
    """Of a patient who lies 60 mm off: the tip alone says nothing of that, and the line lies too far off."""
    device = course(anatomy, anatomy.tree.leaves()[0])[0][-1]
    away = np.array([60.0, 30.0, -10.0])
    frames = frames_of([device], away[None], CAMERAS[:1])
    line = frames[0].lines[0]
    assert line is not None
    tip_alone = [DeviceFrame(0, (line[:1],))]
    (lost,) = locate(anatomy, frames=tip_alone, cameras=CAMERAS[:1])
    assert lost.status != "found"
    known = LocateConfig(landmark_mm=tuple(device[0]))
    (found,) = locate(anatomy, frames=tip_alone, cameras=CAMERAS[:1], config=known)
    assert found.status == "found" and np.linalg.norm(found.position - device[0]) < 2.0
    point = anatomy.tree.branches[0].centerline.points[0]
    pixel = tuple(CAMERAS[0].project(point[None] + away)[0])
    known = LocateConfig(landmark_mm=tuple(point), landmark_px=pixel, breathing_sd_mm=1.0)
    (found,) = locate(anatomy, frames=frames, cameras=CAMERAS[:1], config=known)
    assert np.linalg.norm(found.position - device[0]) < 4.0


def test_later_frames_tell_of_earlier_ones(anatomy) -> None:
    """A tip that stays, in one view, where a landmark registers: breathing looks like travel by half as much."""
    devices, moved = course(anatomy, anatomy.tree.leaves()[0], frames=24)
    still = [devices[12]] * 12
    frames = frames_of(still, moved[:12], CAMERAS[:1])
    point = anatomy.tree.branches[0].centerline.points[0]
    pixel = tuple(CAMERAS[0].project(point[None] + moved[0])[0])
    follow = TipFilter(anatomy.tree, CAMERAS[:1], LocateConfig(landmark_mm=tuple(point), landmark_px=pixel))
    by_then = [follow.update(one.number, one.lines) for one in frames]
    smooth = follow.smooth()
    before, after = (
        np.array([np.linalg.norm(one.position - still[0][0]) for one in some]) for some in (by_then, smooth.values())
    )
    spread, left = (np.ptp([one.abscissa for one in some]) for some in (by_then, smooth.values()))
    assert left < 0.6 * spread and after.mean() < before.mean() + 0.5


def test_a_tip_that_is_suddenly_in_another_branch_is_found_again(anatomy) -> None:
    """The tip travels 4 mm a frame in the mean, and in one frame of fifty is anywhere."""
    one, other = anatomy.tree.leaves()[:2]
    shown = [course(anatomy, leaf)[0][-1] for leaf in (other, other, one, one, one)]
    frames = frames_of(shown, np.zeros((5, 3)), CAMERAS[:1])
    found = locate(anatomy, frames=frames, cameras=CAMERAS[:1])
    assert found[0].branch == other and found[-1].branch == one and found[-1].status == "found"


def test_what_is_no_device_is_not_found(anatomy) -> None:
    devices, moved = course(anatomy, anatomy.tree.leaves()[0])
    frames = frames_of(devices, moved, CAMERAS[:1])
    loop = 512 + 150 * np.stack([np.cos(np.arange(0, 6, 0.05)), np.sin(np.arange(0, 6, 0.05))], axis=-1)
    shown = [*frames[:3], DeviceFrame(3, (loop,)), DeviceFrame(4, (None,)), *frames[5:]]
    found = locate(anatomy, frames=shown, cameras=CAMERAS[:1])
    assert [one.status for one in found[3:5]] == ["not found"] * 2 and np.isnan(found[3].position).all()
    assert np.linalg.norm(found[-1].position - devices[-1][0]) < 3.0


def test_a_planar_camera_does(anatomy) -> None:
    camera = PlanarCamera(mm_per_pixel=0.2, origin_mm=(-60.0, 0.0, 60.0), rows=(0.0, 0.0, -1.0))
    devices, moved = course(anatomy, anatomy.tree.leaves()[0])
    found = locate(anatomy, frames=frames_of(devices, moved, [camera]), cameras=[camera])
    assert np.linalg.norm(found[-1].position - devices[-1][0]) < 3.0


def test_files(anatomy, tmp_path) -> None:
    path = tmp_path / "lines.csv"
    path.write_text("frame,view,column_px,row_px\n3,1,10,20\n3,1,11,21\n3,2,5,6\n7,2,8,9\n")
    first, second = read_frames(path, views=2)
    assert first.number == 3 and first.lines[0].tolist() == [[10, 20], [11, 21]] and first.lines[1].tolist() == [[5, 6]]
    assert second.number == 7 and second.lines[0] is None
    with pytest.raises(InputError, match=r"lines.csv: row 4: view = 2; give 1 to 1, or a camera for each view"):
        read_frames(path)
    path.write_text("frame,column_px,row_px\n3,10,20\n2,11,21\n")
    with pytest.raises(InputError, match="row 3: frame = 2 is before the row above; sort the rows by frame"):
        read_frames(path)
    devices, moved = course(anatomy, anatomy.tree.leaves()[0])
    found = locate(anatomy, frames=frames_of(devices[-2:], moved[-2:], CAMERAS), cameras=CAMERAS)
    write_locations(found, output=tmp_path / "tips.csv")
    table = np.genfromtxt(tmp_path / "tips.csv", delimiter=",", names=True, dtype=None, encoding="utf-8")
    assert table["tip_x_mm"][1] == pytest.approx(found[1].position[0], abs=1e-3)
    assert table["status"].tolist() == [one.status for one in found]
    with pytest.raises(InputError, match="frame 0: 2 lines for 1 cameras; give one for each, or None"):
        locate(anatomy, frames=frames_of(devices[:1], moved[:1], CAMERAS), cameras=CAMERAS[:1])


def test_the_command(anatomy, tmp_path) -> None:
    from endopilot.anatomy.io import write_anatomy
    from endopilot.cli import command_of

    write_anatomy(anatomy, output=tmp_path / "tree")
    devices, moved = course(anatomy, anatomy.tree.leaves()[0])
    (frame,) = frames_of(devices[-1:], moved[-1:], CAMERAS[:1])
    rows = "\n".join(f"0,{column:.3f},{row:.3f}" for column, row in frame.lines[0])
    (tmp_path / "lines.csv").write_text(f"frame,column_px,row_px\n{rows}\n")
    view = CAMERAS[0].view
    right, up, beam = view.axes
    matrix = np.stack([view.scale * right + 512 * beam, -view.scale * up + 512 * beam, beam])
    matrix = np.column_stack([matrix, -matrix @ view.source])
    (tmp_path / "c-arm.yaml").write_text(f"matrix: {matrix.tolist()}\n")
    options = ["--camera", str(tmp_path / "c-arm.yaml"), "-o", str(tmp_path / "tips.csv")]
    options += ["--picture", str(tmp_path / "tips.png")]
    figures = command_of("locate").run([str(tmp_path / "tree"), str(tmp_path / "lines.csv"), *options], shown=False)
    assert figures["found"] == 1 and figures["residual_median_mm"] < 0.5
    assert (tmp_path / "tips.csv").exists() and (tmp_path / "tips.png").stat().st_size > 10_000


@pytest.mark.skipif(not LIVER.exists(), reason="the liver patient of ../shared/data is not there")
def test_a_real_catheter_in_a_liver_that_breathes(tmp_path, monkeypatch) -> None:
    """Frames 8 to 18: chained from frame to frame, a rigid tracker is lost at 14. The authors' tips are no truth."""
    monkeypatch.syspath_prepend(Path(__file__).parents[2] / "examples")
    from liver_catheter import convert, nodes_of

    patient = convert(LIVER / "dataset1", tmp_path)
    camera, frames = read_camera(tmp_path / "c-arm.yaml"), read_frames(tmp_path / "lines.csv")[8:19:2]
    table = np.genfromtxt(LIVER / "authors_hmm_bruteforce_run.csv", delimiter=",", names=True)
    authors = nodes_of(LIVER / "dataset1")[0][table["tip_node"].astype(int)]
    found = locate(patient, frames=frames, cameras=[camera])
    errors = [float(np.linalg.norm(one.position - authors[one.frame])) for one in found]
    assert max(errors) < 5.0 and all(one.status != "not found" for one in found)
    assert np.median([one.residual_mm for one in found]) < 1.0
