"""Where worlds are stepped: which build of the core, refusals and reports. `test_kernel.cpp` tests the numbers."""

from __future__ import annotations

import sys
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from endopilot import _core
from endopilot.devices.device import read_wire
from endopilot.errors import InputError
from endopilot.simulation.config import SimulatorConfig, core_for
from endopilot.simulation.simulate import simulate
from endopilot.simulation.simulator import Simulator
from endopilot.types import Anatomy

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
