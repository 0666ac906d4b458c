"""Tables that people write: columns of numbers, read from a CSV file whichever way a spreadsheet saved it: with commas,
semicolons, tabs or bars, decimal commas, capitals. What was not read as it stands is said in a `Remark`; a cell that is
no finite number is refused."""

from __future__ import annotations

import csv
import difflib
import io
import re
import warnings
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float, Int

from endopilot.errors import InputError, Remark
from endopilot.files import read_text

_LARGEST, _MOST_ROWS = 2**28, 5_000_000  # bytes and rows of a table; 10 000 minutes have 1.2 million rows
_SEPARATORS = {",": "commas", ";": "semicolons", "\t": "tabs", "|": "bars"}
_NUMBER = re.compile(r"[-+]?([0-9]+\.?[0-9]*|\.[0-9]+)([eE][-+]?[0-9]+)?")
_LONGEST_CELL = 40


@dataclass(frozen=True, eq=False)
class Columns:
    """Columns of numbers by name, the file's line that each row ends on, and all columns' names in small letters."""

    path: Path
    values: dict[str, Float[np.ndarray, "rows"]]
    lines: Int[np.ndarray, "rows"]
    header: tuple[str, ...]

    def fault(self, row: int, name: str, what: str) -> InputError:
        """Return what to raise about a row's value in a column: file, line, column, value and `what` is wrong."""
        return InputError(f"{self.path}: row {self.lines[row]}: {name} = {self.values[name][row]:.10g}{what}")

    def refuse(self, bad: Bool[np.ndarray, "rows"], name: str, what: str) -> None:
        """Raise `fault` about the first row whose value in a column is bad, if there is one."""
        if bad.any():
            raise self.fault(int(np.argmax(bad)), name, what)

    def whole(self, name: str, default: int = 0) -> Int[np.ndarray, "rows"]:
        """Return a column of whole numbers, or a default in each row; raise `fault` about one that is none."""
        values = self.values.get(name, np.full(len(self.lines), float(default)))
        self.refuse(values != np.round(values), name, "; give a whole number")
        return values.astype(np.int64)

    def ascends(self, name: str, by: str) -> None:
        """Raise `fault` about the first row that comes before the one above it in a column."""
        values = self.values[name]
        back = np.diff(values, prepend=values[:1]) < 0
        self.refuse(back, name, f" is before the row above; sort the rows by {by}")


def read_columns(
    path: Path, needed: Sequence[str], optional: Sequence[str] = (), *, sparse: Sequence[str] = ()
) -> Columns:
    """Read columns of finite numbers from a CSV file: needed ones, optional ones, and sparse ones, whose cells may be
    empty (NaN). Raises InputError for another table; the line names file, row, column and mend."""
    text = read_text(path, what="CSV file", largest=_LARGEST)
    marked = re.match(r"sep=(.)\r?\n", text, flags=re.IGNORECASE)  # by which Excel finds the separator
    skipped = 1 if marked else 0
    text = text[marked.end() :] if marked else text
    if not text.strip():
        raise InputError(f"{path}: is empty; give the columns {', '.join(needed)}")
    separator = _separator(path, text, needed)
    reader = csv.reader(io.StringIO(text, newline=None), delimiter=separator, skipinitialspace=True, strict=True)
    try:
        rows = ((reader.line_num + skipped, row) for row in reader if row)
        header = _header(path, next(rows)[1], needed, (*optional, *sparse))
        names = [name for name in (*needed, *optional, *sparse) if name in header]
        cells, lines = _cells(path, rows, header, names)
    except csv.Error as error:
        raise InputError(f"{path}: row {reader.line_num + skipped}: no CSV ({error}); correct the file") from error
    if not lines:
        raise InputError(f"{path}: has no rows below the names of its columns; give one for each period")
    values = _numbers(path, cells, lines, separator, sparse)
    return Columns(Path(path), values, np.array(lines), tuple(header))


def _separator(path: Path, text: str, needed: Sequence[str]) -> str:
    """Return what separates the first line into the most of the needed names."""
    first = text.lstrip().split("\n", 1)[0]

    def found(separator: str) -> int:
        return len(set(needed) & {_plain(part) for part in first.split(separator)})

    best = max(_SEPARATORS, key=found)  # the first of equals
    if best != ",":
        warnings.warn(f"{path}: the columns are separated by {_SEPARATORS[best]}; read so", Remark, stacklevel=4)
    return best


