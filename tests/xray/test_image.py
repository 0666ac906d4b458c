"""X-ray images against closed forms: what a wire, a vessel and a patient take away; and `endopilot xray`."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter
from scipy.special import erf

from endopilot.devices.catheter import read_catheter
from endopilot.devices.stack import Stack
from endopilot.errors import InputError, Remark
from endopilot.types import Insertion, Volume
from endopilot.xray.absorbers import (
    CATHETER_MM,
    COIL_MM,
    MARKER_LENGTH_MM,
    MARKER_MM,
    MARKER_WALL_MM,
    STEEL_MM,
    WATER_MM,
    catheter_line,
    in_catheter,
)
from endopilot.xray.carm import Pose
from endopilot.xray.image import PHOTONS_MM2_UGY, ImageConfig, XrayImager
from endopilot.xray.take_image import TakeImageConfig, take_image


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
    radius = imager.stack.wire.tip_radius_mm
    metal = np.pi * radius**2 * (30.0 * COIL_MM + 10.0 * STEEL_MM)
    assert wire.sum() * side**2 == pytest.approx(metal, rel=2e-3)


@pytest.mark.parametrize("name", ["microcatheter-1.7f", "microcatheter-2.4f", "straight-5f"])
def test_a_driven_catheter_takes_away_what_its_wall_and_marker_do(fork, wire, name):
    """Summed over the image, attenuation × pixel area = μ π (R² - r²) L of the wall, and that of the tip's ring."""
    catheter = read_catheter(name)
    imager = XrayImager(fork, Stack(wire, (catheter,)))
    plane = imager.plane((0.0, 0.0))
    side = imager.config.geometry.pixel_mm / magnification(imager)
    nodes = imager.isocenter + np.linspace(-15, 15, 9)[:, None] * np.array([0.6, 0.0, 0.8])
    drawn = imager.wire(plane, nodes, number=1)
    outer, inner = catheter.diameter_mm / 2, catheter.inner_diameter_mm / 2
    wall = CATHETER_MM * np.pi * (outer**2 - inner**2) * 30.0
    ring = 2 * np.pi * (outer + inner) / 2 * MARKER_WALL_MM * MARKER_LENGTH_MM * MARKER_MM
    marked = name.startswith("micro")  # a diagnostic catheter has none
    assert drawn.sum() * side**2 == pytest.approx(wall + marked * ring, rel=5e-3)
    row, column = np.rint(plane.pixel(nodes[0])).astype(int)
    tip, shaft = drawn[row - 6 : row + 7, column - 6 : column + 7].max(), drawn[250:262, 250:262].max()
    assert (tip > 3 * shaft) == marked


def test_a_frame_adds_the_catheter_to_the_wire(fork, wire, imager):
    pair = XrayImager(fork, Stack(wire, (read_catheter("microcatheter-1.7f"),)))
    plane = pair.plane((0.0, 0.0))
    nodes = pair.isocenter + np.linspace(0, 20, 41)[:, None] * np.array([0, 0, 1.0])
    alone, both = (pair.signal(plane, nodes, dose=1e8, catheters=shown) for shown in ([], [nodes[20:]]))
    np.testing.assert_array_equal(alone, imager.signal(imager.plane((0.0, 0.0)), nodes, dose=1e8))
    marker, ahead = (tuple(np.rint(plane.pixel(nodes[at])).astype(int)) for at in (21, 2))
    assert both[marker] < alone[marker] - 0.1
    assert both[ahead] == pytest.approx(alone[ahead], abs=1e-3)


def test_the_wire_lies_where_the_view_projects_it(imager):
    plane = imager.plane((30.0, 20.0), 1.5)
    place = imager.isocenter + np.array([5.0, -3.0, 8.0])
    nodes = place + np.linspace(0, 0.5, 3)[:, None] * np.array([0, 0, 1.0])
    wire = imager.wire(plane, nodes)
    rows, columns = np.indices(wire.shape)
    found = np.array([(columns * wire).sum(), (rows * wire).sum()]) / wire.sum()
    right, up = plane.view.project(nodes.mean(axis=0))
    middle = (imager.config.pixels - 1) / 2
    np.testing.assert_allclose(found, [middle + right, middle - up], atol=0.1)


