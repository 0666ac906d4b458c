"""Tips found in images: against lines of known end, and wires of known tip in a forked vessel."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter
from scipy.special import ndtr

from endopilot.xray.carm import CArmGeometry, view_at
from endopilot.xray.detector import CATHETER_MM, TipDetector
from endopilot.xray.image import XrayImager
from endopilot.xray.tip_posterior import Told, VesselGrid
from endopilot.xray.wire_end import fit_end
from endopilot.xray.wire_likelihood import Shifts, end_log, possible_shifts, tell, way_to

ANGLES = ((-30.0, 0.0), (60.0, 0.0))
TIP = {0: 14.0, 1: 32.0, 2: 32.0}
"""Abscissa of a tip in each branch, mm."""


@pytest.fixture(scope="module")
def imager(fork, wire):
    return XrayImager(fork, wire)


@pytest.fixture(scope="module")
def planes(imager):
    return [imager.plane(angles) for angles in ANGLES]


def wire_to(fork, branch: int) -> np.ndarray:
    """Return the nodes of a wire on the wall of a branch and of those before it, from its tip to the catheter."""
    line = fork.tree.path(branch)
    at = np.arange(TIP[branch], -30.0, -0.5)
    inside = np.stack([np.interp(np.maximum(at, 0.0), line.abscissa, axis) for axis in line.points.T], axis=-1)
    return inside + np.minimum(at, 0.0)[:, None] * fork.insertion.direction + np.array([0.0, 0.4, 0.0])


def exposed(imager, planes, nodes, **how):
    return [imager.signal(plane, nodes, seed=index, **how) for index, plane in enumerate(planes)]


def found_in(imager, planes, signals, length: float, shown=(0, 1), dose: float = 1.0):
    detector = TipDetector(imager.anatomy, imager.stack.wire)
    views, photons = [planes[i].view for i in shown], [imager.photons(planes[i], dose) for i in shown]
    return detector.estimate(views, [signals[i] for i in shown], photons, length)


@pytest.mark.parametrize("branch", TIP)
def test_two_views_find_the_tip_in_space(imager, planes, fork, branch):
    nodes = wire_to(fork, branch)
    found = found_in(imager, planes, exposed(imager, planes, nodes), TIP[branch])
    error = found.position - nodes[0]
    assert np.linalg.norm(error) < 0.4
    assert error @ np.linalg.solve(found.covariance, error) < 16.0  # 4 standard deviations
    shown = np.hstack([np.eye(3), np.eye(3)])  # the tip in the image: its place in the vessel, and the vessel's shift
    assert np.sqrt(np.trace(shown @ found.spread @ shown.T)) < 0.5
    # A straight vessel does not show how far it lies off along itself; only the catheter's end does.
    assert np.sqrt(np.trace(found.covariance)) < 1.0
    start = fork.insertion.position - 8.0 * fork.insertion.direction
    assert np.linalg.norm(found.wire[0] - start) < 1.0 and np.linalg.norm(found.wire[-1] - nodes[0]) < 1.0


@pytest.mark.parametrize("length", [4.0, 14.0])
def test_a_view_along_the_wire_does_not_lengthen_it(imager, planes, fork, length):
    """There the wire is one dark spot: every deeper place of the vessel lies in it, and none of them is evidence."""
    along = imager.plane((0.0, 84.0))
    at = np.arange(length, -30.0, -0.5)
    nodes = np.stack([0.3 + 0 * at, 0 * at, at], axis=-1)
    seen = along.view.slope(nodes[0]) @ [0.0, 0.0, 1.0]
    assert np.linalg.norm(seen) < 0.2 * np.linalg.norm(along.view.slope(nodes[0]), 2)
    both = [planes[0], along]
    found = found_in(imager, both, exposed(imager, both, nodes), length + 1.5)
    assert abs(found.position[2] - length) < 0.5


def test_one_view_leaves_the_depth_to_the_vessel(imager, planes, fork):
    nodes = wire_to(fork, 2)
    found = found_in(imager, planes, exposed(imager, planes, nodes), TIP[2], shown=(0,))
    error = planes[0].view.project(found.position) - planes[0].view.project(nodes[0])
    assert np.linalg.norm(error) < 1.5  # pixels
    beam = planes[0].view.axes[2]
    assert np.sqrt(beam @ found.covariance @ beam) > 0.3  # mm: as wide as the lumen
    assert np.linalg.norm(found.position - nodes[0]) < 1.2


@pytest.mark.parametrize("contrast", [0.0, 0.7])
def test_without_a_wire_none_is_found(imager, planes, fork, contrast):
    """A branch filled with contrast is a dark line too."""
    signals = exposed(imager, planes, np.zeros((0, 3)), contrast=contrast)
    for shown in ((0,), (1,), (0, 1)):
        assert found_in(imager, planes, signals, TIP[2], shown).status == "not found"
    lit = exposed(imager, planes, wire_to(fork, 2), contrast=contrast)
    assert found_in(imager, planes, lit, TIP[2]).status != "not found"


def test_less_dose_is_less_sure(imager, planes, fork):
    nodes = wire_to(fork, 1)
    usual, dim = (
        found_in(imager, planes, exposed(imager, planes, nodes, dose=dose), TIP[1], dose=dose) for dose in (1.0, 0.1)
    )
    assert usual.log_odds > 2 * dim.log_odds > 0
    assert np.trace(usual.covariance) < np.trace(dim.covariance)


def test_the_end_of_a_line_is_found_to_a_part_of_a_pixel():
    """exp(−a²/2w²)·Φ(b/w), a aside and b behind the end, on an uneven background with noise."""
    side = np.arange(65) - 32.0
    right, up = np.meshgrid(side, -side)
    end, angle, width = np.array([3.3, -2.6]), np.deg2rad(35.0), 0.9
    behind = -(np.cos(angle) * (right - end[0]) + np.sin(angle) * (up - end[1]))
    aside = -np.sin(angle) * (right - end[0]) + np.cos(angle) * (up - end[1])
    noise = np.random.default_rng(0).standard_normal(right.shape)
    background = 0.3 + 0.01 * right - 0.02 * up + 0.05 * noise
    image = (background - 0.6 * np.exp(-0.5 * (aside / width) ** 2) * ndtr(behind / width)).astype(np.float32)
    place, covariance = fit_end(image, end + np.array([1.5, -1.0]), np.array([1.0, 0.0]), width)
    np.testing.assert_allclose(place, end, atol=0.3)
    assert np.all(np.diag(covariance) < 0.45**2)
    assert fit_end(background.astype(np.float32), end, np.array([1.0, 0.0]), width) is None  # no line
    assert fit_end(image, np.array([29.0, 0.0]), np.array([1.0, 0.0]), width) is None  # the image ends


def ends_in(fork, view, image, length):
    """Return what one image of evidence says of a wire's end in a vessel that lies where it is registered."""
    grid = VesselGrid.of(fork.tree, step_mm=0.5).with_catheter(fork, CATHETER_MM)
    still, room_mm = Shifts(np.zeros((1, 3)), np.zeros(1), np.zeros((3, 3))), grid.radius - 0.18 + 0.3
    ends = end_log(grid.abscissa, length)
    told, log_odds = tell(grid, room_mm, way_to(grid, room_mm, [view], [image], still.mm), still, ends)
    return replace(grid.estimate(told, ends, 4.0), log_odds=log_odds)


