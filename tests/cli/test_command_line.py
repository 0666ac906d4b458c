"""How commands are called: options, help, files of options, what a bad one is answered, and what Tab completes."""

from __future__ import annotations

import importlib.util
import json
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from command import output_of, refused
from command import run as figures_of
from endopilot.cli import COMMANDS, GROUPS, command_of
from endopilot.cli.arguments import show
from endopilot.cli.options import LISTED_AT_MOST, Command, Option
from endopilot.errors import InputError
from endopilot.files import read_yaml
from endopilot.runs import OutputFolder
from endopilot.settings import Count, Positive, Seed, read_settings, settings


def test_the_overview_names_every_command(capsys: pytest.CaptureFixture[str]) -> None:
    printed = output_of(capsys)
    for name, summary in COMMANDS.items():
        assert name in printed
        assert summary in " ".join(printed.split())
    assert max(map(len, printed.splitlines())) <= 80
    assert [line for line in printed.splitlines() if line in GROUPS.values()] == list(GROUPS.values())


@pytest.mark.parametrize(("options", "figure"), [((), " 0.0074 "), (("workhorse-014", "--tip-load"), " 0.755 ")])
def test_tables_fit_80_columns_and_keep_names_and_figures_whole(options, figure, capsys) -> None:
    lines = output_of(capsys, "devices", *options).splitlines()
    assert max(map(len, lines)) <= 80
    assert any(line.startswith("workhorse-014 ") and figure in line for line in lines)


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


