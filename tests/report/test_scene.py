from __future__ import annotations

import dataclasses
import os

import numpy as np
import pytest

from endopilot.anatomy.wall_mesh import wall_mesh
from endopilot.devices.catheter import read_catheter
from endopilot.devices.stack import SHOWN_BEHIND_MM, Stack
from endopilot.report import still
from endopilot.report.scene import navigation_scene, visible_devices
from endopilot.report.still import LIBRARIES_MISSING, render_still
from endopilot.simulation.trajectory import Trajectory
from endopilot.types import DistanceMap, TipProjection

CENTRE, SQUEEZE = np.array([1.0, 2.0, 3.0]), np.array([1.0, 2.0, 1.5])


def egg(radius_mm: float, spacing_mm: float, origin_mm: np.ndarray) -> DistanceMap:
    """Return an ellipsoid with three different axes as (about) a distance map."""
    axes = [np.arange(low, low + 24.0, spacing_mm) for low in origin_mm]
    z, y, x = np.meshgrid(*axes[::-1], indexing="ij")
    squeezed = (np.stack([x, y, z], axis=-1) - CENTRE) * SQUEEZE
    return DistanceMap(radius_mm - np.linalg.norm(squeezed, axis=-1), spacing_mm, origin_mm)


@pytest.mark.parametrize("max_triangles", [100_000, 2_000])
def test_the_wall_lies_where_the_distance_is_zero(max_triangles):
    surface = wall_mesh(egg(8.0, 0.5, np.array([-11.0, -10.0, -9.0])), max_triangles=max_triangles)
    assert len(surface.triangles) <= max_triangles
    distance = np.linalg.norm((surface.vertices - CENTRE) * SQUEEZE, axis=1)
    np.testing.assert_allclose(distance, 8.0, atol=0.1)


def test_a_lumen_that_reaches_the_edge_of_its_map_is_closed_there():
    surface = wall_mesh(egg(8.0, 0.5, np.array([1.0, -10.0, -9.0])))
    edges = np.sort(surface.triangles[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1)
    _, count = np.unique(edges, axis=0, return_counts=True)
    assert (count == 2).all()


def test_the_wire_is_shown_from_its_tip_to_just_behind_the_ostium(rollout):
    (wire,) = visible_devices(rollout, 0, 3)
    np.testing.assert_array_equal(wire[0], rollout.tip_position[0, 3, 0])
    length = np.linalg.norm(np.diff(wire, axis=0), axis=1).sum()
    assert (
        rollout.inserted_length[0, 3, 0] + SHOWN_BEHIND_MM - 2.0
        < length
        <= rollout.inserted_length[0, 3, 0] + SHOWN_BEHIND_MM
    )


def test_every_sample_is_a_frame_and_a_step_of_the_slider(anatomy, rollout):
    figure = navigation_scene(anatomy, rollout)
    frames = list(figure.frames)
    assert [frame.name for frame in frames] == [str(sample) for sample in range(6)]
    steps = figure.layout.sliders[0].steps
    assert [step.label for step in steps] == ["0.5", "1", "1.5", "2", "2.5", "3"]
    np.testing.assert_allclose(np.array(frames[4].data[0].z)[0], rollout.tip_position[0, 4, 0, 2])
    assert "Δtip = 24.0 mm" in frames[4].data[0].hovertemplate
    # The frames replace the wire, its trail and its tip, not the vessel.
    assert [figure.data[index].name for index in frames[4].traces] == ["Guidewire", "Tip, last 20 s", "Tip"]


@pytest.fixture
def pair(rollout) -> Trajectory:
    """Return the wire with a catheter that stays behind it until the last sample, in which it leads by 2 mm."""
    inserted = np.array([0.0, 3.0, 7.0, 9.0, 12.0, 30.0])[None, :, None]
    deepest = np.maximum(rollout.inserted_length, inserted)
    shape = rollout.shape.copy()
    shape[..., 2] = -deepest + 2.0 * np.arange(shape.shape[2])
    both = {
        each.name: np.repeat(value, 2, axis=2)
        for each in dataclasses.fields(rollout)
        if each.name != "shape" and np.ndim(value := getattr(rollout, each.name)) > 2 and value.shape[1] == 6
    }
    both["inserted_length"][:, :, 1:] = inserted
    both["rotation"][:, :, 1] = np.pi
    both["tip_position"][:, :, 1, 2] = -inserted[..., 0]
    both["drive_force"][:] = 0.5, 0.25
    tip = TipProjection(**{name: np.repeat(value, 2, axis=2) for name, value in vars(rollout.tip).items()})
    start = np.repeat(rollout.start, 2, axis=1)
    return dataclasses.replace(rollout, shape=shape, tip=tip, start=start, **both)


@pytest.fixture
def devices(wire):
    """Return a wire and a catheter around it."""
    return Stack(wire, (read_catheter("microcatheter-2.4f"),)).devices


def test_a_catheter_covers_its_wire_and_both_are_named(anatomy, pair, devices):
    wire, catheter, *others = navigation_scene(anatomy, pair, devices=devices).frames[2].data
    assert (wire.name, catheter.name) == ("Guidewire workhorse-014", "Catheter microcatheter-2.4f")
    assert [trace.name for trace in others] == ["Tip, last 20 s", "Tip"]
    assert wire.line.color != catheter.line.color
    assert catheter.line.width / wire.line.width == pytest.approx(devices[1].diameter_mm / 0.36, rel=0.05)
    z = np.array(wire.z), np.array(catheter.z)
    np.testing.assert_allclose(z[0], [-16.0, -14.0, -12.0, -10.0, -8.0, -7.0])
    np.testing.assert_allclose(z[1][[0, 1, -1]], [-7.0, -6.0, SHOWN_BEHIND_MM])
    assert "Δtip = 16.0 mm" in wire.hovertemplate and "push of its drive = 0.50 N" in wire.hovertemplate
    for state in ("Δ = 7.0 mm", "φ = 180°", "push of its drive = 0.25 N"):
        assert state in catheter.hovertemplate


def dies(*given):
    os.abort()


def test_a_renderer_that_dies_is_one_line_and_no_picture(anatomy, tmp_path, monkeypatch):
    monkeypatch.setattr(still, "render", dies)
    assert render_still(anatomy, [], tmp_path / "scene.png") == LIBRARIES_MISSING
    assert "apt-get install" in LIBRARIES_MISSING
    assert "\n" not in LIBRARIES_MISSING
    assert list(tmp_path.iterdir()) == []


def test_the_still_picture_shows_vessel_wire_and_catheter(anatomy, pair, devices, tmp_path):
    from matplotlib.image import imread

    if render_still(anatomy, visible_devices(pair, 0, 4), tmp_path / "scene.png", devices=devices) is not None:
        pytest.skip("VTK finds no graphics library here")
    picture = imread(tmp_path / "scene.png")[..., :3]
    turquoise = (picture[..., 1:].min(axis=-1) > picture[..., 0] + 0.3).mean()
    reddish = (picture[..., 0] > picture[..., 2] + 0.1).mean()
    assert turquoise > 1e-3 and 0.01 < reddish < 0.6  # the catheter and the vessel
    assert (picture.min(axis=-1) > 0.6).mean() > 1e-4  # the wire
