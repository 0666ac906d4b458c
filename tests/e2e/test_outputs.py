"""Where commands write, what they replace and leave; and bad input: one line, exit code 2, nothing half-written."""

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
from endopilot.devices.device_files import device_yaml
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


def test_the_cockpits_catheters(patient, tmp_path, capsys):
    recordings = ("--output", tmp_path / "recordings")
    narrow = refused(capsys, "cockpit", patient, "--device", "j-035", "--catheter", "microcatheter-1.7f", *recordings)
    assert "is too wide for the bore of catheter microcatheter-1.7f" in narrow
    assert "no such catheter" in refused(capsys, "cockpit", patient, "--catheter", "nonesuch", *recordings)
    brought = refused(capsys, "cockpit", "--task", "follow", "--catheter", "microcatheter-1.7f", *recordings)
    assert brought.endswith("catheter: a replay, a task and a session have theirs; leave it out")
    assert "follow" in refused(capsys, "cockpit", "--task", "nonesuch", *recordings)
    assert not (tmp_path / "recordings").exists()


@pytest.mark.parametrize(
    ("command", "said"),
    [
        (
            "plan mask.nrrd --target 4",
            ["mask.nrrd: is a file; make an anatomy of it first: `", "`endopilot anatomy mask.nrrd"],
        ),
        ("anatomy {patient}", ["{patient}: is an anatomy already; give it to the next command"]),
        ("simulate {patient} --seed abc", ["seed: 'abc'; give a whole number"]),
        ("phantom {patient} --slice-mm thin", ["slice_mm: 'thin'; give a number"]),
        ("segment mask.nrrd --picture slices.jpeg2", ["slices.jpeg2: is written as .png; end the name so"]),
        ("segment missing.nii.gz", ["missing"]),
        ("anatomy missing.stl", ["missing"]),
        ("phantom missing", ["missing"]),
        ("simulate missing", ["missing"]),
        ("dataset missing", ["missing"]),
        ("train missing", ["missing"]),
        ("evaluate missing", ["missing"]),
        ("replay missing.csv --anatomy missing", ["missing"]),
        ("plan {vessel} --target 80,0,0", ["80,0,0", "LPS"]),
        ("plan {vessel} --target nothing.csv", ["nothing.csv"]),
        ("plan {vessel} --target tips.csv", ["1 s are too few for the 41 mm", "40 mm/s"]),  # faster than any drive
        ("plan {vessel} --target 0,0,33 --seconds 2", ["seconds: 2", "31 mm", "speed_mm_s"]),
        ("plan {vessel} --target 0,0,33 --force-limit-n nan", ["force_limit_n"]),
        (
            "plan {vessel} --target 0,0,33 --force-limit-n 1e-6",
            ["under 1e-06 N", "workhorse-014", "larger force_limit_n"],
        ),
    ],
)
def test_what_is_wrong_is_told_in_one_line(patient, vessel, tmp_path, capsys, monkeypatch, command, said):
    monkeypatch.chdir(tmp_path)
    Path("mask.nrrd").write_bytes(b"")
    Path("tips.csv").write_text("time_s,tip_abscissa_mm,tip_offset_mm\n0.5,10,0.2\n1.0,43,0\n")
    before, folders = sorted(tmp_path.iterdir()), {"patient": patient, "vessel": vessel}
    written = {"segment": "out.nii.gz", "phantom": "out.nii.gz", "simulate": "out.csv"}.get(command.split()[0], "out")
    line = refused(capsys, *command.format(**folders).split(), "-o", written)
    assert all(part.format(**folders) in line for part in said), line
    assert sorted(tmp_path.iterdir()) == before


def test_a_branch_that_the_wire_does_not_get_into(vessel, tmp_path, capsys):
    """A wire without a bend at its tip."""
    text = device_yaml("workhorse-014")[1].replace("angle_deg: 45", "angle_deg: 0")
    (tmp_path / "straight.yaml").write_text(text)
    out = 20.0 * np.array([np.sin(np.pi / 3), 0.0, np.cos(np.pi / 3)]) * 0.8 + [0.0, 0.0, 20.0]
    target = ",".join(f"{x:.2f}" for x in out)
    plan = ("plan", vessel, "--target", target, "-o", tmp_path / "plan", "--device", tmp_path / "straight.yaml")
    line = refused(capsys, *plan, "--tip", "own")
    assert "no path found to branch 2" in line
    assert "at the fork into section vessel (branch 2) at 20.0 mm, which its tip of 0/3 does not enter" in line
    assert "--tip" in line and "--catheter-tilt-deg" in line
    assert not (tmp_path / "plan").exists()
    shaped = run(capsys, *plan)  # a hand bends it
    assert shaped["reached"] and shaped["tip"] != "0/3"
    assert re.search(r"enters vessel from \d+ of 24 rotations; as delivered from none", shaped["why"])
    assert run(capsys, "simulate", vessel, "--controls", tmp_path / "plan", "-o", tmp_path / "again.csv", *plan[-2:])
