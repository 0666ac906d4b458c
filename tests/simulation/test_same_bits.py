"""The same bits however worlds are stepped: in any company, by any threads, step by step; and by which core."""

from __future__ import annotations

import sys
from dataclasses import dataclass, field, replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import bend
import numpy as np
import pytest

from endopilot import _core
from endopilot.devices.catheter import read_catheter
from endopilot.devices.device import read_wire
from endopilot.devices.stack import Stack, Transmission
from endopilot.errors import InputError
from endopilot.simulation.config import SimulatorConfig, core_for
from endopilot.simulation.motion import Motion
from endopilot.simulation.simulate import simulate
from endopilot.simulation.simulator import Simulator
from endopilot.simulation.trajectory import SimulatorState, Trajectory
from endopilot.types import Anatomy

WIRE, STIFF, CATHETER = read_wire("workhorse-014"), read_wire("stiff-014"), read_catheter("microcatheter-1.7f")
WEAK = replace(WIRE, friction=0.5, push_limit_n=0.006, pull_limit_n=0.002, torque_limit_n_mm=0.003)
BEHIND = Transmission(length_mm=1000.0, twist_friction_n_mm_mm=2e-4)
COARSE = SimulatorConfig(element_mm=1.25, time_step_s=0.025)
WORLDS, SAMPLES, HALF = 5, 12, 6
RECORDED = (
    *("tip_position", "tip_direction", "proximal", "contact_force_max", "contact_force_sum", "wall_force"),
    *("base_force", "base_torque", "slip", "rotation_slip", "node_iterations", "iterations"),
)


@dataclass(frozen=True)
class SetUp:
    """What is simulated and how."""

    stack: Stack
    config: SimulatorConfig = COARSE
    period_s: float = 0.5
    options: dict[str, Any] = field(default_factory=dict)

    def simulated(self, worlds: Any, **changed: Any) -> Trajectory:
        """Return the trajectories of some worlds, simulated with nobody else."""
        initial, control = self.drives()
        config = replace(self.config, **changed)
        drives = {"initial": initial[worlds], "period_s": self.period_s}
        return simulate(VESSEL, self.stack, control[worlds], **drives, config=config, **self.options)

    def simulator(self) -> Simulator:
        return Simulator(VESSEL, self.stack, worlds=WORLDS, config=self.config, **self.options)

    def drives(self) -> tuple[np.ndarray, np.ndarray]:
        draw, devices = np.random.default_rng(8), len(self.stack)
        initial = draw.uniform([30.0, -3.0], [50.0, 3.0], (WORLDS, devices, 2))
        if "actuation" in self.options:
            return initial, draw.uniform([0.0, -0.02], [0.15, 0.02], (WORLDS, SAMPLES, devices, 2))
        control = draw.uniform([-4.0, -4.0], [5.0, 4.0], (WORLDS, SAMPLES, devices, 2))
        control[:, 1::2] = control[:, ::2]  # long enough for a weak drive to slip
        return initial, control


VESSEL = bend.vessel()
SET_UPS = {
    "wire": SetUp(Stack(WIRE), SimulatorConfig()),
    "weak drive": SetUp(Stack(WEAK)),
    "steps of another length": SetUp(Stack(WIRE), period_s=0.06),  # no multiple of the time step
    "loads": SetUp(Stack(WIRE), options={"actuation": "force"}),
    "compliant wall": SetUp(Stack(STIFF), replace(COARSE, compliant_wall_n_mm2=0.01)),
    "friction along": SetUp(Stack(WIRE), replace(COARSE, friction_along=(1.0, 4.0))),
    "moving vessel": SetUp(Stack(WIRE), options={"motion": Motion()}),
    "drive behind": SetUp(Stack(WIRE, (), (BEHIND,))),
    "catheter": SetUp(Stack(WIRE, (CATHETER,))),
    "catheter in a moving vessel": SetUp(Stack(WIRE, (CATHETER,)), options={"motion": Motion()}),
    "catheter, drives behind": SetUp(Stack(WIRE, (CATHETER,), (BEHIND, BEHIND))),
}


@pytest.fixture(scope="module", params=SET_UPS)
def made(request: pytest.FixtureRequest) -> tuple[str, SetUp, Trajectory]:
    whole = SET_UPS[request.param].simulated(slice(None), threads=1)
    assert whole.valid.all()
    return request.param, SET_UPS[request.param], whole


def test_in_any_company_and_by_any_number_of_threads(made: tuple[str, SetUp, Trajectory]) -> None:
    name, set_up, whole = made
    assert whole.period_s == set_up.period_s
    if name == "weak drive":
        assert (whole.slip > 0.1).any() and (np.abs(whole.rotation_slip) > 0.1).any()
    if "catheter" in name:  # wire and catheter overtake each other
        ahead = whole.inserted_length[..., 0] > whole.inserted_length[..., 1]
        assert ahead.any() and not ahead.all()
    order = np.array([3, 0, 4, 1, 2])
    for rows, threads in ((slice(None), 2), (order, 0), ([4], 1)):
        found = set_up.simulated(rows, threads=threads)
        for each in RECORDED:
            np.testing.assert_array_equal(getattr(found, each), getattr(whole, each)[rows], err_msg=each)


