"""A pose that images of the wire bound: a wrong one recovers, and a right one stays."""

from __future__ import annotations

import numpy as np
import pytest

from endopilot.xray.carm import Pose, View, view_at, view_of
from endopilot.xray.corridor import CATHETER_MM, STEP_MM
from endopilot.xray.image import ImageConfig, isocenter_of
from endopilot.xray.pose_refinement import PoseRefiner
from endopilot.xray.registration import Registration, vessel_error_mm
from endopilot.xray.tip_posterior import TipEstimate

TRUE = Pose(np.deg2rad([1.0, -2.0, 1.5]), np.array([2.0, -3.0, 1.0]))
ROOM_MM, SLACK_MM = 0.8, 4.0


@pytest.fixture(scope="module")
def views(fork):
    return [view_at(angles, isocenter_of(fork), ImageConfig().geometry) for angles in ((-30.0, 0.0), (60.0, 0.0))]


def depth_of(view: View) -> np.ndarray:
    """Return a registration's covariance in one view: 3 mm along its beam, and little else."""
    sd = np.array([*np.full(3, np.deg2rad(0.2)), *np.full(3, 0.05)])
    beam = view.axes[2]
    covariance = np.diag(sd**2)
    covariance[3:, 3:] += 3.0**2 * np.outer(beam, beam)
    return covariance


def followed(fork, refiner: PoseRefiner, views: list[View], aside_mm: np.ndarray) -> TipEstimate:
    """Return what the detector gives of a wire that lies aside of the centerline, seen with the pose so far.

    In one view a place is known up to its depth; the one beside the centerline is taken, as the detector does.
    """
    isocenter = isocenter_of(fork)
    line = fork.tree.path(2)
    at = np.concatenate([np.arange(-CATHETER_MM, -0.5 * STEP_MM, STEP_MM), np.arange(0.0, 30.0, STEP_MM)])
    middle = np.stack([np.interp(np.maximum(at, 0.0), line.abscissa, axis) for axis in line.points.T], axis=-1)
    middle += np.minimum(at, 0.0)[:, None] * fork.insertion.direction
    wire = middle + aside_mm
    rows, values = [], []
    for view, believed in zip(views, refiner.views(views), strict=True):
        pixel = view_of(view, TRUE, isocenter).project(wire)
        ray = np.column_stack([pixel, np.full(len(pixel), believed.scale)]) @ believed.axes
        ray /= np.linalg.norm(ray, axis=1, keepdims=True)
        across = np.eye(3) - ray[:, :, None] * ray[:, None, :]
        rows.append(across)
        values.append(np.einsum("nij,nj->ni", across, believed.source - middle))
    normal = sum(rows) + 1e-3 * np.eye(3)
    shown = middle + np.linalg.solve(normal, sum(values)[..., None])[..., 0]
    room = np.full(len(at), ROOM_MM + SLACK_MM)
    return TipEstimate(99.0, shown[-1], 0.01 * np.eye(3), 1.0, np.zeros((3, 3)), shown, middle, room)


def test_a_poisoned_depth_recovers_from_another_view(fork, views):
    """One view leaves the depth open, and the pose is wrong by 4 mm there; the other view sees it."""
    beam = views[0].axes[2]
    wrong = Pose(TRUE.rotation_rad, TRUE.translation_mm + 4.0 * beam)
    refiner = PoseRefiner(fork, Registration(wrong, depth_of(views[0]), 1.0, ""))
    assert refiner.slack_mm(views[1:], 0.3) == pytest.approx(9.0, abs=0.5)  # 3 standard deviations of 3 mm
    assert refiner.slack_mm(views[:1], 0.3) < 1.5
    walls = [np.array(aside) for aside in ((0.7, 0.0, 0.0), (-0.7, 0.0, 0.0), (0.0, 0.7, 0.0), (0.0, -0.7, 0.0))]
    errors = [vessel_error_mm(fork, TRUE, wrong)]
    for aside in walls:
        refiner.refine(views[1:], followed(fork, refiner, views[1:], aside), SLACK_MM)
        errors.append(vessel_error_mm(fork, TRUE, refiner.pose))
    assert errors[0] == pytest.approx(4.0)
    assert errors[1] < 2.0 and errors[-1] < 0.5


def test_a_wire_on_the_wall_does_not_move_a_right_pose(fork, views):
    refiner = PoseRefiner(fork, Registration(TRUE, depth_of(views[0]), 1.0, ""))
    for _ in range(5):
        refiner.refine(views, followed(fork, refiner, views, np.array([0.0, 0.75, 0.0])), SLACK_MM)
    np.testing.assert_array_equal(refiner.pose.vector, TRUE.vector)


@pytest.mark.parametrize("seed", range(6))
def test_no_wire_in_the_lumen_leads_away(fork, views, seed):
    """Measured by registration's covariance, the true pose is never farther than before."""
    random = np.random.default_rng(seed)
    covariance = depth_of(views[seed % 2])
    root = np.linalg.cholesky(covariance)
    begin = Pose.of_vector(TRUE.vector + root @ random.standard_normal(6))
    refiner = PoseRefiner(fork, Registration(begin, covariance, 1.0, ""))

    def far() -> float:
        return float(np.linalg.norm(np.linalg.solve(root, refiner.pose.vector - TRUE.vector)))

    first = far()
    for _ in range(3):
        angle = random.uniform(0, 2 * np.pi)
        aside = ROOM_MM * random.uniform(0, 1) * np.array([np.cos(angle), np.sin(angle), 0.0])
        shown = views if random.random() < 0.5 else views[1:]
        refiner.refine(shown, followed(fork, refiner, shown, aside), SLACK_MM)
        assert far() <= first + 0.02


def test_a_wire_that_lies_elsewhere_moves_a_sure_pose_little(fork, views):
    """A line 2 mm beside the vessel, taken for the wire again and again.

    Four images of 27 places pull by 4.7 pixels/mm, two by the cosine of 30° and two by that of 60°, against 0.03 mm:
    4.7·27·2·(0.87 + 0.5)·0.03² = 0.31 mm.
    """
    covariance = np.diag(np.array([*np.full(3, np.deg2rad(0.02)), *np.full(3, 0.03)]) ** 2)
    refiner = PoseRefiner(fork, Registration(TRUE, covariance, 1.0, ""))
    for _ in range(12):
        refiner.refine(views, followed(fork, refiner, views, np.array([0.0, 2.8, 0.0])), SLACK_MM)
    assert 0.0 < vessel_error_mm(fork, TRUE, refiner.pose) < 0.33
