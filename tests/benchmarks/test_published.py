"""Published tests of devices, and the straightening of aorto-iliac paths, against closed forms; verdicts on both."""

from __future__ import annotations

from dataclasses import replace
from functools import partial

import numpy as np
import pytest
from scipy.spatial import KDTree

from benchmarks.published import published, straightening, tubing
from benchmarks.published.published import (
    Comparison,
    PublishedConfig,
    bending,
    tip_loads,
)
from benchmarks.published.straightening import (
    AortoIliac,
    draw_path,
    stiff_wire,
    straighten,
    tortuosity_index,
)
from benchmarks.published.three_point import flexural_modulus
from benchmarks.published.tubing import BORE_MM, LENGTH_MM, draw_tubing, push_through
from endopilot.devices.catheter import read_catheter
from endopilot.devices.device import read_wire
from endopilot.simulation.config import COMPLIANT_WALL_STIFFENING_MM2, PRESETS
from endopilot.types import Anatomy


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


WAVE_MM, SWING_MM, RADIUS_MM, CLEARANCE_MM, OVER_MM = 150.0, 4.0, 3.0, 0.02, 24.0


@pytest.fixture(scope="module")
def waves() -> tuple[AortoIliac, Anatomy]:
    """Return three waves of a vessel, which goes on straight as the aorta."""
    along = np.arange(0, 3 * WAVE_MM + 0.5)
    iliac = np.column_stack([along, SWING_MM * np.cos(2 * np.pi * along / WAVE_MM), 0 * along])
    path = AortoIliac(
        iliac_mm=iliac,
        radius_mm=np.full(len(along), RADIUS_MM),
        aorta_mm=iliac[-1] + np.outer(np.arange(0, 150.0), [1.0, 0.0, 0.0]),
        tissue_mpa=0.004,
        stiffens_over_mm=OVER_MM,
        friction=0.0,
    )
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(straightening, "AORTA_WIDTH_MM", 4 * RADIUS_MM)
        return path, path.anatomy()


@pytest.mark.parametrize("modulus_gpa", [20.0, 40.0])
def test_a_wire_straightens_waves_as_a_beam_on_an_elastic_bed_does(waves, modulus_gpa) -> None:
    # EI w'''' + K (w - w0) = 0 with w0 = a cos(q x): the bed yields by a EI q⁴ / (K + EI q⁴), which is a half where
    # the wave is √2 π times as long as the beam's length (4 EI/K)^¼. Within its clearance c the wire is free, and the
    # bed stiffens, K d (1 + s d²): of A cos(q x) and the force on it these are the first harmonics.
    path, anatomy = waves
    wire = replace(stiff_wire(modulus_gpa, friction=0.0), diameter_mm=2 * (RADIUS_MM - CLEARANCE_MM))
    bent = wire.bend_stiffness_n_mm2[-1] * (2 * np.pi / WAVE_MM) ** 4
    bed = path.foundation_n_mm2(wire.bend_stiffness_n_mm2[-1])
    expected, stiffening = 0.0, COMPLIANT_WALL_STIFFENING_MM2 / path.scale**2
    for _ in range(50):
        firmer = bed * (1 + 0.75 * stiffening * expected**2)
        expected = (bent * SWING_MM + firmer * 4 / np.pi * CLEARANCE_MM) / (firmer + bent) - CLEARANCE_MM
    found = straighten(path, anatomy, wire)
    assert found.valid and found.through
    third = len(found.moved_mm) // 3  # the wave in the middle
    assert found.moved_mm[third : 2 * third].max() == pytest.approx(expected, rel=0.02)
    # What the wall bears is what the bed bears: the integral of K d over the wire.
    length = np.linalg.norm(np.diff(found.begun_mm, axis=0), axis=1).sum()
    d = found.moved_mm
    assert found.force_n == pytest.approx(bed * (d * np.exp(stiffening * d**2)).mean() * length, rel=0.03)


def test_a_stiffer_wire_straightens_more() -> None:
    path = draw_path(np.random.default_rng(5))
    anatomy = path.anatomy()
    soft, stiff = (straighten(path, anatomy, stiff_wire(modulus, friction=0.05)) for modulus in (9.5, 158.4))
    assert all(each.valid and each.through for each in (soft, stiff))
    assert 1.0 < soft.largest_mm < 0.7 * stiff.largest_mm
    assert 0 < soft.mean_mm < soft.largest_mm
    assert stiff.tortuosity < soft.tortuosity < soft.tortuosity_before
    assert stiff.force_n > soft.force_n


def test_paths_are_as_long_and_tortuous_as_published_and_differ() -> None:
    drawn = [draw_path(np.random.default_rng([3, draw])) for draw in range(20)]
    for each in drawn:
        steps = np.linalg.norm(np.diff(each.iliac_mm, axis=0), axis=1)
        assert 130 - 1.5 <= steps.sum() <= 190 and steps == pytest.approx(1.0, rel=0.01)
        turned = np.einsum("ij,ij->i", np.diff(each.iliac_mm, axis=0)[1:], np.diff(each.iliac_mm, axis=0)[:-1])
        assert np.arccos(np.clip(turned, -1, 1)).max() < 1.1 / 15  # no bend of less than 15 mm radius
        assert 1.05 <= tortuosity_index(each.iliac_mm) <= 1.71
        assert 3.5 <= each.radius_mm[0] <= 4.5 <= each.radius_mm[-1] <= 7.5
        np.testing.assert_allclose(each.iliac_mm[-1], each.aorta_mm[0], atol=1e-9)
    assert np.mean([tortuosity_index(each.iliac_mm) for each in drawn]) == pytest.approx(1.36, abs=0.12)
    assert len({each.tissue_mpa for each in drawn}) == len(drawn)


def test_a_wire_has_the_published_modulus_behind_its_floppy_tip() -> None:
    wire = stiff_wire(158.4, friction=0.05)
    shaft = wire.bend_stiffness(np.array([0.0, 40.0, 70.0, 1000.0]))
    np.testing.assert_allclose(shaft, [8.0, 8.0, 158400 * np.pi * 0.889**4 / 64, 158400 * np.pi * 0.889**4 / 64])
