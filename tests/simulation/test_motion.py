"""Vessels that move: published amplitudes and rests, the same bits however worlds are stepped, and what is told."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from endopilot.anatomy.io import write_anatomy
from endopilot.atlas.heart_reference import LEFT_VENTRICLE_AXIS, TO_CRUX
from endopilot.cli import simulate as command
from endopilot.devices.device import read_wire
from endopilot.errors import InputError
from endopilot.simulation.config import SimulatorConfig
from endopilot.simulation.motion import Motion, draw_motion, motion_named, place
from endopilot.simulation.simulate import simulate
from endopilot.types import Anatomy

DEVICE = read_wire("workhorse-014")
OSTIUM = np.array([10.0, -20.0, 30.0])
MOTION = Motion()
BEATS = Motion(breathing_caudal_mm=0.0, breathing_anterior_mm=0.0, breathing_dorsal_deg=0.0, breathing_dextral_deg=0.0)


def maps(motion: Motion, times: np.ndarray) -> np.ndarray:
    return motion.core(OSTIUM).placements(times)[0]


def drives(worlds: int, samples: int) -> tuple[np.ndarray, np.ndarray]:
    random = np.random.default_rng(4)
    initial = np.column_stack([random.uniform(5, 30, worlds), random.uniform(-3, 3, worlds)])
    return initial, random.uniform((-2, -3), (6, 3), (worlds, samples, 2))


def test_a_breath_shifts_and_turns_by_the_given_amounts() -> None:
    motion = motion_named("breathing")
    assert motion is not None
    (map_,), ((w, *_),) = motion.core(OSTIUM).placements(np.array([2.0]))  # inspired
    np.testing.assert_allclose(place(map_, OSTIUM) - OSTIUM, [0, -1.3, -4.9], atol=1e-3)  # forwards and to the feet
    np.testing.assert_allclose(map_[:, :3] @ map_[:, :3].T, np.eye(3), atol=1e-12)  # rigid
    assert np.degrees(2 * np.arccos(w)) == pytest.approx(np.hypot(1.5, 1.2), rel=1e-3)
    head = map_[:, :3] @ [0, 0, 1.0]
    assert head[1] == pytest.approx(np.sin(np.radians(1.5)), rel=0.01)  # the head's end goes backwards,
    assert head[0] == pytest.approx(np.sin(np.radians(1.2)), rel=0.01)  # and the feet's end to the right


def test_a_heartbeat_contracts_towards_a_resting_apex() -> None:
    times = BEATS.heart_period_s * np.linspace(0, 1, 500)
    found = maps(BEATS, times)
    axis = np.array(LEFT_VENTRICLE_AXIS) / np.linalg.norm(LEFT_VENTRICLE_AXIS)
    ostium, apex = place(found, OSTIUM), place(found, OSTIUM + 94 * axis)
    assert np.ptp(ostium @ axis) == pytest.approx(11.6, rel=0.01)
    assert np.ptp(apex, axis=0).max() < 0.01
    across = np.sqrt(np.linalg.det(found[:, :, :3]) / np.linalg.norm(found[:, :, :3] @ axis, axis=-1))
    assert across.min() / across.max() == pytest.approx(np.sqrt(1 - 0.082), abs=0.003)


def test_every_motion_begins_where_ct_shows_the_vessel_and_is_periodic() -> None:
    for motion in (MOTION, draw_motion(3), replace(BEATS, heart_period_s=1.0)):
        np.testing.assert_allclose(maps(motion, np.zeros(1))[0], np.eye(3, 4), atol=1e-9)
    times = np.linspace(0, BEATS.heart_period_s, 7)
    np.testing.assert_allclose(maps(BEATS, times), maps(BEATS, times + 3 * BEATS.heart_period_s), atol=1e-9)


def test_the_right_coronary_artery_rests_as_long_as_published() -> None:
    # Proximal to middle segments move by less than 1 mm in 76 ± 34 ms at end-systole and 65 ± 42 ms in mid-diastole
    # (Shechter, Resar and McVeigh, Med Phys 2005).
    step, period = 4e-3, BEATS.heart_period_s
    times = step * np.arange(round(period / step))
    points = place(maps(BEATS, times)[:, None], OSTIUM + TO_CRUX[:7])
    apart = np.tile(np.linalg.norm(points[:, None] - points[None], axis=-1).mean(axis=-1), (2, 2))

    def rest(first: float, last: float) -> float:
        """Longest time in a part of the heartbeat, counted from mid-diastole, in which the artery stays within 1 mm."""
        longest = 0.0
        for begin in range(int(first * period / step), int(last * period / step)):
            end = begin
            while apart[begin : end + 2, begin : end + 2].max() < 1:
                end += 1
            longest = max(longest, step * (end - begin))
        return longest

    assert rest(0.5, 0.75) == pytest.approx(0.076, abs=0.034)  # end-systole is 0.66 of a period after mid-diastole
    assert rest(0.85, 1.05) == pytest.approx(0.065, abs=0.042)
    assert 8 < apart.max() < 25


def test_drawn_patients_differ_and_stay_in_the_published_ranges() -> None:
    drawn = [draw_motion(seed) for seed in range(200)]
    assert draw_motion(7) == draw_motion(7) != draw_motion(8)
    caudal = np.array([motion.breathing_caudal_mm for motion in drawn])
    assert caudal.min() >= 2.4 and caudal.max() <= 8.0
    assert caudal.mean() == pytest.approx(4.9, abs=0.4) and caudal.std() == pytest.approx(1.4, abs=0.4)
    assert motion_named("still") is None and motion_named("still", 3) is None
    assert motion_named("both", 7) == draw_motion(7)
    heartbeat = motion_named("heartbeat", 7)
    assert heartbeat is not None and heartbeat.annulus_mm == draw_motion(7).annulus_mm
    with pytest.raises(InputError, match=r"annulus_mm: -1\.0; give a number from 0 to 200"):
        Motion(annulus_mm=-1.0)


def test_a_breath_does_not_move_the_wire_in_its_vessel(anatomy: Anatomy) -> None:
    # A rigid motion of vessel and catheter: a wire without mass does not feel it.
    initial, control = drives(3, 6)
    config = SimulatorConfig(tolerance_mm=1e-7)
    still = simulate(anatomy, DEVICE, control, initial=initial, config=config)
    breathing = replace(motion_named("breathing") or MOTION, breathing_period_s=2.0, breathing_dorsal_deg=25.0)
    moving = simulate(anatomy, DEVICE, control, initial=initial, config=config, motion=breathing)
    np.testing.assert_allclose(moving.tip_position, still.tip_position, atol=1e-4)
    np.testing.assert_allclose(moving.tip_direction, still.tip_direction, atol=1e-4)
    np.testing.assert_allclose(moving.base_force, still.base_force, atol=1e-4)
    assert moving.vessel_to_laboratory is not None
    at = moving.tip_position[:, :, 0]
    assert np.linalg.norm(place(moving.vessel_to_laboratory, at) - at, axis=-1).max() > 4


def test_the_command_tells_tips_in_the_vessel_and_in_the_laboratory(anatomy: Anatomy, tmp_path: Path) -> None:
    write_anatomy(anatomy, output=tmp_path / "bend")
    random = command.RandomConfig(sequences=2, seconds=2.0)
    command.simulate_command(tmp_path / "bend", output=tmp_path / "still.csv", random=random)
    command.simulate_command(
        tmp_path / "bend", output=tmp_path / "both.csv", motion="both", motion_seed=5, random=random
    )
    still, moving = (pd.read_csv(tmp_path / name) for name in ("still.csv", "both.csv"))
    told = [f"tip_laboratory_{axis}_mm" for axis in "xyz"]
    assert set(moving.columns) - set(still.columns) == set(told)
    found = place(
        draw_motion(5).core(np.asarray(anatomy.insertion.position)).placements(moving["time_s"].to_numpy())[0],
        moving[[f"tip_{axis}_mm" for axis in "xyz"]].to_numpy(),
    )
    np.testing.assert_allclose(moving[told], found, atol=1e-6)