def test_a_slab_of_water_takes_away_what_water_does(fork, wire):
    """Uniform water in air, 120 mm thick: ∫ μ dl = 120 μ in the middle, and more by 1/cos along an oblique ray."""
    size = np.array([60, 40, 60]) + 2  # x, y, z voxels of 3 mm, the outermost of air
    start = np.concatenate([branch.centerline.points for branch in fork.tree.branches]).mean(axis=0)
    voxels = np.pad(np.zeros((60, 40, 60)), 1, constant_values=-1000.0)
    water = Volume(voxels, np.full(3, 3.0), start - 3.0 * (size - 1) / 2, np.eye(3))
    imager = XrayImager(fork, wire, ct=water, config=ImageConfig(pixels=128))
    background = imager.plane((0.0, 0.0), 0.25, rays=64).background
    assert background[64, 64] == pytest.approx(WATER_MM * 120.0, rel=0.01)
    offset = 60 * 4 * imager.config.geometry.pixel_mm / imager.config.geometry.source_to_detector_mm
    assert background[64, 124] / background[64, 64] == pytest.approx(np.sqrt(1 + offset**2), rel=0.01)


def test_more_dose_is_more_air_kerma(imager):
    plane = imager.plane((0.0, 0.0))
    assert imager.air_kerma_ugy(plane, 2.0) == pytest.approx(2 * imager.air_kerma_ugy(plane, 1.0))
    assert 0.1 < imager.air_kerma_ugy(plane, 1.0) < 100  # µGy a frame: fluoroscopy of a chest


def test_scatter_spreads_a_share_of_the_light(imager):
    """Far from the image's edges an even beam is scattered into itself: scatter = share × primary."""
    plane = imager.plane((0.0, 0.0))
    primary = np.exp(-WATER_MM * 200)
    middle = plane.scatter[250:262, 250:262].mean()
    # erf: the beam ends at ±256 pixels of 0.308 mm, which is 2.63 standard deviations of 30 mm
    assert middle == pytest.approx(imager.config.scatter * primary * erf(256 * 0.308 / 30 / np.sqrt(2)) ** 2, rel=0.02)
    assert plane.scatter[0, 0] == pytest.approx(0.25 * imager.config.scatter * primary, rel=0.1)
    # A grid of ratio 10 lets 0.706 of primary and 0.21 of scattered light through (Altunbas 2016, doi
    # 10.1118/1.4957763): 0.3 is what it leaves of as much scatter as primary light. Behind 300 mm of acrylic it left
    # 1.28, more than is here.
    assert middle / primary == pytest.approx(0.21 / 0.706, rel=0.05)


def test_motion_blurs_a_wire_along_its_path(imager):
    """Across its axis a wire that moves by d while it is exposed has a profile whose variance grows by d²/12."""
    plane = imager.plane((0.0, 0.0))
    nodes = imager.isocenter + np.linspace(-5, 5, 9)[:, None] * np.array([0.0, 0.0, 1.0])
    speed = np.tile([250.0, 0.0, 0.0], (9, 1))  # 2 mm in a pulse of 8 ms
    still, moving = (imager.wire(plane, nodes, velocity=velocity) for velocity in (None, speed))
    columns = np.arange(512)

    def middle_and_variance(image):
        profile = image.sum(axis=0)
        middle = (profile * columns).sum() / profile.sum()
        return middle, (profile * (columns - middle) ** 2).sum() / profile.sum()

    path = 2.0 * magnification(imager) / imager.config.geometry.pixel_mm
    (at, narrow), (at_moving, wide) = middle_and_variance(still), middle_and_variance(moving)
    assert wide - narrow == pytest.approx(path**2 / 12, rel=0.05)
    assert at - at_moving == pytest.approx(path / 2, rel=0.02)  # the pulse ends with the wire at its nodes
    assert moving.sum() == pytest.approx(still.sum(), rel=1e-3)


def test_subtraction_leaves_the_contrast_alone(imager):
    """The logarithm of an image less that of its mask is the contrast's attenuation, wherever scatter is absent."""
    plane = imager.plane((0.0, 0.0))
    uneven = np.linspace(0, 2, 512, dtype=np.float32)
    plane = replace(plane, scatter=0 * plane.scatter, background=plane.background + uneven)
    none = np.zeros((0, 3))
    dose = 1e8  # hardly any noise
    lit, mask = imager.signal(plane, none, contrast=0.5, dose=dose), imager.signal(plane, none, dose=dose, seed=1)
    np.testing.assert_allclose(lit - mask, -0.5 * imager.config.iodine_mm * plane.vessel_mm, atol=1e-3)
    grey = imager.grey(lit, mask=mask)
    assert len(np.unique(grey[plane.vessel_mm == 0])) <= 2


