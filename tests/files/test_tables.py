"""Tables of controls as spreadsheets save them and people type them: read as meant, with a remark, or refused."""

from __future__ import annotations

import warnings
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from make_fuzz import bounded, read_or_refused, refusal

from endopilot.control.plan import read_tips
from endopilot.errors import InputError, Remark
from endopilot.simulation.controls import PERIODS_S, ScriptedControls, read_controls_csv

HEADER = "time_s,translation_mm_s,rotation_rad_s"
ROWS = ["0.5,2,0", "1.0,-1,0.5", "1.5,0,-0.25"]
PLAIN = "\n".join([HEADER, *ROWS]) + "\n"


def read(tmp_path: Path, content: str | bytes, **options: int) -> tuple[ScriptedControls, list[str]]:
    """Return the controls of a file, and the remarks about it."""
    path = tmp_path / "controls.csv"
    path.write_bytes(content if isinstance(content, bytes) else content.encode())
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        script = read_controls_csv(path, **options)
    assert all(each.category is Remark for each in caught)
    return script, [str(each.message) for each in caught]


def refused(tmp_path: Path, content: str | bytes, **options: int) -> str:
    return refusal(tmp_path / "controls.csv", content, lambda path: read_controls_csv(path, **options))


@pytest.mark.parametrize(
    "content",
    [
        PLAIN.replace("\n", "\r\n"),
        PLAIN.replace("\n", "\r"),
        PLAIN.rstrip("\n"),
        "\n\n" + PLAIN.replace("\n", "\n\n"),
        PLAIN.encode("utf-8-sig"),
        PLAIN.encode("utf-16"),
        PLAIN.upper(),
        PLAIN.replace(",", " , "),
        '"time_s","translation_mm_s","rotation_rad_s"\n"0.5","2","0"\n"1.0","-1","0.5"\n"1.5","0","-0.25"\n',
        PLAIN + ",,\n,,\n",
        PLAIN.replace("\n", ",\n"),
        "note," + PLAIN.replace("\n", "\nsome text,", 3),
    ],
    ids=["crlf", "cr", "no-end", "blank-lines", "bom", "utf-16", "capitals", "spaces", "quotes", "blank-cells",
         "last-comma", "other-column"],
)  # fmt: skip
def test_what_spreadsheets_add_changes_nothing(tmp_path, content) -> None:
    script, remarks = read(tmp_path, content)
    np.testing.assert_array_equal(script.control, [[[[2, 0]], [[-1, 0.5]], [[0, -0.25]]]])
    assert script.period_s == 0.5 and remarks == []


@pytest.mark.parametrize(
    ("content", "said"),
    [
        (PLAIN.replace(",", ";"), ["semicolons"]),
        (PLAIN.replace(",", "\t"), ["tabs"]),
        (PLAIN.replace(",", "|"), ["bars"]),
        ("sep=;\n" + PLAIN.replace(",", ";"), ["semicolons"]),
        (PLAIN.replace(",", ";").replace(".", ","), ["semicolons", "decimal commas"]),
        (PLAIN.replace(",", "\t").replace(".", ",").encode("utf-16"), ["tabs", "decimal commas"]),
    ],
    ids=["semicolons", "tabs", "bars", "sep", "decimal-commas", "excel-unicode"],
)
def test_other_separators_are_read_and_said(tmp_path, content, said) -> None:
    script, remarks = read(tmp_path, content)
    np.testing.assert_array_equal(script.control, [[[[2, 0]], [[-1, 0.5]], [[0, -0.25]]]])
    assert len(remarks) == len(said) and all(word in remark for word, remark in zip(said, remarks, strict=True))
    assert all(remark.startswith(str(tmp_path)) for remark in remarks)