def test_evidence_and_encoder_both_count(fork, planes):
    """Without evidence the odds are even, and the tip is where the encoder says: to 2 mm and 4 %, or 10 % less deep."""
    view, flat = planes[0].view, np.zeros((512, 512), dtype=np.float32)
    found = ends_in(fork, view, flat, 12.0)
    assert found.log_odds == pytest.approx(0.0, abs=1e-4)
    off = np.linspace(-4.0, 4.0, 801)  # within 4 mm of the mode
    weight = np.exp(-0.5 * (off / np.where(off > 0, 2.0 + 0.04 * 12.0, 2.0 + 0.1 * 12.0)) ** 2)
    mean = np.average(off, weights=weight)
    assert found.position[2] == pytest.approx(12.0 + mean, abs=0.2)
    assert found.covariance[2, 2] == pytest.approx(np.average((off - mean) ** 2, weights=weight), rel=0.1)
    uphill = np.full((512, 512), -0.3, dtype=np.float32)
    assert ends_in(fork, view, uphill, 12.0).log_odds < -2.0


def test_a_wire_that_may_have_folded_back_is_ambiguous(imager, planes, fork):
    """It is seen to reach 14 mm: with 20 mm more inserted its tip is anywhere behind, with 1 mm more it is there."""
    signals = exposed(imager, planes, wire_to(fork, 0))
    there, folded = (found_in(imager, planes, signals, TIP[0] + more) for more in (1.0, 20.0))
    assert there.status == "found" and folded.status == "ambiguous"


def test_lines_that_were_there_before_are_none_of_the_wire(imager, planes, fork):
    """A metal line goes on where the wire ends."""
    nodes, at = wire_to(fork, 0), np.arange(36.0, 15.5, -0.5)
    metal = np.stack([0 * at, 0.4 + 0 * at, at], axis=-1)
    among = [replace(plane, background=plane.background + imager.wire(plane, metal)) for plane in planes]
    views, photons = [plane.view for plane in among], [imager.photons(plane) for plane in among]
    images = views, exposed(imager, among, nodes), photons, TIP[0]
    empty = [imager.signal(plane, np.zeros((0, 3)), seed=90 + index) for index, plane in enumerate(among)]
    detector = TipDetector(fork, imager.stack.wire)
    lines = list(map(detector.lines, views, empty, photons))
    assert np.linalg.norm(detector.estimate(*images, lines).position - nodes[0]) < 1.5
    assert np.linalg.norm(detector.estimate(*images).position - nodes[0]) > 5.0
    assert detector.estimate(views, empty, photons, TIP[0], lines).status == "not found"
    dim = detector.lines(views[0], empty[0], 0.0025 * photons[0])  # a little dose would not show them
    assert lines[0].sum() > 200 and dim.sum() < 0.2 * lines[0].sum()


