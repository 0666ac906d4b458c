"""Contact and friction against closed forms. Equations stand in `endopilot.verification.contact`."""

from __future__ import annotations

import numpy as np
import pytest

from endopilot.verification import contact


def test_capstan() -> None:
    # T2/T1 = exp(µ θ) with µ = 0.4; the tube's clearance makes θ a little less than the bend's π/2.
    (case,) = contact.capstan()
    assert 0.98 * np.pi / 2 < np.log(case.reference) / 0.4 < np.pi / 2
    assert case.value == pytest.approx(case.reference, rel=0.02)
