"""Telescoping tubes. Derivations stand in `benchmarks.verification.tubes`; the numbers here are others than there."""

from __future__ import annotations

import numpy as np
import pytest

from benchmarks.verification.tubes import ELEMENTS, Sliding, Uniform, curvature, drive, lay_out, mesh
from endopilot.verification.case import Loading


def test_three_precurved_tubes_lie_where_their_moments_balance() -> None:
    # Σ EIk (κ - κk) = 0: κ = Σ EIk κk / Σ EIk, with the third opposed
    stack = (Uniform(30.0, 24.0, 0.02), Uniform(50.0, 40.0, 0.01), Uniform(20.0, 16.0, 0.03))
    rod = mesh(20.0)
    result = drive(rod, lay_out(stack, 20.0), np.full(3, 20.0), rotation=np.array([0.0, 0.0, np.pi]))
    expected = (30 * 0.02 + 50 * 0.01 - 20 * 0.03) / 100
    found = curvature(result["shape"][-1][:ELEMENTS], float(rod.abscissa_mm[1]))
    assert found == pytest.approx(np.full(len(found), expected), rel=1e-5)
    assert np.abs(result["base_torque"][-1]).max() < 1e-6  # no torque: the opposed tube is in balance there


def test_the_catheter_slides_over_a_bent_wire_and_straightens_it() -> None:
    # Curvature of the stretch that a straight catheter covers: EIw κw / (EIw + EIc); beyond its end the wire's own.
    wire, catheter, length, covered = Uniform(20.0, 16.0, 0.03), Uniform(60.0, 48.0), 30.0, 18.3
    rod = mesh(length)
    control = np.zeros((14, 2, 2))
    control[1:13, 1, 0] = covered / 12 / 0.5
    result = drive(rod, lay_out((wire, catheter), length), np.array([length, 0.0]), control=control)
    size = float(rod.abscissa_mm[1])
    found = curvature(result["shape"][-1][:ELEMENTS], size)
    joints = rod.abscissa_mm[1 : ELEMENTS - 1]
    ahead, behind = joints < length - covered - size, joints > length - covered + size
    assert found[ahead] == pytest.approx(np.full(ahead.sum(), wire.curvature), rel=1e-5)
    assert found[behind] == pytest.approx(np.full(behind.sum(), 20 * 0.03 / 80), rel=1e-5)
    # where it ends in a joint, the angle there is that of both parts
    (between,) = found[~ahead & ~behind][[int(np.argmin(np.abs(joints[~ahead & ~behind] - (length - covered))))]]
    assert 20 * 0.03 / 80 < between < wire.curvature


def test_it_does_not_matter_which_tip_is_foremost() -> None:
    # The stack (wire ahead of catheter) and the stack with the same two tubes in each other's places are the same rod.
    first, second, length = Uniform(20.0, 16.0, 0.02), Uniform(60.0, 48.0, 0.01), 30.0
    rod, shapes = mesh(length), []
    for stack, inserted in (((first, second), (length, 17.0)), ((second, first), (17.0, length))):
        result = drive(rod, lay_out(stack, length), np.array(inserted))
        shapes.append(result["shape"][-1][:ELEMENTS])
    assert shapes[1] == pytest.approx(shapes[0], abs=1e-8)


def test_pushed_in_a_wire_keeps_less_than_its_load() -> None:
    # The friction of the way in is kept at rest: the pull is exp(-µθ) times the load on the tip.
    pull, _ = Sliding(0.25, 1.2).drive((0.0, 0.0), 2)
    assert pull[-1] == pytest.approx(np.exp(-0.25 * 1.2), rel=0.01)


def test_a_catheter_on_a_bent_wire_is_pushed_back() -> None:
    # Without friction, a mm more of a straight catheter over a wire that a moment M bends takes
    # M²/2 (1/EIw - 1/(EIw + EIc)) (D. Bigoni et al., Mechanics of Materials 80, 2015, have it for a rigid sleeve). At
    # the base it is bent itself, and T + EIc κ²/2 is the same all along a uniform tube.
    wire, catheter, length, covered, moment = Uniform(10.0, 8.0), Uniform(30.0, 24.0), 30.0, 16.0, 0.2
    rod = mesh(length, elements=240)
    loading = Loading.none(len(rod.abscissa_mm))
    loading.moment_n_mm[0, 0] = moment
    result = drive(rod, lay_out((wire, catheter), length), np.array([length, covered]), loading=loading)
    both = wire.bend + catheter.bend
    expected = moment**2 / 2 * (1 / wire.bend - 1 / both) + catheter.bend * (moment / both) ** 2 / 2
    assert result["base_force"][-1, 1] == pytest.approx(expected, rel=0.02)
