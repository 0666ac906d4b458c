"""A bolus in the blood: it obeys its closed form, and none of it is lost."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.special import gammainc

from benchmarks.anatomy.analytic_lumens import forked_tree
from endopilot.angiograms.flow import MIXING_S, Flow, Injection

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
