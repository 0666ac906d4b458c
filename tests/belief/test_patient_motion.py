"""The motion of a vessel by what X-ray shows of a wire in it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from endopilot.belief.patient_motion import find_motion
from endopilot.simulation.motion import Motion, motion_named, place

OSTIUM = np.array([10.0, -20.0, 5.0])
TIMES_S = np.array([0.0, 3.5, 6.0, 7.5, 9.5, 11.0, 14.0])


def tips(random: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Tips that go on along a vessel, and the directions of their wires."""
    direction = np.tile([0.6, 0.0, -0.8], (len(TIMES_S), 1))
    return OSTIUM + np.linspace(5.0, 60.0, len(TIMES_S))[:, None] * direction, direction


@pytest.mark.parametrize(
    "motion",
    [
        Motion(heart_period_s=0.95, annulus_mm=8.0, breathing_period_s=5.0, breathing_caudal_mm=6.5),
        motion_named("breathing"),
        motion_named("heartbeat"),
    ],
)
def test_periods_and_amplitudes_are_found_from_seven_images(motion: Motion) -> None:
    random = np.random.default_rng(1)
    tip, direction = tips(random)
    placed = motion.core(OSTIUM).placements(TIMES_S)[0]
    seen = np.array([place(maps, point) for maps, point in zip(placed, tip, strict=True)])
    found = find_motion(tip, direction, seen + 0.2 * random.standard_normal(seen.shape), TIMES_S, OSTIUM)
    assert found.gain > 6.0 and found.misfit < 0.8
    there = found.motion.core(OSTIUM).placements(TIMES_S)[0]
    off = [place(a, point) - place(b, point) for a, b, point in zip(there, placed, tip, strict=True)]
    assert np.linalg.norm(off, axis=1).mean() < 1.0
    assert np.linalg.norm(seen - tip, axis=1).mean() > 1.5


def test_errors_along_the_wire_and_of_another_place_are_no_motion() -> None:
    random = np.random.default_rng(2)
    tip, direction = tips(random)
    for off in (2.5 * direction, 0.6 * np.ones(3), 1.5 * random.standard_normal((len(tip), 1)) * direction):
        noise = 0.2 * random.standard_normal(tip.shape)
        assert find_motion(tip, direction, tip + off + noise, TIMES_S, OSTIUM).gain < 6.0


def test_a_registration_that_errs_and_drifts_is_no_motion() -> None:
    """3 mm a minute, over 40 s: without the drift's own evidence a heart that beats gains 10 and more."""
    times_s = np.linspace(0.0, 40.0, 16)
    for seed in range(4):
        random = np.random.default_rng(seed)
        tip, side = random.uniform(-40, 40, (16, 3)) + OSTIUM, random.standard_normal((17, 3))
        side /= np.linalg.norm(side, axis=1, keepdims=True)
        off = np.array([1.0, 0.3, -0.5]) + 3.0 * side[16] * times_s[:, None] / 60
        seen = tip + off + 0.3 * random.standard_normal((16, 3))
        assert find_motion(tip, side[:16], seen, times_s, OSTIUM).gain < 0.0


def test_amplitudes_are_found_around_a_known_motion_and_only_where_they_differ() -> None:
    """A seventh image of another amplitude is enough, since the periods are known; with those that are known the
    motion gains nothing."""
    random, known = np.random.default_rng(3), Motion()
    tip, direction = tips(random)
    for motion, gains in ((known, False), (replace(known, breathing_caudal_mm=9.0, breathing_anterior_mm=4.5), True)):
        placed = motion.core(OSTIUM).placements(TIMES_S)[0]
        seen = np.array([place(maps, point) for maps, point in zip(placed, tip, strict=True)])
        noise = 0.2 * random.standard_normal(seen.shape)
        found = find_motion(tip, direction, seen + noise, TIMES_S, OSTIUM, known=known)
        assert (found.gain > 6.0) == gains
        assert found.motion.heart_period_s == pytest.approx(known.heart_period_s)
        assert found.motion.breathing_period_s == pytest.approx(known.breathing_period_s)
        there = found.motion.core(OSTIUM).placements(TIMES_S)[0]
        off = [place(a, point) - place(b, point) for a, b, point in zip(there, placed, tip, strict=True)]
        assert np.linalg.norm(off, axis=1).mean() < 1.0
