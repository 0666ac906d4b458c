"""Rods in tubes. Derivations stand in `benchmarks.verification.tube`."""

from __future__ import annotations

import numpy as np

from benchmarks.verification import tube


def test_sinusoidal_buckling() -> None:
    # A rod of weight w per length on the bottom of a tube of clearance r begins to snake at F = 2 sqrt(EI w/r)
    # (Dawson and Paslay 1984).
    (case,) = tube.sinusoidal_buckling()
    assert case.error <= 0.05


def test_helical_buckling() -> None:
    # A helix has the straight rod's energy at F = 2 sqrt(2) sqrt(EI w/r) (Chen, Lin and Cheatham 1990), and the wall
    # holds it with F² r/(4 EI) per length (Lubinski, Althouse and Logan 1962).
    load, force = tube.helical_buckling()
    assert np.isclose(load.reference, 2 * np.sqrt(2) * tube.LOAD_N)
    assert load.error <= 0.05
    assert force.error <= 0.05


def test_a_rod_sinks_into_a_compliant_wall() -> None:
    # Winkler: w = F β/(2k) exp(-β|x|) (cos βx + sin β|x|), β = (k/4EI)^¼ (Hetényi 1946), along the whole rod.
    (case,) = tube.compliant_wall()
    assert case.error <= 0.01
    assert case.picture is not None
    exact, core = case.picture.curves
    assert np.abs(core.y - exact.y).max() < 0.005 * exact.y.max()
    assert exact.y.min() < 0  # it lifts beside the load


def test_a_compliant_wall_stiffens() -> None:
    # A rod of weight w per length sinks to where K d exp(s d²) = w (Holzapfel and Ogden 2009, simple shear).
    (case,) = tube.stiffening_wall()
    assert case.error <= 0.001
    assert case.picture is not None
    _, core = case.picture.curves
    np.testing.assert_allclose(core.x, [0.5, 1.0, 1.5, 2.0], rtol=1e-3)


def test_torque_whip() -> None:
    # GJ θ'' = EI k0 kt sin θ; the tip jumps when L sqrt(EI k0 kt/GJ) > π/2.
    (case,) = tube.torque_whip()
    assert case.error <= 0.02


def test_a_short_wire_follows_and_a_long_one_whips() -> None:
    # The same equation, far from θ = π: the short wire's tip follows the closed form there and back; the long one's
    # jumps twice in a turn there and back.
    (case,) = tube.torque_whip()
    assert case.picture is not None
    formula, short, _, long = case.picture.curves
    expected = np.interp(short.x, formula.x[np.argsort(formula.x)], np.sort(formula.y))
    assert np.abs(short.y - expected).max() < 0.05
    assert (np.abs(np.diff(long.y)) > 2.0).sum() == 2