def _plain(name: str) -> str:
    return name.strip().strip("\"'").strip().lower()


def _header(path: Path, row: list[str], needed: Sequence[str], optional: Sequence[str]) -> list[str]:
    header = [_plain(name) for name in row]
    if (
        len(header) > 1
        and not _NUMBER.fullmatch(header[0])
        and all(_NUMBER.fullmatch(name.replace(",", ".")) for name in header[1:])
    ):
        raise InputError(f"{path}: row 1 holds one name and then numbers; exchange rows and columns")
    if all(_NUMBER.fullmatch(name) for name in header):
        raise InputError(f"{path}: row 1 holds numbers; give the columns' names there: {', '.join(needed)}")
    for name in needed:
        if name not in header:
            near = difflib.get_close_matches(name, header, n=1)
            hint = f" ({near[0]} is there)" if near else ""
            mend = f"the columns are {', '.join(needed)}" if len(needed) > 1 else "rename or add it"
            raise InputError(f"{path}: column {name} is missing{hint}; {mend}")
    for name in (*needed, *optional):
        if header.count(name) > 1:
            raise InputError(f"{path}: column {name} stands there {header.count(name)} times; leave one")
    for other in header:
        known = (*needed, *optional)
        near = [] if other in known or not other else difflib.get_close_matches(other, optional, n=1, cutoff=0.85)
        if near and near[0] not in header:
            raise InputError(f"{path}: column {other} is not known; did you mean {near[0]}? Rename or remove it")
    return header


def _cells(
    path: Path, rows: Iterator[tuple[int, list[str]]], header: list[str], names: Sequence[str]
) -> tuple[dict[str, list[str]], list[int]]:
    """Return the text of the cells of the named columns, and the line of each row; blank rows at the end are none."""
    places = [header.index(name) for name in names]
    kept: list[list[str]] = []
    lines: list[int] = []
    filled = 0
    for line, row in rows:
        if len(row) > len(header) and any(cell.strip() for cell in row[len(header) :]):
            raise InputError(
                f"{path}: row {line} has {len(row)} cells where the columns are {len(header)}; write decimal points, "
                "or separate the columns by semicolons"
            )
        kept.append([row[place].strip() if place < len(row) else "" for place in places])
        lines.append(line)
        if len(kept) > _MOST_ROWS:
            raise InputError(f"{path}: has more than {_MOST_ROWS} rows; give fewer")
        if any(cell.strip() for cell in row):
            filled = len(kept)
    columns = zip(*kept[:filled], strict=True) if filled else [()] * len(names)
    return {name: list(cells) for name, cells in zip(names, columns, strict=True)}, lines[:filled]


def _numbers(
    path: Path, cells: dict[str, list[str]], lines: list[int], separator: str, sparse: Sequence[str]
) -> dict[str, Float[np.ndarray, "rows"]]:
    if separator != "," and any("," in cell for column in cells.values() for cell in column):
        if any("." in cell for column in cells.values() for cell in column):
            raise InputError(f"{path}: holds decimal commas and decimal points; write points alone")
        warnings.warn(f"{path}: the numbers have decimal commas; read so", Remark, stacklevel=4)
        cells = {name: [cell.replace(",", ".", 1) for cell in column] for name, column in cells.items()}
    values = {}
    for name, column in cells.items():
        numbers = np.array([float(cell) if _NUMBER.fullmatch(cell) else np.nan for cell in column])
        empty = np.array([not cell for cell in column]) if name in sparse else False
        bad = np.flatnonzero(~np.isfinite(numbers) & ~empty)
        if len(bad):
            cell, line = column[bad[0]], lines[bad[0]]
            if not cell:
                raise InputError(f"{path}: row {line}: {name} is empty; give a number")
            shown = cell if len(cell) <= _LONGEST_CELL else f"{cell[:_LONGEST_CELL]}..."
            raise InputError(f"{path}: row {line}: {name} = {shown} is no finite number; correct it")
        values[name] = numbers
    return values
