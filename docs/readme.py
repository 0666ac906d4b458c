"""Write the measured parts of README.md and docs/evidence/demo.md, from `runs/` and from other pages.

`make readme` runs it, after `make demo` and `make cta`. A part whose run is not there stays as it is.
"""

from __future__ import annotations

import shutil
import sys
from pathlib import Path

import numpy as np

sys.path.append(str(Path(__file__).parents[1]))  # where `benchmarks` is

from benchmarks.figures import find_row
from endopilot.dataset.loader import read_dataset
from endopilot.files import read_json
from endopilot.report.report_text import tip_rows
from endopilot.report.scene import visible_devices
from endopilot.report.still import render_still

ROOT = Path(__file__).parents[1]
IMAGES = ROOT / "docs" / "images"
SPLIT = "test"
SPEED = ("simulation", "realtime_factor_per_core"), ("errors", "true_tip_error_median_mm")


def main() -> None:
    """Replace each part of the pages between its markers."""
    demo, cta = ROOT / "runs" / "demo", ROOT / "runs" / "cta-thorax"
    if (demo / "manifest.json").exists():
        _picture(demo / "dataset")
        metrics, record = read_json(demo / "metrics.json"), read_json(demo / "manifest.json")
        _replace("README.md", "demo", _demo(metrics, record))
        _replace("docs/evidence/demo.md", "demo-table", _demo_table(metrics, record))
    if (cta / "simulate.json").exists():
        shutil.copyfile(cta / "mask.png", IMAGES / "cta-mask.png")
        shutil.copyfile(cta / "wire.png", IMAGES / "cta-wire.png")
        _replace("README.md", "cta", _cta(cta))
    _replace("README.md", "stands", stands())


def _replace(page: str, name: str, content: str) -> None:
    path, begin, end = ROOT / page, f"<!-- {name}:begin -->", f"<!-- {name}:end -->"
    head, rest = path.read_text(encoding="utf-8").split(begin)
    path.write_text(f"{head}{begin}\n{content}\n{end}{rest.split(end)[1]}", encoding="utf-8")


def _picture(dataset: Path) -> None:
    """Draw the test navigation in which the tip travels farthest, where it is deepest."""
    held_out = read_dataset(dataset).of_split(SPLIT)
    best = int(np.ptp(held_out.tip_abscissa[:, :, 0], axis=1).argmax())
    trajectory = held_out.trajectory(best, record_shape=True)
    wire = visible_devices(trajectory, 0, int(trajectory.tip.abscissa[0, :, 0].argmax()))
    render_still(trajectory.set_up.anatomies[0], wire, IMAGES / "demo.png")


def _demo(metrics: dict, record: dict) -> str:
    """Return in three lines what the demo found."""
    split = metrics["splits"][SPLIT]
    dice, ostium = _anatomy_errors(metrics)
    ours, hold = (split["tip"][name]["abscissa"] for name in ("P1", "hold_slack"))
    error, baseline = ([of[span]["mae"] for span in ("0-10", "10-30", "30-45")] for of in (ours, hold))
    return "\n".join(
        [
            f"- **Segmentation** from the CT alone: Dice {min(dice):.2f}–{max(dice):.2f}; the ostium errs by "
            f"{min(ostium):.1f}–{max(ostium):.1f} mm.",
            f"- **Prediction** of the tip in patients never trained on: mean error {_list(error)} mm after 0–10, "
            f"10–30 and 30–45 s without X-ray; the best simple baseline errs by {_list(baseline)} mm.",
            f"- **Time**: {record['wall_seconds']:.0f} s on {record['machine']['cores']} cores "
            f"({record['machine']['processor']}). The page is `runs/demo/report.html`; "
            "[the demo](docs/evidence/demo.md) explains every figure.",
        ]
    )


def _list(values: list[float]) -> str:
    return ", ".join(f"{value:.2f}" for value in values)


def _anatomy_errors(metrics: dict) -> list[list[float]]:
    """Return the Dice coefficients and the errors of the ostium, mm, of the patients."""
    scores = metrics["anatomy_scores"].values()
    return [[score[name] for score in scores] for name in ("dice", "ostium_error_mm")]


