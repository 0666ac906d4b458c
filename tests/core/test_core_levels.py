"""The core's builds for different processors: the same bits, a choice that can be made by hand, and its tables."""

from __future__ import annotations

import json
import os
import re
import shutil
import subprocess
import sys
from importlib import import_module
from pathlib import Path

import navigations
import pytest

from command import run
from endopilot import _core

BASELINE = import_module("endopilot._core_baseline")
SUPPORTED: list[str] = BASELINE.supported_levels()
HERE = Path(__file__).parent


def python(*arguments: str | Path, level: str | None = None) -> subprocess.CompletedProcess[str]:
    """Run Python in a fresh process, with the level asked for in its environment."""
    environment = {name: value for name, value in os.environ.items() if name != "ENDOPILOT_CORE"}
    environment["PYTHONPATH"] = str(HERE.parents[1])  # navigations.py takes a scene from the benchmarks
    if level is not None:
        environment["ENDOPILOT_CORE"] = level
    return subprocess.run([sys.executable, *map(str, arguments)], env=environment, capture_output=True, text=True)


def test_every_level_and_every_number_of_lanes_gives_the_same_bits() -> None:
    found: dict[str, set[str]] = {"velocity": set(), "force": set()}
    for level in SUPPORTED:
        ran = python(HERE / "navigations.py", level=level)
        assert ran.returncode == 0, ran.stderr
        answer = json.loads(ran.stdout)
        assert answer["level"] == level
        assert len(answer["digests"]) == 6
        for name, digest in answer["digests"].items():
            found[name.split(",")[0]].add(digest)
    assert {actuation: len(digests) for actuation, digests in found.items()} == {"velocity": 1, "force": 1}


def test_the_highest_level_that_the_processor_supports_is_taken() -> None:
    code = "from endopilot import _core; print(_core.LEVEL)"
    assert python("-c", code).stdout.split() == [SUPPORTED[-1]]


def test_a_level_that_does_not_exist_is_refused() -> None:
    ran = python("-m", "endopilot.cli", "info", level="avx3")
    assert ran.returncode == 2
    assert ran.stderr == (
        "endopilot info: ENDOPILOT_CORE: 'avx3' is no level of the core; give one of baseline, avx2, avx512\n"
    )


def test_a_level_that_the_processor_lacks_is_refused() -> None:
    code = (
        "import endopilot._core_baseline as baseline\n"
        "baseline.supported_levels = lambda: ['baseline']\n"
        "import endopilot._core\n"
    )
    ran = python("-c", code, level="avx2")
    assert ran.returncode != 0
    assert "ENDOPILOT_CORE: this processor does not run 'avx2'; give one of baseline" in ran.stderr


def test_info_names_the_level(capsys: pytest.CaptureFixture[str]) -> None:
    assert run(capsys, "info")["core"] == _core.LEVEL


@pytest.mark.parametrize("level", SUPPORTED)
def test_a_level_holds_its_own_instructions_and_no_fused_ones(level: str) -> None:
    objdump = shutil.which("objdump")
    if objdump is None or SUPPORTED == ["baseline"]:
        pytest.skip("needs objdump, and an x86-64 processor with AVX2")
    module = import_module(f"endopilot._core_{level}").__file__
    assert module is not None
    listing = subprocess.run([objdump, "-d", "--no-show-raw-insn", module], capture_output=True, text=True, check=True)
    names = set(re.findall(r"^\s*[0-9a-f]+:\t(\w+)", listing.stdout, re.MULTILINE))
    assert "sqrtsd" in names or "vsqrtsd" in names  # the listing is of the core
    assert not {name for name in names if re.match(r"vfn?m(add|sub)", name)}
    assert any(name.startswith("v") for name in names) == (level != "baseline")
    assert ("%zmm" in listing.stdout) == (level == "avx512")


@pytest.mark.parametrize("lanes", [2, 3, 16, -1])
def test_another_number_of_lanes_is_refused(lanes: int) -> None:
    with pytest.raises(ValueError, match=f"lanes: {lanes}; give 1, 4 or 8"):
        navigations.navigate("velocity", lanes)


def test_a_run_records_what_the_table_of_outputs_lists() -> None:
    recorded = navigations.navigate("velocity", 1)
    each = (navigations.WORLDS, navigations.SAMPLES)
    shapes = {"sample": each, "device": (*each, 1), "start": (navigations.WORLDS, 1)}
    for name, of, numbers, _, meaning in _core.OUTPUTS:
        assert meaning, name
        if of == "element":  # which are not asked for
            assert name not in recorded
            continue
        shape = shapes.get(of, (*each, recorded["contacts"].shape[1]))
        assert recorded[name].shape == (shape if numbers == 1 else (*shape, numbers)), name
    assert set(recorded) - {name for name, *_ in _core.OUTPUTS} == {"reason", "contacts"}


def test_the_table_of_options_lists_the_settings() -> None:
    options = _core.Options()
    for name, kind, _, meaning in _core.OPTIONS:
        setattr(options, name, 3)
        assert meaning and type(getattr(options, name)).__name__ == kind, name
    assert {name for name in dir(_core.Options) if not name.startswith("_")} == {name for name, *_ in _core.OPTIONS}
