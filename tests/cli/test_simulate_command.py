"""`endopilot simulate` with random controls: where it stops."""

from __future__ import annotations

import json

import numpy as np
import pytest

from endopilot.cli import main
from endopilot.simulation.trajectory import read_trajectory


@pytest.mark.parametrize(("option", "deepest_mm"), [((), 35.0), (("--no-stop-short",), 39.0)])
def test_random_navigations_stop_short_of_ends_unless_asked_otherwise(vessel, tmp_path, capsys, option, deepest_mm):
    """The vessel ends at 40 mm, its branch too; a tip stops 5 mm before."""
    options = ("--sequences", "3", "--seconds", "20", "--seed", "1", "--json")
    with pytest.raises(SystemExit) as leaving:
        main(["simulate", str(vessel), "-o", str(tmp_path / "run.csv"), *option, *options])
    assert leaving.value.code == 0
    figures = json.loads(capsys.readouterr().out)
    assert figures["valid_worlds"] == 3
    if not option:
        assert figures["worlds_stopped_short"] > 0 and figures["deepest_tip_mm"] <= deepest_mm + 0.5
    else:
        assert "worlds_stopped_short" not in figures and figures["deepest_tip_mm"] >= deepest_mm


def test_a_random_navigation_is_written_with_its_shapes(vessel, tmp_path, capsys):
    options = ("--sequences", "1", "--seconds", "5", "--seed", "1", "--shape", "--json")
    with pytest.raises(SystemExit) as leaving:
        main(["simulate", str(vessel), "-o", str(tmp_path / "run.npz"), *options])
    assert leaving.value.code == 0 and json.loads(capsys.readouterr().out)["worlds_stopped_short"] >= 0
    made = read_trajectory(tmp_path / "run.npz")
    assert made.shape is not None
    np.testing.assert_array_equal(made.shape[:, :, 0], made.tip_position[:, :, 0])
