from dataclasses import replace

import numpy as np

from endopilot.devices.device import read_wire
from endopilot.devices.drive_limits import DriveLimits, far_end_mm, within_travel
from endopilot.simulation.config import SimulatorConfig
from endopilot.simulation.simulator import Simulator
from endopilot.types import Branch, VesselTree
from toy_evaluation import make_anatomy

LIMITS = DriveLimits(max_velocity_mm_s=20.0, max_rotation_rad_s=3.0, travel_mm=(0.0, 100.0))
ASKED = np.array([[50.0, -9.0], [-50.0, 1.0], [2.0, 0.0]])


def test_the_limits_of_a_wire_in_a_vessel_are_the_drives_speed_the_ostium_and_the_far_end():
    wire, vessel = read_wire("workhorse-014"), make_anatomy()
    length_mm = vessel.tree.longest_path().abscissa[-1]
    limits = DriveLimits.of(wire, vessel)
    assert limits.fastest.tolist() == [wire.max_velocity_mm_s, wire.max_rotation_rad_s]
    assert limits.travel_mm == (0.0, length_mm + 20.0) == (0.0, far_end_mm(vessel))
    assert DriveLimits.of(wire).travel_mm == (0.0, np.inf)


def test_a_clipped_control_stays_within_speed_and_travel():
    assert LIMITS.clip(ASKED, np.array([97.0, 4.0, 50.0]), 0.5).tolist() == [[6.0, -3.0], [-8.0, 1.0], [2.0, 0.0]]
    assert LIMITS.clip(ASKED, 50.0, 0.5).tolist() == [[20.0, -3.0], [-20.0, 1.0], [2.0, 0.0]]


def test_a_wire_beyond_its_travel_is_moved_no_farther_and_not_brought_back_by_force():
    assert LIMITS.clip(ASKED, 101.0, 0.5)[:, 0].tolist() == [0.0, -20.0, 0.0]
    assert LIMITS.clip(ASKED, -1.0, 0.5)[:, 0].tolist() == [20.0, 0.0, 2.0]


def test_each_wire_may_have_a_travel_of_its_own():
    asked, inserted, end = np.array([5.0, 5.0, -5.0]), np.array([9.0, 9.0, 1.0]), np.array([10.0, 99.0, 9.0])
    made = within_travel(asked, inserted, 1.0, travel_mm=(0.0, end))
    assert isinstance(made, np.ndarray)
    assert made.tolist() == [1.0, 5.0, -1.0]


def test_a_sequence_ends_at_the_ends_of_the_travel_and_nan_stays():
    control = np.zeros((3, 4, 2))
    control[0, :, 0], control[1, :, 0], control[2, 1, 0] = 15.0, [-4.0, -4.0, 1.0, -4.0], np.nan
    made = LIMITS.clip_sequence(control, np.array([90.0, 3.0, 50.0]), 0.5)
    assert made[0, :, 0].tolist() == [15.0, 5.0, 0.0, 0.0]
    assert made[1, :, 0].tolist() == [-4.0, -2.0, 1.0, -1.0]
    assert np.isnan(made[2, :, 0]).tolist() == [False, True, True, True]


def test_controls_within_the_limits_stay_the_same_to_the_last_bit():
    control = np.random.default_rng(0).uniform([-3.0, -2.0], [3.0, 2.0], (50, 20, 2))
    assert np.array_equal(LIMITS.clip_sequence(control, np.full(50, 50.0), 0.5), control)


def test_a_simulator_takes_what_has_been_clipped():
    """A wire that is pushed on and on stops at the far end; rounding takes it no farther, which would be refused."""
    wire, tube = read_wire("workhorse-014"), make_anatomy()
    line = tube.tree.branches[0].centerline
    start = replace(line, **{name: values[:31] for name, values in vars(line).items()})
    vessel = replace(tube, tree=VesselTree((Branch(start, -1, np.zeros(31, dtype=int)),), ("1",)))
    simulator, end = Simulator(vessel, wire, worlds=8, config=SimulatorConfig(threads=1)), far_end_mm(vessel)
    begin = end - np.linspace(0.1, 0.9, 8)
    simulator.reset(inserted_length=begin, rotation=np.zeros(8))
    for _ in range(12):
        control = np.column_stack([np.linspace(3.3, 9.7, 8), np.zeros(8)])[:, None]
        simulator.step(DriveLimits.of(wire, vessel).clip(control, simulator.inserted_length, 0.07), 0.07)
    np.testing.assert_allclose(simulator.inserted_length, end, atol=1e-9)
