"""The sdist holds the whole package; what `make release` builds of it does what the base install promises.

Wheels are tried where `make release` has built them: `make test` builds the sdist alone, and tests/cli/test_bare.py
hides the libraries of all extras instead of installing the base ones.
"""

from __future__ import annotations

import json
import os
import re
import subprocess
import sys
import tarfile
import venv
import zipfile
from pathlib import Path

import pytest

from endopilot import __version__

ROOT = Path(__file__).parents[2]
RELEASE = os.environ.get("ENDOPILOT_RELEASE")
"""Folder in which `make release` has put sdist and wheels."""
QUICK = ("-C", "cmake.define.CMAKE_CXX_FLAGS_RELEASE=-O1 -DNDEBUG", "-C", "cmake.define.ENDOPILOT_LEVELS=")
"""The core's baseline alone, with little optimisation: the other tests run what is released."""
needs_release = pytest.mark.skipif(RELEASE is None, reason="`make release` builds the wheels that this test tries")
UNREACHABLE = re.compile(
    "NewConnectionError|NameResolutionError|ConnectTimeout|ReadTimeout|Network is unreachable|Connection refused"
)


def install(*arguments: str | Path) -> None:
    """Run pip, and skip the test where no package index can be reached."""
    result = subprocess.run([*map(str, arguments)], capture_output=True, encoding="utf-8")
    if result.returncode and not RELEASE and UNREACHABLE.search(result.stdout + result.stderr):
        pytest.skip("no package index can be reached, and the wheel needs one for its build and its libraries")
    assert result.returncode == 0, result.stdout + result.stderr


@pytest.fixture(scope="module")
def dist(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a folder with the sdist and wheels of the release, or with an sdist."""
    if RELEASE:
        return Path(RELEASE)
    folder = tmp_path_factory.mktemp("dist")
    install(sys.executable, "-m", "build", "--sdist", "--outdir", folder, ROOT)
    return folder


@pytest.fixture(scope="module")
def wheel(dist: Path) -> Path:
    """Return the wheel for this Python."""
    (made,) = dist.glob(f"endopilot-{__version__}-cp{sys.version_info[0]}{sys.version_info[1]}-*.whl")
    return made


@pytest.fixture(scope="module", params=["wheel", "sdist"])
def clean(request: pytest.FixtureRequest, dist: Path, wheel: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the `bin` folder of an environment that holds the wheel, or the sdist, and its base libraries alone."""
    folder = tmp_path_factory.mktemp("clean")
    venv.create(folder, with_pip=True)
    pip = (folder / "bin" / "python", "-m", "pip", "install", "-q", "--no-compile", "-c", ROOT / "constraints.txt")
    if request.param == "wheel":
        install(*pip, wheel)
    else:
        install(*pip, *QUICK, dist / f"endopilot-{__version__}.tar.gz")
    return folder / "bin"


def run(clean: Path, *arguments: str | Path) -> subprocess.CompletedProcess[str]:
    """Run a program of the clean environment, away from the source tree."""
    kept = {name: value for name, value in os.environ.items() if not name.startswith("PYTHON")}
    program, *rest = map(str, arguments)
    return subprocess.run(
        [str(clean / program), *rest], capture_output=True, encoding="utf-8", cwd=clean.parent, env=kept, timeout=300
    )


def packaged() -> set[str]:
    """Return the paths of the package's own files in `src`."""
    package = ROOT / "src" / "endopilot"
    return {
        path.relative_to(package.parent).as_posix()
        for path in package.rglob("*")
        if path.is_file() and path.suffix not in (".pyc", ".so")
    }


def test_the_sdist_holds_the_package_and_what_builds_it(dist: Path) -> None:
    with tarfile.open(dist / f"endopilot-{__version__}.tar.gz") as sdist:
        held = {name.partition("/")[2] for name in sdist.getnames()}
    core = {f"src/core/{path.name}" for path in (ROOT / "src" / "core").iterdir()}
    assert {f"src/{name}" for name in packaged()} | core <= held
    assert {"CMakeLists.txt", "LICENSE", "README.md", "pyproject.toml"} <= held
    for needed in ("py.typed", "__init__.pyi", "devices/wires/workhorse-014.yaml", "tasks/ladder_2/crux.yaml"):
        assert f"src/endopilot/{needed}" in held


@needs_release
def test_the_wheel_holds_the_whole_package(wheel: Path) -> None:
    files = packaged()
    names = [each.filename for each in zipfile.ZipFile(wheel).infolist() if not each.is_dir()]
    held = {name for name in names if name.startswith("endopilot/")}
    assert files - held == set()
    core = held - files
    assert core and all(re.fullmatch(r"endopilot/_core\w*\.[\w.-]+\.so", name) for name in core)


@needs_release
def test_it_simulates_and_plans(clean: Path) -> None:
    result = run(clean, "python", ROOT / "tests" / "e2e" / "installed.py")
    assert result.returncode == 0, result.stderr
    assert Path(result.stdout.strip()).is_relative_to(clean.parent)


@needs_release
def test_the_command_line_answers(clean: Path) -> None:
    assert run(clean, "endopilot", "--version").stdout == f"endopilot {__version__}\n"
    assert "endopilot COMMAND" in run(clean, "endopilot", "--help").stdout
    assert json.loads(run(clean, "endopilot", "info", "--json").stdout)["extras"] == "-"


@needs_release
def test_a_command_without_its_extra_says_so_in_one_line(clean: Path) -> None:
    result = run(clean, "endopilot", "train", clean.parent, "-o", "run")
    assert result.returncode == 2
    assert result.stderr == "endopilot train: needs torch; install it with: pip install 'endopilot[learn]'\n"
