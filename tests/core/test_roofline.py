"""The roofline, which runs the core's own formulas on another number type, follows the core."""

from __future__ import annotations

import os
import shutil
import subprocess
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]


def test_the_roofline_compiles_with_the_core() -> None:
    compiler = shutil.which(os.environ.get("CXX", "c++"))
    if compiler is None or not (ROOT / "benchmarks").exists():
        pytest.skip("no C++ compiler, or no source of the project, here")
    command = [compiler, "-std=gnu++20", "-fsyntax-only", "-Wno-psabi", "-I", str(ROOT / "src" / "core")]
    run = subprocess.run([*command, str(ROOT / "benchmarks" / "core" / "roofline.cpp")], capture_output=True, text=True)
    assert run.returncode == 0, run.stderr
