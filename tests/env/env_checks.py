"""What tests of environments compare."""

from __future__ import annotations

import numpy as np


def same(one, other) -> bool:
    """Return whether two observations are equal."""
    if isinstance(one, dict):
        return all(np.array_equal(one[name], other[name]) for name in one)
    return np.array_equal(one, other)
