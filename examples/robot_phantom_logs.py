"""The public logs of a robot in coronary phantoms (Kweon et al., IEEE Access 2021) as logs that endopilot reads.

    python examples/robot_phantom_logs.py FOLDER_OF_CSV_FILES OUTPUT_FOLDER
    endopilot replay OUTPUT_FOLDER/NAME.csv --anatomy PHANTOM --device workhorse-014 -o replay

The published files have a row for each event: a command (drive positions), an image (the tip's pixel), an encoder's
reply, or a note. The device was moved by an unknown amount at a fast retraction, and wherever it was clamped again.
Lengths rest on a wire of 0.014 inch: a pixel is 0.095 mm and a thousandth of the drive's unit 0.24 mm, each ± 10 %.
The logs are under PolyForm Noncommercial 1.0.0; doi 10.1109/ACCESS.2021.3135277. Without arguments, a made-up file of
the same form is converted.
"""

from __future__ import annotations

import math
import sys
import tempfile
from pathlib import Path

import numpy as np
import pandas as pd
import yaml

import endopilot

PIXEL_MM, STEP_MM, TURN = 0.095, 0.24, 0.2125
"""A pixel, a thousandth of the drive's unit of translation, and a turn in its unit of rotation: 0.20 to 0.225."""
RESETS = ("fast-retraction", "reclamped")


def convert(path: Path, folder: Path) -> endopilot.RobotLog:
    """Write one published file, and the camera, as a log into a folder, and return it as it is read back."""
    rows = pd.read_csv(path)
    command, encoder, image = (rows["event"] == name for name in ("command", "encoder", "image"))
    drive = rows[["translation_mu", "rotation_u"]].to_numpy() * [STEP_MM, 2 * math.pi / TURN]
    table = pd.DataFrame({"time_s": rows["time_s"], "episode": rows["event"].isin(RESETS).cumsum()})
    for names, which in ((("translation_mm", "rotation_rad"), command), (("encoder_mm", "encoder_rad"), encoder)):
        table[list(names)] = np.where(which.to_numpy()[:, None], drive, np.nan)
    table[["tip_row_px", "tip_col_px"]] = rows[["tip_row_px", "tip_col_px"]].where(image)  # the unfiltered tip
    table = table.rename(columns={"tip_col_px": "tip_column_px"})
    table["flag"] = (rows["is_folded"].astype(str) == "True").astype(int)
    table = table[command | encoder | image].dropna(axis="columns", how="all")
    folder.mkdir(parents=True, exist_ok=True)
    camera = {"mm_per_pixel": PIXEL_MM, "origin_mm": [0, 0, 0], "columns": [1, 0, 0], "rows": [0, -1, 0]}
    (folder / "camera.yaml").write_text(yaml.safe_dump(camera, sort_keys=False))
    table.to_csv(folder / path.name, index=False)
    return endopilot.read_log(folder / path.name)


def made_up(path: Path) -> None:
    """Write a file of the published form: twice forward by 20 steps, from 0 and, after a fast retraction, from 5."""
    head = "time_s,event,translation_mu,rotation_u,tip_row_px,tip_col_px,is_folded\n"
    lines, time_s = [], 0.0
    for start in (0, 5):
        for step in range(20):
            lines.append(f"{time_s:.2f},command,{start + step},0.0,,,")
            lines.append(f"{time_s + 0.04:.2f},image,{start + step},0.0,{500 - 2 * step},893,False")
            time_s += 0.08
        lines.append(f"{time_s:.2f},fast-retraction,,,,,")
    path.write_text(head + "\n".join(lines) + "\n")


def main() -> None:
    if len(sys.argv) == 3:
        for path in sorted(Path(sys.argv[1]).glob("*_phantom_*.csv")):
            log = convert(path, Path(sys.argv[2]))
            print(f"{log.name}: {log.commanded.sum()} commands, {log.seen.sum()} tips")
        return
    with tempfile.TemporaryDirectory() as folder:
        made_up(Path(folder) / "2D_phantom_made_up.csv")
        log = convert(Path(folder) / "2D_phantom_made_up.csv", Path(folder) / "logs")
    first, second = log.episodes()
    drive = second.command[second.commanded, 0, 0]
    print(f"{log.name}: {len(first)} and {len(second)} rows in two episodes")
    assert log.seen.sum() == 40 and math.isclose(drive[0], 1.2) and math.isclose(drive[-1], 5.76)


if __name__ == "__main__":
    main()
