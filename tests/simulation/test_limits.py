"""The drive slips at its limits of push, pull and torque: closed forms, bookkeeping, determinism."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from endopilot.devices.device import read_wire
from endopilot.simulation.config import SimulatorConfig
from endopilot.simulation.core import of_device, run_core
from endopilot.simulation.simulate import simulate
from endopilot.simulation.simulator import Simulator
from endopilot.types import SAMPLE_PERIOD_S, Anatomy
from endopilot.verification.free_rod import STATIC, X_AXIS, Loading, straight_rod

LENGTH_MM, EI, GJ, EA, ELEMENTS = 40.0, 60.0, 46.0, 900.0, 20
PUSH_N, PULL_N, TORQUE_N_MM = 0.2, 0.3, 1.5
TURNS_BACK = 30
"""Sample from which on the base is moved back."""
HALF_MM = 0.5 * LENGTH_MM / (ELEMENTS - 0.5)
"""Half an element: forces act at nodes, torques at the middles of elements."""
START_MM = LENGTH_MM - 0.5 * HALF_MM
"""Inserted length; the drive holds the rod from the next node on."""
STIFF = 1e4
"""Of the springs that hold the tip, N/mm and N mm/rad."""
DEVICE = replace(read_wire("workhorse-014"), friction=0.5)
WEAK = replace(DEVICE, push_limit_n=0.015, pull_limit_n=0.004, torque_limit_n_mm=0.003)
"""A drive that slips in every direction in the bent vessel."""
CONFIG = SimulatorConfig(threads=1, wall_stiffness_n_mm=10.0)


def held_at_its_tip(speed: float, spin: float, samples: int = 40) -> dict[str, np.ndarray]:
    """Return what a straight rod does whose tip is held and whose base is moved (mm/s, rad/s)."""
    rod = straight_rod(elements=ELEMENTS, length_mm=LENGTH_MM, bend=EI, twist=GJ, stretch=EA)
    nodes, tip = len(rod.abscissa_mm), np.array([START_MM, 0.0, 0.0])
    loading = Loading.none(nodes)
    loading.spring_n_mm[0], loading.anchor_mm[0], loading.hold_n_mm[0] = STIFF, tip, STIFF
    loading.attitude[:] = [np.sqrt(0.5), 0.0, np.sqrt(0.5), 0.0]
    control = np.tile([speed, spin], (1, samples, 1))
    control[:, TURNS_BACK:] *= -1.0
    result = run_core(
        rod,
        None,
        X_AXIS,
        config=replace(STATIC, sample_tolerance_mm=1e-10),
        initial=np.array([[START_MM, 0.0]]),
        control=control,
        friction=np.zeros(1),
        loads=loading.core(),
        lanes=1,
        approach=False,
        free_behind_mm=0.0,
        push_limit_n=PUSH_N,
        pull_limit_n=PULL_N,
        torque_limit_n_mm=TORQUE_N_MM,
    )
    assert result["valid"].all()
    return {name: values[0] for name, values in of_device(result, 0).items()} | {"control": control[0]}


def clutch(stiffness: float, commanded: np.ndarray, low: float, high: float) -> tuple[np.ndarray, np.ndarray]:
    """Return the load of a spring behind a clutch that slips at `low` and `high`, and the slip, after each sample."""
    load, loads, slips = 0.0, [], []
    for moved in commanded:
        asked = load + stiffness * moved
        load = min(max(asked, low), high)
        loads.append(load)
        slips.append((asked - load) / stiffness)
    return np.array(loads), np.array(slips)


@pytest.mark.parametrize(("speed", "spin"), [(1.5e-3, 0.0), (-1.5e-3, 0.0), (0.0, 0.2), (0.0, -0.2)])
def test_a_wire_held_at_its_tip_is_pushed_pulled_and_turned_no_harder_than_the_limits(
    speed: float, spin: float
) -> None:
    # A spring EA/L or GJ/L behind a clutch: F = EA/L (moved - slipped), within [-pull, push]; T alike; then back.
    found = held_at_its_tip(speed, spin)
    along = 1.0 / ((LENGTH_MM - HALF_MM) / EA + 1.0 / STIFF), -PULL_N, PUSH_N
    around = 1.0 / ((START_MM - HALF_MM) / GJ + 1.0 / STIFF), -TORQUE_N_MM, TORQUE_N_MM
    kinds = [("base_force", "slip", 0, *along), ("base_torque", "rotation_slip", 1, *around)]
    (driven, slipped, column, spring, low, high), (_, other, *_) = kinds if speed else kinds[::-1]
    load, slip = clutch(spring, SAMPLE_PERIOD_S * found["control"][:, column], low, high)
    assert (slip != 0).sum() > 5 and (slip == 0).sum() > 5
    np.testing.assert_allclose(found[driven], load, atol=1e-6)
    np.testing.assert_allclose(found[slipped], slip, atol=1e-8 if speed else 1e-6)
    np.testing.assert_array_equal(found[other], 0.0)


def navigation(worlds: int = 5, samples: int = 24) -> tuple[np.ndarray, np.ndarray]:
    random = np.random.default_rng(8)
    initial = np.column_stack([random.uniform(30, 50, worlds), random.uniform(-3, 3, worlds)])
    control = np.stack([random.uniform(-3, 5, (worlds, samples)), random.uniform(-4, 4, (worlds, samples))], axis=-1)
    control[:, 1::2] = control[:, ::2]
    return initial, control


def test_what_slips_in_a_vessel_is_told_and_the_limits_hold(anatomy: Anatomy) -> None:
    initial, control = navigation()
    trajectory = simulate(anatomy, WEAK, control, initial=initial, config=CONFIG)
    assert trajectory.valid.all()
    assert (trajectory.slip > 1e-3).any() and (trajectory.slip < -1e-3).any()
    assert (trajectory.rotation_slip > 1e-3).any() and (trajectory.rotation_slip < -1e-3).any()
    # Newton's method leaves the force within the sample's tolerance of 1 nm times the wire's stiffness of some kN/mm.
    assert trajectory.base_force.max() == pytest.approx(WEAK.push_limit_n, rel=1e-3)
    assert trajectory.base_force.min() == pytest.approx(-WEAK.pull_limit_n, rel=1e-2)
    assert np.abs(trajectory.base_torque).max() == pytest.approx(WEAK.torque_limit_n_mm, rel=1e-2)
    slip = np.stack([trajectory.slip, trajectory.rotation_slip], axis=-1)
    asked = SAMPLE_PERIOD_S * control[:, :, None]
    np.testing.assert_allclose(SAMPLE_PERIOD_S * trajectory.control + slip, asked, atol=1e-12)
    made = trajectory.start[:, None] + SAMPLE_PERIOD_S * np.cumsum(trajectory.control, axis=1)
    np.testing.assert_allclose(trajectory.proximal, made, atol=1e-9)


def test_a_wire_that_was_not_pulled_back_is_pushed_on_from_there(anatomy: Anatomy) -> None:
    # 20 s of pulling at a drive that holds next to nothing, then 10 s of pushing: the wire is deeper than commanded.
    control = np.zeros((1, 60, 2))
    control[0, :40, 0], control[0, 40:, 0] = -1.0, 2.0
    loose = replace(WEAK, pull_limit_n=2e-3, push_limit_n=0.5)
    trajectory = simulate(anatomy, loose, control, initial=np.array([[60.0, 0.0]]), record_shape=True, config=CONFIG)
    assert trajectory.valid.all() and trajectory.shape is not None
    assert trajectory.base_force[0, :40, 0] == pytest.approx(-2e-3, abs=1e-6)
    assert trajectory.inserted_length[0, -1, 0] > 70.0  # and 60 mm was commanded
    behind = anatomy.insertion.position[0] - trajectory.shape[0, -1, -1, 0]
    assert behind > 3.0  # the recorded wire reaches back into the catheter


def test_loads_that_are_given_have_no_limit(anatomy: Anatomy) -> None:
    load = np.zeros((1, 8, 2))
    load[:, :4], load[:, 4:] = [0.08, 0.02], [-0.08, -0.02]
    weak, strong = (
        simulate(
            anatomy,
            replace(WEAK, push_limit_n=n, pull_limit_n=n, torque_limit_n_mm=n),
            load,
            actuation="force",
            config=CONFIG,
        )
        for n in (5e-3, 1e3)
    )
    assert np.ptp(strong.inserted_length) > 5.0
    for name in ("tip_position", "inserted_length", "rotation", "drive_force", "drive_torque"):
        np.testing.assert_array_equal(getattr(weak, name), getattr(strong, name))
    np.testing.assert_array_equal(weak.slip, 0.0)
    np.testing.assert_array_equal(weak.rotation_slip, 0.0)


def test_a_wire_that_has_gone_through_the_wall_is_no_result(anatomy: Anatomy) -> None:
    """It is pushed on against the blind end, where a soft wall gives way by more than the wire's radius."""
    control, initial = np.tile([10.0, 0.0], (1, 16, 1)), np.array([[40.0, 0.0]])
    soft = SimulatorConfig(element_mm=1.0, wall_stiffness_n_mm=0.2)
    with pytest.warns(UserWarning, match="went through the wall after"):
        trajectory = simulate(anatomy, DEVICE, control, initial=initial, config=soft)
    assert trajectory.reason[0] == 3 and not trajectory.valid[0, -1]
    before = trajectory.contact_force_max[trajectory.valid]
    assert len(before) and before.max() < 2 * 0.2 * DEVICE.tip_radius_mm  # node and middle together
    simulator = Simulator(anatomy, DEVICE, config=soft)
    simulator.reset(inserted_length=initial[:, 0], rotation=initial[:, 1])
    for sample in control[0]:
        simulator.step(sample[None], SAMPLE_PERIOD_S)
    assert simulator.reason[0] == 3
    hard = simulate(anatomy, DEVICE, control, initial=initial, config=SimulatorConfig(element_mm=1.0))
    assert hard.valid.all()
