"""A small vessel, a wire in it and made-up predictions: enough to draw, tell and check everything."""

from __future__ import annotations

import numpy as np
from scipy.spatial import KDTree

from endopilot.devices.device import read_wire
from endopilot.devices.stack import Stack
from endopilot.evaluation.results import SplitResult, TipSeries
from endopilot.simulation.config import SimulatorConfig
from endopilot.simulation.trajectory import SimulationSetUp, Trajectory
from endopilot.types import (
    Anatomy,
    Branch,
    Centerline,
    DistanceMap,
    Insertion,
    TipProjection,
    VesselTree,
)
from toy_navigation import toy_outputs

SPACING_MM = 0.5
LENGTH_MM = 40.0
RADIUS_MM = 2.0
GIVEN, PREDICTED = 30, 90


def make_anatomy(name: str = "tube") -> Anatomy:
    """A tube from the ostium at the origin along −z, bent towards −x, with a catheter behind the ostium."""
    abscissa = np.linspace(0.0, LENGTH_MM, 81)
    points = np.stack([-2.0 * (abscissa / 20.0) ** 2, np.zeros(81), -abscissa], axis=-1)
    normals = np.tile([0.0, 1.0, 0.0], (81, 1))
    section = np.repeat([0, 1], [41, 40])
    line = Centerline(points, np.full(81, RADIUS_MM), abscissa, normals)
    catheter = np.stack([np.zeros(20), np.zeros(20), np.linspace(0.5, 10.0, 20)], axis=-1)
    centres = np.concatenate([points, catheter])
    low, high = centres.min(axis=0) - 4.0, centres.max(axis=0) + 4.0
    axes = [np.arange(a, b, SPACING_MM) for a, b in zip(low, high, strict=True)]
    z, y, x = np.meshgrid(*axes[::-1], indexing="ij")
    distance, _ = KDTree(centres).query(np.stack([x, y, z], axis=-1))
    insertion = Insertion(np.zeros(3), np.array([0.0, 0.0, -1.0]))
    tree = VesselTree((Branch(line, -1, section),), ("1", "2"))
    return Anatomy(name, tree, DistanceMap(RADIUS_MM - distance, SPACING_MM, low), insertion, RADIUS_MM)


def make_trajectory(samples: int = 6) -> Trajectory:
    """One world whose wire lies on the z axis and goes 4 mm deeper each sample."""
    depth = 8.0 + 4.0 * np.arange(samples)
    nodes = np.arange(30)
    shape = np.zeros((1, samples, 30, 3))
    shape[0, :, :, 2] = -depth[:, None] + 2.0 * nodes
    start = np.array([[[4.0, 0.0]]])
    of_wire = np.zeros((1, samples, 1))
    inserted = depth[None, :, None]
    stack, friction = Stack(read_wire("workhorse-014")), np.full((1, 1), 0.1)
    return Trajectory(
        set_up=SimulationSetUp([make_anatomy()], [stack], start, friction, "velocity", None, SimulatorConfig()),
        period_s=0.5,
        start=start,
        command=np.tile([8.0, 0.0], (1, samples, 1, 1)),
        tip=TipProjection(inserted, of_wire, np.zeros((1, samples, 1), dtype=int), of_wire + RADIUS_MM),
        **toy_outputs(
            (1, samples),
            1,
            inserted_length=inserted,
            tip_position=shape[:, :, :1],
            tip_direction=np.tile([0.0, 0.0, -1.0], (1, samples, 1, 1)),
        ),
        reason=np.zeros(1, dtype=int),
        shape=shape,
    )


def make_result(anatomies: tuple[str, ...] = ("a", "b"), episodes: int = 6, seed: int = 3) -> SplitResult:
    """Predictions whose errors differ by series: P1 good, P4 bad, the baselines in between."""
    random = np.random.Generator(np.random.Philox(seed))
    size = (episodes, PREDICTED)
    radius = np.full(size, 1.5)
    abscissa = 40.0 + np.cumsum(random.normal(0, 0.5, size), axis=1)
    offset = random.uniform(0.0, 1.3, size)
    control = random.normal(0, 2.0, (*size, 2))

    def tip(scale: float) -> TipSeries:
        noise = random.normal(0, scale, size)
        return TipSeries(abscissa + noise, np.abs(offset + 0.3 * noise), radius)

    scales = {"P1": 0.2, "P3": 0.6, "P4": 1.4, "hold_slack": 0.9, "training_mean": 0.8}
    scales |= {"hold_control": 4.0, "follow_slack": 0.7, "P2_replayed": 1.2, "true_replay": 0.0}
    simulated = ("P4", "P2_replayed", "hold_control", "follow_slack", "true_replay")
    return SplitResult(
        sample_period_s=0.5,
        anatomies=anatomies,
        anatomy=np.arange(episodes) % len(anatomies),
        sequence=np.arange(episodes),
        wire_radius_mm=0.18,
        true=TipSeries(abscissa, offset, radius),
        true_control=control,
        tips={name: tip(scale) for name, scale in scales.items()},
        controls={
            "P2": control + random.normal(0, 0.5, control.shape),
            "P3": control + 1.0,
            "hold_control": np.zeros_like(control),
            "training_mean": np.zeros_like(control),
            "follow_slack": control + random.normal(0, 1.0, control.shape),
        },
        tip_distance={name: np.abs(random.normal(0, scales[name], size)) for name in simulated},
    )
