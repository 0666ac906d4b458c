"""The GPU's part of the core compiles, where a CUDA compiler is at hand; test_kernel.cpp runs it on the processor."""

from __future__ import annotations

import shutil
import subprocess
from pathlib import Path

import pytest

HERE = Path(__file__).parent
CORE = HERE.parents[1] / "src" / "core"


def test_the_kernel_compiles_for_a_gpu(tmp_path: Path) -> None:
    compiler = shutil.which("nvcc")
    if compiler is None:
        pytest.skip("no CUDA compiler (nvcc) here")
    version = subprocess.run([compiler, "--version"], capture_output=True, encoding="utf-8", check=True).stdout
    if int(version.rsplit("release ", 1)[-1].split(".")[0]) < 12:
        pytest.skip("nvcc is older than 12, which knows C++20")
    made = tmp_path / "cuda.ptx"
    # the options of CMakeLists.txt, to the assembly that every GPU of this kind takes: the assembler adds no check and
    # takes most of the time; a call of host code from the device is an error
    options = ["-std=c++20", "-arch=compute_80", "--fmad=false", "--expt-relaxed-constexpr", "-diag-suppress", "549"]
    options += ["-Werror", "cross-execution-space-call"]
    command = [compiler, *options, "--ptx", str(CORE / "cuda.cu"), "-o", str(made)]
    run = subprocess.run(command, capture_output=True, encoding="utf-8", check=False)
    assert run.returncode == 0, run.stdout + run.stderr
    assert b"step_kernel" in made.read_bytes()
