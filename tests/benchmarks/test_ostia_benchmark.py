"""Judging ostia that are found in masks, and lines by other programs, where the truth is known."""

from __future__ import annotations

import json

import numpy as np
import pytest

from benchmarks.anatomy import analytic_lumens as analytic
from benchmarks.anatomy.ostia import bench_ostia, judged
from benchmarks.judges import judges
from benchmarks.judges.environment import CannotInstall, environment
from endopilot.anatomy.tree import sampled
from endopilot.errors import InputError
from endopilot.imaging.volume import write_volume
from toy_coronaries import artery, mask_of_arteries


def test_a_folder_of_masks_is_judged_by_its_truth(tmp_path):
    with pytest.raises(InputError, match=r"ostia.json: is missing"):
        bench_ostia(tmp_path)
    truth = {"rca": {"near_aorta_mm": [0.0, 0.0, 0.0]}}
    (tmp_path / "ostia.json").write_text(json.dumps({"one": truth, "two": {"lca": {"near_aorta_mm": [0, 0, 0]}}}))
    right = mask_of_arteries(artery("rca"))
    write_volume(right.volume, tmp_path / "one.nii.gz")
    with pytest.raises(InputError, match=r"two.nii.gz: is missing"):
        bench_ostia(tmp_path)
    write_volume(right.volume, tmp_path / "two.nii.gz")
    found, absent = bench_ostia(tmp_path)["arteries"]
    assert found["ostium_error_mm"] < 3.0 and found["confidence"] > 0.8 and found["refusal"] is None
    assert 0.99 < found["coverage"] <= 1.0
    assert absent["ostium_error_mm"] is None
    assert "it is the right coronary artery: take --vessel rca" in absent["refusal"]


def test_figures_count_what_is_right_what_is_wrong_and_what_is_told():
    made = {"refusal": None, "coverage": 0.995, "seconds": 4.0}
    rows = [made | {"ostium_error_mm": error} for error in np.linspace(0.0, 4.9, 23)]
    told = {"refusal": "not certain", "ostium_error_mm": None, "coverage": None, "seconds": 3.0}
    assert [figure["passed"] for figure in judged([*rows, told])] == [True, True, True, True]
    assert [figure["passed"] for figure in judged([*rows[1:], told, told])] == [False, True, True, True]
    wrong = made | {"ostium_error_mm": 5.1, "coverage": 0.98, "seconds": 16.0}
    assert [figure["passed"] for figure in judged([*rows, wrong])] == [True, False, False, False]


def test_an_environment_that_cannot_be_made_says_why_and_is_not_kept(tmp_path):
    with pytest.raises(CannotInstall, match=r"no-such-package for .*ERROR"):
        environment("nobody", (str(tmp_path / "no-such-package"),), tmp_path)
    assert not (tmp_path / "nobody" / "complete").exists()


def test_lines_are_as_far_off_as_they_are_shifted():
    tree = analytic.straight_tree()
    points, radius = sampled(tree)
    exact = judges.errors(tree, (points, radius))
    aside = judges.errors(tree, (points + np.array([0.3, 0.4, 0.0]), radius + 0.1))
    assert max(exact.values()) < 1e-6
    assert list(aside.values()) == pytest.approx([0.5, 0.5, 0.1], abs=1e-4)
