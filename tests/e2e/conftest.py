"""A synthetic patient for the commands."""

from __future__ import annotations

from pathlib import Path

import pytest


@pytest.fixture(scope="session")
def right_artery(tmp_path_factory) -> Path:
    """Return the folder of a right coronary artery; do not write into it."""
    from endopilot.anatomy.io import write_anatomy
    from endopilot.atlas.atlas import AtlasConfig, make_patient

    folder = tmp_path_factory.mktemp("patient") / "rca"
    write_anatomy(make_patient(AtlasConfig(seed=7), 0), output=folder)
    return folder
