"""A library that is not installed: the message names the extra that brings it."""

from __future__ import annotations

import subprocess
import sys

import pytest

from endopilot.extras import extra_named, requirements_of_extras, what_is_missing

HIDE = "import sys; sys.modules[{module!r}] = None\n"
"""Makes a process where importing a module fails as if it were not installed."""


def run_without(module: str, code: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, "-c", HIDE.format(module=module) + code], capture_output=True, text=True, timeout=120
    )


def test_each_library_belongs_to_an_extra() -> None:
    extras = requirements_of_extras()
    assert "torch" in extras["learn"] and "gymnasium" in extras["env"] and "pydicom" in extras["imaging"]


@pytest.mark.parametrize(
    ("module", "extra"),
    [
        ("torch", "learn"),
        ("torch.utils.tensorboard", "learn"),
        ("pyarrow", "learn"),
        ("gymnasium", "env"),
        ("pydicom", "imaging"),
        ("jinja2", "report"),
        ("distributed", "cluster"),
        ("highdicom", "dicom-seg"),
        ("stable_baselines3", "rl"),
    ],
)
def test_the_mend_names_the_extra(module: str, extra: str) -> None:
    missing = what_is_missing(ModuleNotFoundError(f"No module named {module!r}", name=module))
    assert missing is not None and missing.endswith(f"pip install 'endopilot[{extra}]'")


def test_a_defect_stays_a_defect() -> None:
    error = ModuleNotFoundError("No module named 'nonsense'", name="nonsense")
    assert what_is_missing(error) is None
    with pytest.raises(ModuleNotFoundError) as caught, extra_named("x"):
        raise error
    assert caught.value is error


def test_a_command_names_the_extra_in_one_line() -> None:
    result = run_without("torch", "from endopilot.cli import main; main(['train', 'dataset', '-o', 'run'])")
    assert result.returncode == 2
    assert result.stdout == ""
    assert result.stderr == "endopilot train: needs torch; install it with: pip install 'endopilot[learn]'\n"


def test_a_name_of_the_package_names_the_extra() -> None:
    result = run_without("torch", "import endopilot; endopilot.train")
    assert result.returncode == 1
    last = result.stderr.strip().splitlines()[-1]
    assert last == "ModuleNotFoundError: endopilot.train needs torch; install it with: pip install 'endopilot[learn]'"
