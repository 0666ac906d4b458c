"""Judges: an environment that cannot be made says why, and lines that lie aside are so far aside."""

from __future__ import annotations

import numpy as np
import pytest

from benchmarks.anatomy import analytic_lumens as analytic
from benchmarks.judges import judges
from benchmarks.judges.environment import CannotInstall, environment
from endopilot.anatomy.tree import sampled


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
