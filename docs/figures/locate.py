"""Measure `endopilot locate` on a real catheter, and write figures and picture of docs/evidence/locate.md.

`python docs/figures/locate.py FOLDER`, the folder of the published data with `authors_hmm_bruteforce_run.csv`.
"""

from __future__ import annotations

import sys
import tempfile
import time
from dataclasses import replace
from pathlib import Path

import numpy as np

DOCS = Path(__file__).parents[1]
sys.path[:0] = [str(DOCS.parent / "examples"), str(DOCS.parent)]

from liver_catheter import convert, nodes_of

from benchmarks.figures import fill
from endopilot.anatomy.extract import extract_anatomy
from endopilot.types import Anatomy
from endopilot.xray.camera import Camera, read_camera
from endopilot.xray.frames import DeviceFrame, draw_locations, read_frames
from endopilot.xray.tip_filter import LocateConfig, TipLocation, locate

TRAINED = 37
"""Frames on which the filter's constants were chosen; the others are the test."""
LOST_MM, NEAR_MM, OF_95 = 20.0, 5.0, 2.795


def judged(found: list[TipLocation], authors: np.ndarray, seconds: float) -> str:
    """Return the cells of one row: what a run reaches on some frames."""
    there = [one for one in found if one.status != "not found"]
    errors = np.array([one.position - authors[one.frame] for one in there])
    off = np.array(
        [float(np.sqrt(e @ np.linalg.solve(one.covariance, e))) for e, one in zip(errors, there, strict=True)]
    )
    size = np.linalg.norm(errors, axis=1)
    lost = len(found) - len(there) + int((size > LOST_MM).sum())
    residual = np.median([one.residual_mm for one in there])
    return (
        f"{lost} of {len(found)} | {residual:.2f} mm | {100 * np.mean(size <= NEAR_MM):.0f} % "
        f"| {np.median(size):.1f} mm, {size.max():.1f} mm | {100 * np.mean(off < OF_95):.0f} % | {seconds:.2f} s"
    )


def rows_of(anatomy: Anatomy, frames: tuple[DeviceFrame, ...], camera: Camera, authors: np.ndarray) -> list[str]:
    """Return the rows of one tree: registered by a landmark and by the catheter alone, the frames in two parts."""
    rows = []
    for name, landmark in (
        ("the first frame's tip", tuple(float(v) for v in authors[0])),
        ("the catheter alone", None),
    ):
        began = time.process_time()
        config = LocateConfig(landmark_mm=landmark)
        found = list(locate(anatomy, frames=frames, cameras=[camera], config=config))
        seconds = (time.process_time() - began) / len(frames)
        for part, of in (("0 to 36", found[:TRAINED]), ("37 to 73", found[TRAINED:])):
            rows.append(f"| {anatomy.name} | {name} | {part} | {judged(of, authors, seconds)} |")
        if landmark is not None:
            draw_locations(
                anatomy,
                found,
                DOCS / "images" / "locate.png",
                lines=[frame.lines[0] for frame in frames],
                project=lambda index, points, found=found: camera.project(points + found[index].moved_mm),
            )
    return rows


def main(folder: Path) -> None:
    """Measure, and write table and picture."""
    with tempfile.TemporaryDirectory() as scratch:
        whole = convert(folder / "dataset1", Path(scratch))
        camera, frames = read_camera(Path(scratch) / "c-arm.yaml"), read_frames(Path(scratch) / "lines.csv")
    table = np.genfromtxt(folder / "authors_hmm_bruteforce_run.csv", delimiter=",", names=True)
    authors = nodes_of(folder / "dataset1")[0][table["tip_node"].astype(int)]
    trunk = replace(extract_anatomy(folder / "tace-lps-0.75mm.vtp"), name="without the aorta")
    head = [
        "| tree | registered by | frames | lost | residual, median | within 5 mm of the authors' "
        "| distance from theirs, median, largest | theirs in our 95 % region | processor time a frame |",
        "|---|---|---|---|---|---|---|---|---|",
    ]
    rows = rows_of(trunk, frames, camera, authors)
    text = "\n".join([*head, *rows_of(replace(whole, name="whole"), frames, camera, authors), *rows])
    fill("evidence/locate.md", "liver", text)
    print(text)


if __name__ == "__main__":
    main(Path(sys.argv[1]))
