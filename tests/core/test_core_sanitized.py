"""The core's own C++ tests, built and run under address and undefined-behaviour sanitizers."""

from __future__ import annotations

import os
import shutil
import subprocess
from pathlib import Path

import pytest

HERE = Path(__file__).parent
SOURCES = Path(__file__).parents[2] / "src" / "core"
SEEN_BY_ADDRESS = "-fno-sanitize=null,alignment,object-size,vptr"  # or a fault; a quarter of the build
SANITIZERS = ("-fsanitize=address,undefined", SEEN_BY_ADDRESS, "-fno-sanitize-recover=all")
WARNINGS = ("-Wall", "-Wextra", "-Wno-psabi")
FLAGS = ("-std=gnu++20", "-O1", "-g1", "-march=native", "-ffp-contract=off", *WARNINGS, *SANITIZERS)


@pytest.fixture(scope="module")
def compiler(tmp_path_factory: pytest.TempPathFactory) -> str:
    found = os.environ.get("CXX") or shutil.which("c++") or shutil.which("g++") or shutil.which("clang++")
    if not found:
        pytest.skip("no C++ compiler: the core's own tests need one")
    folder = tmp_path_factory.mktemp("probe")
    (folder / "empty.cpp").write_text("int main() { return 0; }\n")
    program = folder / "empty"
    built = subprocess.run(
        [found, *SANITIZERS, folder / "empty.cpp", "-o", program], capture_output=True, encoding="utf-8"
    )
    if built.returncode or subprocess.run([program], capture_output=True).returncode:
        pytest.skip(f"{found} cannot build programs with address and undefined-behaviour sanitizers here")
    return found


@pytest.mark.parametrize("name", ["test_core", "test_kernel", "test_tubes"])
def test_the_core_passes_its_tests_under_sanitizers(compiler: str, name: str, tmp_path: Path) -> None:
    program = tmp_path / name
    folders = [f"-I{folder}" for folder in (SOURCES, HERE, HERE / "cuda_on_cpu")]
    command = [compiler, *FLAGS, *folders, HERE / f"{name}.cpp", "-o", program]
    built = subprocess.run(command, capture_output=True, encoding="utf-8")
    assert built.returncode == 0, built.stderr
    ran = subprocess.run([program], capture_output=True, encoding="utf-8")
    assert ran.returncode == 0, f"{ran.stdout[-4000:]}\n{ran.stderr[-4000:]}"
    assert "all core tests passed" in ran.stdout
