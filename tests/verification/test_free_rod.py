"""The rod against closed forms, without a wall. Derivations stand in `endopilot.verification.free_rod`."""

from __future__ import annotations

import numpy as np
import pytest

from endopilot.verification import free_rod


@pytest.mark.parametrize("group", free_rod.CASES, ids=lambda group: group.__name__)
def test_closed_form(group) -> None:
    # elastica: θ'' = -α cos θ, α = F L²/EI (Mattiasson 1981); roll-up: M = 2π EI/L closes a circle; Timoshenko:
    # δ = F L³/3EI + F L/κGA; Euler: P = π² EI/(2L)²; 45° bend: Bathe and Bolourchi (1979), converged; objectivity:
    # the energy of a rod that is turned about its base once does not change.
    for case in group():
        assert case.error <= case.bar, case.case


def test_the_elastica_is_compared_at_four_loads_and_the_bend_at_two() -> None:
    names = [case.case for group in (free_rod.elastica, free_rod.bend_of_45_degrees) for case in group()]
    assert names == [
        *(f"elastica α={alpha} {name}" for alpha in (1, 2, 5, 10) for name in ("w/L", "u/L")),
        "45° bend P=300",
        "45° bend P=600",
    ]


@pytest.mark.parametrize("alpha", [1.0, 10.0])
def test_whole_elastica(alpha: float) -> None:
    # Not the tip alone: all nodes lie on the solution of θ'' = -α cos θ, θ(0) = 0, θ'(L) = 0.
    x, y = free_rod.elastica_curve(alpha)
    shape = free_rod.elastica_tip(alpha, 100)[1][:100]
    assert np.abs(np.interp(shape[::-1, 1], y, x) - shape[::-1, 0])[3:].max() < 1e-3
