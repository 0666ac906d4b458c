from __future__ import annotations

import dataclasses
import warnings
from pathlib import Path

import numpy as np
import pytest

from endopilot.errors import InputError
from endopilot.robot.log import read_log
from endopilot.xray.camera import PlanarCamera

LOG = """time_s,episode,translation_mm,rotation_rad,encoder_mm,encoder_rad,tip_column_px,tip_row_px,flag
0.0,1,0.5,0,,,,,0
0.1,1,,,0.48,0.01,,,0
0.1,1,,,,,100,500,0
0.2,1,1.0,0.1,,,,,0
0.3,1,,,,,100,495,1
0.4,2,0.0,0,,,,,0
0.5,2,,,,,100,500,0
"""


def written(tmp_path: Path, text: str, camera: bool = True) -> Path:
    path = tmp_path / "log.csv"
    path.write_text(text)
    if camera:
        (tmp_path / "camera.yaml").write_text(
            "mm_per_pixel: 0.1\norigin_mm: [0, 0, 0]\ncolumns: [1, 0, 0]\nrows: [0, -1, 0]\n"
        )
    return path


def refused(tmp_path: Path, text: str, camera: bool = True) -> str:
    with pytest.raises(InputError) as caught:
        read_log(written(tmp_path, text, camera))
    return str(caught.value).removeprefix(f"{tmp_path}/")


def test_a_log_is_read(tmp_path) -> None:
    log = read_log(written(tmp_path, LOG))
    assert log.commanded.tolist() == [True, False, False, True, False, True, False]
    assert log.seen.tolist() == [False, False, True, False, False, False, True]  # the flagged tip is left out
    np.testing.assert_array_equal(log.command[log.commanded, 0], [[0.5, 0], [1.0, 0.1], [0, 0]])
    np.testing.assert_array_equal(log.encoders[1, 0], [0.48, 0.01])
    assert np.isnan(log.load).all() and np.isnan(log.tip).all()
    assert log.camera == PlanarCamera(mm_per_pixel=0.1)
    assert [len(episode) for episode in log.episodes()] == [5, 2]


def test_velocities_are_summed_up_to_where_a_command_ends(tmp_path) -> None:
    text = (
        "time_s,episode,translation_mm_s,rotation_rad_s,tip_x_mm,tip_y_mm,tip_z_mm\n0,0,2,1,,,\n0.5,0,-4,0,1,2,3\n"
        "1,0,0,0,,,\n1,1,2,0,,,\n1.5,1,0,0,,,\n"
    )
    log = read_log(written(tmp_path, text, camera=False))
    np.testing.assert_allclose(log.command[:, 0], [[1, 0.5], [-1, 0.5], [-1, 0.5], [1, 0], [1, 0]])
    assert log.by_velocity
    assert log.camera is None and log.seen.tolist() == [False, True, False, False, False]


def test_a_table_of_a_spreadsheet_is_read(tmp_path) -> None:
    path = written(tmp_path, LOG.replace(",", ";").replace(".", ","))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        log = read_log(path)
    assert np.array_equal(log.command, read_log(written(tmp_path, LOG)).command, equal_nan=True)


@pytest.mark.parametrize(
    ("text", "line"),
    [
        (LOG.replace("0.2,1,1.0,0.1", "0.2,1,,"), None),
        (LOG.replace("0.2,1,1.0,0.1", "0.05,1,1.0,0.1"),
         "log.csv: row 5: time_s = 0.05 is before the row above; sort the rows by time"),
        (LOG.replace("0.1,1,,,0.48,0.01", "0.1,1,,,0.48,"),
         "log.csv: row 3: encoder_rad is empty; give all, or none"),
        (LOG.replace("0.0,1,0.5", "0.0,1.5,0.5"), "log.csv: row 2: episode = 1.5; give a whole number"),
        (LOG.replace(",tip_row_px,", ",,"),
         "log.csv: column tip_row_px is missing where tip_column_px is there; give all, or none"),
        (LOG.replace("encoder_mm,encoder_rad", "translation_mm_s,rotation_rad_s"),
         "log.csv: holds translation_mm and translation_mm_s; give one of them"),
        ("time_s,encoder_mm\n0,1\n", "log.csv: is no log of a robot: column translation_mm, or translation_mm_s, is "
         "missing, where the drive is sent; it has time_s, encoder_mm"),
        ("time_s,translation_mm,encoder_mm\n0,,1\n", "log.csv: translation_mm: holds no command; give one"),
        (LOG.replace("0.0,1,0.5", "0.0,1,five"),
         "log.csv: row 2: translation_mm = five is no finite number; correct it"),
    ],
)  # fmt: skip
def test_a_table_that_is_no_log_is_refused(tmp_path, text, line) -> None:
    if line is None:
        assert read_log(written(tmp_path, text)).commanded.sum() == 2
    else:
        assert refused(tmp_path, text) == line


@pytest.mark.parametrize("separator", [",", ";", "\t"])
def test_a_table_on_its_side_is_refused(tmp_path, separator) -> None:
    rows = [line.split(",") for line in "time_s,translation_mm\n0,0.5\n0.1,1\n0.2,1.5".splitlines()]
    text = "\n".join(separator.join(column) for column in zip(*rows, strict=True))
    text = text if separator == "," else text.replace(".", ",")
    assert refused(tmp_path, text) == "log.csv: row 1 holds one name and then numbers; exchange rows and columns"


def test_a_log_of_another_vessel_is_refused_and_exchanged_pixels_are_told(tmp_path, fork) -> None:
    points = np.concatenate([branch.centerline.points for branch in fork.tree.branches])[::40]
    camera = PlanarCamera(
        mm_per_pixel=0.1, origin_mm=(-10.0, 0.0, 150.0), columns=(1.0, 0.0, 0.0), rows=(0.0, 0.0, -1.0)
    )
    lines = [f"{0.1 * k:.1f},{k},{point[0]},{point[1]},{point[2]}" for k, point in enumerate(points)]
    path = written(tmp_path, "\n".join(["time_s,translation_mm,tip_x_mm,tip_y_mm,tip_z_mm", *lines]), camera=False)
    log = read_log(path)
    assert log.in_vessel(fork.tree).tip.shape == (len(points), 3)
    with pytest.raises(
        InputError,
        match=r"^log: tips were seen at x .*, half of them 45 mm or more from the vessel at x .*; give the anatomy",
    ):
        dataclasses.replace(log, tip=log.tip + np.array([0.0, 45.0, 0.0])).in_vessel(fork.tree)
    pixel = camera.project(points)
    seen = dataclasses.replace(log, tip=np.full_like(log.tip, np.nan), pixel=pixel, camera=camera)
    np.testing.assert_allclose(seen.in_vessel(fork.tree).tip, points, atol=1.5)
    with pytest.raises(InputError, match="exchange tip_column_px and tip_row_px"):
        dataclasses.replace(seen, pixel=pixel[:, ::-1]).in_vessel(fork.tree)


def test_pixels_need_a_camera(tmp_path) -> None:
    line = refused(tmp_path, LOG, camera=False)
    assert line.startswith("log.csv: tip_column_px: pixels need camera.yaml beside the log; write mm_per_pixel")
