"""A published catheter in a real liver's arteries (Ambrosini et al., IEEE TMI 2017), as `endopilot locate` reads it.

    python examples/liver_catheter.py FOLDER OUTPUT_FOLDER
    endopilot locate OUTPUT_FOLDER/anatomy OUTPUT_FOLDER/lines.csv --camera OUTPUT_FOLDER/c-arm.yaml -o tips.csv

FOLDER holds `dataset1` as published: the tree of a rotational angiogram, the C-arm's geometry, and the catheter's line
in each of 74 frames, under a BSD licence. Their world's axes (x, y, z) are (x, z, -y) of ours. Without arguments,
made-up files of the same form are converted.
"""

from __future__ import annotations

import sys
import tempfile
from pathlib import Path

import numpy as np
import yaml

import endopilot

TREE, VOXELS = "3dra/3dra_0001_3.0_vesselsStructCenterline.txt", "3dra/3dra_0001_info.txt"
C_ARM, LINES = "fluoro/infoFluoroCarmParameters.txt", "fluoro/centerlines/*.txt"


def numbers(path: Path) -> list[float]:
    """Return the numbers of a file of parameters, whose comments begin with #."""
    lines = [line for line in path.read_text().splitlines() if line[:1] not in ("#", "T", "F")]
    return [float(word) for line in lines for word in line.split()]


def nodes_of(folder: Path) -> tuple[np.ndarray, np.ndarray, list[list[int]]]:
    """Return the places of the tree's nodes, LPS mm, their radii, mm, and the neighbours of each."""
    rows = (folder / TREE).read_text().split("\n")[2:]
    table = np.array([[float(value) for value in row.split(";")[:7]] for row in rows[::2] if row])
    neighbours = [[int(value) for value in row.split(";") if value.strip()] for row in rows[1::2]][: len(table)]
    matrix = np.array(numbers(folder / VOXELS)).reshape(4, 4)
    x, y, z = (table[:, :3] @ matrix[:3, :3].T + matrix[:3, 3]).T
    return np.stack([x, z, -y], axis=-1), table[:, 6], neighbours


def convert(published: Path, folder: Path) -> endopilot.Anatomy:
    """Write anatomy, C-arm and lines into a folder, and return the anatomy."""
    points, radius, neighbours = nodes_of(published)
    before, order = {0: -1}, [0]
    for node in order:
        new = [other for other in neighbours[node] if other not in before]
        before |= dict.fromkeys(new, node)
        order += new
    pieces = []
    for node in (n for n in order[1:] if len(neighbours[n]) != 2):
        piece = [node, before[node]]
        while piece[-1] and len(neighbours[piece[-1]]) == 2:
            piece.append(before[piece[-1]])
        pieces.append(piece[::-1])
    lines = endopilot.Polylines(tuple(points[p] for p in pieces), tuple(radius[p] for p in pieces))
    anatomy = endopilot.extract_anatomy(lines, name="liver")
    endopilot.write_anatomy(anatomy, output=folder / "anatomy")
    rows, columns, to_detector, to_patient, *angles, pixel, _ = numbers(published / C_ARM)
    geometry = {"source_to_isocenter_mm": to_patient, "source_to_detector_mm": to_detector, "pixel_mm": pixel}
    centre = {"isocenter_mm": [0, 0, 0], "centre_px": [columns / 2, rows / 2]}
    (folder / "c-arm.yaml").write_text(yaml.safe_dump({"angles_deg": angles, **centre, "geometry": geometry}))
    with (folder / "lines.csv").open("w") as stream:
        stream.write("frame,column_px,row_px\n")
        for number, path in enumerate(sorted(published.glob(LINES))):
            stream.writelines(f"{number},{column},{row}\n" for column, row in np.loadtxt(path))
    return anatomy


def made_up(folder: Path) -> None:
    """Write files of the published form: a straight vessel of 40 nodes, and two lines in it."""
    for name in (TREE, C_ARM, LINES):
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
    rows = [f"0;0;{3 * n};0;0;0;1.5;\n{';'.join(str(k) for k in (n - 1, n + 1) if 0 <= k < 40)};" for n in range(40)]
    (folder / TREE).write_text("\n".join(["40", "0", *rows]))
    (folder / VOXELS).write_text("1 0 0 0\n0 0 -1 0\n0 1 0 -60\n0 0 0 1\n")
    (folder / C_ARM).write_text("True\n1024\n1024\n1113\n810\n-27.9\n-0.28\n0.25355859375\n0.25355859375\n")
    for number, tip in enumerate((400, 350)):
        line = np.stack([np.full(60, 512.0), np.linspace(tip, 800, 60)], axis=-1)
        np.savetxt(folder / "fluoro/centerlines" / f"{number:04d}.txt", line)


def main(published: Path, folder: Path) -> None:
    """Convert, locate the first frames, and say where the tip is."""
    anatomy = convert(published, folder)
    camera = endopilot.read_camera(folder / "c-arm.yaml")
    frames = endopilot.read_frames(folder / "lines.csv")[:5]
    found = endopilot.locate(anatomy, frames=frames, cameras=[camera])
    for one in found:
        place = f"{one.section}, {one.abscissa:.1f} mm, residual {one.residual_mm:.2f} mm"
        print(f"frame {one.frame}: {one.status}, {place}")
    assert found[1].abscissa > found[0].abscissa  # the catheter is pushed forward


if __name__ == "__main__":
    if len(sys.argv) > 2:
        main(Path(sys.argv[1]) / "dataset1", Path(sys.argv[2]))
    else:
        with tempfile.TemporaryDirectory() as scratch:
            made_up(Path(scratch) / "dataset1")
            main(Path(scratch) / "dataset1", Path(scratch) / "out")