@pytest.mark.parametrize(
    ("rows", "what"),
    [
        (["0,5,2,0"], "row 2 has 4 cells where the columns are 3; write decimal points"),
        (['"0,5",2,0'], "row 2: time_s = 0,5 is no finite number"),
        (["0.5,2"], "row 2: rotation_rad_s is empty; give a number"),
        (["0.5,2,0", "1.0,,0"], "row 3: translation_mm_s is empty"),
        (["0.5,inf,0"], "row 2: translation_mm_s = inf is no finite number"),
        (["0.5,1_0,0"], "row 2: translation_mm_s = 1_0 is no finite number"),
        (["0.5,\u0661,0"], "is no finite number"),
        (["00:00:00.5,1,0"], "row 2: time_s = 00:00:00.5 is no finite number"),
        (['0.5,"1,0'], "row 2: no CSV"),
        (["500,1,0", "1000,1,0"], "row 2: time_s = 500 seems to be in ms (500 ms is 0.5 s); give seconds"),
        (["0.0001,1,0"], "row 2: time_s = 0.0001; give seconds; a period has 0.001 to 4"),
        (["1.7e9,1,0", "1700000000.5,1,0"], "row 2: time_s = 1700000000; give seconds"),
        (["0,1,0", "0.5,1,0"], "row 2: time_s = 0; the first row ends the first period"),
        (["0.5,1,0", "0.5,1,0"], "row 3: time_s = 0.5; each world's rows end periods of one length"),
        ([], "has no rows below the names"),
    ],
)  # fmt: skip
def test_a_row_that_is_none_is_refused_by_its_line_and_column(tmp_path, rows, what) -> None:
    assert what in refused(tmp_path, "\n".join([HEADER, *rows]) + "\n")


@pytest.mark.parametrize(
    ("content", "what"),
    [
        (PLAIN.replace(",", ";").replace("0.25", "0,25"), "holds decimal commas and decimal points"),
        ("", "is empty; give the columns time_s, translation_mm_s, rotation_rad_s"),
        ("0.5,2,0\n1.0,2,0\n", "row 1 holds numbers; give the columns' names there"),
        (PLAIN.replace("rotation_rad_s", "rotation_deg_s"), "rotation_rad_s is missing (rotation_deg_s is there)"),
        (PLAIN.replace("rotation_rad_s", "time_s"), "column rotation_rad_s is missing"),
        (PLAIN.replace("\n", ",1\n").replace("rad_s,1", "rad_s,Time_s"), "column time_s stands there 2 times"),
        (PLAIN.replace("\n", ",1\n").replace("rad_s,1", "rad_s,worlds"), "worlds is not known; did you mean world?"),
        (b"\x89PNG\r\n\x1a\n\x00\x00", "is no text"),
        (PLAIN.replace("time_s", "Zeit in µs, time_s").encode("latin-1"), "is no text in UTF-8"),
        (PLAIN.encode("utf-16-le"), "is no text (it holds zero bytes)"),
        ("time_s," + "x" * 200_000 + "\n", "no CSV (field larger than field limit"),
    ],
)  # fmt: skip
def test_what_is_no_such_table_is_refused(tmp_path, content, what) -> None:
    assert what in refused(tmp_path, content)


def test_worlds_are_whole_numbers_and_each_row_has_one(tmp_path) -> None:
    def table(*worlds: str) -> str:
        rows = [f"{row},{world}" for row, world in zip(ROWS[:2] * 2, worlds, strict=True)]
        return "\n".join([f"{HEADER},world", *rows]) + "\n"

    script, _ = read(tmp_path, table("7", "7", "3.0", "3.0"))
    assert script.control.shape == (2, 2, 1, 2)
    assert "row 3: world is empty" in refused(tmp_path, table("0", "", "1", "1"))
    assert "row 2: world is empty" in refused(tmp_path, table("", "", "", ""))
    assert "row 2: world = 0.5; give a whole number" in refused(tmp_path, table("0.5", "0", "1", "1"))
    assert "row 2: world = -1; give a whole number" in refused(tmp_path, table("-1", "-1", "1", "1"))
    assert "world = a is no finite number" in refused(tmp_path, table("a", "a", "b", "b"))
    assert "world 1 has 1, world 0 has 3" in refused(tmp_path, table("0", "0", "0", "1"))


