"""The vessels of most of these tests."""

from __future__ import annotations

import pytest


@pytest.fixture(scope="session")
def anatomy():
    """Return a tube that bends by 90° to a blind end; do not write into it."""
    from bend import vessel

    return vessel()


@pytest.fixture(scope="session")
def vessel():
    """Return a synthetic right coronary artery; do not write into it."""
    from endopilot.atlas.atlas import AtlasConfig, make_patient

    return make_patient(AtlasConfig(), 0)
