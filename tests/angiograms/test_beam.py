"""What surrounds a cine's vessel: the body beyond the CT, blood without contrast, beam and monitor, fine branches."""

from __future__ import annotations

import numpy as np
import pytest

from benchmarks.anatomy.analytic_lumens import forked_tree
from endopilot.angiograms.cine import Beam, harmonised, shown
from endopilot.angiograms.flow import Flow, Injection, grow
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