def test_a_pose_moves_the_patient_in_the_image(imager):
    """A translation across the beam moves everything by as many pixels; the isocenter is the middle of a rotation."""
    still = imager.plane((0.0, 0.0))
    moved = imager.plane((0.0, 0.0), pose=Pose(np.array([0.0, 0.2, 0.0]), np.array([4.0, 0.0, -3.0])))
    per_mm = magnification(imager) / imager.config.geometry.pixel_mm
    change = moved.pixel(imager.isocenter) - still.pixel(imager.isocenter)
    np.testing.assert_allclose(change, [3.0 * per_mm, 4.0 * per_mm], atol=1e-6)  # down by 3 mm, right by 4 mm
    place = imager.isocenter + np.array([0.0, 0.0, 10.0])
    pose = Pose(np.array([0.0, 0.2, 0.0]), np.array([4.0, 0.0, -3.0]))
    np.testing.assert_allclose(moved.pixel(place), still.pixel(pose.move(place, imager.isocenter)), atol=1e-6)


def test_a_coronary_catheter_bends_up_behind_its_straight_end(fork):
    """A wire behind the ostium is laid along the bend, as far from the axis as before; elsewhere all stays."""
    nodes = np.array([[0.1, 0.0, 5.0], [0.1, 0.2, -3.0], [0.0, 0.1, -90.0]])
    np.testing.assert_allclose(in_catheter(fork, nodes), nodes, atol=1e-9)  # no coronary: straight
    level = Insertion(np.zeros(3), np.array([1.0, 0.0, 0.0]))
    tree = replace(fork.tree, section_names=("1", *fork.tree.section_names[1:]))
    coronary = replace(fork, tree=tree, insertion=level)
    distance, places, heading = catheter_line(coronary)
    np.testing.assert_allclose(places[:11], -distance[:11, None] * level.direction, atol=1e-9)
    np.testing.assert_allclose(heading[-1], [0.0, 0.0, 1.0], atol=1e-9)
    np.testing.assert_allclose(places[-1, 0], -10.0 - 25.0, atol=0.1)  # 10 mm straight, then a quarter of a circle
    steps = np.linalg.norm(np.diff(places, axis=0), axis=1)
    np.testing.assert_allclose(steps, 1.0, rtol=1e-3)
    wire = np.array([[3.0, 0.1, 0.0], [-3.0, 0.1, 0.0], [-80.0, 0.3, 0.0]])
    laid = in_catheter(coronary, wire)
    np.testing.assert_allclose(laid[:2], wire[:2], atol=1e-9)
    np.testing.assert_allclose(laid[2] - places[80], [0.0, 0.3, 0.0], atol=1e-9)


def test_a_vessel_that_passes_behind_the_ostium_is_not_laid_into_the_catheter(fork):
    """A right coronary artery comes back below its ostium, behind the plane across the catheter's axis."""
    tree = replace(fork.tree, section_names=("1", *fork.tree.section_names[1:]))
    coronary = replace(fork, tree=tree, insertion=Insertion(np.zeros(3), np.array([1.0, 0.0, 0.0])))
    turn = np.linspace(1.5 * np.pi, 0.0, 40)
    nodes = np.stack([40 * np.sin(turn), 0 * turn, 40 * np.cos(turn) - 40], axis=-1)  # from the tip to the ostium
    assert nodes[:12, 0].max() < 0  # behind the plane
    shaft = np.stack([-np.arange(1.0, 41.0), 0 * turn, 0 * turn], axis=-1)
    laid = in_catheter(coronary, np.concatenate([nodes, shaft]))
    np.testing.assert_allclose(laid[:40], nodes, atol=1e-9)
    assert np.abs(laid[40:] - shaft).max() > 1.0  # the catheter itself bends


def noise_of(fork, wire, *, dose=1.0, seed=0, before=None, **changes):
    """Return the noise of a flat image, and how many photons a pixel counts."""
    flat = XrayImager(fork, wire, config=ImageConfig(pixels=256, **changes))
    plane = flat.plane((0.0, 0.0))
    plane = replace(plane, background=np.full_like(plane.background, 4.0), scatter=np.zeros_like(plane.scatter))
    plane = replace(plane, reference=-4.0)
    return flat.signal(plane, np.zeros((0, 3)), dose=dose, seed=seed, before=before), flat.photons(plane, dose)