def test_a_suffix_is_refused_before_the_work(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """The folder holds no anatomy, which is found out when the work begins."""
    folder, lines = str(tmp_path), tmp_path / "lines.csv"
    lines.touch()
    for arguments, message in (
        (("simulate", folder, "-o", "a.txt"), "a.txt: is written as .parquet or .csv or .npz; end the name so"),
        (("simulate", folder, "-o", "A.CSV", "--shape"), "A.CSV: wire shapes do not fit a table; write them as .npz"),
        (("locate", folder, str(lines), "-o", "tips.txt"), "tips.txt: is written as .csv; end the name so"),
    ):
        assert refused(capsys, *arguments).endswith(message)


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


EVERY = [command_of(name) for name in COMMANDS]
ROOT = Path(__file__).parents[2]


@settings
class Weights:
    """Weights."""

    force: Positive = 8.0
    """Of the force, mm/s."""
    time: Positive = 1.0
    """Of the time, mm/s."""


@settings
class SearchConfig:
    """How to search."""

    rounds: Count = 4
    """Rounds."""
    quick: bool = True
    """Stop at the first success."""
    weights: Weights = Weights(time=2.0)
    """What is weighed."""


FIVE_ROUNDS = SearchConfig(rounds=5)


def search(
    patient: Path,
    /,
    *,
    output: OutputFolder,
    points: tuple[tuple[float, float], ...] = (),
    seed: Seed | None = None,
    config: SearchConfig = FIVE_ROUNDS,
) -> dict[str, object]:
    """Search.

    Args:
        patient: where.
        output: folder of the result.
        points: pairs of numbers, in 100 % of the cases.
        seed: of the search.
        config: how.
    """
    return {"patient": patient, "output": output, "points": points, "seed": seed, "config": config}


SEARCH = Command("endopilot search", search)


def flags(text: str) -> list[str]:
    return [line.split()[-1 if "," in line else 0] for line in text.splitlines() if line.startswith("  -")]


def documented(command: Command) -> list[Option]:
    return [leaf for one in command.options() for leaf in (one, *one.leaves())]


@pytest.mark.parametrize("command", EVERY, ids=lambda command: command.name)
def test_help_fits_a_head(command: Command) -> None:
    listed, everything = (flags(command.help(everything=every)) for every in (False, True))
    assert len(listed) <= LISTED_AT_MOST < 11 and set(listed) <= set(everything)
    by_name = [leaf for one in command.options() for leaf in one.leaves() if not leaf.positional]
    assert len(everything) == len(by_name) and len({leaf.name for leaf in by_name}) == len(by_name)
    text = command.help(everything=False)
    assert f"usage: {command.name}" in text and ("--help-all" in text) == (len(listed) < len(everything))


@pytest.mark.parametrize("command", EVERY, ids=lambda command: command.name)
def test_every_option_says_what_it_means(command: Command) -> None:
    assert [one.name for one in documented(command) if not one.meaning.endswith((".", ")"))] == []


@pytest.mark.parametrize("command", EVERY, ids=lambda command: command.name)
def test_a_printed_file_is_read_back_the_same(command: Command, tmp_path) -> None:
    file = tmp_path / "options.yaml"
    file.write_text(command.file(), encoding="utf-8")
    content = read_yaml(file)
    assert set(content or ()) == {one.name for one in command.options() if not one.required}
    if content:
        assert read_settings(file, command.settings) == command.defaults
        assert command.file(command.read(["--config", str(file), "--print-config"])) == command.file()


def test_flags_win_over_the_file_which_wins_over_defaults(tmp_path) -> None:
    file = tmp_path / "options.yaml"
    file.write_text("output: out\nseed: 3\npoints: [[1, 2]]\nquick: false\nweights: {force: 9}\nrounds: 7\n")
    read = SEARCH.read(["p", "--config", str(file), "--seed", "4"])
    assert (read.output, read.points, read.seed, read.quick) == (Path("out"), ((1.0, 2.0),), 4, False)
    assert (read.rounds, read.weights) == (7, Weights(force=9.0, time=2.0))
    assert SEARCH.read(["p", f"--config={file}", "--quick", "--time", "5"]).weights == Weights(force=9.0, time=5.0)
    assert SEARCH.read(["p", f"--config={file}", "--quick"]).quick
    assert SEARCH.read(["p", "-o", "o"]) == SEARCH.settings(
        patient=Path("p"), output=Path("o"), rounds=5, weights=Weights(time=2.0)
    )


def test_a_word_that_begins_with_a_minus_and_a_digit_is_a_value() -> None:
    plan = command_of("plan").read(["patient", "--target", "-1.5,2,3", "-o", "a-1", "--seconds", "1e2"])
    assert (plan.target, plan.output, plan.seconds) == ("-1.5,2,3", Path("a-1"), 100.0)
    read = SEARCH.read(["p", "-o", " o", "--points", "-1e-3", "-.5", "3", "4"])
    assert (read.points, read.output) == (((-1e-3, -0.5), (3.0, 4.0)), Path(" o"))


def test_the_function_is_called_with_all_of_it(tmp_path, capsys) -> None:
    file = tmp_path / "options.yaml"
    file.write_text("patient: p\nweights: {force: 9}\n")
    SEARCH.run(["-o", "o", "--config", str(file), "--points", "1", "-2", "3", "4", "--no-quick"])
    shown = capsys.readouterr().out
    assert "patient  p\n" in shown and "points   1, -2, 3, 4\n" in shown
    assert "SearchConfig(rounds=5, quick=False, weights=Weights(force=9.0, time=2.0))" in shown


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("weights: {force: -1}", "options.yaml: weights.force: -1; give a positive number"),
        ("weights: {forse: 1}", "options.yaml: weights.forse: no such field; did you mean force?"),
        ("rouns: 1", "options.yaml: rouns: no such field; did you mean rounds?"),
        ("weights: 1", "options.yaml: weights: 1; write it as {force: ..., time: ...}"),
        ("seed: -1", "options.yaml: seed: -1; give a whole number from 0"),
        ("quick: 3", "options.yaml: quick: 3; give true or false"),
        ("- 1", "options.yaml: holds no mapping of fields"),
        ("a: [", "options.yaml: line 2: not valid YAML"),
        (None, "options.yaml: no such file; check the path"),
    ],
)
def test_a_bad_file_is_refused_in_one_line(tmp_path, text, said) -> None:
    file = tmp_path / "options.yaml"
    if text is not None:
        file.write_text(f"{text}\n")
    with pytest.raises(InputError) as refused:
        SEARCH.read(["p", "-o", "o", "--config", str(file)])
    assert said in str(refused.value) and "\n" not in str(refused.value)


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["p"], "Missing from endopilot search: -o DIR, --output DIR"),
        (["-o", "o"], "Missing from endopilot search: PATIENT"),
        (["p", "-o", "o", "--config"], "argument --config: expected one argument"),
        (["p", "-o", "o", "--force", "-1"], "force: -1.0; give a positive number"),
        (["p", "-o", "o", "--nonesuch"], "unrecognized arguments: --nonesuch"),
    ],
)
def test_bad_flags_are_refused_in_one_line(arguments, said) -> None:
    with pytest.raises(InputError) as refused:
        SEARCH.read(arguments)
    assert said in str(refused.value)


