"""A wire with a closed form, for tests of what comes after the simulator.

The slack s = Δ − Δtip follows a play operator: it grows with insertion and shrinks with retraction, at the rate
`SLACK_RATE`, within an envelope that widens with depth. The offset is a function of depth and rotation.
"""

from __future__ import annotations

import os
from dataclasses import replace
from pathlib import Path
from typing import Any
from unittest.mock import patch

import numpy as np

from endopilot import _core
from endopilot.anatomy.io import write_anatomy
from endopilot.dataset.config import DatasetConfig
from endopilot.dataset.generate import generate_dataset
from endopilot.dataset.loader import read_dataset
from endopilot.devices.device import read_wire
from endopilot.devices.stack import Stack
from endopilot.files import read_json, write_json
from endopilot.simulation.trajectory import SimulationSetUp, Trajectory
from endopilot.types import (
    SAMPLE_PERIOD_S,
    Anatomy,
    Branch,
    Centerline,
    DistanceMap,
    Insertion,
    TipProjection,
    VesselTree,
)

SLACK_RATE = 0.6
LENGTH_MM = 100.0


def toy_anatomy(name: str) -> Anatomy:
    """Return a straight vessel, 100 mm long and 1.5 mm in radius, whose distance map the toy wire does not need."""
    along = np.linspace(0, LENGTH_MM, 41)
    points = np.stack([along, np.zeros(41), np.zeros(41)], axis=-1)
    normals = np.tile([0.0, 1.0, 0.0], (41, 1))
    line = Centerline(points=points, radius=np.full(41, 1.5), abscissa=along, normals=normals)
    return Anatomy(
        name=name,
        tree=VesselTree((Branch(line, -1, np.zeros(41, dtype=int)),), ("1",)),
        distance_map=DistanceMap(np.ones((3, 3, 3)), 1.0, np.zeros(3)),
        insertion=Insertion(np.zeros(3), np.array([1.0, 0.0, 0.0])),
        catheter_radius_mm=1.5,
    )


def toy_simulate(
    anatomy: Anatomy, device, control, *, initial, config, friction, motion=None, record_shape=False
) -> Trajectory:
    """Return what the toy wire does under the controls; takes what `simulate` takes."""
    worlds, samples = control.shape[:2]
    control, initial = control.reshape(worlds, samples, 1, 2), initial.reshape(worlds, 1, 2)
    stack, friction = Stack.of(device), friction.reshape(worlds, 1)
    proximal = initial[:, None] + SAMPLE_PERIOD_S * np.cumsum(control, axis=1)
    inserted, rotation = proximal[..., 0], proximal[..., 1]
    advance = np.diff(inserted, axis=1, prepend=initial[:, None, :, 0])
    curliness = 0.02 + 0.005 * (len(anatomy.name) % 3)
    slack = np.zeros((worlds, samples, 1))
    now = curliness * initial[..., 0]
    for t in range(samples):
        low = curliness * np.maximum(inserted[:, t], 0)
        now = np.clip(now + SLACK_RATE * advance[:, t], low, low + 1.5)
        slack[:, t] = now
    abscissa = inserted - slack
    offset = 0.8 + 0.5 * np.sin(0.1 * abscissa + rotation)
    force, still = 0.01 * slack, np.zeros_like(slack)
    branch = np.zeros((worlds, samples, 1), dtype=np.int64)
    return Trajectory(
        set_up=SimulationSetUp([anatomy] * worlds, [stack] * worlds, initial, friction, "velocity", motion, config),
        period_s=SAMPLE_PERIOD_S,
        start=initial,
        command=control,
        tip=TipProjection(abscissa=abscissa, offset=offset, branch=branch, radius=still + 1.5),
        **toy_outputs(
            (worlds, samples),
            1,
            inserted_length=inserted,
            rotation=rotation,
            tip_position=np.stack([abscissa, offset, still], axis=-1),
            tip_direction=np.tile([1.0, 0.0, 0.0], (worlds, samples, 1, 1)),
            contact_force_max=force[..., 0],
            contact_force_sum=2 * force[..., 0],
            wall_force=force[..., 0],
            base_force=force.copy(),
            base_torque=0.1 * force,
            drive_force=force + 0.05,
            drive_torque=0.1 * force + 0.01,
            iterations=np.ones((worlds, samples)),
            node_iterations=np.ones((worlds, samples)),
        ),
        reason=np.zeros(worlds, dtype=int),
        shape=_straight(abscissa[..., 0], offset[..., 0]) if record_shape else None,
    )