def test_a_state_is_whole_or_absent(tmp_path) -> None:
    def table(*names: str) -> str:
        return "\n".join([",".join([HEADER, *names]), ",".join(["0.5,2,0.5", *["6"] * len(names)])]) + "\n"

    script, _ = read(tmp_path, table("inserted_length_mm", "rotation_rad"))
    np.testing.assert_allclose(script.initial, [[[5, 5.75]]])
    assert "column rotation_rad is missing where inserted_length_mm is there" in refused(
        tmp_path, table("inserted_length_mm")
    )
    assert "column inserted_length_mm is missing where rotation_rad is" in refused(tmp_path, table("rotation_rad"))
    pair = table("catheter_1_translation_mm_s", "catheter_1_rotation_rad_s", "inserted_length_mm", "rotation_rad")
    assert "column catheter_1_inserted_length_mm is missing" in refused(tmp_path, pair, devices=2)


def test_controls_of_a_catheter_that_is_not_there_are_said(tmp_path) -> None:
    content = PLAIN.replace("\n", ",1,0\n").replace(
        "rad_s,1,0", "rad_s,catheter_1_translation_mm_s,catheter_1_rotation_rad_s"
    )
    _, remarks = read(tmp_path, content)
    assert len(remarks) == 1 and "column catheter_1_translation_mm_s is not used" in remarks[0]
    script, remarks = read(tmp_path, content, devices=2)
    assert script.control.shape == (1, 3, 2, 2) and remarks == []


def test_desired_tips_are_read_by_the_same_rules(tmp_path) -> None:
    path = tmp_path / "tips.csv"
    path.write_text("Time_s;tip_abscissa_mm;tip_offset_mm\n0,5;5;0,1\n1,0;6;0,1\n")
    with pytest.warns(Remark):
        tips = read_tips(path, 40.0, 2.0)
    np.testing.assert_array_equal(tips[["abscissa", "offset", "branch"]], [[5, 0.1, -1], [6, 0.1, -1]])
    path.write_text("time_s,tip_abscissa_mm,tip_offset_mm\n0.5,-5,0.1\n")
    with pytest.raises(InputError, match="row 2: tip_abscissa_mm = -5; give 0 or more"):
        read_tips(path, 40.0, 2.0)


BOUNDED = bounded(50)
NAMES = ["time_s", "translation_mm_s", "rotation_rad_s", "world", "inserted_length_mm", "rotation_rad", "branch", ""]
NUMBERS = st.floats(-50, 50).map(lambda value: round(value, 3))
ODD = ["0.5", "1.0", "1.5", "0", "", "nan", "1e400", "0,5", '"', "x", " 2 ", "1_0", "#N/A"]
CELLS = st.sampled_from(ODD) | NUMBERS.map(str)


@BOUNDED
@given(
    header=st.lists(st.sampled_from(NAMES), max_size=7),
    rows=st.lists(st.lists(CELLS, max_size=7), max_size=5),
    separator=st.sampled_from(",;\t|"),
    end=st.sampled_from(["\n", "\r\n", "\r"]),
    devices=st.integers(1, 3),
)
def test_any_cells(tmp_path, header, rows, separator, end, devices) -> None:
    content = end.join(separator.join(row) for row in (header, *rows))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        found = read_or_refused(tmp_path / "c.csv", content, lambda path: read_controls_csv(path, devices=devices))
        read_or_refused(tmp_path / "c.csv", content, lambda path: read_tips(path, 40.0, 2.0))
    if found is not None:
        assert np.isfinite(found.control).all() and np.isfinite(found.initial).all()
        assert PERIODS_S[0] <= found.period_s <= PERIODS_S[1]
