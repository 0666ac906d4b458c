"""Write tables and pictures of docs/evidence/reality.md: `python docs/figures/reality.py FOLDER ROBOT DEVICE`.

FOLDER holds the public logs of Kweon et al. (IEEE Access 2021) as CSV files, and the 2-D phantom's lumen as .vtp; ROBOT
and DEVICE are what `endopilot calibrate` made of all sessions but those of `KEPT_ASIDE`.
"""

from __future__ import annotations

import sys
import tempfile
from collections.abc import Sequence
from itertools import combinations, pairwise
from pathlib import Path

import matplotlib as mpl
import numpy as np

sys.path.append(str(Path(__file__).parents[2]))  # where `benchmarks` is
sys.path.append(str(Path(__file__).parents[2] / "examples"))

from robot_phantom_logs import convert

import endopilot
from benchmarks.figures import fill
from endopilot.files import read_json
from endopilot.plotting import BLACK, BLUE, GREY, STYLE, VERMILLION
from endopilot.report.figures import replay_figure
from endopilot.robot.log import Courses
from endopilot.robot.replay import (
    EpisodeReplay,
    Prepared,
    ReplayConfig,
    prepare,
    replay_prepared,
    summary,
    usable_episodes,
)

mpl.use("Agg")
import matplotlib.pyplot as plt

IMAGES = Path(__file__).parents[1] / "images"
EPISODES = 8
"""Of each session at most, evenly chosen."""
KEPT_ASIDE = ("log7", "_M2_")
"""Parts of the names of the sessions that errors and tracks are shown of."""
CALIBRATED = "calibrated"
LEAST_RUN_MM, LEAST_TURNS = 3.5, 1.2
"""A reversal counts after so much travel in one direction; a rotation if it goes on for so long without translation."""
SAME, NEAR_MM = 20, 0.3
"""Commands of two advances that are compared, and how near to each other they begin."""
FIRST_MM, SNAP_MM = 0.3, 0.8
"""The tip moves, and has snapped over, where it is so far from where it was."""


def main() -> None:
    """Replay the sessions with each robot; tell and draw what real and simulated tips have in common."""
    folder, robot_file, device = Path(sys.argv[1]), sys.argv[2], sys.argv[3]
    phantom = endopilot.extract_anatomy(next(folder.glob("phantom2d*.vtp")), config=endopilot.AnatomyConfig(scale=1.0))
    with tempfile.TemporaryDirectory() as made:
        logs = [convert(path, Path(made)) for path in sorted(folder.glob("2D_phantom_*.csv"))]
    episodes, repeats = [], []
    for log in logs:
        usable = usable_episodes([log], phantom)
        repeats.append(_repeats(prepare(usable, phantom, 0.5, endopilot.read_robot("ideal"))))
        chosen = np.unique(np.linspace(0, len(usable) - 1, EPISODES).round().astype(int))
        episodes += [usable[k] for k in chosen]
    wire, config = endopilot.read_wire("workhorse-014"), ReplayConfig()
    worlds = {name: (endopilot.read_robot(name), wire) for name in ("ideal", "assumed")}
    worlds[CALIBRATED] = (endopilot.read_robot(robot_file), endopilot.read_wire(device))
    found = {}
    for name, (robot, driven) in worlds.items():
        of = prepare(episodes, phantom, config.given, robot)
        found[name] = replay_prepared(of, endopilot.Stack(driven), robot, config)
        print(name, summary(found[name]), flush=True)
    drives = _drives(of.courses, robot)
    aside = [any(part in log.name for part in KEPT_ASIDE) for log in episodes]
    apart = {name: [each for each, kept in zip(row, aside, strict=True) if kept] for name, row in found.items()}
    measured = {"real": _measures(drives, found[CALIBRATED], 0)}
    measured |= {name: _measures(drives, each, 1) for name, each in found.items()}
    fill("evidence/reality.md", "reality", _table(measured, apart, repeats))
    fill("evidence/reality.md", "calibration", _calibration(Path(robot_file).with_suffix(".json")))
    _draw(measured)
    figure = replay_figure(phantom, apart[CALIBRATED], "sessions kept aside, robot and wire calibrated on the others")
    figure.savefig(IMAGES / "reality-tracks.png", dpi=80)


def _calibration(record: Path) -> str:
    """Return what `endopilot calibrate` found as a table."""
    found = read_json(record)
    lines = ["| constant | best | 95 % |", "|---|---|---|"]
    for name, each in found["estimates"].items():
        low, high = each["interval"]
        said = f"{low:.3g} to {high:.3g}" if each["identified"] else "not identifiable from these logs"
        lines.append(f"| `{name}` | {each['value']:.3g} | {said} |")
    band, held = found["band_of_90_percent_mm"], found["it_holds_in_logs_left_out"]
    said = f"holds in {held:.0%} of the episodes of logs left out"
    share, known = found["start_rotation_known_in"], found["start_rotation_known_rad"]
    lines.append(
        f"| rotation at the start of an episode | its own | known to ± {known:.2g} rad (median) in {share:.0%} of the "
        "episodes, not identifiable in the others |"
    )
    lines.append(f"| band of Δtip throughout 90 % of the episodes | ± {band:.2g} mm | {said} |")
    return "\n".join(lines)