def toy_run(set_up: SimulationSetUp, command, *, period_s, record_shape) -> Trajectory:
    """Return what the toy wire does in worlds of one vessel; takes what `run_set_up` takes."""
    given = {"initial": set_up.initial, "config": set_up.config, "friction": set_up.friction, "motion": set_up.motion}
    return toy_simulate(set_up.anatomies[0], set_up.stacks[0], command, **given, record_shape=record_shape)


def toy_outputs(each: tuple[int, ...], devices: int, **known: np.ndarray) -> dict[str, Any]:
    """Return all that the core records of worlds: 0, and valid, but for what is known."""
    outputs: dict[str, Any] = {
        name: np.zeros((*each, *([devices] if of == "device" else []), *([numbers] if numbers > 1 else [])))
        for name, of, numbers, *_ in _core.OUTPUTS
        if of in ("device", "sample")
    }
    return outputs | {"valid": np.ones(each, dtype=bool)} | known


def _straight(abscissa: np.ndarray, offset: np.ndarray) -> np.ndarray:
    """Return the nodes of wires that lie straight behind their tips, 0.5 mm apart."""
    along = abscissa[..., None] - 0.5 * np.arange(260)
    return np.stack([along, np.broadcast_to(offset[..., None], along.shape), np.zeros_like(along)], axis=-1)


def write_toy_anatomies(folder: Path, patients: int) -> list[Path]:
    """Write straight vessels that differ in name and catheter, and return their folders."""
    folders = [folder / f"patient-{i}" for i in range(patients)]
    for i, where in enumerate(folders):
        if not where.exists():
            vessel = toy_anatomy(f"patient-{i}{'x' * i}")
            catheter_mm = vessel.catheter_radius_mm + 1e-3 * i  # the toy wire does not feel it
            write_anatomy(replace(vessel, catheter_radius_mm=catheter_mm), output=where)
    return folders


def toy_navigate(simulate=toy_simulate):
    """Return a stand-in for `simulate_navigations`: the drawn controls, driven as they are through the toy."""

    def simulate_navigations(set_up, control, *, advance, **_):
        control = control.astype(np.float32).astype(float)
        given = {name: getattr(set_up, name) for name in ("initial", "config", "friction")}
        trajectory = simulate(set_up.anatomies[0], set_up.stacks[0], control, **given)
        advance(control.shape[0] * control.shape[1])
        return trajectory, np.zeros(len(control), dtype=bool)

    return simulate_navigations


def make_toy_dataset(
    folder: Path,
    *,
    patients: int,
    sequences: int,
    simulate=toy_simulate,
    scheduler: str | None = None,
    device: str = "workhorse-014",
    **settings,
) -> None:
    """Generate a dataset with the toy wire in place of the rod; two thirds of the patients train, the others test."""
    shares = (2 / 3, 0.0, 1 / 3) if patients > 1 else None
    config = DatasetConfig(**({"sequences": sequences, "anatomy_shares": shares} | settings))
    with patch("endopilot.dataset.generate.simulate_navigations", toy_navigate(simulate)):
        anatomies = write_toy_anatomies(folder.parent / "anatomies", patients)
        generate_dataset(anatomies, output=folder, device=read_wire(device), config=config, scheduler=scheduler)


def make_untrained_run(dataset_folder, run_folder, patients=None):
    """Write a run whose networks are their simple guesses: slack and offset stay; the drive moves as the tip is to.

    Its patients are those of the data set to train on, if none are given.
    """
    from endopilot.models.checkpoint import write_network
    from endopilot.models.config import TransformerConfig
    from endopilot.models.paper import NETWORKS

    size = TransformerConfig(d_model=24, encoder_layers=1, decoder_layers=1)
    for name, network in NETWORKS.items():
        write_network(run_folder / f"{name}.safetensors", name, network(size), size)
    device = read_json(dataset_folder / "meta" / "manifest.json")["device"]
    if patients is None:
        data = read_dataset(dataset_folder)
        patients = [data.patients[name] for name in set(data.of_split("train").anatomy.tolist())]
    record = {
        "config": {"model": "paper"},
        "patients": patients,
        "dataset": os.path.relpath(dataset_folder, run_folder),
        "networks": {"ff": {}, "if": {}},
        "device": device | {"max_velocity_mm_s": 1e3, "max_rotation_rad_s": 1e3},
    }
    write_json(run_folder / "manifest.json", record)
    epoch = {"epoch": 1, "steps": 1, "loss": 1.0, "validation_loss": None}
    write_json(run_folder / "training.json", {name: {"seconds": 0.0, "curve": [epoch]} for name in NETWORKS})
