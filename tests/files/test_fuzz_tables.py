"""Tables with anything in them: read, or refused in one line. What is read has the numbers that the file has."""

from __future__ import annotations

import warnings
from pathlib import Path

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from make_fuzz import bounded

from endopilot.control.plan import read_tips
from endopilot.errors import InputError
from endopilot.simulation.controls import PERIODS_S, ScriptedControls, read_controls_csv

BOUNDED = bounded(80)
NAMES = ["time_s", "translation_mm_s", "rotation_rad_s", "world", "inserted_length_mm", "rotation_rad", "branch", ""]
NUMBERS = st.floats(-50, 50).map(lambda value: round(value, 3))
ODD = ["0.5", "1.0", "1.5", "0", "", "nan", "1e400", "0,5", '"', "x", " 2 ", "1_0", "#N/A"]
CELLS = st.sampled_from(ODD) | NUMBERS.map(str)


def outcome(path: Path, content: str | bytes, devices: int = 1) -> ScriptedControls | None:
    """Return what a file is read as; None where one line refuses it."""
    path.write_bytes(content if isinstance(content, bytes) else content.encode("utf-8", "surrogatepass"))
    found = None
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        for read in (lambda: read_controls_csv(path, devices=devices), lambda: read_tips(path, 40.0, 2.0)):
            try:
                found = read() if found is None else found
            except InputError as error:
                line = str(error)
                assert line.startswith(str(path)) and "\n" not in line and len(line) < 1500, line
    if isinstance(found, ScriptedControls):
        assert np.isfinite(found.control).all() and np.isfinite(found.initial).all()
        assert PERIODS_S[0] <= found.period_s <= PERIODS_S[1]
        return found
    return None


@BOUNDED
@given(
    header=st.lists(st.sampled_from(NAMES), max_size=7),
    rows=st.lists(st.lists(CELLS, max_size=7), max_size=5),
    separator=st.sampled_from(",;\t|"),
    end=st.sampled_from(["\n", "\r\n", "\r"]),
    devices=st.integers(1, 3),
)
def test_any_cells(tmp_path, header, rows, separator, end, devices) -> None:
    outcome(tmp_path / "c.csv", end.join(separator.join(row) for row in (header, *rows)), devices)


@BOUNDED
@given(content=st.binary(max_size=80) | st.text(max_size=80))
def test_any_bytes(tmp_path, content) -> None:
    assert outcome(tmp_path / "c.csv", content) is None


@BOUNDED
@given(
    rows=st.lists(st.tuples(NUMBERS, NUMBERS), min_size=1, max_size=6),
    period=st.sampled_from([0.05, 0.5, 1.0]),
    separator=st.sampled_from(",;\t|"),
    comma=st.booleans(),
    order=st.permutations(range(3)),
    encoding=st.sampled_from(["utf-8", "utf-8-sig", "utf-16"]),
)
def test_a_table_is_read_the_same_however_it_is_written(
    tmp_path, rows, period, separator, comma, order, encoding
) -> None:
    table = [NAMES[:3], *([f"{period * (k + 1):.3f}", *map(str, row)] for k, row in enumerate(rows))]
    text = "\n".join(separator.join(row[place] for place in order) for row in table)
    if comma and separator != ",":
        text = text.replace(".", ",")
    found = outcome(tmp_path / "c.csv", text.encode(encoding))
    assert found is not None and abs(found.period_s - period) < 1e-12
    np.testing.assert_array_equal(found.control[0, :, 0], rows)