def test_the_noise_power_spectrum_is_that_of_photons_in_a_scintillator(fork, wire):
    """NNPS(f) = |H(f)|² / (q η): photons q a mm², of which η count; H is that of the scintillator's blur in pixels."""
    config, power, impulse = ImageConfig(), 0.0, np.zeros((256, 256))
    impulse[0, 0] = 1.0
    blur = gaussian_filter(impulse, config.scintillator_mm / config.geometry.pixel_mm, mode="wrap")
    kerma = 2.57  # µGy, of the measurement below
    modulation, photons = np.abs(np.fft.fft2(blur)), PHOTONS_MM2_UGY * kerma
    for seed in range(12):
        noise, _ = noise_of(fork, wire, dose=kerma / config.detector_ugy, seed=seed)
        power = power + np.abs(np.fft.fft2(noise - noise.mean())) ** 2 * config.geometry.pixel_mm**2 / noise.size / 12
    frequency = np.fft.fftfreq(256, config.geometry.pixel_mm)
    radial = np.hypot(frequency[:, None], frequency)

    def mean(values, low, high):
        return values[(radial > low) & (radial < high)].mean()

    for band in ((0.1, 0.3), (0.5, 0.7), (0.9, 1.1), (1.3, 1.5)):
        known = mean(modulation**2, *band) / (photons * config.efficiency)
        assert mean(power, *band) == pytest.approx(known, rel=0.04)
    # six panels of caesium iodide at 70 kV behind 1 mm of copper: 1.42e-5 mm² at 2.57 µGy, give or take 6.5 %, and a
    # detective quantum efficiency of 0.60 at 0.5 /mm (Marshall 2011, doi 10.1088/0031-9155/56/4/007)
    assert mean(power, 0.4, 0.6) == pytest.approx(1.42e-5, rel=0.065)
    efficiency = [mean(modulation**2, *band) / (photons * mean(power, *band)) for band in ((0.05, 0.2), (0.4, 0.6))]
    # near 0 /mm: 0.55 (Jain 2011, doi 10.1118/1.3599751), 0.64 (Friedman 2010, doi 10.1118/1.3495968), 0.70 (Spahn
    # 2000, Invest Radiol 35:260), 0.77 (Granfors 2003, Med Phys 30:2715)
    assert 0.55 < efficiency[0] < 0.77
    assert 0.60 < efficiency[1] == pytest.approx(efficiency[0], rel=0.05)  # that of panels falls with frequency


def test_noise_of_the_electronics_equals_that_of_photons_at_its_air_kerma(fork, wire):
    """Variances 1/N of photons and (K_e/K)/N of electronics add up, where the scintillator blurs nothing."""
    for dose in (1.0, 0.25):
        noise, photons = noise_of(fork, wire, dose=dose, scintillator_mm=0.0, electronic_noise_ugy=0.03)
        assert noise.var() * photons == pytest.approx(1 + 1 / dose, rel=0.03)


def test_a_temporal_filter_lowers_the_noise_of_what_stands_still(fork, wire):
    """The variance of y ← w y + (1 - w) x is (1 - w)/(1 + w) times that of x."""
    plain, before = noise_of(fork, wire)[0], noise_of(fork, wire, temporal_weight=0.6, seed=0, before=None)[0]
    for seed in range(1, 8):
        before, _ = noise_of(fork, wire, temporal_weight=0.6, seed=seed, before=before)
    assert before.var() / plain.var() == pytest.approx(0.4 / 1.6, rel=0.05)


def test_edges_are_enhanced_and_the_mean_is_kept(imager, fork, wire):
    """Unsharp masking multiplies what is finer than its blur by 1 + weight, and leaves the rest."""
    sharp = XrayImager(fork, wire, config=ImageConfig(edge_weight=2.0, edge_mm=3.0))
    nodes = imager.isocenter + np.linspace(-20, 20, 9)[:, None] * np.array([0.6, 0.0, 0.8])
    plane = imager.plane((0.0, 0.0))
    clear = plane.background.min() - 1
    plane = replace(plane, background=np.full_like(plane.background, clear))
    plain, enhanced = (one.signal(plane, nodes, dose=1e8) for one in (imager, sharp))
    assert enhanced.mean() == pytest.approx(plain.mean(), abs=1e-3)
    depth, deeper = np.median(plain) - plain.min(), np.median(enhanced) - enhanced.min()
    assert 2.2 < deeper / depth < 3.0
    assert enhanced.max() > plain.max() + 0.05  # a bright rim beside the wire


