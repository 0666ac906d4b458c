"""The names of `import endopilot`: all are there, documented, and imported no sooner than they are used."""

from __future__ import annotations

import inspect
import re
import subprocess
import sys
from pathlib import Path

import pytest

import endopilot

ROOT = Path(__file__).parents[1]
LARGE = {
    "SimpleITK", "gymnasium", "jinja2", "matplotlib", "numpy", "pandas", "plotly", "pyarrow", "pydantic", "pydicom",
    "pyvista", "scipy", "skimage", "torch", "tyro", "vtk", "vtkmodules", "yaml",
}  # fmt: skip
ASKED = {
    "Anatomy", "read_anatomy", "extract_anatomy", "segment", "Wire", "read_device", "Simulator", "simulate", "plan",
    "make_atlas", "generate_dataset", "train", "load_model", "navigate", "evaluate", "InputError", "read_volume",
}  # fmt: skip


def imported_by(code: str) -> set[str]:
    """Return which large libraries a fresh process has imported after some code."""
    code = f"import sys\n{code}\nprint(*{{name.partition('.')[0] for name in sys.modules}})"
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert result.returncode == 0, result.stderr
    return LARGE & set(result.stdout.split())


def test_the_import_brings_no_library() -> None:
    assert imported_by("import endopilot; endopilot.__version__; dir(endopilot)") == set()


@pytest.mark.parametrize("name", ["simulate", "Simulator", "read_device", "read_anatomy"])
def test_the_rod_core_brings_no_large_library(name: str) -> None:
    assert imported_by(f"import endopilot; endopilot.{name}") <= {"numpy", "scipy", "yaml", "pydantic"}


def test_every_name_is_there_and_documented() -> None:
    assert set(endopilot.__all__) <= set(dir(endopilot))
    assert set(endopilot.__all__) >= ASKED
    for name in endopilot.__all__:
        thing = getattr(endopilot, name)
        assert inspect.getdoc(thing), name
        assert thing.__module__.startswith("endopilot."), name


def test_the_reference_describes_exactly_these_names() -> None:
    page = (ROOT / "docs" / "reference.md").read_text(encoding="utf-8")
    described = re.findall(r"^\.\. auto(?:function|class|exception):: (\w+)$", page, re.MULTILINE)
    assert sorted(described) == sorted(endopilot.__all__)


def test_another_name_is_no_attribute() -> None:
    with pytest.raises(AttributeError, match="nonsense"):
        _ = endopilot.nonsense  # pyright: ignore[reportAttributeAccessIssue]
