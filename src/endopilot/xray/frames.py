"""Lines of a device in the images of a sequence, and where its tip is in each: their files.

Frames are a CSV file with a row for each point of a line, from the tip backwards; a single row is the tip alone.

==========================  ============================================================================================
column                      meaning
==========================  ============================================================================================
`frame`                     whole number, the same for all points of a frame; frames stand in the order of time
`view`                      1 or 2: which of the cameras; 1 if not given
`column_px`, `row_px`       pixel of the point
==========================  ============================================================================================

Frames whose number is left out show nothing.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from endopilot.files import write_whole
from endopilot.runs import CSV
from endopilot.simulation.csv_file import read_columns
from endopilot.xray.line_observations import DeviceFrame, Line
from endopilot.xray.tip_filter import TipLocation


def read_frames(path: str | Path, *, views: int = 1) -> tuple[DeviceFrame, ...]:
    """Read the lines of a sequence.

    Args:
        path: CSV file of the columns frame, view (if there are several), column_px and row_px.
        views: number of cameras.

    Raises:
        InputError: no such table; the line names file, row, column and mend.
    """
    table = read_columns(Path(path), ["frame", "column_px", "row_px"], ["view"])
    frame, view = table.whole("frame"), table.values.get("view", np.ones(len(table.lines)))
    pixels = np.column_stack([table.values["column_px"], table.values["row_px"]])
    table.ascends("frame", by="frame")
    table.refuse(~np.isin(view, np.arange(1, views + 1)), "view", f"; give 1 to {views}, or a camera for each view")
    found = []
    for number in np.unique(frame):
        lines: list[Line | None] = []
        for k in range(1, views + 1):
            line = pixels[(frame == number) & (view == k)]
            lines.append(line if len(line) else None)
        found.append(DeviceFrame(int(number), tuple(lines)))
    return tuple(found)


def write_locations(locations: Sequence[TipLocation], *, output: str | Path) -> None:
    """Write where the tip is in each frame as a CSV file, whole or not at all; empty cells where it is not found.

    Raises:
        InputError: the suffix is not .csv, or the file cannot be written.
    """
    import pandas as pd

    CSV.files(Path(output))
    upper = [(i, j) for i in range(3) for j in range(i, 3)]
    rows = [
        {
            "frame": one.frame,
            "status": one.status,
            "section": one.section,
            "tip_abscissa_mm": one.abscissa,
            **{f"tip_{axis}_mm": value for axis, value in zip("xyz", one.position, strict=True)},
            **{f"covariance_{'xyz'[i]}{'xyz'[j]}_mm2": one.covariance[i, j] for i, j in upper},
            "share": one.share,
            **{f"moved_{axis}_mm": value for axis, value in zip("xyz", one.moved_mm, strict=True)},
            "residual_mm": one.residual_mm,
        }
        for one in locations
    ]
    write_whole(output, pd.DataFrame(rows).to_csv(index=False, float_format="%.4f"))
