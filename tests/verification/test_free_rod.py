"""The rod against closed forms, without a wall. Derivations stand in `endopilot.verification.free_rod`."""

from __future__ import annotations

import numpy as np
import pytest

from endopilot.verification import free_rod

ELASTICA = {
    1: (0.301721, 0.056433),
    2: (0.493457, 0.160642),
    3.7: (0.653000, 0.308452),
    5: (0.713792, 0.387628),
    10: (0.810609, 0.554996),
    15: (0.847716, 0.635286),
    40: (0.907371, 0.776395),
}
"""Deflection w/L and shortening u/L of a clamped rod of 100 elements, by α = F L²/EI."""


@pytest.mark.parametrize(("name", "tip"), [("P=300", (-7.045, -11.932, 40.192)), ("P=600", (-13.605, -23.561, 53.475))])
def test_bend_of_45_degrees(name: str, tip: tuple[float, ...]) -> None:
    # Bathe and Bolourchi (1979), converged; the error is the distance of the tips over the tip's displacement.
    case = next(case for case in free_rod.bend_of_45_degrees() if case.case.endswith(name))
    assert case.reference == pytest.approx(np.linalg.norm(tip), rel=1e-4)
    assert case.error <= 3e-3


@pytest.mark.parametrize("alpha", [1.0, 2.0, 5.0, 10.0])
def test_closed_form_of_the_elastica(alpha: float) -> None:
    # elliptic integrals against Mattiasson's table
    assert free_rod.elastica_closed_form(alpha)[:2] == pytest.approx(ELASTICA[alpha], abs=1e-6)


@pytest.mark.parametrize("alpha", [1.0, 10.0, 40.0])
def test_whole_elastica(alpha: float) -> None:
    # Not the tip alone: all nodes lie on the solution of θ'' = -α cos θ, θ(0) = 0, θ'(L) = 0.
    x, y = free_rod.elastica_curve(alpha)
    shape = free_rod.elastica_tip(alpha, 100)[1][:100]
    assert np.abs(np.interp(shape[::-1, 1], y, x) - shape[::-1, 0])[3:].max() < 1e-3