def test_step_by_step_and_from_a_state_written_on_the_way(made: tuple[str, SetUp, Trajectory], tmp_path: Path) -> None:
    name, set_up, whole = made
    initial, control = set_up.drives()
    simulator = set_up.simulator()
    simulator.reset(inserted_length=initial[..., 0], rotation=initial[..., 1])
    for sample in range(SAMPLES):
        if sample == HALF:
            simulator.state.write(tmp_path / "state.npz")
            simulator = set_up.simulator()
            simulator.set_state(SimulatorState.read(tmp_path / "state.npz"))
        step = simulator.step(control[:, sample], set_up.period_s)
        for each in ("tip_position", "tip_direction", "contact_force_max", "wall_force", "slip", "rotation_slip"):
            np.testing.assert_array_equal(getattr(step, each), getattr(whole, each)[:, sample], err_msg=each)
        np.testing.assert_array_equal(simulator.base_load[..., 0], whole.base_force[:, sample])
        np.testing.assert_array_equal(simulator.drive_load[..., 0], whole.drive_force[:, sample])
        np.testing.assert_array_equal(simulator.proximal, whole.proximal[:, sample])
        np.testing.assert_array_equal(simulator.contacts.max(axis=1), whole.contact_force_max[:, sample])
        np.testing.assert_array_equal(simulator.project().abscissa, whole.tip.abscissa[:, sample])
        if whole.vessel_to_laboratory is not None:
            np.testing.assert_array_equal(simulator.vessel_to_laboratory, whole.vessel_to_laboratory[:, sample])
    if "behind" in name:
        assert (simulator.drive_rotation != simulator.rotation).any()


@pytest.mark.parametrize("name", [name for name in SET_UPS if name not in ("wire", "steps of another length")])
def test_a_state_of_another_set_up_is_refused(name: str) -> None:
    state = SET_UPS[name].simulator().state
    with pytest.raises(InputError, match="state: made with other"):
        Simulator(VESSEL, WIRE, worlds=WORLDS, config=COARSE).set_state(state)


DEVICE = read_wire("workhorse-014")
GPU = SimulatorConfig(element_mm=1.5, processor="cuda")
CPU = SimulatorConfig(element_mm=1.5)


def put_gpu(monkeypatch: pytest.MonkeyPatch, **changed: Any) -> list[int]:
    """Stand the processor's core in for the GPU's; return the numbers of worlds that it is given."""
    given: list[int] = []

    def simulation(**arguments: Any) -> Any:
        given.append(arguments["worlds"])
        return _core.Simulation(**arguments)

    module = {**vars(_core), "why_no_gpu": lambda: "", "Simulation": simulation, **changed}
    monkeypatch.setitem(sys.modules, "endopilot._core_cuda", SimpleNamespace(**module))  # type: ignore[arg-type]
    return given


def test_a_build_and_a_machine_without_gpu_are_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "endopilot._core_cuda", None)  # type: ignore[arg-type]
    with pytest.raises(InputError, match=r"'cuda': endopilot was built without it; build it with .*ENDOPILOT_CUDA"):
        core_for("cuda")
    assert core_for("cpu") is _core
    put_gpu(monkeypatch, why_no_gpu=lambda: "no CUDA-capable device is detected")
    with pytest.raises(
        InputError, match=r"processor: 'cuda': no GPU can be used here \(no CUDA-capable device is detected\)"
    ):
        core_for("cuda")


def test_the_gpu_steps_worlds_and_their_state_goes_anywhere(monkeypatch: pytest.MonkeyPatch, anatomy: Anatomy) -> None:
    given = put_gpu(monkeypatch)
    on_gpu, here = (Simulator(anatomy, DEVICE, worlds=2, config=config) for config in (GPU, CPU))
    assert given == [2]
    on_gpu.reset(seed=1)
    here.set_state(on_gpu.state)
    control = [[3.0, 0.2], [5.0, -0.2]]
    assert np.array_equal(on_gpu.step(control, 0.1).tip_position, here.step(control, 0.1).tip_position)


def test_what_the_gpu_reports_is_said_in_one_line(monkeypatch: pytest.MonkeyPatch, anatomy: Anatomy) -> None:
    def full(**arguments: Any) -> Any:
        raise RuntimeError("the GPU reports: out of memory")

    put_gpu(monkeypatch, Simulation=full)
    control = np.zeros((1, 1, 2))
    with pytest.raises(InputError, match="processor: 'cuda': the GPU reports: out of memory; simulate fewer worlds"):
        simulate(anatomy, DEVICE, control, config=GPU)
    with pytest.raises(InputError, match="out of memory"):
        Simulator(anatomy, DEVICE, config=GPU)


def test_a_gpu_agrees_with_the_processor(anatomy: Anatomy) -> None:
    try:
        core_for("cuda")
    except InputError as refused:
        pytest.skip(str(refused))
    control = np.random.default_rng(2).uniform((-2, -1), (6, 1), (40, 20, 2))
    on_gpu, here = (simulate(anatomy, DEVICE, control, config=config) for config in (GPU, CPU))
    distance = np.linalg.norm(on_gpu.tip_position - here.tip_position, axis=-1)
    assert np.percentile(distance, 95) < 1e-3
    assert (on_gpu.valid == here.valid).mean() > 0.99
