from __future__ import annotations

import numpy as np
import pytest

from endopilot.errors import InputError
from endopilot.xray.camera import CArmCamera, PlanarCamera, points_in_vessel, read_camera
from endopilot.xray.carm import CArmGeometry

POINTS = np.array([[0.0, 0, 0], [10, 5, -3], [-4, 20, 7]])
CAMERAS = [
    PlanarCamera(mm_per_pixel=0.1, origin_mm=(-20, 30, 0)),
    PlanarCamera(mm_per_pixel=0.2, columns=(0.0, 0.6, 0.8), rows=(1.0, 0.0, 0.0)),
    CArmCamera(angles_deg=(30.0, -20.0), isocenter_mm=(2.0, 3.0, 4.0), centre_px=(512.0, 400.0)),
    CArmCamera(matrix=((1000.0, 20, 300, 4e4), (-3, -1300, 500, 7e4), (0.2, -0.1, 1, 700))),
]
NAMES = ["planar", "planar-tilted", "c-arm", "matrix"]


@pytest.mark.parametrize("camera", CAMERAS, ids=NAMES)
def test_a_point_lies_on_the_ray_of_its_pixel(camera) -> None:
    through, along = camera.rays(camera.project(POINTS))
    np.testing.assert_allclose(np.linalg.norm(along, axis=1), 1)
    np.testing.assert_allclose(np.cross(POINTS - through, along), 0, atol=1e-9)


def test_columns_grow_to_the_right_and_rows_downwards() -> None:
    planar = PlanarCamera(mm_per_pixel=0.1, origin_mm=(1, 2, 0))
    np.testing.assert_allclose(planar.project(np.array([[3.0, 1.0, 9.0]])), [[20, 10]])
    front = CArmCamera(angles_deg=(0.0, 0.0), isocenter_mm=(0.0, 0.0, 0.0), centre_px=(100.0, 100.0))
    (left_of_patient, head) = front.project(np.array([[5.0, 0, 0], [0, 0, 5.0]]))
    assert left_of_patient[0] > 110 and left_of_patient[1] == pytest.approx(100)
    assert head[1] < 90 and head[0] == pytest.approx(100)


@pytest.mark.parametrize("camera", CAMERAS, ids=NAMES)
def test_a_pixel_of_a_vessel_is_found_on_it(anatomy, camera) -> None:
    line = anatomy.tree.branches[0].centerline.points
    pixels = np.vstack([camera.project(line[5:40:5]), [[np.nan, np.nan]]])
    found = points_in_vessel(camera, pixels, anatomy.tree)
    np.testing.assert_allclose(found[:-1], line[5:40:5], atol=1e-6)
    assert np.isnan(found[-1]).all()


def test_a_matrix_is_its_projection() -> None:
    """(w·column, w·row, w) = M·(x, y, z, 1); pixels that are not square are kept."""
    camera = CAMERAS[3]
    assert isinstance(camera, CArmCamera)
    shown = np.column_stack([POINTS, np.ones(len(POINTS))]) @ np.array(camera.matrix).T
    np.testing.assert_allclose(camera.project(POINTS), shown[:, :2] / shown[:, 2:])


def test_a_c_arm_is_given_in_one_way(tmp_path) -> None:
    path = tmp_path / "c-arm.yaml"
    path.write_text("matrix: [[1000, 0, 0, 0], [0, 1000, 0, 0], [0, 0, 1, 700]]\n")
    assert read_camera(path) == CArmCamera(matrix=((1000, 0, 0, 0), (0, 1000, 0, 0), (0, 0, 1, 700)))
    path.write_text("matrix: [[1000, 0, 0, 0], [0, 1000, 0, 0], [0, 0, 0, 700]]\n")
    with pytest.raises(InputError, match=r"c-arm.yaml: matrix: its first three columns have no inverse"):
        read_camera(path)
    path.write_text("matrix: [[1000, 0, 0, 0], [0, 1000, 0, 0], [0, 0, 1, 700]]\ncentre_px: [1, 2]\n")
    with pytest.raises(InputError, match=r"c-arm.yaml: centre_px: is given beside matrix; give one of them"):
        read_camera(path)
    with pytest.raises(InputError, match="centre_px: missing; add it, or give a matrix"):
        CArmCamera(angles_deg=(0.0, 0.0), isocenter_mm=(0.0, 0.0, 0.0))


def test_files(tmp_path) -> None:
    path = tmp_path / "camera.yaml"
    path.write_text("mm_per_pixel: 0.095\norigin_mm: [1, 2, 3]\ncolumns: [1, 0, 0]\nrows: [0, -1, 0]\n")
    assert read_camera(path) == PlanarCamera(mm_per_pixel=0.095, origin_mm=(1.0, 2.0, 3.0))
    path.write_text(
        "angles_deg: [30, 0]\nisocenter_mm: [0, 0, 0]\ncentre_px: [512, 512]\n"
        "geometry: {source_to_isocenter_mm: 765, source_to_detector_mm: 1100, pixel_mm: 0.3}\n"
    )
    camera = read_camera(path)
    assert isinstance(camera, CArmCamera) and camera.geometry.pixel_mm == 0.3
    path.write_text("mm_per_pixel: 0.095\norigin_mm: [1, 2, 3]\ncolumns: [1, 0, 0]\nrows: [1, -1, 0]\n")
    with pytest.raises(InputError, match=r"camera.yaml: rows: .* has length 1.414; give a unit vector"):
        read_camera(path)


@pytest.mark.parametrize(
    ("source_to_isocenter_mm", "message"),
    [
        (0.72, r"source_to_isocenter_mm: 0\.72; give a number from 100 to 5000 mm \(0\.72 m is 720 mm\)"),
        (1200.0, r"source_to_detector_mm: 1100; give more than source_to_isocenter_mm, 1200"),
    ],
)
def test_a_geometry_that_no_c_arm_has_is_refused(source_to_isocenter_mm, message):
    with pytest.raises(InputError, match=message):
        CArmGeometry(source_to_isocenter_mm=source_to_isocenter_mm)