def _demo_table(metrics: dict, record: dict) -> str:
    """Return the tip errors in new patients, the scores of the anatomies and the time of each stage."""
    split = metrics["splits"][SPLIT]
    stages = ", ".join(f"{name} {seconds:.0f}" for name, seconds in record["stages"].items())
    dice, ostium = _anatomy_errors(metrics)
    lines = [
        f"Tip error, mm (mean ± SD), over {split['episodes']} navigations of {len(split['anatomies'])} patients that "
        "were never trained on. Δtip is the tip's distance from the ostium along the vessel, γtip its distance from "
        "the centerline. Skill is 1 − RMSE/RMSE of the baseline that is hardest to beat.",
        "",
        "| | Δ 0–10 s | Δ 10–30 s | Δ 30–45 s | skill | γ 0–10 s | γ 10–30 s | γ 30–45 s | skill |",
        "| --- " * 9 + "|",
    ]
    for row in tip_rows(metrics, SPLIT):
        lines.append("| " + " | ".join([row.title, *row.cells[:8]]) + " |")
    return "\n".join(
        [
            *lines,
            "",
            "The means of simulated controls hold rare navigations in which the tip enters another branch: "
            f"in the last span the median error of P4 is {split['tip']['P4']['abscissa']['30-45']['median']:.2f} mm.",
            "",
            f"Segmentation from the CT alone: Dice {min(dice):.2f}–{max(dice):.2f}, the ostium errs by "
            f"{min(ostium):.1f}–{max(ostium):.1f} mm in {len(dice)} patients.",
            "",
            f"{record['wall_seconds']:.0f} s on {record['machine']['cores']} cores ({record['machine']['processor']}): "
            f"{stages}.",
        ]
    )


def _cta(run: Path) -> str:
    """Return agreement and navigation in the real CT angiogram."""
    mask, wire = read_json(run / "segment.json"), read_json(run / "navigation" / "manifest.json")["figures"]
    return (
        f"Dice {mask['dice']:.2f} against the aorta of a segmentation network (not a human reader). The agent takes "
        "the 0.035″ J wire from the false lumen through a tear into the true one and over the arch: "
        f"{wire['deepest_tip_mm']:.0f} mm in {wire['seconds']:g} s, with {wire['exposures']} X-ray exposures and at "
        f"most {wire['peak_force_n']:.2f} N on the wall "
        "([navigation](docs/evidence/navigation.md#a-dissected-aorta)).\n\n"
        "![The CT in three slices, our lumen in green, the network's aorta in red](docs/images/cta-mask.png)\n\n"
        "![The J wire in the true lumen, over the arch](docs/images/cta-wire.png)"
    )


def stands() -> str:
    """Return the table of where endopilot stands beside others, with the figures that the pages of evidence hold."""
    speed, error = (_row("performance", block, row)[0] for block, row in SPEED)
    agent = _row("leaderboard", "scores", "[agent]", "[240]")[3]
    theirs = {task: _row("ladder", "benchmark", task.lower()) for task in ("ArchVariety", "DualDeviceNav")}
    ours = {task: _row("ladder", "benchmark", task.lower(), "`agent`") for task in theirs}
    plane = _row("reality", "reality", "error in the camera")[-1]
    share, forks = _row("reality", "", "the real branch, of forks in two")[1].split(" of ")
    band, kept = _row("reality", "calibration", "band of Δtip")
    straight, leaning, play = (
        _row("planning", "", row)[0] for row in ("as it is believed", "leans by", "as believed;")
    )
    rows = [
        (
            "speed",
            f"{float(speed):.0f} times real time on one core, tips err by {float(error):.3f} mm (median)",
            "beside simulators made for guidewires",
            [("performance", ""), ("worlds", "#another-engine")],
        ),
        (
            "own tasks",
            f"ladder, version 2: {agent} % of 240 navigations are safe",
            "elsewhere",
            [("leaderboard", "")],
        ),
        (
            "tasks of others",
            "stEVE_bench, within 5 mm, in our simulator, earlier search: "
            + ", ".join(f"{task} {row[2]} % of {row[-1]}" for task, row in ours.items())
            + f"; learned controllers in its own {' and '.join(theirs[task][2] for task in ours)} %",
            "in its simulator; with hospital devices",
            [("ladder", "#tasks-of-a-public-benchmark")],
        ),
        (
            "a real robot",
            f"public log of a phantom, sessions kept aside: tips err by {plane} mm (median), "
            f"{100 * float(share):.0f} % of {forks} forks are taken as the real wire took them; "
            f"a band of {band} for Δtip holds throughout "
            f"{kept.split('%')[0].split()[-1]} % of the episodes",
            "forces; a robot driven by the agent",
            [("reality", "")],
        ),
        (
            "real patients",
            f"simulated wires in coronary arteries of seven CTs: {straight} distal targets safely, {leaning} where the "
            f"guiding catheter leans by 20°, {play} with play in the drive",
            "wires in patients; real fluoroscopy",
            [("planning", "#real-arteries")],
        ),
    ]
    lines = ["| beside | measured | not measured | page |", "| --- | --- | --- | --- |"]
    for beside, measured, missing, pages in rows:
        links = ", ".join(f"[{name}](docs/evidence/{name}.md{anchor})" for name, anchor in pages)
        lines.append(f"| {beside} | {measured} | {missing} | {links} |")
    return "\n".join(lines)


def _row(page: str, mark: str, begin: str, *others: str) -> list[str]:
    """Return the cells after the first of a row of a page of evidence."""
    return find_row(f"evidence/{page}.md", mark, begin, *others).cells[1:]


if __name__ == "__main__":
    main()
