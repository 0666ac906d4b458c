"""What a page's install line brings is enough for the commands below it: no other library can be found here."""

from __future__ import annotations

import json
import re
import subprocess
import sys
from pathlib import Path

import pytest

from endopilot.extras import extras_present

README = Path(__file__).parents[2] / "README.md"
NEEDS = {
    "cockpit": {"cockpit"},
    "demo": {"learn", "report"},
    "run": {"learn", "report"},
    "dataset": {"learn"},
    "train": {"learn"},
    "evaluate": {"learn", "report"},
    "angiograms": {"imaging"},
}
"""Extras that commands cannot do without; all others write what they can."""
ONLY = """
import json, sys
from importlib.machinery import PathFinder

kept, commands = json.loads(sys.argv[1])
from endopilot.extras import requirements_of_extras

libraries = {extra: {one.replace("-", "_") for one in of} for extra, of in requirements_of_extras().items()}
hidden = set().union(*libraries.values()) - set().union(*(libraries[extra] for extra in kept))


class Finder(PathFinder):
    @classmethod
    def find_spec(cls, name, path=None, target=None):
        return None if name.partition(".")[0] in hidden else super().find_spec(name, path, target)


sys.meta_path[sys.meta_path.index(PathFinder)] = Finder
from endopilot.cli import main

for command in commands:
    if command[0] == "cockpit" and "cockpit" in kept:
        import endopilot.cockpit.server
        endopilot.cockpit.server.serve = lambda *_, listening, **__: listening("http://here")
    try:
        main(command)
    except SystemExit as leaving:
        print(command[0], "ended with", leaving.code)
"""
"""Runs commands where only the libraries of some extras are installed, beside those of the package itself."""


def run(tmp_path: Path, extras: list[str], *commands: list[str]) -> subprocess.CompletedProcess[str]:
    line = [sys.executable, "-c", ONLY, json.dumps([extras, commands])]
    return subprocess.run(line, cwd=tmp_path, capture_output=True, text=True, check=True)


def test_commands_need_no_extra_or_name_the_one_that_they_need(tmp_path, vessel) -> None:
    (tmp_path / "ct.nii.gz").touch()
    (tmp_path / "x").mkdir()
    drive = ["navigate", str(vessel), "--target=vessel", "--tip", "own", "--seconds", "20", "-o", "drive"]
    plan = ["plan", str(vessel), "--target=vessel", "--seconds", "20", "-o", "plan"]
    enough = [drive, plan, ["simulate", str(vessel), "--controls", "plan", "-o", "rollout.csv"], ["devices"]]
    asked = {"run": ["ct.nii.gz", "--target=4", "-o", "a"], "dataset": [str(vessel), "-o", "b"]}
    asked |= {"demo": ["-o", "e"], "train": ["x", "-o", "c"], "angiograms": [str(vessel), "-o", "d"], "cockpit": []}
    helps = [[name, "--help"] for name in ("run", "dataset", "dataset-info", "train", "evaluate")]
    refused = [[name, *arguments] for name, arguments in asked.items()]
    told = run(tmp_path, [], *enough, *helps, *refused)
    codes = re.findall(r"^([a-z-]+) ended with (\d+)$", told.stdout, re.MULTILINE)
    expected = [(line[0], "0") for line in enough + helps] + [(name, "2") for name in asked]
    assert codes == expected, told.stderr
    (left_out,) = (line for line in told.stdout.splitlines() if line.startswith("left_out"))
    assert left_out.endswith("pip install 'endopilot[learn,report]'")
    made = {path.name for path in (tmp_path / "drive").iterdir()}
    assert made == {"manifest.json", "navigation.csv", "run.json", "trajectory.npz"}
    assert (tmp_path / "rollout.csv").stat().st_size > 1000
    named = re.findall(r"^endopilot ([a-z]+): needs .*'endopilot\[([a-z,]+)\]'$", told.stderr, re.MULTILINE)
    assert {name: set(extras.split(",")) for name, extras in named} == {name: NEEDS[name] for name in asked}
    assert not (tmp_path / "e").exists()  # before minutes of work


def test_the_cockpit_needs_its_own_extra_alone(tmp_path, vessel) -> None:
    if not extras_present()["cockpit"]:
        pytest.skip("the extra `cockpit` is not installed")
    assert "page       http://here" in run(tmp_path, ["cockpit"], ["cockpit", str(vessel), "--no-browser"]).stdout


def test_the_readme_installs_what_its_commands_need() -> None:
    text = README.read_text(encoding="utf-8")
    brought: set[str] = set()
    for line in text.splitlines():
        if extras := re.search(r"pip install 'endopilot\[([a-z,-]+)\]'", line):
            brought |= set().union(*NEEDS.values()) if extras[1] == "all" else set(extras[1].split(","))
        command = re.match(r"    endopilot ([a-z-]+)", line)
        assert not command or NEEDS.get(command[1], set()) <= brought, line
    forms = set(re.findall(r"pip install (?:-\S+ )*'?([^\s'\[`]+)\[", text))
    assert forms == {"endopilot"}  # one form in all lines
