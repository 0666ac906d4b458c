"""docs/concepts/shipped.md has a row for all that the package holds besides code and settings."""

from __future__ import annotations

from pathlib import Path

import endopilot
from endopilot.files import read_json

PACKAGE = Path(endopilot.__file__).parent
PAGE = (Path(__file__).parents[2] / "docs/concepts/shipped.md").read_text(encoding="utf-8")


def test_every_file_of_data_has_a_card() -> None:
    files = [
        path for kind in ("*.json", "*.safetensors", "*.npz", "*.yaml", "*/vendor/*") for path in PACKAGE.rglob(kind)
    ]
    assert len(files) > 60
    for path in files:
        named = [path.relative_to(PACKAGE), *path.relative_to(PACKAGE).parents][:-1]
        assert any(f"`{name}`" in PAGE for name in named), path


def test_calibrations_are_of_as_many_patients_as_the_page_says() -> None:
    for path in PACKAGE.rglob("xray.json"):
        row = next(line for line in PAGE.splitlines() if line.startswith(f"| `{path.relative_to(PACKAGE)}`"))
        calibration = read_json(path)
        assert f"| {calibration['anatomies']}, {calibration['intervals']} |" in row
