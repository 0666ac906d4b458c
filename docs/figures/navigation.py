"""Write the pictures and tables of docs/evidence/navigation.md.

The first part drives the agent in a synthetic patient, with a catheter too. The second needs what
`make cta` leaves in `runs/cta-thorax`; it pushes the J wire without a policy, at first rotations all around, to see
where it goes.
"""

from __future__ import annotations

import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np

sys.path.append(str(Path(__file__).parents[2]))  # where `benchmarks` is

import endopilot
from benchmarks.figures import fill
from endopilot.files import read_json
from endopilot.imaging.sample import fetch_sample

ROOT = Path(__file__).parents[2]
IMAGES, CTA = ROOT / "docs" / "images", ROOT / "runs" / "cta-thorax"
ROTATIONS, SPEED_MM_S, SECONDS = 24, 9.0, 40.0
BLIND_END_MM = 80.0
"""A wire that comes no deeper has gone into the blind end of the false lumen."""


def main() -> None:
    """Write what can be written."""
    command = [sys.executable, "-m", "endopilot.cli"]
    patients = ROOT / "runs" / "patients"
    if not (patients / "lca-41-0000").exists():
        subprocess.run([*command, "atlas", "-o", patients, "--vessel", "lca", "--seed", "41"], check=True)
    navigate = [*command, "navigate", patients / "lca-41-0000", "--target", "12", "--world", "drawn"]
    pair = ("--catheter", "microcatheter-2.4f", "--arrives", "catheter")
    for options, folder, picture, part in (
        ((), "navigation", "navigation.png", "outcome"),
        (pair, "pair", "navigation-pair.png", "pair"),
    ):
        output = ROOT / "runs" / folder
        subprocess.run([*navigate, *options, "-o", output], check=True)
        shutil.copyfile(output / "navigation.png", IMAGES / picture)
        fill("evidence/navigation.md", part, f"    {read_json(output / 'manifest.json')['figures']['outcome']}")
    if (CTA / "navigation" / "manifest.json").exists():
        fill("evidence/navigation.md", "dissection", _dissection())


def _dissection() -> str:
    """Return where the J wire goes in the dissected aorta, pushed and driven."""
    aorta, wire = endopilot.read_anatomy(CTA / "anatomy"), endopilot.read_wire("j-035")
    lumens = [_lumen(name) for name in ("true", "false")]
    rows = ["| section | from, to, mm | in the true lumen, % | in the false lumen, % |", "| --- " * 4 + "|"]
    for branch in aorta.tree.branches:
        name, line = aorta.tree.section_names[int(branch.section[-1])], branch.centerline
        if name in ("G0", "G1.2", "G2.2", "G3.1", "G1.1", "G2.3"):
            shares = " | ".join(f"{100 * _share(mask, line.points):.0f}" for mask in lumens)
            rows.append(f"| {name} | {line.abscissa[0]:.0f}–{line.abscissa[-1]:.0f} | {shares} |")
    lines = []
    for rate in (0.0, 1.0):
        control = np.tile([SPEED_MM_S, rate], (ROTATIONS, round(SECONDS / 0.5), 1))
        initial = np.column_stack([np.zeros(ROTATIONS), 2 * np.pi * np.arange(ROTATIONS) / ROTATIONS])
        depth = endopilot.simulate(aorta, wire, control, initial=initial).tip.abscissa.max(axis=(1, 2))
        over = depth > BLIND_END_MM
        turned = "without rotation" if rate == 0 else f"and turned at {rate:g} rad/s"
        lines.append(
            f"- pushed at {SPEED_MM_S:g} mm/s {turned}: with {int(over.sum())} of {ROTATIONS} first rotations it comes "
            f"{depth[over].min():.0f} to {depth[over].max():.0f} mm far, with the others no farther than "
            f"{depth[~over].max():.0f} mm;"
        )
    driven = read_json(CTA / "navigation" / "manifest.json")["figures"]
    lines.append(f"- driven by the agent: {driven['outcome']}.")
    return "\n".join([*rows, "", "The 0.035″ J wire", "", *lines])


def _lumen(name: str) -> endopilot.Volume:
    return endopilot.read_volume(fetch_sample().with_name(f"seg_aorta_{name}_lumen.nii.gz"))


def _share(mask: endopilot.Volume, points: np.ndarray) -> float:
    i, j, k = np.round(mask.world_to_index(points)).astype(int).T
    inside = (k < mask.voxels.shape[0]) & (j < mask.voxels.shape[1]) & (i < mask.voxels.shape[2])
    return float((mask.voxels[k[inside], j[inside], i[inside]] > 0).mean())


if __name__ == "__main__":
    main()
