"""What a cine shows beside its vessel: body, bolus, beam and monitor, fine branches; and masks of lines."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.special import gammainc

from benchmarks.anatomy.analytic_lumens import forked_tree
from endopilot.angiograms.cine import Beam, box_of, encoded, harmonised, laid_together, shown, stroke
from endopilot.angiograms.flow import MIXING_S, Flow, Injection, grow
from endopilot.types import Volume
from endopilot.xray.absorbers import WATER_MM, without_contrast
from endopilot.xray.carm import CArmGeometry, view_at
from endopilot.xray.projector import cast

PIXELS = 128


@pytest.fixture(scope="module")
def beam():
    random = np.random.default_rng(3)
    return Beam.draw(random, random.normal(4, 0.1, (PIXELS, PIXELS)).astype(np.float32), 1.2)


@pytest.mark.parametrize("half", [40, 70])
def test_a_ct_that_ends_in_the_body_goes_on_to_its_skin(half):
    """A chest of water, 243 mm deep, of which a CT shows a block: ∫ μ dl is that of the chest."""
    size = 2 * half // 4
    water = Volume(np.zeros((size, size, size)), np.full(3, 4.0), np.full(3, -half + 2.0), np.eye(3))
    through = cast(water, view_at((0.0, 0.0), np.zeros(3), CArmGeometry()), 16, 16)
    assert through[8, 8] == pytest.approx(243 * WATER_MM, rel=0.03)


def test_chambers_lose_their_contrast_and_bone_stays():
    voxels = np.full((40, 40, 40), 40.0)
    voxels[5:30, 5:30, 5:20], voxels[:, :, 34:36], voxels[:4] = 350.0, 700.0, 900.0
    plain = without_contrast(Volume(voxels, np.ones(3), np.zeros(3), np.eye(3)), np.zeros((0, 3))).voxels
    assert plain[5:30, 5:30, 5:20].max() == 40 and plain[10, 10, 34] == 700 and plain[1].max() == 900


def test_harmonising_presses_the_slow_part_and_keeps_details(beam):
    """A ramp of 3 is left with the span; a line upon it keeps its contrast but for what is slow of it."""
    ramp = np.tile(np.linspace(-1.5, 1.5, PIXELS, dtype=np.float32), (PIXELS, 1))
    line = ramp.copy()
    line[:, 64] -= 0.2
    pressed = harmonised(ramp, beam, 1.2, 0.3)
    left = (ramp - pressed)[20:-20, 20:-20]
    assert np.ptp(left) == pytest.approx(0.3 * 87 / (0.9 * 127), rel=0.25)
    difference = (line - harmonised(line, beam, 1.2, 0.3)) - (ramp - pressed)
    assert difference[64, 64] - difference[64, 30] == pytest.approx(-0.2, abs=0.02)


def test_a_monitor_shows_nothing_black_or_white(beam):
    light = np.linspace(-5, 5, PIXELS**2, dtype=np.float32).reshape(PIXELS, PIXELS)
    seen = shown(light, beam)
    assert np.abs(seen).max() < 0.86  # of 0.9
    near = (np.abs(light) < 0.5) & (beam.field > 0.999)
    np.testing.assert_allclose(seen[near], light[near], atol=2e-3)


def test_fine_branches_obey_murray_and_go_on_from_the_ends(fork):
    flow = Flow(fork.tree, 100.0)
    own = len(flow.points)
    places, sizes = grow(fork, flow, np.random.default_rng(0))
    assert len(flow.points) > own and len(places) == len(sizes) == 6 * (len(flow.points) - own)
    for branch in np.unique(flow.branch[own:]):
        line = np.flatnonzero(flow.branch == branch)
        gap = np.linalg.norm(flow.points[:own] - flow.points[line[0]], axis=1) - flow.radius[:own]
        assert (np.diff(flow.transit_s[line]) > 0).all() and (np.diff(flow.radius[line]) <= 0).all()
        if gap.min() < 0.5:  # it leaves a vessel of the CT: blood is as much slower as it is thinner
            parent = int(gap.argmin())
            speed = flow.rate_ml_s[[parent, line[0]]] / flow.radius[[parent, line[0]]] ** 3
            assert speed[1] == pytest.approx(speed[0], rel=0.05)
    ends = [branch.centerline.points[-1] for branch in fork.tree.branches[1:]]
    assert all(np.linalg.norm(flow.points[own:] - end, axis=1).min() < 2.0 for end in ends)


def test_what_the_vessel_does_not_take_is_around_the_ostium_for_a_while():
    """dV/dt = Q_injected − Q_vessel − V / τ: steady after some τ, and nothing flows back from a slow injection."""
    flow, times = Flow(forked_tree(radius=(1.0, 0.8)), velocity_mm_s=100.0), np.linspace(0, 3, 31)
    steady = flow.reflux_ml(Injection(0.0, 10.0, 3.0), times)[-1]
    assert steady == pytest.approx((3.0 - flow.inflow_ml_s) * 0.3, rel=0.01)
    assert flow.reflux_ml(Injection(0.0, 10.0, 0.2), times).max() == 0


SUDDEN_S = 1e-6


@pytest.fixture(scope="module")
def flow():
    return Flow(forked_tree(radius=(1.0, 0.8)), velocity_mm_s=100.0)


def test_transit_times_are_volume_over_flow(flow):
    """The trunk is 20 mm long and 1 mm wide in radius: 100 mm/s take 0.2 s to its fork."""
    trunk = flow.branch == 0
    assert flow.inflow_ml_s == pytest.approx(0.1 * np.pi, rel=1e-3)
    np.testing.assert_allclose(flow.transit_s[trunk][-1], 0.2, rtol=0.01)
    np.testing.assert_allclose(np.diff(flow.transit_s[trunk]).std(), 0, atol=1e-6)


def test_branches_share_the_blood_by_the_cubes_of_their_radii(flow):
    rates = [flow.rate_ml_s[flow.branch == branch][0] for branch in range(3)]
    assert rates[1] + rates[2] == pytest.approx(rates[0])
    assert sorted(rates[1:])[1] / sorted(rates[1:])[0] == pytest.approx((1.0 / 0.8) ** 3, rel=1e-3)


def test_a_front_arrives_as_through_tanks_in_series(flow):
    """Behind n + 1 well-mixed volumes of time m a step is the regularised incomplete gamma function P(n + 1, t/m)."""
    times = np.linspace(0, 1, 41)
    transit, shares = flow.contrast(Injection(0.0, 10.0, 100.0, ramp_s=SUDDEN_S), times)
    for tank in (1, 4, 8):
        assert transit[tank] == pytest.approx((tank - 0.5) * MIXING_S)
        np.testing.assert_allclose(shares[:, tank], gammainc(tank, times / MIXING_S), atol=0.02)


def integral(values, times):
    return np.append(0.0, np.cumsum(0.5 * (values[1:] + values[:-1]) * np.diff(times)))


def test_no_contrast_is_lost_in_a_tree(flow):
    """What flows in, Q₀ ∫ c₀ dt, is in the tree, Σ ∫ A c ds, or has flowed out of its ends, Σ Q ∫ c dt.

    Between two volumes the share is interpolated: contrast is displaced by half a volume at most.
    """
    times, injection = np.arange(0, 2.0, 0.005), Injection(0.1, 0.4, 0.2)
    transit, shares = flow.contrast(injection, times)
    at_points = np.stack([np.interp(flow.transit_s, transit, row) for row in shares])
    inside, out = np.zeros(len(times)), np.zeros(len(times))
    for branch in range(3):
        own = flow.branch == branch
        along, share, rate = flow.transit_s[own], at_points[:, own], flow.rate_ml_s[own][0]
        inside += rate * np.trapezoid(share, along, axis=1)  # A ds is Q dτ
        if branch:
            out += rate * integral(share[:, -1], times)
    into = integral(injection.rate(times), times)
    np.testing.assert_allclose(inside + out, into, atol=0.2 * MIXING_S / 2)
    assert (inside + out)[-1] == pytest.approx(into[-1], rel=0.003)


def test_more_contrast_than_blood_fills_the_vessel_and_no_more(flow):
    times = np.linspace(0, 1, 11)
    _, little = flow.contrast(Injection(0.0, 10.0, 0.25 * flow.inflow_ml_s), times)
    _, much = flow.contrast(Injection(0.0, 10.0, 9.0), times)
    assert little.max() == pytest.approx(0.25, abs=1e-3)
    assert much.max() == pytest.approx(1.0, abs=1e-3)


def test_a_stroke_covers_the_pixels_within_its_half_width():
    mask = stroke(np.array([[5.0, 10.0], [20.0, 10.0]]), np.array([2.0, 2.0]), 32)
    assert mask[8:13, 5:21].all() and not mask[[7, 13]].any()
    assert mask[10, 3] and not mask[10, 2]  # its end is round
    assert box_of(mask) == [3, 8, 20, 5]


def test_a_thin_line_has_no_gaps_and_what_lies_outside_is_left_out():
    line = np.array([[-40.0, -3.0], [10.3, 17.2], [80.0, 60.0]])
    mask = stroke(line, np.full(3, 0.1), 48)
    assert mask[:, :11].any(axis=0).all() and mask.sum() < 4 * 96
    assert not stroke(line + 500, np.full(3, 0.1), 48).any()


@pytest.mark.parametrize("kind", ["empty", "full", "random", "bar"])
def test_pycocotools_reads_what_was_encoded(kind):
    coco = pytest.importorskip("pycocotools.mask", reason="pip install pycocotools")
    mask = np.zeros((40, 300), dtype=bool)
    if kind == "full":
        mask[:] = True
    elif kind == "random":
        mask = np.random.default_rng(0).random(mask.shape) < 0.3
    elif kind == "bar":
        mask[3:5, 20:290] = True
        mask[:, 7] = True
    np.testing.assert_array_equal(coco.decode(coco.frPyObjects(encoded(mask), *mask.shape)), mask)


def test_masks_lie_together_as_bits():
    a, b = np.eye(3, dtype=bool), np.ones((3, 3), dtype=bool)
    together = laid_together({"vessel": a, "wire": b})
    assert together[0, 0] == 17 and together[0, 1] == 16
