"""Centerlines of real patients as other programs wrote them: read whole, with loops and parent vessels said."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from endopilot.anatomy.tree import tree_from_polylines
from endopilot.vessels.read_source import read_source
from endopilot.vessels.sources import Polylines

DATA = Path(__file__).parents[3] / "shared" / "data"


def made(path, vessel="generic"):
    content = read_source(path).content
    assert isinstance(content, Polylines)
    return tree_from_polylines(content, None, path.name, vessel)


@pytest.mark.skipif(not (DATA / "steve_bench").exists(), reason="the benchmark's curves are not at hand")
def test_the_loop_of_the_vertebral_arteries_is_said():
    folder = DATA / "steve_bench" / "dualdevicenav"
    curves = [curve for file in folder.glob("*.mrk.json") for curve in json.loads(file.read_text())["markups"]]
    found = made(folder)
    assert found.coverage["left_out_mm"] < 1.0
    basilar = next(np.array(c["controlPoints"][0]["position"]) for c in curves if len(c["controlPoints"]) == 30)
    (loop,) = [note for note in found.notes if "close a loop" in note]
    place = np.array(loop[loop.index("(") + 1 : loop.index(")")].split(","), dtype=float)
    assert np.linalg.norm(place - basilar) < 5.0
    assert any("do not touch" in note for note in found.notes)
    root = found.tree.branches[0].centerline.points[0]
    assert np.linalg.norm(root - [-367.5, 3.9, -10.2]) < 1.0  # the ascending aorta, which no vessel passes


@pytest.mark.skipif(not (DATA / "liver_tace").exists(), reason="the liver's vessel tree is not at hand")
def test_a_liver_tree_is_covered_but_for_its_parent_vessel():
    found = made(DATA / "liver_tace" / "tace-lps-0.75mm.vtp")
    assert len(found.tree.leaves()) > 40
    assert len(found.notes) == 1 and "lies in the parent vessel that the lines start in" in found.notes[0]


@pytest.mark.skipif(
    not (DATA / "coronary_centerlines").exists(), reason="the real patient's centerlines are not at hand"
)
@pytest.mark.parametrize("vessel", ["rca", "lca"])
def test_coronary_lines_are_covered_but_for_the_aorta(vessel):
    found = made(DATA / "coronary_centerlines" / f"{vessel}_cl.vtp", vessel)
    assert len(found.notes) == 1 and "lies in the parent vessel that the lines start in" in found.notes[0]
