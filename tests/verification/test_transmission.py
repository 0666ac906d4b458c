"""Between drive and ostium, against closed forms; derivations stand in `benchmarks.verification.transmission`."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest

from benchmarks.verification.transmission import LAG_RAD, turn


def test_friction_keeps_twist() -> None:
    # |T'| <= m everywhere: a device at rest neither creeps nor unwinds
    path = np.concatenate([np.linspace(0.0, 1.7 * LAG_RAD, 20), np.full(50, 1.7 * LAG_RAD)])
    rotation, torque = turn(path)
    assert 0 < rotation[19] < path[19]
    assert rotation[20:] == pytest.approx(rotation[19], abs=1e-9)
    assert torque[20:] == pytest.approx(torque[19], abs=1e-9)


def test_what_the_ostium_does_depends_on_the_path_alone() -> None:
    # rate independence: where the path of the drive is cut into more steps, it ends the same
    corners = np.array([0.0, 5.0, 1.5, 3.0, -4.0, 0.5])
    ends = []
    for steps in (1, 7, 40):
        legs = [np.linspace(a, b, steps + 1)[1:] for a, b in pairwise(corners)]
        rotation, torque = turn(np.concatenate(legs))
        ends.append([rotation[steps - 1 :: steps], torque[steps - 1 :: steps]])
    assert np.allclose(ends[0], ends[1], atol=1e-9) and np.allclose(ends[0], ends[2], atol=1e-9)


def test_a_small_loop_closes() -> None:
    # return-point memory: after a small loop the device goes on as if it had not been made
    whole = np.linspace(0.0, 0.9 * LAG_RAD, 10)
    loop = np.concatenate([whole[:6], whole[4:1:-1], whole[2:]])
    straight, looped = turn(whole[1:]), turn(loop[1:])
    assert looped[1][-1] == pytest.approx(straight[1][-1], abs=1e-12)
    assert looped[0][-1] == pytest.approx(straight[0][-1], abs=1e-12)
