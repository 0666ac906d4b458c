"""φ's zero belongs to the vessel: a wire in a turned vessel does the same, turned, whatever the world's axes are."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from endopilot.anatomy.catheter_axis import turned_axis, with_axis, with_world_zero
from endopilot.anatomy.distance import add_catheter, distance_map_from_spheres
from endopilot.anatomy.tree import Line, tree_from_lines
from endopilot.devices.device import read_wire
from endopilot.errors import InputError
from endopilot.simulation.config import SimulatorConfig
from endopilot.simulation.simulate import simulate
from endopilot.types import Anatomy, Insertion

RADIUS_MM, CATHETER_MM = 1.5, 0.9
# Two maps of one vessel on grids that lie differently in it differ by some hundredths of a mm at this spacing.
SPACING_MM, ALIKE_MM = 0.3, 0.05


def vessel(turn: Rotation) -> Anatomy:
    """Return a vessel along +z that bends and twists, and leaves a branch, with all its points turned."""
    along = np.arange(0.0, 45.0, 0.75)
    course = np.column_stack([0.012 * along**2, 4.0 * np.sin(along / 18.0) ** 2, along])
    side = course[28] + np.linspace(0.0, 12.0, 13)[:, None] * np.array([-0.6, 0.3, 0.74])
    lines = [(course, -1, 0), (side, 0, 28)]
    tree = tree_from_lines(
        [Line(turn.apply(points), np.full(len(points), RADIUS_MM), parent, place) for points, parent, place in lines]
    )
    return made(tree, Insertion(turn.apply(course[0]), turn.apply([0.0, 0.0, 1.0])))


def zero_of(anatomy: Anatomy) -> np.ndarray:
    """Return where the bend of a tip points at φ = 0."""
    assert isinstance(anatomy.insertion.rotation_zero, np.ndarray)
    return anatomy.insertion.rotation_zero


def made(tree, insertion: Insertion) -> Anatomy:
    """Return the anatomy of a tree of spheres."""
    lumen = distance_map_from_spheres(tree, spacing_mm=SPACING_MM)
    return Anatomy("vessel", tree, add_catheter(lumen, insertion, CATHETER_MM), insertion, CATHETER_MM)


def tips(anatomy: Anatomy) -> np.ndarray:
    """Return the tips of two wires that are pushed and turned."""
    control = np.zeros((2, 14, 2))
    control[:, :, 0], control[:, 4:, 1] = 4.0, np.array([[0.4], [-0.6]])
    initial, config = np.array([[5.0, 0.0], [5.0, 2.0]]), SimulatorConfig(element_mm=1.0)
    trajectory = simulate(anatomy, read_wire("workhorse-014"), control, initial=initial, config=config)
    assert trajectory.valid.all()
    return trajectory.tip_position[:, :, 0]


# +z stays, becomes −z about either of the other axes (where the shortest turn from +z is singular), becomes +x, +y;
# then any turns.
TURNS = [
    *(Rotation.from_euler("xyz", angles, degrees=True) for angles in ([180, 0, 0], [0, 180, 0], [0, 90, 0])),
    Rotation.random(rng=np.random.default_rng(35)),
]


def test_a_turned_vessel_turns_the_motion():
    at_first = tips(vessel(Rotation.identity()))
    for turn in TURNS:
        again = turn.inv().apply(tips(vessel(turn)).reshape(-1, 3)).reshape(at_first.shape)
        assert np.abs(again - at_first).max() < ALIKE_MM
    before, turned = (tips(with_world_zero(vessel(turn))) for turn in (Rotation.identity(), TURNS[-1]))
    off_mm = np.abs(TURNS[-1].inv().apply(turned.reshape(-1, 3)).reshape(before.shape) - before).max()
    assert off_mm > 1.0  # by the world's axes it does something else: the comparison above can fail


@pytest.mark.parametrize("direction", [[0.0, 0.0, 1.0], [0.0, 0.0, -1.0], [0.6, 0.0, -0.8], [0.1, -0.99, 0.1]])
def test_the_bend_points_to_the_zero_and_turns_clockwise_as_the_operator_sees_it(direction):
    axis = np.array(direction) / np.linalg.norm(direction)
    tree = tree_from_lines([Line(np.arange(0.0, 41.0)[:, None] * axis, np.full(41, 8.0), -1, 0)])
    insertion = Insertion(np.zeros(3), axis)
    lumen = add_catheter(distance_map_from_spheres(tree, spacing_mm=1.5), insertion, 8.0)
    anatomy = Anatomy("wide", tree, lumen, insertion, 8.0)
    phi, device = 0.5, read_wire("workhorse-014")
    trajectory = simulate(anatomy, device, np.zeros((1, 1, 2)), initial=np.array([[15.0, phi]]))
    zero = zero_of(anatomy)
    right = np.cross(axis, zero)  # of the operator, who looks along the axis with the zero above
    across = trajectory.tip_direction[0, 0, 0] - (trajectory.tip_direction[0, 0, 0] @ axis) * axis
    expected = np.cos(phi) * zero + np.sin(phi) * right
    assert across / np.linalg.norm(across) == pytest.approx(expected, abs=1e-3)


@pytest.mark.parametrize(
    ("direction", "zero"),
    [
        ([0.0, 0.0, 1.0], [0.0, -1.0, 0.0]),
        ([0.0, 0.0, -1.0], [0.0, -1.0, 0.0]),
        ([0.8, 0.6, 0.0], [0.6, -0.8, 0.0]),
        ([0.0, 1.0, 0.0], [0.0, 0.0, 1.0]),
    ],
)
def test_the_zero_of_a_straight_vessel_is_the_front_of_the_patient_or_its_head(direction, zero):
    points = np.arange(0.0, 31.0)[:, None] * np.array(direction)
    points += np.random.default_rng(0).normal(0.0, 0.1, points.shape)  # a mask's roughness decides nothing
    tree = tree_from_lines([Line(points, np.full(31, 2.0), -1, 0)])
    assert tree.rotation_zero(Insertion(np.zeros(3), np.array(direction))) == pytest.approx(np.array(zero))


def test_the_zero_turns_with_a_catheter_that_leans():
    anatomy = vessel(TURNS[0])  # along −z, where a zero by the world's axes spins
    axis = anatomy.insertion.direction
    for side_deg in (0.0, 90.0, 200.0):
        leaned = with_axis(anatomy, turned_axis(axis, 8.0, side_deg))
        assert np.degrees(np.arccos(zero_of(leaned) @ zero_of(anatomy))) < 8.0 + 1e-6
        assert abs(zero_of(leaned) @ leaned.insertion.direction) < 1e-12
        assert zero_of(with_axis(leaned, axis)) == pytest.approx(zero_of(anatomy), abs=1e-12)
    assert with_axis(with_world_zero(anatomy), turned_axis(axis, 8.0, 0.0)).insertion.rotation_zero == "world axes"


def test_a_zero_that_is_not_across_the_catheter_is_refused():
    anatomy = vessel(Rotation.identity())
    stale = replace(anatomy.insertion, rotation_zero=np.array([0.0, 0.6, 0.8]))
    with pytest.raises(InputError, match=r"rotation_zero = .* is no unit vector across"):
        tips(replace(anatomy, insertion=stale))
