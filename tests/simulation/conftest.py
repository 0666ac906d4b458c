"""The vessel of most of these tests."""

from __future__ import annotations

import pytest


@pytest.fixture(scope="session")
def anatomy():
    """Return a tube that bends by 90° to a blind end; do not write into it."""
    from bend import vessel

    return vessel()


@pytest.fixture(scope="session")
def bend(anatomy):
    """Return the same tube."""
    return anatomy
