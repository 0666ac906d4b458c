"""The patient in whom the rod core drives."""

from __future__ import annotations

import pytest


@pytest.fixture(scope="session")
def patient(tmp_path_factory):
    """Return the folder of a synthetic right coronary artery; do not write into it."""
    from endopilot.anatomy.io import write_anatomy
    from endopilot.atlas.atlas import AtlasConfig, make_patient

    folder = tmp_path_factory.mktemp("anatomies") / "patient"
    write_anatomy(make_patient(AtlasConfig(count=1, seed=4, population="textbook"), 0), output=folder)
    return folder