def test_a_straight_vessel_that_lies_off_along_itself_is_not_taken_for_sure(imager, planes, fork):
    """The wire shows no shift along a straight vessel; the catheter's end says that the vessel may lie elsewhere."""
    nodes = wire_to(fork, 0)
    views = [replace(plane.view, source=plane.view.source + np.array([0.0, 0.0, 2.5])) for plane in planes]
    photons = [imager.photons(plane) for plane in planes]
    found = TipDetector(fork, imager.stack.wire).estimate(views, exposed(imager, planes, nodes), photons, TIP[0])
    error = found.position - nodes[0]
    assert found.status == "ambiguous" and np.linalg.norm(error[:2]) < 0.82  # of the room in the lumen
    assert error @ np.linalg.solve(found.covariance, error) < 2.795**2  # the region of 95 %


def test_a_posterior_of_two_places_is_at_the_likelier_one_and_its_region_holds_both(fork):
    """Σ of an ambiguous tip is that near its mode, and w·d·dᵀ of a place at d of weight w."""
    grid = VesselGrid.of(fork.tree, step_mm=1.0)
    places = np.array([5, 40])
    told = Told(places, np.log([0.7, 0.3]), np.zeros((2, 6)), np.tile(np.diag([0.1] * 6), (2, 1, 1)))
    found = replace(grid.estimate(told, np.zeros(2), 4.0), status="ambiguous")
    far = grid.middle[40] - grid.middle[5]
    assert found.share == pytest.approx(0.7) and found.mode == 5
    np.testing.assert_allclose(found.covariance, (0.1 + 1 / 12) * np.eye(3) + 0.3 * np.outer(far, far))


def test_what_one_view_leaves_open_of_a_shift_is_what_the_covariance_says() -> None:
    """Σ = K S Kᵀ + unseen: S is the covariance as it is seen, but for what lies beyond the largest shifts tried."""
    views = [view_at((0.0, 0.0), np.zeros(3), CArmGeometry())]
    covariance = np.array([[4.0, 1.5, 0.0], [1.5, 1.0, 0.2], [0.0, 0.2, 0.5]])
    tried = possible_shifts(views, np.zeros(3), covariance, 0.5)
    assert np.linalg.eigvalsh(tried.unseen)[0] > 0
    weight = np.exp(tried.log[1:]) / np.exp(tried.log[1:]).sum()
    spread = np.einsum("t,ti,tj->ij", weight, tried.mm[1:], tried.mm[1:]) + tried.unseen
    np.testing.assert_allclose(spread, covariance, rtol=0.15, atol=0.05)


@pytest.mark.parametrize("with_wire", [False, True])
def test_a_ridge_that_contrast_may_make_is_no_wire(imager, planes, fork, with_wire):
    """A thin stream in a branch is taken for a wire, unless other times show contrast there; a wire is one with it."""
    nodes, line = wire_to(fork, 2) if with_wire else np.zeros((0, 3)), fork.tree.path(1).points
    signals = exposed(imager, planes, nodes)
    for plane, signal in zip(planes, signals, strict=True):
        drawn = np.zeros_like(signal)
        drawn[
            tuple(np.rint(plane.pixel(line[0] + np.linspace(0, 1, 400)[:, None] * (line[-1] - line[0]))).astype(int).T)
        ] = 1
        signal -= 0.0 if with_wire else 0.25 * np.minimum(4 * gaussian_filter(drawn, 1.5), 1)
    detector = TipDetector(fork, imager.stack.wire)
    views, photons = [plane.view for plane in planes], [imager.photons(plane, 1.0) for plane in planes]
    anywhere = np.where(detector.grid.branch < 0, -np.inf, 0.0)
    estimates = []
    for dark in (0.0, 0.12, np.inf):
        seen = detector.look(views, signals, photons, contrast=[np.full_like(one, dark) for one in signals])
        told, log_odds = detector.tell(seen, anywhere)
        estimates.append(detector.judge(seen, told, anywhere, log_odds))
    alone, beside, unseen = estimates
    assert alone.status == "found" and unseen.status == "not found"
    if with_wire:
        assert np.linalg.norm(beside.position - nodes[0]) < 1.0
    else:
        assert beside.status == "not found"
