"""The measures of rotation beside a real robot, on made-up runs, tips and forks."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from benchmarks.robot.twist import (
    Run,
    bench_twist,
    dead_bands,
    passages,
    rotation_runs,
    steps_to,
)
from endopilot.anatomy.io import write_anatomy
from endopilot.errors import InputError
from endopilot.robot.replay import EpisodeReplay
from endopilot.types import Anatomy

STEP = 0.59


def commands(*moves: tuple[float, float]) -> np.ndarray:
    """Return positions of a drive after each move, mm and steps of rotation; the first is where it begins."""
    return np.cumsum([(0.0, 0.0), *moves], axis=0) * [1.0, STEP]


def test_runs_of_rotation_and_which_of_them_reverse() -> None:
    command = commands((0, 1), (0, 1), (0, -1), (0, -1), (0, -1), (0.25, 0), (0, 1), (0, 0), (0, -1))
    assert rotation_runs(command) == [
        Run(1, 2, reverses=False, advanced_mm=0.0),
        Run(3, 3, reverses=True, advanced_mm=0.0),
        Run(7, 1, reverses=False, advanced_mm=0.25),  # the wire was advanced before
        Run(9, 1, reverses=True, advanced_mm=0.0),  # a rest is no advance
    ]


def test_steps_to_an_event_where_some_runs_end_before_it() -> None:
    # Kaplan and Meier by hand: at 2, 1 of 4 falls; at 5, 1 of 2 (one run ended at 3); at 6, the last
    assert steps_to([(2, True), (3, False), (5, True), (6, True)]) == (2, 5, 6)
    none = steps_to([(4, False), (9, False)])
    assert np.isnan(none).all()


def test_dead_bands_of_tips_that_rest_then_creep_and_leap() -> None:
    def tips(*x: float) -> np.ndarray:
        return np.column_stack([x, np.zeros(len(x)), np.zeros(len(x))])

    late = tips(0, 0, 0.1, 0.3, 1.5, 2.3, 2.3)  # moves after 3 steps, leaps in 4 and 5: once
    twice = tips(0, 1, 1, 2, 2)
    runs = [(Run(1, 6, reverses=True, advanced_mm=0.0), each) for each in (late, twice, tips(0))]
    moves, snaps, per_step = dead_bands(runs)
    assert (moves[0], moves[2]) == (1, 3) and (snaps[0], snaps[2]) == (1, 4)
    assert per_step == pytest.approx(3 / 10)


def test_a_fork_is_passed_once_and_the_branch_compared(fork: Anatomy) -> None:
    ways = [k for k, branch in enumerate(fork.tree.branches) if branch.parent == 0]
    assert len(ways) == 2
    begins = fork.tree.branches[ways[0]].centerline.abscissa[0]
    abscissa = begins + np.array([-4.0, -2.0, 1.0, 3.0, 5.0])
    real = np.array([0, 0, ways[0], ways[0], ways[0]])

    def replay(simulated: list[int], given: int = 0) -> EpisodeReplay:
        tips = np.zeros((5, 3))
        return EpisodeReplay(
            number=0,
            time_s=np.arange(5.0),
            given=np.arange(5) < given,
            seen=tips,
            simulated=tips,
            predicted=tips,
            abscissa=np.column_stack([abscissa, abscissa]),
            driven=abscissa,
            in_view=tips,
            core_mm=np.zeros(5),
            along=tips,
            branch=np.column_stack([real, simulated]).astype(float),
            force=np.zeros((0, 2)),
            rotation_rad=0.0,
            rotation_known_rad=0.1,
        )

    right, wrong, behind = ([0, 0, 0, way, way] for way in (ways[0], ways[1], 0))
    assert passages(replay(right), fork) == [True]
    assert passages(replay(wrong), fork) == [False]
    assert passages(replay(behind), fork) == [False]  # not in time
    assert passages(replay(right, given=2), fork) == []


def test_a_log_is_compared_with_its_replay(fork: Anatomy, tmp_path: Path) -> None:
    write_anatomy(fork, output=tmp_path / "fork")
    (tmp_path / "logs").mkdir()
    at, turn = np.arange(60) * 0.24, np.zeros(60)
    at[40:], turn[40:50], turn[50:] = at[39], STEP * np.arange(1, 11), STEP * np.arange(9, -1, -1)
    line = fork.tree.path(1)
    seen = np.array([[np.interp(5.0 + x, line.abscissa, axis) for axis in line.points.T] for x in at])
    columns = np.column_stack([0.1 * np.arange(60), at, turn, seen])
    header = "time_s,translation_mm,rotation_rad,tip_x_mm,tip_y_mm,tip_z_mm"
    np.savetxt(tmp_path / "logs" / "made-up.csv", columns, delimiter=",", header=header, comments="")
    rows = bench_twist(logs=tmp_path / "logs", anatomy=tmp_path / "fork", tip_deg=45.0, tip_mm=3.0)
    assert [row["log"] for row in rows] == ["made-up", "all"]
    for row in rows:
        assert (row["episodes"], row["reversals_real"], row["reversals_simulated"]) == (1, 1, 1)
        assert row["moves_after_real"] == "- (---)"  # the tip seen stays on the centerline
        assert row["snaps_a_turn_real"] == 0
    (alone,) = bench_twist(logs=tmp_path / "logs")
    assert {name: rows[0][name] for name in alone} == alone and alone["reversals_real"] == 1
    with pytest.raises(InputError, match="no log; convert the public ones"):
        bench_twist(logs=tmp_path, anatomy=tmp_path / "fork")
