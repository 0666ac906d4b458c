"""Makes the modules in this folder importable from every test, and gives a small dataset of a toy wire."""

from __future__ import annotations

import pytest


@pytest.fixture(scope="session")
def toy_dataset(tmp_path_factory):
    """Return the folder of a dataset of six toy patients with 24 navigations each; do not write into it."""
    from toy_navigation import make_toy_dataset  # here, so that endopilot is imported after its shape checks are on

    folder = tmp_path_factory.mktemp("toy") / "dataset"
    make_toy_dataset(folder, patients=6, sequences=24)
    return folder
