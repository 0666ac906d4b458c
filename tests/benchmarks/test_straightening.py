"""The aorto-iliac path: its draws, a wire in it against a beam on an elastic bed, and stiffer wires."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from benchmarks.published import straightening
from benchmarks.published.straightening import (
    AortoIliac,
    draw_path,
    stiff_wire,
    straighten,
    tortuosity_index,
)
from endopilot.simulation.config import COMPLIANT_WALL_STIFFENING_MM2
from endopilot.types import Anatomy

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