def test_a_file_can_be_started_from_flags(tmp_path, capsys, monkeypatch) -> None:
    """On a real command, through the command line: what is required may be left out, and flags are printed too."""
    monkeypatch.chdir(tmp_path)
    printed = output_of(capsys, "plan", "--speed-mm-s", "5", "--print-config")
    assert "straight push, mm/s.\nspeed_mm_s: 5.0\n" in printed and "# target: TEXT  (required)" in printed
    Path("plan.yaml").write_text(printed)
    again = command_of("plan").read(["patient", "--target", "4", "-o", "o", "--config", "plan.yaml"])
    assert again.speed_mm_s == 5.0 and again.target == "4"
    Path("none.yaml").write_text("sources: []\noutput: o\n")
    assert "Missing from endopilot anatomy: [SOURCES ...]" in refused(capsys, "anatomy", "--config", "none.yaml")


def test_the_pages_are_made_of_the_commands() -> None:
    spec = importlib.util.spec_from_file_location("commands_page", ROOT / "docs" / "commands.py")
    assert spec and spec.loader
    script = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(script)
    pages = script.pages()
    assert {path: path.read_text(encoding="utf-8") for path in pages} == pages, "run `python docs/commands.py`"
    assert {*(ROOT / "docs" / "commands").glob("*.md")} < pages.keys() and len(pages) > 5
    page = "".join(pages.values())
    for command in EVERY:
        assert f"## {command.name}\n" in page
        for one in documented(command):
            assert one.group or f"| `{', '.join(one.flags)}` |" in page


def test_random_navigations_stop_short_of_ends(vessel, tmp_path, capsys):
    """The vessel ends at 40 mm, its branch too; a tip stops 5 mm before."""
    options = ("--sequences", "3", "--seconds", "20", "--seed", "1")
    figures = figures_of(capsys, "simulate", vessel, "-o", tmp_path / "run.csv", *options)
    assert figures["valid_worlds"] == 3
    assert figures["worlds_stopped_short"] > 0 and figures["deepest_tip_mm"] <= 35.5


ASK = 'source "$0"; COMP_WORDS=("$@"); COMP_CWORD=$(($# - 1)); _endopilot; echo "${COMPREPLY[@]}"'


@pytest.mark.skipif(shutil.which("fish") is None, reason="needs fish")
def test_tab_completes_in_fish():
    ask = f"{sys.executable} -m endopilot.cli completion fish | source; complete -C 'endopilot xray --show '"
    made = subprocess.run(["fish", "--no-config", "-c", ask], capture_output=True, text=True, check=True)
    assert made.stdout.split() == ["contrast", "dsa", "fluoroscopy", "roadmap"]


@pytest.mark.skipif(shutil.which("bash") is None, reason="needs bash")
def test_tab_completes(capsys, tmp_path):
    (tmp_path / "script").write_text(output_of(capsys, "completion"))
    for words, completed in (
        (["endopilot", "na"], "navigate"),
        (["endopilot", "navigate", "patient", "--tar"], "--target"),
        (["endopilot", "xray", "--show", ""], "fluoroscopy contrast dsa roadmap"),
        (["endopilot", "navigate", "patient", "--robot", ""], ""),  # bash goes on with files
    ):
        line = ["bash", "-c", ASK, tmp_path / "script", *words]
        assert subprocess.run(line, capture_output=True, text=True, check=True).stdout.strip() == completed