def _drives(courses: Courses, robot: endopilot.RobotConfig) -> list[np.ndarray]:
    """Return where each drive is when the tip is seen, without play, mm and turns: after the lag alone."""
    one, none, late = np.ones(1), np.zeros(1), np.array([robot.latency_s])
    motion = [courses.followed(axis, at_s=courses.seen_s, latency_s=late, gain=one, play=none)[0] for axis in (0, 1)]
    both = np.stack([motion[0], motion[1] / (2 * np.pi)], axis=-1)
    return [row[seen] for row, seen in zip(both, courses.seen, strict=True)]


def _measures(drives: Sequence[np.ndarray], found: Sequence[EpisodeReplay], which: int) -> dict[str, np.ndarray]:
    """Return what tips did: advance per drive, lag behind it after reversals, turns before they move.

    Args:
        drives: of each episode, mm and turns.
        found: replays.
        which: 0 for the real tip, 1 for the simulated one.
    """
    advance, reversals, turns = [], [], []
    for drive, each in zip(drives, found, strict=True):
        along, tip = each.abscissa[:, which], (each.seen, each.simulated)[which]
        advance += _advance(drive[:, 0], along)
        reversals += _reversals(drive[:, 0], along)
        turns += _turns(drive, tip)
    first, snap = (np.array([_reached(moved, turned, far) for moved, turned in turns]) for far in (FIRST_MM, SNAP_MM))
    return {"advance": np.array(advance), "reversals": reversals, "turns": turns, "first": first, "snap": snap}


def _advance(drive: np.ndarray, along: np.ndarray) -> list[float]:
    """Return slopes over 2 mm of steady forward drive, from 4 mm after it began."""
    slopes, begun = [], 0
    for k in range(1, len(drive)):
        if drive[k] < drive[k - 1] - 1e-9:
            begun = k
        behind = np.searchsorted(drive[begun : k + 1], drive[k] - 2.0) + begun
        if drive[k] > drive[k - 1] and drive[behind] - drive[begun] > 4.0:
            slopes.append((along[k] - along[behind]) / (drive[k] - drive[behind]))
    return slopes


def _reversals(drive: np.ndarray, along: np.ndarray) -> list[tuple[np.ndarray, np.ndarray]]:
    """Return the drive's travel since each reversal, and the tip's in the same direction, mm."""
    step = np.sign(np.round(np.diff(drive), 4))
    moving = np.flatnonzero(step)
    found = []
    for before, after in pairwise(moving):
        if step[before] == step[after]:
            continue
        first, last = before, after
        while first > 0 and step[first - 1] in (0, step[before]):
            first -= 1
        while last + 1 < len(step) and step[last + 1] in (0, step[after]):
            last += 1
        travel = np.abs(drive[after : last + 2] - drive[after])
        if abs(drive[after] - drive[first]) > LEAST_RUN_MM and travel[-1] > 1.0:
            found.append((travel, step[after] * (along[after : last + 2] - along[after])))
    return found


def _turns(drive: np.ndarray, tip: np.ndarray) -> list[tuple[np.ndarray, np.ndarray]]:
    """Return how far the tip is from where it was, mm, and the turns since then, of rotations in one direction."""
    still, turning = np.abs(np.diff(drive[:, 0])) < 1e-4, np.sign(np.round(np.diff(drive[:, 1]), 4))
    found, k = [], 0
    while k < len(turning):
        last = k
        while last < len(turning) and still[last] and turning[last] == turning[k] != 0:
            last += 1
        if last > k and abs(drive[last, 1] - drive[k, 1]) > LEAST_TURNS:
            moved = np.linalg.norm(tip[k : last + 1] - tip[k], axis=1)
            found.append((np.maximum.accumulate(moved), np.abs(drive[k : last + 1, 1] - drive[k, 1])))
        k = max(last, k + 1)
    return found


