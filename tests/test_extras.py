"""A library that is not installed: the message names the extra that brings it."""

from __future__ import annotations

import subprocess
import sys
from importlib import metadata
from pathlib import Path

import pytest
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

from endopilot.errors import InputError
from endopilot.extras import extra_named, require_extras, requirements_of_extras, what_is_missing

HIDE = "import sys; sys.modules[{module!r}] = None\n"
"""Makes a process where importing a module fails as if it were not installed."""

WITHOUT = """
import runpy, sys

class Hidden:
    def find_spec(self, name, path, target=None):
        if name.partition(".")[0] in {hidden}:
            raise ModuleNotFoundError(f"No module named {{name!r}}", name=name)

sys.meta_path.insert(0, Hidden())
runpy.run_path({script!r}, run_name="__main__")
"""
"""Runs a script where some libraries cannot be imported."""


def run_without(module: str, code: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, "-c", HIDE.format(module=module) + code], capture_output=True, encoding="utf-8", timeout=120
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


def test_all_extras_that_are_missing_are_named_at_once(monkeypatch: pytest.MonkeyPatch) -> None:
    present = {"learn": False, "env": True, "report": False}
    monkeypatch.setattr("endopilot.extras.extras_present", lambda: present)
    require_extras("env")
    with pytest.raises(InputError, match=r"pip install 'endopilot\[learn,report\]'$"):
        require_extras("learn", "env", "report")


def test_a_run_says_so_before_it_begins(tmp_path: Path) -> None:
    pytest.importorskip("torch", reason="the extra `learn` is not installed, which the line would name too")
    result = run_without("plotly", f"from endopilot.cli import main; main(['demo', '-o', {str(tmp_path / 'demo')!r}])")
    assert result.returncode == 2
    assert result.stderr == "endopilot demo: needs more libraries; install them with: pip install 'endopilot[report]'\n"
    assert not (tmp_path / "demo").exists()


def of_base_install() -> set[str]:
    """Return the distributions that `pip install endopilot` brings, by their normal names."""
    found: set[str] = set()
    waiting = ["endopilot"]
    while waiting:
        name = canonicalize_name(waiting.pop())
        if name not in found:
            found.add(name)
            needs = map(Requirement, metadata.requires(name) or ())
            waiting += [each.name for each in needs if each.marker is None or each.marker.evaluate({"extra": ""})]
    return found


def test_the_base_libraries_are_enough(tmp_path: Path) -> None:
    base = of_base_install()
    hidden = {
        module
        for module, owners in metadata.packages_distributions().items()
        if base.isdisjoint(map(canonicalize_name, owners))
    }
    assert {"torch", "pyarrow", "gymnasium", "pydicom", "pytest"} <= hidden and {"numpy", "scipy"}.isdisjoint(hidden)
    script = Path(__file__).parent / "e2e" / "installed.py"
    code = WITHOUT.format(hidden=hidden, script=str(script))
    done = subprocess.run([sys.executable, "-c", code], cwd=tmp_path, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr


def test_help_needs_no_extra() -> None:
    commands = ["demo", "run", "dataset", "dataset-info", "train", "evaluate"]
    code = (
        "from endopilot.cli import main\n"
        f"for command in {commands}:\n"
        "    try: main([command, '--help'])\n"
        "    except SystemExit as leaving: assert not leaving.code, command\n"
        "    else: raise AssertionError(command)\n"
    )
    result = run_without("pyarrow", code)
    assert result.returncode == 0, result.stderr
    told = [line.split()[2] for line in result.stdout.splitlines() if line.startswith("usage: endopilot ")]
    assert told == commands
