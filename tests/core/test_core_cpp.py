"""The core's own C++ tests under sanitizers, its lanes beside the step that is written to be read, and the GPU's."""

from __future__ import annotations

import os
import shutil
import subprocess
from pathlib import Path

import pytest

HERE = Path(__file__).parent
ROOT = HERE.parents[1]
CORE = ROOT / "src" / "core"
COMPILER = shutil.which(os.environ.get("CXX", "c++"))
SEEN_BY_ADDRESS = "-fno-sanitize=null,alignment,object-size,vptr"  # or a fault; a quarter of the build
SANITIZERS = ("-fsanitize=address,undefined", SEEN_BY_ADDRESS, "-fno-sanitize-recover=all")
LANES = ("-march=native", "-ffp-contract=off")

pytestmark = pytest.mark.skipif(COMPILER is None, reason="no C++ compiler: the core's own tests need one")


def run(*command: str | Path) -> subprocess.CompletedProcess[str]:
    return subprocess.run([*map(str, command)], capture_output=True, encoding="utf-8", check=False)


def compiled(source: Path, *options: str | Path) -> None:
    """Compile a source against the core's headers, and tell what the compiler says of its faults."""
    folders = [f"-I{folder}" for folder in (CORE, HERE, HERE / "cuda_on_cpu")]
    built = run(COMPILER, "-std=gnu++20", "-Wno-psabi", *options, *folders, source)
    assert built.returncode == 0, built.stderr


@pytest.fixture(scope="module")
def sanitizers(tmp_path_factory) -> tuple[str, ...]:
    """Return the compiler's options for sanitizers, where programs that are built with them run."""
    folder = tmp_path_factory.mktemp("probe")
    (folder / "empty.cpp").write_text("int main() { return 0; }\n")
    if (
        run(COMPILER, *SANITIZERS, folder / "empty.cpp", "-o", folder / "empty").returncode
        or run(folder / "empty").returncode
    ):
        pytest.skip(f"{COMPILER} cannot build programs with address and undefined-behaviour sanitizers here")
    return SANITIZERS


@pytest.mark.parametrize("name", ["test_core", "test_kernel", "test_tubes"])
def test_the_core_passes_its_tests_under_sanitizers(sanitizers, name: str, tmp_path: Path) -> None:
    compiled(HERE / f"{name}.cpp", "-Og", "-g1", "-Wall", "-Wextra", *LANES, *sanitizers, "-o", tmp_path / name)
    ran = run(tmp_path / name)
    assert ran.returncode == 0 and "all core tests passed" in ran.stdout, f"{ran.stdout[-4000:]}\n{ran.stderr[-4000:]}"


def test_the_lanes_agree_with_the_reference_step(tmp_path: Path) -> None:
    """Sanitizers would make it slow; the test before runs the same headers with them."""
    compiled(HERE / "test_reference.cpp", "-O1", *LANES, "-o", tmp_path / "reference")
    ran = run(tmp_path / "reference")
    assert ran.returncode == 0 and "all core tests passed" in ran.stdout, ran.stdout


@pytest.mark.skipif(not (ROOT / "benchmarks").exists(), reason="no source of the benchmarks is here")
def test_the_roofline_compiles_with_the_core() -> None:
    """The roofline runs the core's own formulas on another number type."""
    compiled(ROOT / "benchmarks" / "core" / "roofline.cpp", "-fsyntax-only")


def test_the_kernel_compiles_for_a_gpu(tmp_path: Path) -> None:
    """Where a CUDA compiler is at hand; test_kernel.cpp runs the kernel on the processor."""
    nvcc = shutil.which("nvcc")
    if nvcc is None:
        pytest.skip("no CUDA compiler (nvcc) here")
    if int(run(nvcc, "--version").stdout.rsplit("release ", 1)[-1].split(".")[0]) < 12:
        pytest.skip("nvcc is older than 12, which knows C++20")
    made = tmp_path / "cuda.ptx"
    # the options of CMakeLists.txt, to the assembly that every GPU of this kind takes, not optimised: that and the
    # assembler add no check and take most of the time; a call of host code from the device is an error
    options = ["-std=c++20", "-arch=compute_80", "--fmad=false", "--expt-relaxed-constexpr", "-diag-suppress", "549"]
    options += ["-Werror", "cross-execution-space-call", "-Xcicc", "-O0"]
    built = run(nvcc, *options, "--ptx", CORE / "cuda.cu", "-o", made)
    assert built.returncode == 0, built.stdout + built.stderr
    assert b"step_kernel" in made.read_bytes()