def _repeats(of: Prepared) -> np.ndarray:
    """Return by how much two advances of the tip differ that the same commands made from the same place, mm.

    They are pairs of different episodes of a session, each of `SAME` steps of the drive from where the tip was seen
    within `NEAR_MM` of the other's, in the same branch.
    """
    runs: dict[bytes, list[tuple[int, float, float, float]]] = {}
    for k, log in enumerate(of.logs):
        asked, begins = log.command[log.commanded, 0], log.time_s[log.commanded]
        last = np.searchsorted(log.time_s[log.seen], begins, side="right") - 1  # the tip before each command
        steps = np.round(np.diff(asked, axis=0), 3)
        for at in range(int((last < 0).sum()), len(steps) - SAME):
            begin, end = last[at], last[at + SAME]
            place = (k, of.branch[k, begin], of.abscissa[k, begin], of.abscissa[k, end])
            runs.setdefault(steps[at : at + SAME].tobytes(), []).append(place)
    return np.array(
        [
            (a[3] - a[2]) - (b[3] - b[2])
            for same in runs.values()
            for a, b in combinations(same, 2)
            if a[0] != b[0] and a[1] == b[1] and abs(a[2] - b[2]) < NEAR_MM
        ]
    )


def _reached(moved: np.ndarray, turned: np.ndarray, far: float) -> float:
    return float(np.interp(far, moved, turned)) if moved[-1] > far else np.nan


def _lags(reversals: Sequence[tuple[np.ndarray, np.ndarray]], at_mm: float) -> np.ndarray:
    return np.array([at_mm - np.interp(at_mm, travel, tip) for travel, tip in reversals if travel[-1] >= at_mm])


def _table(measured: dict, found: dict, repeats: Sequence[np.ndarray]) -> str:
    def quartiles(values: np.ndarray, digits: int = 2) -> str:
        values = values[np.isfinite(values)]
        if not len(values):
            return "-"
        low, middle, high = np.quantile(values, [0.25, 0.5, 0.75])
        return f"{middle:.{digits}f} ({low:.{digits}f} to {high:.{digits}f})"

    rows = {
        "advance of the tip per advance of the drive while it moves forward": lambda m: quartiles(m["advance"]),
        "tip behind the drive 4 mm after a reversal, mm": lambda m: quartiles(_lags(m["reversals"], 4.0)),
        f"turns before the tip has moved by {FIRST_MM} mm": lambda m: quartiles(m["first"]),
        f"turns before it has moved by {SNAP_MM} mm": lambda m: quartiles(m["snap"]),
    }
    lines = ["| median (quartiles) | real robot | " + " | ".join(f"ours, {name}" for name in found) + " |"]
    lines += ["|---|" + "---|" * (1 + len(found))]
    lines += [f"| {title} | " + " | ".join(show(m) for m in measured.values()) + " |" for title, show in rows.items()]
    each, every = [float(np.std(some) / np.sqrt(2)) for some in repeats], np.concatenate(repeats)
    lines.append(
        f"| the same {SAME} commands from the same place within {NEAR_MM} mm: SD of the tip's advance, mm (sessions) | "
        f"{np.std(every) / np.sqrt(2):.2f} ({min(each):.2f} to {max(each):.2f}) |" + " |" * len(found)
    )
    figures = {name: summary(each) for name, each in found.items()}
    for title, key in (
        ("error of Δtip, predicted second half of an episode of a session kept aside, mm (median)", "error_along_mm"),
        ("error in the camera's plane there, mm (median)", "error_in_view_mm"),
        ("the real branch is taken there", "real_branch_share"),
    ):
        lines.append(f"| {title} | | " + " | ".join(f"{each[key]:.2f}" for each in figures.values()) + " |")
    return "\n".join(lines)


def _draw(measured: dict) -> None:
    colors = {"real": BLACK, "ideal": GREY, "assumed": BLUE, CALIBRATED: VERMILLION}
    with plt.rc_context(STYLE):
        figure, (left, right) = plt.subplots(1, 2, figsize=(9.5, 3.6), layout="constrained")
        for name, each in measured.items():
            label = "real robot" if name == "real" else f"ours, {name}"
            at_mm = np.arange(0.0, 6.1, 0.25)
            lags = [_lags(each["reversals"], at) for at in at_mm]
            enough = [k for k, values in enumerate(lags) if len(values) >= 5]
            left.plot(at_mm[enough], [np.median(lags[k]) for k in enough], color=colors[name], label=label)
            at_turns = np.arange(0.0, 1.5, 0.05)
            moved = [
                [np.interp(at, turned, far) for far, turned in each["turns"] if turned[-1] >= at] for at in at_turns
            ]
            enough = [k for k, values in enumerate(moved) if len(values) >= 5]
            right.plot(at_turns[enough], [np.median(moved[k]) for k in enough], color=colors[name], label=label)
        left.set(xlabel="travel of the drive since it reversed, mm", ylabel="tip behind the drive, mm", xlim=(0, 6))
        right.set(xlabel="turns of the drive since it began", ylabel="tip moved, mm", xlim=(0, 1.5))
        left.legend()
        figure.savefig(IMAGES / "reality.png", dpi=90)


if __name__ == "__main__":
    main()
