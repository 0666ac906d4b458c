"""The lanes make the steps of `reference_step.hpp`, which is written to be read."""

from __future__ import annotations

import os
import shutil
import subprocess
from pathlib import Path

import pytest

HERE = Path(__file__).parent


def test_the_lanes_agree_with_the_reference_step(tmp_path: Path) -> None:
    compiler = os.environ.get("CXX") or shutil.which("c++")
    if not compiler:
        pytest.skip("no C++ compiler: the core's own tests need one")
    folders = [f"-I{folder}" for folder in (HERE.parents[1] / "src" / "core", HERE)]
    program = tmp_path / "test_reference"
    # sanitizers would make it slow; test_core_sanitized.py runs the same headers with them
    command = [compiler, "-std=gnu++20", "-O2", "-march=native", "-ffp-contract=off", "-Wno-psabi", *folders]
    built = subprocess.run(
        [*command, HERE / "test_reference.cpp", "-o", program], capture_output=True, encoding="utf-8"
    )
    assert built.returncode == 0, built.stderr
    ran = subprocess.run([program], capture_output=True, encoding="utf-8")
    assert ran.returncode == 0 and "all core tests passed" in ran.stdout, ran.stdout
