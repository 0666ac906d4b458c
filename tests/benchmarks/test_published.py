"""`python -m benchmarks published`: its tests against closed forms, its paths, its verdicts, and a short run."""

from __future__ import annotations

from dataclasses import replace
from functools import partial

import numpy as np
import pytest
from scipy.spatial import KDTree

from benchmarks.published import published, tubing
from benchmarks.published.published import (
    Comparison,
    PublishedConfig,
    bending,
    tip_loads,
)
from benchmarks.published.three_point import flexural_modulus
from benchmarks.published.tubing import BORE_MM, LENGTH_MM, draw_tubing, push_through
from endopilot.devices.catheter import read_catheter
from endopilot.devices.device import read_wire
from endopilot.simulation.config import PRESETS


def test_a_full_round_wire_shows_the_modulus_of_its_steel() -> None:
    # E = 64 EI / (π d⁴); shear and the length that a deflection of span / 40 adds stay below 0.5 %.
    device = replace(
        read_wire("j-035"), abscissa_mm=(0.0,), bend_stiffness_n_mm2=(5000.0,), twist_stiffness_n_mm2=(3846.0,)
    )
    expected = 64 * 5000.0 / (np.pi * 0.89**4) / 1000
    found = flexural_modulus(device, at_mm=100.0, deflection_mm=1.0, diameter_mm=0.89)
    assert found == pytest.approx(expected, rel=5e-3)
    thicker = flexural_modulus(device, at_mm=100.0, deflection_mm=1.0, diameter_mm=0.979)
    assert thicker == pytest.approx(expected / 1.1**4, rel=5e-3)


def test_paths_have_the_published_length_and_bore_and_differ() -> None:
    drawn = [draw_tubing(np.random.default_rng([7, draw])) for draw in range(4)]
    for each in drawn:
        along = np.linalg.norm(np.diff(each.axis_mm, axis=0), axis=1)
        assert along.sum() - 12.0 == pytest.approx(LENGTH_MM, abs=0.5)  # 12 mm of guide lie behind the entrance
        assert np.deg2rad(380) <= each.turn_rad <= np.deg2rad(600)
        direction = np.diff(each.axis_mm[::20], axis=0)
        direction /= np.linalg.norm(direction, axis=1, keepdims=True)
        turned = np.arccos(np.clip((direction[1:] * direction[:-1]).sum(axis=1), -1, 1))
        assert turned.max() <= 1.05 / tubing.BEND_RADIUS_MM[0]  # over 1 mm
    assert not np.allclose(drawn[0].axis_mm[-1], drawn[1].axis_mm[-1], atol=1.0)

    vessel = drawn[0].anatomy()
    field, random = vessel.distance_map, np.random.default_rng(1)
    axis = drawn[0].axis_mm[240:-40]
    points = axis[random.integers(0, len(axis), 200)] + random.uniform(-0.5, 0.5, (200, 3))
    index = np.round((points - field.origin_mm) / field.spacing_mm).astype(int)
    at = field.origin_mm + field.spacing_mm * index
    expected = BORE_MM / 2 - KDTree(drawn[0].axis_mm).query(at)[0]
    np.testing.assert_allclose(field.values[index[:, 2], index[:, 1], index[:, 0]], expected, atol=1e-9)


def test_more_friction_takes_more_force_and_a_drive_at_its_limit_does_not_pass(monkeypatch) -> None:
    monkeypatch.setattr(tubing, "LENGTH_MM", 70.0)
    monkeypatch.setattr(tubing, "ANGLES_DEG", ((80.0, 100.0),))
    vessel = draw_tubing(np.random.default_rng(3)).anatomy()
    wire, catheter = read_wire("workhorse-014"), read_catheter("microcatheter-1.7f")
    push = partial(push_through, vessel, config=PRESETS["fast"])
    smooth, rough = (push(replace(wire, friction=friction)) for friction in (0.02, 0.3))
    assert smooth.valid and smooth.through and rough.valid and rough.through
    assert 0 < smooth.force_n < 0.8 * rough.force_n
    both = push(wire, [catheter])
    assert both.through and both.force_n > push(wire).force_n
    weak = push(replace(wire, friction=0.3, push_limit_n=0.5 * rough.force_n))
    assert weak.valid and not weak.through


def test_a_verdict_says_where_our_figures_lie() -> None:
    def row(*ours: float, published: tuple[float, float] | None = (1.0, 2.0)) -> dict:
        return Comparison("case", "source", "prediction", "N", published, ours).row()

    assert row(0.5, 1.5, 1.6)["verdict"] == "agrees"
    assert row(0.1, 0.5, 0.6, 0.7, 1.5)["verdict"] == "overlaps"
    assert row(2.1, 3.0, 4.0)["verdict"] == "disagrees"
    assert row(0.5, 1.5, 1.6)["share_within"] == 0.667
    alone = row(3.0, published=None)
    assert alone["verdict"] is None and alone["share_within"] is None and alone["ours"] == 3.0


def test_what_calibrates_a_device_is_no_prediction() -> None:
    loads = tip_loads()
    assert [each.kind for each in loads] == ["calibration"] * 3
    assert all(each.ours[0] == pytest.approx(each.published[0], rel=0.05) for each in loads if each.published)
    (bent,) = bending(PublishedConfig(draws=3))
    assert bent.kind == "prediction" and len(set(bent.ours)) == 3
    # EI of the shaft over the section of the nominal diameter, within what its tolerance makes: d⁻⁴
    nominal = 64 * 500 / (np.pi * 0.89**4) / 1000
    assert all(
        abs(modulus / nominal - 1) < 4.2 * published.DIAMETER_TOLERANCE_MM / 0.89 + 5e-3 for modulus in bent.ours
    )
