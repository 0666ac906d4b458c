"""The command line: help, exit codes, one line for bad input."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest

from endopilot.cli import COMMANDS, GROUPS, main
from endopilot.cli.arguments import show


def run(*arguments: str | Path, cwd: Path | None = None) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, "-m", "endopilot.cli", *map(str, arguments)],
        capture_output=True,
        text=True,
        cwd=cwd,
        timeout=300,
    )


def assert_one_line(result: subprocess.CompletedProcess[str], *fragments: str) -> None:
    """Bad input: exit code 2, one line on standard error, no traceback, nothing on standard output."""
    assert result.returncode == 2, result.stderr
    assert result.stdout == ""
    assert len(result.stderr.strip().splitlines()) == 1, result.stderr
    assert "Traceback" not in result.stderr
    for fragment in fragments:
        assert fragment in result.stderr


def test_the_overview_names_every_command(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit, match="0"):
        main([])
    printed = capsys.readouterr().out
    for name, summary in COMMANDS.items():
        assert name in printed
        assert summary in printed
    assert [line for line in printed.splitlines() if line in GROUPS.values()] == list(GROUPS.values())


@pytest.mark.parametrize("options", [(), ("workhorse-014", "--tip-load")])
def test_tables_fit_80_columns_and_keep_names_and_figures_whole(options, capsys) -> None:
    with pytest.raises(SystemExit, match="0"):
        main(["devices", *options])
    lines = capsys.readouterr().out.splitlines()
    assert max(map(len, lines)) <= 80
    assert any(line.startswith("workhorse-014 ") and " 0.0074 " in line for line in lines)


@pytest.mark.parametrize("name", COMMANDS)
def test_every_command_has_help(name: str, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as leaving:
        main([name, "--help"])
    assert leaving.value.code == 0
    assert f"usage: endopilot {name}" in capsys.readouterr().out


def test_an_unknown_command_proposes_a_near_one() -> None:
    assert_one_line(run("segmnt"), "did you mean 'segment'")


def test_info_is_json_and_imports_nothing_heavy() -> None:
    code = (
        "import sys; from endopilot.cli import main\n"
        "try: main(['info', '--json'])\n"
        "except SystemExit: pass\n"
        "heavy = {'torch', 'vtk', 'pyvista', 'SimpleITK', 'matplotlib', 'plotly', 'pandas'} & set(sys.modules)\n"
        "assert not heavy, heavy"
    )
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert result.returncode == 0, result.stderr
    assert json.loads(result.stdout)["endopilot"]


def test_a_missing_input_is_reported_in_one_line_by_a_process(tmp_path: Path) -> None:
    assert_one_line(run("run", "missing.nii.gz", "-o", "out", cwd=tmp_path), "missing")
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    "arguments",
    [
        ("segment", "missing.nii.gz", "-o", "mask.nii.gz"),
        ("anatomy", "missing.stl", "-o", "out"),
        ("phantom", "missing", "-o", "ct.nii.gz"),
        ("simulate", "missing", "-o", "out.parquet"),
        ("dataset", "missing", "-o", "out"),
        ("train", "missing", "-o", "out"),
        ("evaluate", "missing", "-o", "out"),
    ],
)
def test_a_missing_input_is_reported_in_one_line(
    arguments: tuple[str, ...], tmp_path: Path, monkeypatch, capsys
) -> None:
    monkeypatch.chdir(tmp_path)
    with pytest.raises(SystemExit) as leaving:
        main(list(arguments))
    told = capsys.readouterr()
    assert leaving.value.code == 2 and told.out == ""
    assert len(told.err.strip().splitlines()) == 1 and "missing" in told.err, told.err
    assert list(tmp_path.iterdir()) == []


def test_a_closed_output_is_no_error() -> None:
    with subprocess.Popen(
        [sys.executable, "-m", "endopilot.cli", "evaluate", "--help"],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    ) as process:
        process.stdout.close()  # as `head` does
        errors = process.stderr.read()
    assert errors == ""
    assert process.returncode == 141


def test_what_is_absent_is_shown_as_a_dash(capsys: pytest.CaptureFixture[str]) -> None:
    show({"remarks": [], "rejected": {}, "difference": None, "count": 0}, as_json=False)
    assert [line.split() for line in capsys.readouterr().out.splitlines()] == [
        ["remarks", "-"], ["rejected", "-"], ["difference", "-"], ["count", "0"],
    ]  # fmt: skip
