"""X-ray images against closed forms: what a wire, a vessel and a patient take away, and the noise that is left."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from endopilot.types import Volume
from endopilot.xray.image import _COIL_MM, _STEEL_MM, PHOTONS_MM2_UGY, WATER_MM, ImageConfig, XrayImager


@pytest.fixture(scope="module")
def imager(fork, wire):
    return XrayImager(fork, wire)


def magnification(imager):
    geometry = imager.config.geometry
    return geometry.source_to_detector_mm / geometry.source_to_isocenter_mm


def test_a_wire_takes_away_what_its_metal_does(imager):
    """Summed over the image, attenuation × pixel area in the isocenter = ∫ μ π r² ds, wherever the pixels lie."""
    plane = imager.plane((0.0, 0.0))
    side = imager.config.geometry.pixel_mm / magnification(imager)
    nodes = imager.isocenter + np.linspace(-20, 20, 9)[:, None] * np.array([0.6, 0.0, 0.8])
    wire = imager.wire(plane, nodes)
    radius = imager.device.tip_radius_mm
    metal = np.pi * radius**2 * (30.0 * _COIL_MM + 10.0 * _STEEL_MM)
    assert wire.sum() * side**2 == pytest.approx(metal, rel=2e-3)


def test_a_wire_along_the_beam_is_dark_and_short(imager):
    """Foreshortened, the same metal lies on fewer pixels."""
    plane = imager.plane((0.0, 0.0))
    along = np.linspace(-10, 10, 5)[:, None]
    across = imager.wire(plane, imager.isocenter + along * np.array([1.0, 0, 0]))
    down = imager.wire(plane, imager.isocenter + along * np.array([0, 1.0, 0]))
    assert down.max() > 5 * across.max()
    assert down.sum() == pytest.approx(across.sum(), rel=0.01)


def test_the_vessel_is_as_thick_as_it_is(imager, fork):
    """The longest path through a straight vessel across the beam is its diameter, less what the detector blurs."""
    plane = imager.plane((0.0, 0.0))
    diameter = 2 * fork.tree.branches[0].centerline.radius.max()
    assert 0.75 * diameter < np.percentile(plane.vessel_mm[plane.vessel_mm > 0.5], 90) < 1.6 * diameter


def test_the_wire_lies_where_the_view_projects_it(imager):
    plane = imager.plane((30.0, 20.0), 1.5)
    place = imager.isocenter + np.array([5.0, -3.0, 8.0])
    nodes = place + np.linspace(0, 0.5, 3)[:, None] * np.array([0, 0, 1.0])
    wire = imager.wire(plane, nodes)
    rows, columns = np.indices(wire.shape)
    found = np.array([(columns * wire).sum(), (rows * wire).sum()]) / wire.sum()
    right, up = 1.5 * plane.view.project(nodes.mean(axis=0))
    middle = (imager.config.pixels - 1) / 2
    np.testing.assert_allclose(found, [middle + right, middle - up], atol=0.1)


def test_a_slab_of_water_takes_away_what_water_does(fork, wire):
    """A CT of uniform water, 120 mm thick: ∫ μ dl = 120 μ in the middle, and more by 1/cos along an oblique ray."""
    size = np.array([60, 40, 60])  # x, y, z voxels of 3 mm
    start = np.concatenate([branch.centerline.points for branch in fork.tree.branches]).mean(axis=0)
    water = Volume(np.zeros(tuple(size[::-1])), np.full(3, 3.0), start - 3.0 * (size - 1) / 2, np.eye(3))
    imager = XrayImager(fork, wire, water, ImageConfig(pixels=128))
    background = imager.plane((0.0, 0.0), 0.25, rays=64).background
    # The rays run between the middles of the outermost voxels, in steps of 1.5 mm.
    assert background[64, 64] == pytest.approx(WATER_MM * 117.0, rel=0.02)
    offset = 60 * 4 * imager.config.geometry.pixel_mm / imager.config.geometry.source_to_detector_mm
    assert background[64, 124] / background[64, 64] == pytest.approx(np.sqrt(1 + offset**2), rel=0.01)


def test_quantum_noise_is_that_of_the_counted_photons(imager):
    """The standard deviation of ln(signal) is 1/√N with N = dose × photons × efficiency × pixel area."""
    plane = replace(imager.plane((0.0, 0.0)), background=np.full((512, 512), WATER_MM * 200, dtype=np.float32))
    config = imager.config
    for dose in (1.0, 4.0):
        frame = imager.frame(plane, imager.isocenter + np.array([[500.0, 0, 0], [501.0, 0, 0]]), dose=dose, seed=1)
        photons = PHOTONS_MM2_UGY * config.efficiency * config.detector_ugy * dose * config.geometry.pixel_mm**2
        sd = frame[:100].astype(float).std() * config.window / 127.5
        assert sd == pytest.approx(1 / np.sqrt(photons), rel=0.03)


def test_a_frame_follows_from_its_seed(imager):
    plane, nodes = imager.plane((0.0, 0.0)), imager.isocenter + np.linspace(0, 20, 5)[:, None] * np.array([0, 0, 1.0])
    first, again, other = (imager.frame(plane, nodes, seed=seed) for seed in (3, 3, 4))
    np.testing.assert_array_equal(first, again)
    assert (first != other).mean() > 0.9


def test_more_dose_is_more_air_kerma(imager):
    plane = imager.plane((0.0, 0.0))
    assert imager.air_kerma_ugy(plane, 2.0) == pytest.approx(2 * imager.air_kerma_ugy(plane, 1.0))
    assert 0.1 < imager.air_kerma_ugy(plane, 1.0) < 100  # µGy a frame: fluoroscopy of a chest
