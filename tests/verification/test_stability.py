"""Twisted rods that buckle. Derivations stand in `benchmarks.verification.stability`."""

from __future__ import annotations

from benchmarks.verification.stability import greenhill, michell_ring


def test_greenhill() -> None:
    # A long rod in tension T loses its straightness under the moment M = 2 sqrt(EI T) (Greenhill 1883).
    (case,) = greenhill()
    assert case.reference == 20.0  # EI = 100 N mm², T = 1 N
    assert case.error <= 0.01


def test_michell() -> None:
    # A ring of a straight rod leaves its plane under the twist Tw = 2π sqrt(3) EI/GJ (Michell 1890), and its stiffness
    # against cos 2θ falls towards it as 1 - (Tw/Tw_critical)².
    (case,) = michell_ring()
    assert case.error <= 0.01
    assert case.picture is not None
    core = case.picture.curves[1]
    share = core.x / case.reference
    assert abs(core.y - (1 - share**2)).max() < 0.01
