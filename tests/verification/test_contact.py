"""Contact and friction against closed forms. Equations stand in `benchmarks.verification.contact`."""

from __future__ import annotations

import numpy as np
import pytest

from benchmarks.verification import contact


def test_capstan() -> None:
    # T2/T1 = exp(µ θ) with µ = 0.4; the tube's clearance makes θ a little less than the bend's π/2.
    (case,) = contact.capstan()
    assert 0.98 * np.pi / 2 < np.log(case.reference) / 0.4 < np.pi / 2
    assert case.value == pytest.approx(case.reference, rel=0.02)


def test_capstan_over_bends() -> None:
    # T2/T1 = exp(µ Σθ) with µ = 0.3 over three bends of 60°; a taut string cuts 0.95 rad off the corners in all.
    (case,) = contact.capstan_over_bends()
    assert np.log(case.reference) / 0.3 == pytest.approx(np.pi - 0.95, abs=0.02)
    assert case.value == pytest.approx(case.reference, rel=0.02)


def test_capstan_in_a_helix() -> None:
    # T2/T1 = exp(µ ∫κ ds) with µ = 0.2 over one revolution, which turns by 2π a/√(a² + p²) less the corners cut.
    (case,) = contact.capstan_in_a_helix()
    assert np.log(case.reference) / 0.2 == pytest.approx(2 * np.pi * np.sqrt(0.5) - 0.11, abs=0.02)
    assert case.value == pytest.approx(case.reference, rel=0.02)
