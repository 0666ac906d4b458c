"""The core's headers compile as CUDA device code, where a CUDA compiler is at hand."""

from __future__ import annotations

import shutil
import subprocess
from pathlib import Path

import pytest

HERE = Path(__file__).parent
CORE = HERE.parents[1] / "src" / "core"


def test_the_core_compiles_for_a_cuda_device(tmp_path: Path) -> None:
    compiler = shutil.which("nvcc")
    if compiler is None:
        pytest.skip("no CUDA compiler (nvcc) here")
    version = subprocess.run([compiler, "--version"], capture_output=True, text=True, check=True).stdout
    if int(version.rsplit("release ", 1)[-1].split(".")[0]) < 12:
        pytest.skip("nvcc is older than 12, which knows C++20")
    made = tmp_path / "newton.o"
    # a call of host code from the device is an error; the diagnostic that is switched off does not see that the
    # unrolled loops of solve.hpp set what they use
    command = [compiler, "-std=c++20", "--expt-relaxed-constexpr", "-Werror", "cross-execution-space-call"]
    command += ["-diag-suppress", "549", "-I", str(CORE), "-c", str(HERE / "newton.cu"), "-o", str(made)]
    run = subprocess.run(command, capture_output=True, text=True, check=False)
    assert run.returncode == 0, run.stdout + run.stderr
    assert made.stat().st_size > 0
