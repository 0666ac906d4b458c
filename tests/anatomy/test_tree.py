"""Trees, their sections, the signed distance to the wall, the catheter's axis, and tips projected onto trees."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from benchmarks.anatomy.analytic_lumens import forked_tree, mask_of, torus_distance, tree_distance, tree_of
from endopilot.anatomy.catheter_axis import lean_between, turned_axis
from endopilot.anatomy.distance import add_catheter, distance_map_from_spheres, sample
from endopilot.anatomy.labels import label_tree
from endopilot.anatomy.projection import project_tip, safety_ratio
from endopilot.anatomy.tree import make_centerline, parallel_transport, tangents
from endopilot.atlas.atlas import AtlasConfig, make_patient_tree
from endopilot.errors import InputError
from endopilot.types import Branch, Insertion, VesselTree
from endopilot.vessels.surface import distance_map_from_surface, surface_from_mask

A_MM, B_MM = 8.0, 2.0
SPEED = np.hypot(A_MM, B_MM)


def helix(step_mm: float = 0.5) -> tuple[np.ndarray, np.ndarray]:
    angle = np.arange(0.0, 4 * np.pi, step_mm / SPEED)
    points = np.stack([A_MM * np.cos(angle), A_MM * np.sin(angle), B_MM * angle], axis=1)
    return angle, points


def test_normals_turn_against_the_frenet_frame_by_the_integral_of_torsion():
    angle, points = helix()
    normals, direction = parallel_transport(points), tangents(points)
    frenet = -np.stack([np.cos(angle), np.sin(angle), 0 * angle], axis=1)
    binormal = np.cross(direction, frenet)
    turned = np.unwrap(np.arctan2(np.einsum("ij,ij->i", normals, binormal), np.einsum("ij,ij->i", normals, frenet)))
    expected = -B_MM / SPEED**2 * SPEED * angle
    assert np.abs((turned - turned[0] - expected)[2:-2]).max() < 0.01
    assert np.abs(np.einsum("ij,ij->i", normals, direction)).max() < 1e-12
    assert np.abs(np.linalg.norm(normals, axis=1) - 1.0).max() < 1e-12


def test_tangents_are_exact_to_second_order_up_to_both_ends():
    angle, points = helix()
    exact = np.stack([-A_MM * np.sin(angle), A_MM * np.cos(angle), np.full(len(angle), B_MM)], axis=1) / SPEED
    assert np.linalg.norm(tangents(points) - exact, axis=1).max() < 2e-3


@pytest.mark.parametrize("tilt_deg", [0.3, 20.0, 120.0])
@pytest.mark.parametrize("side_deg", [-170.0, 0.0, 90.0])
def test_a_turned_axis_leans_by_its_angle_to_its_side(tilt_deg, side_deg) -> None:
    random = np.random.default_rng(round(tilt_deg + side_deg) % 97)
    axis = random.standard_normal(3)
    axis /= np.linalg.norm(axis)
    other = turned_axis(axis, tilt_deg, side_deg)
    assert np.degrees(np.arccos(axis @ other)) == pytest.approx(tilt_deg, abs=1e-6)
    assert lean_between(axis, other) == pytest.approx((tilt_deg, side_deg), abs=1e-6)


def test_generic_names_count_generations():
    assert label_tree(forked_tree(), "generic").section_names == ("G0", "G1.1", "G1.2")


def test_a_tree_names_only_the_sections_that_it_has():
    tree, _ = make_patient_tree(AtlasConfig(vessel="rca", count=1, seed=7), 0)
    root = replace(tree, branches=tree.branches[:1])
    assert len(tree.sections_present) > 1 and root.sections_present == ("1",)


def grid_points(distance_map):
    k, j, i = np.indices(distance_map.values.shape)
    return distance_map.origin_mm + distance_map.spacing_mm * np.stack([i, j, k], axis=-1)


def test_cone_has_its_exact_distance():
    # max over τ of r₀ − sτ − √(ρ² + (z − τ)²), at z − τ = sρ/√(1 − s²), is r₀ − sz − ρ√(1 − s²).
    length, first, slope = 30.0, 3.0, 0.05
    z = np.linspace(0, length, 61)
    centerline = make_centerline(np.outer(z, [0, 0, 1.0]), first - slope * z)
    tree = VesselTree((Branch(centerline, -1, np.zeros(61, dtype=np.int64)),), ("v",))
    found = distance_map_from_spheres(tree, spacing_mm=0.5)
    points = grid_points(found)
    rho = np.hypot(points[..., 0], points[..., 1])
    exact = first - slope * points[..., 2] - rho * np.sqrt(1 - slope**2)
    middle = (points[..., 2] > 5) & (points[..., 2] < 25) & (np.abs(exact) < 2)
    assert np.abs(found.values - exact)[middle].max() < 1e-3


def test_fillet_widens_the_fork_and_nothing_else():
    tree = forked_tree()
    found = distance_map_from_spheres(tree, spacing_mm=0.8)
    exact = np.maximum(tree_distance(tree, grid_points(found)), -2.5)
    away = np.linalg.norm(grid_points(found) - [0, 0, 20], axis=-1) > 9.0
    assert np.abs(found.values - exact)[away & (exact > -2)].max() < 0.02
    assert (found.values - exact).min() > -0.02
    assert 0.05 < (found.values - exact).max() < 0.5


def test_mask_gives_a_sub_voxel_distance():
    spacing = 0.45, 0.45, 0.6
    rotation = Rotation.from_rotvec([0.3, 0.2, 0.5]).as_matrix()
    mask = mask_of(lambda p: torus_distance(p, 2.0), (25, 25, 9), spacing, rotation)
    found = distance_map_from_surface(surface_from_mask(mask.volume), spacing_mm=0.5)
    exact = torus_distance(grid_points(found), 2.0)
    error = (found.values - exact)[np.abs(exact) < 2.0]
    assert np.sqrt(np.mean(error**2)) < 0.1 * max(spacing)
    assert abs(error.mean()) < 0.05 * min(spacing)


def test_catheter_opens_the_ostium():
    tree = forked_tree()
    insertion = Insertion(tree.branches[0].centerline.points[0], np.array([0.0, 0, 1]))
    vessel = distance_map_from_spheres(tree, spacing_mm=0.4)
    found = add_catheter(vessel, insertion, 1.2, 15.0)
    axis = np.outer(np.linspace(-14, 5, 80), [0, 0, 1.0])
    assert sample(found, axis).min() > 1.2 - 0.3
    assert sample(vessel, axis[:20]).max() < 0
    tube_wall = np.stack([np.full(40, 1.2), np.zeros(40), np.linspace(-13, -4, 40)], axis=1)
    assert np.abs(sample(found, tube_wall)).max() < 0.05


def test_catheter_refuses_nonsense():
    tree = forked_tree()
    vessel = distance_map_from_spheres(tree, spacing_mm=0.5)
    with pytest.raises(InputError, match="radius -1"):
        add_catheter(vessel, Insertion(np.zeros(3), np.array([0.0, 0, 1])), -1.0)


INSERTION = Insertion(np.zeros(3), np.array([0.0, 0, 1]))


def brute_force(tree, points):
    """Least offset over radius of all segments of all branches, one by one."""
    best = np.full(len(points), np.inf)
    result = np.zeros((3, len(points)))
    for index, branch in enumerate(tree.branches):
        line = branch.centerline
        offset, abscissa, radius = np.full(len(points), np.inf), np.zeros(len(points)), np.ones(len(points))
        for i in range(len(line.points) - 1):
            axis = line.points[i + 1] - line.points[i]
            share = np.clip((points - line.points[i]) @ axis / (axis @ axis), 0, 1)
            gap = np.linalg.norm(points - line.points[i] - share[:, None] * axis, axis=1)
            nearer = gap < offset
            offset[nearer] = gap[nearer]
            abscissa[nearer] = (line.abscissa[i] + share * np.linalg.norm(axis))[nearer]
            radius[nearer] = (line.radius[i] + share * (line.radius[i + 1] - line.radius[i]))[nearer]
        better = offset / radius < best
        best[better] = (offset / radius)[better]
        result[:, better] = np.stack([abscissa, offset, np.full(len(points), index)])[:, better]
    return result


def test_a_point_is_projected_to_the_same_bits_whatever_the_others():
    tree = forked_tree()
    points = np.random.default_rng(1).uniform((-2, -1, -4), (8, 1, 30), (500, 3))  # behind the ostium too
    together = project_tip(tree, INSERTION, points)
    for name in ("abscissa", "offset", "branch", "radius"):
        alone = [getattr(project_tip(tree, INSERTION, point), name) for point in points[:100]]
        assert np.array_equal(alone, getattr(together, name)[:100])


def test_shapes_follow_the_points():
    found = project_tip(forked_tree(), INSERTION, np.tile([0.5, 0, 10.0], (3, 5, 1)))
    assert found.abscissa.shape == found.branch.shape == (3, 5)
    assert np.allclose(found.abscissa, 10.0) and np.allclose(found.offset, 0.5)
    assert project_tip(forked_tree(), INSERTION, np.array([0.0, 0, -3.0])).abscissa == -3.0


def test_agrees_with_brute_force_on_a_whole_tree():
    tree, _ = make_patient_tree(AtlasConfig(seed=3), 0)
    rng = np.random.default_rng(0)
    centre, size = (np.concatenate([getattr(b.centerline, n) for b in tree.branches]) for n in ("points", "radius"))
    chosen = rng.integers(0, len(centre), 1500)
    points = centre[chosen] + 0.4 * size[chosen, None] * rng.normal(size=(1500, 3))
    start = tree.branches[0].centerline.points
    insertion = Insertion(start[0], (start[1] - start[0]) / np.linalg.norm(start[1] - start[0]))
    points = points[(points - start[0]) @ insertion.direction > 0.5]
    found, exact = project_tip(tree, insertion, points), brute_force(tree, points)
    lines = [tree.branches[int(index)].centerline for index in exact[2]]
    ratio = np.array([np.interp(at, own.abscissa, own.radius) for at, own in zip(exact[0], lines, strict=True)])
    depth, least = found.offset / found.radius, exact[1] / ratio
    inside = least < 1.0
    # nearest places on a polyline and on its turning planes differ by the corners alone
    assert np.abs(depth - least)[inside].max() < 0.02
    assert (found.branch == exact[2])[inside].mean() > 0.99
    same = inside & (found.branch == exact[2])
    assert np.quantile(np.abs(found.abscissa - exact[0])[same], 0.99) < 0.2


def test_abscissa_follows_a_bend_smoothly_and_exactly():
    bend, step = 5.0, 0.5
    angle = np.arange(0.0, 2.0, step / bend)
    line = bend * np.stack([np.sin(angle), 0 * angle, 1 - np.cos(angle)], axis=1)
    tree, insertion = tree_of((line, 2.0, -1)), Insertion(np.zeros(3), np.array([1.0, 0, 0]))
    fine = np.linspace(0.05, angle[-1] - 0.05, 20_001)
    for off in (-1.5, 0.0, 1.5):  # outwards, on the axis and inwards of the bend
        radius = bend - off
        points = np.stack([radius * np.sin(fine), 0 * fine, bend - radius * np.cos(fine)], axis=1)
        found = project_tip(tree, insertion, points)
        assert np.abs(found.abscissa - bend * fine).max() < 0.01
        speed = np.diff(found.abscissa) / (bend * np.diff(fine))
        assert speed.min() > 0.95 and speed.max() < 1.05  # neither a jump nor a halt at any vertex
        assert np.abs(found.offset - abs(off)).max() < 0.01


def test_abscissa_is_continuous_across_the_ostium_and_joints_off_the_axis():
    tree = forked_tree()
    way = np.linspace(-3.0, 30.0, 3301)
    points = np.stack([0 * way, np.full(len(way), 1.5), way], axis=1)
    for direction in ([0.0, 0.0, 1.0], [0.0, 0.15, np.sqrt(1 - 0.15**2)], [0.0, -0.15, np.sqrt(1 - 0.15**2)]):
        found = project_tip(tree, Insertion(np.zeros(3), np.array(direction)), points)
        assert np.abs(np.diff(found.abscissa)).max() < 0.05
        assert np.diff(found.abscissa).min() >= 0.0


def test_a_step_into_a_branch_is_no_longer_than_the_shortcut():
    tree = forked_tree()
    rng = np.random.default_rng(1)
    for _ in range(20):
        start = np.array([0.0, 0, 15]) + rng.uniform(-1.0, 1.0, 3)
        end = np.array([6.0, 0, 23.5]) + rng.uniform(-0.6, 0.6, 3)
        share = np.linspace(0.0, 1.0, 2001)[:, None]
        found = project_tip(tree, INSERTION, (1 - share) * start + share * end)
        jump = np.abs(np.diff(found.abscissa))
        change = np.flatnonzero(np.diff(found.branch))
        assert found.branch[-1] == 2 and np.delete(jump, change).max() < 0.02
        assert (jump[change] <= found.offset[change] + found.offset[change + 1] + 0.02).all()


def test_the_safety_ratio_is_the_share_of_the_room_between_centerline_and_wall():
    offset, radius = np.array([0.0, 0.75, 1.32, 1.4]), np.full(4, 1.5)
    np.testing.assert_allclose(safety_ratio(offset, radius, 0.18), [0.0, 0.75 / 1.32, 1.0, 1.4 / 1.32])
    np.testing.assert_allclose(safety_ratio(offset, radius, 0.0), offset / 1.5)
    # Where the wire fills the lumen, the wall is reached wherever the wire lies.
    assert safety_ratio(np.array([0.0, 0.1]), np.array([0.18, 0.1]), 0.18).tolist() == [1.0, 1.0]
    assert np.isnan(safety_ratio(np.array([np.nan, 0.1]), np.array([0.1, np.nan]), 0.18)).all()