def shown(fork, **changes):
    return take_image(fork, config=TakeImageConfig(view_deg=(0.0, 0.0), inserted_length_mm=12.0, **changes))


def darker(image, row: int, column: int) -> float:
    """Return by how much a small square is darker than the image."""
    square = image.grey[row - 1 : row + 2, column - 1 : column + 2]
    return float(np.median(image.grey)) - float(square.mean())


def test_fluoroscopy_shows_the_wire_to_its_tip(fork):
    """The straight wire lies along z: above its tip there is no wire, 5 mm below it there is."""
    image = shown(fork, dose=10.0)
    row, column = np.rint(image.tip_pixel).astype(int)
    below = row + round(5.0 / image.mm_per_pixel)
    darkest = max(darker(image, below, column + side) for side in range(-4, 5))
    assert darkest > 30 > 10 > darker(image, row - 10, column)
    assert (image.frames, image.air_kerma_ugy > 0) == (1, True)


def test_dsa_and_roadmap_show_the_vessel_and_take_two_frames(fork):
    plain, dsa, roadmap = (shown(fork, show=kind, dose=4.0) for kind in ("fluoroscopy", "dsa", "roadmap"))
    row, column = np.rint(plain.tip_pixel).astype(int)
    place = row - round(10.0 / plain.mm_per_pixel), column  # in the vessel, ahead of the wire
    assert darker(dsa, *place) > 10
    assert darker(roadmap, *place) < darker(plain, *place) - 10
    assert (dsa.frames, roadmap.frames) == (2, 2)
    assert dsa.air_kerma_ugy == pytest.approx(2 * plain.air_kerma_ugy)


@pytest.mark.parametrize("shift_mm", [(-250.0, 0.0, 0.0), (0.0, 0.0, 90.0), (0.0, -33.0, 33.0)])
def test_a_ct_of_another_place_is_refused_with_both_boxes(fork, shift_mm):
    points = np.concatenate([branch.centerline.points for branch in fork.tree.branches])
    low, high = points.min(axis=0) - 5.0, points.max(axis=0) + 5.0
    voxels = np.full(np.ceil((high - low) / 2.0).astype(int)[::-1] + 1, 40, dtype=np.int16)
    there = Volume(voxels, np.full(3, 2.0), low, np.eye(3))
    XrayImager(fork, "workhorse-014", ct=there)
    with pytest.raises(InputError, match=r"^ct: the CT spans x .* mm; .*% of the vessel .* \(x .*\) lies outside"):
        XrayImager(fork, "workhorse-014", ct=replace(there, origin_mm=low + shift_mm))
    with pytest.warns(Remark, match=r"[1-4]?\d% of the vessel"):
        XrayImager(fork, "workhorse-014", ct=replace(there, voxels=voxels[3:], origin_mm=low + np.array([0, 0, 8.5])))


def test_a_breath_moves_vessel_and_wire_in_the_image(fork):
    """Two seconds into a breath the vessel lies 4.9 mm nearer to the feet: lower in a view from the front."""
    plain, inspired = shown(fork, dose=10.0), shown(fork, dose=10.0, motion="breathing", time_s=2.0)
    down = inspired.tip_pixel[0] - plain.tip_pixel[0]
    assert down * plain.mm_per_pixel == pytest.approx(4.9, abs=0.5)
    row, column = np.rint(inspired.tip_pixel).astype(int)
    below = row + round(5.0 / plain.mm_per_pixel)
    assert max(darker(inspired, below, column + side) for side in range(-4, 5)) > 30
    assert shown(fork, motion="breathing").tip_pixel == pytest.approx(plain.tip_pixel, abs=0.5)


def test_a_catheter_is_shown_up_to_its_own_tip(fork, monkeypatch):
    """The line that both share, cut at each tip, ends where the core has the tips."""
    seen = {}
    signal = XrayImager.signal
    monkeypatch.setattr(XrayImager, "signal", lambda *given, **how: seen.update(how) or signal(*given, **how))
    for deep in (7.0, 14.0):  # behind the wire's tip, at 12 mm, and ahead of it
        image = shown(fork, catheter=("microcatheter-1.7f",), catheter_inserted_length_mm=deep)
        (line,) = seen["catheters"]
        assert line[0, 2] == pytest.approx(deep, abs=0.3)
        assert np.linalg.norm(image.tip_pixel - shown(fork).tip_pixel) * image.mm_per_pixel < 1.0
