"""Where commands write, what they replace, and what they leave."""

from __future__ import annotations

import marshal
import os
import re
import resource
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from command import refused, run
from endopilot.imaging.volume import write_mask
from endopilot.types import LumenMask, Volume

SHORT = ("--sequences", "2", "--seconds", "2")


@pytest.fixture
def mask(tmp_path) -> Path:
    return straight_mask(tmp_path / "scans" / "m.nii.gz", radius=4.0)


def straight_mask(path: Path, radius: float) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    across = np.indices((60, 24, 24))[1:] - 11.5
    voxels = np.hypot(*across) < radius
    voxels[:2] = voxels[-2:] = False
    write_mask(LumenMask(Volume(voxels, np.ones(3), np.zeros(3), np.eye(3)), None), path, manifest={})
    return path


def content(folder: Path) -> dict[str, bytes]:
    return {str(path.relative_to(folder)): path.read_bytes() for path in sorted(folder.rglob("*")) if path.is_file()}


def test_an_output_in_which_an_input_lies_is_refused_and_all_of_it_stays(mask, patient, capsys, tmp_path):
    (mask.parent / "thesis.txt").write_text("dear")
    before = content(mask.parent)
    inner = tmp_path / "scans" / "deeper"
    shutil.copytree(mask.parent, inner)
    for sources in ([mask], [mask, inner / mask.name]):
        assert "lies in the output" in refused(capsys, "anatomy", *sources, "-o", mask.parent)
    assert "lies in the output" in refused(capsys, "navigate", patient, "--target", "2", "-o", patient)
    shutil.rmtree(inner)
    assert content(mask.parent) == before


def test_a_finished_anatomy_is_made_again_from_the_same_mask_alone(mask, capsys, tmp_path):
    folder, wider = tmp_path / "patient", straight_mask(tmp_path / "wider.nrrd", 6.0)
    run(capsys, "anatomy", mask, "-o", folder)
    (folder / "plan").mkdir()
    (folder / "plan" / "mine.txt").write_text("kept")
    before = content(folder)
    assert "was begun with source" in refused(capsys, "anatomy", wider, "-o", folder)
    line = refused(capsys, "anatomy", mask, "-o", folder, "--minimum-branch-length-mm", "9")
    assert "minimum_branch_length_mm = 4.0, now it is 9.0" in line
    assert content(folder) == before
    run(capsys, "anatomy", mask, "-o", folder)
    assert content(folder) == before


def test_a_file_is_replaced_only_where_the_user_says_so_and_never_one_of_the_input(patient, capsys, tmp_path):
    table, before = tmp_path / "rollout.csv", content(patient)
    table.write_text("theirs")
    simulate = ("simulate", patient, "-o", table, *SHORT)
    assert "rollout.csv: is there already" in refused(capsys, *simulate)
    assert table.read_text() == "theirs"
    run(capsys, *simulate, "--overwrite")
    assert table.read_text().startswith("world")
    picture = tmp_path / "picture.png"
    picture.write_text("theirs")
    assert "picture.png: is there already" in refused(capsys, *simulate[:3], tmp_path / "b.csv", "--picture", picture)
    for also in ((), ("--overwrite",)):
        assert "lumen.nrrd" in refused(capsys, "phantom", patient, "-o", patient / "lumen.nrrd", *also)
    assert content(patient) == before


def test_an_output_that_is_a_link_leads_where_it_points(mask, capsys, tmp_path):
    real = tmp_path / "real"
    real.mkdir()
    (tmp_path / "link").symlink_to(real)
    (tmp_path / "nowhere").symlink_to(tmp_path / "gone")
    run(capsys, "anatomy", mask, "-o", tmp_path / "link")
    run(capsys, "anatomy", mask, "-o", tmp_path / "link")
    assert (tmp_path / "link").is_symlink() and (real / "anatomy.json").exists()
    assert "nowhere" in refused(capsys, "anatomy", mask, "-o", tmp_path / "nowhere")


def test_a_failing_command_leaves_no_folder_behind(capsys, tmp_path):
    straight_mask(tmp_path / "thin.nrrd", 0.6)
    refused(capsys, "anatomy", tmp_path / "thin.nrrd", "-o", tmp_path / "patient", "--ostium-mm", "90", "0", "0")
    assert not (tmp_path / "patient").exists()


LIMIT = 5_000
"""Bytes that a file may have: fewer than any of these results have, and more than the record of a run."""


def test_a_limit_on_files_leaves_no_compiled_module_cut_short(tmp_path):
    limit = 16_000  # more than the command's first module, which is there before the limit is known
    environment = {name: value for name, value in os.environ.items() if name != "PYTHONDONTWRITEBYTECODE"}
    subprocess.run(
        [sys.executable, "-m", "endopilot.cli", "info"],
        capture_output=True,
        preexec_fn=lambda: resource.setrlimit(resource.RLIMIT_FSIZE, (limit, limit)),
        env=environment | {"PYTHONPYCACHEPREFIX": str(tmp_path)},
        check=True,
    )
    compiled = list(tmp_path.rglob("endopilot/**/*.pyc"))
    assert compiled and all(marshal.loads(path.read_bytes()[16:]) for path in compiled)


@pytest.mark.parametrize(
    "words", ["anatomy {mask} -o {out}", "simulate {patient} --sequences 4 --seconds 10 --shape -o {out}.npz"]
)
def test_what_does_not_fit_is_told_in_one_line_and_is_not_there(words, mask, patient, tmp_path):
    out = tmp_path / "out" / "it"
    ended = subprocess.run(
        [sys.executable, "-m", "endopilot.cli", *words.format(mask=mask, patient=patient, out=out).split()],
        capture_output=True,
        text=True,
        preexec_fn=lambda: resource.setrlimit(resource.RLIMIT_FSIZE, (LIMIT, LIMIT)),
        env={**os.environ, "TMPDIR": str(tmp_path), "PYTHONDONTWRITEBYTECODE": "1"},
        check=False,
    )
    lines = [line for line in ended.stderr.splitlines() if ": done in" not in line]
    assert ended.returncode == 2 and len(lines) == 1 and "ulimit -f" in lines[0], ended.stderr
    assert str(out) in lines[0]
    assert not [path for path in out.parent.rglob("*") if path.is_file()]


ROOT = Path(__file__).parents[2]
LADDER = {"runs/ladder"}
"""Where `endopilot ladder` keeps its results."""


def test_no_two_commands_keep_their_results_in_one_folder():
    sources = [path for folder in ("src/endopilot", "benchmarks") for path in (ROOT / folder).rglob("*.py")]
    found: dict[str, list[str]] = {}
    for path in sources:
        for name in re.findall(r'(?:Path|OutputFolder) = Path\("(runs/[\w-]+)"\)', path.read_text(encoding="utf-8")):
            found.setdefault(name, []).append(str(path))
    assert len(found) > 8 and not LADDER & found.keys()
    for name, paths in found.items():  # or in files that are named as the folder is, as the cockpit's are
        assert len(paths) == 1 or all(name.partition("/")[2] in path for path in paths), name
