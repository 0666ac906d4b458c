"""What the rod core's error and speed are measured on: `make_scenes`, and what is compared of them, a `Solution`."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, fields

import numpy as np
from jaxtyping import Bool, Float, Int

from endopilot.anatomy.catheter_axis import with_world_zero
from endopilot.atlas.atlas import AtlasConfig, make_patient
from endopilot.devices.device import Wire, read_wire
from endopilot.simulation.config import SimulatorConfig
from endopilot.simulation.controls import ControlConfig, random_controls
from endopilot.simulation.motion import Motion
from endopilot.simulation.simulate import simulate
from endopilot.simulation.trajectory import Trajectory
from endopilot.types import SAMPLE_PERIOD_S, Anatomy

KINDS: Mapping[str, str] = {"right": "rca", "left": "lca", "cerebral": "cerebral"}
"""Names of the patients, and their kinds in the atlas. Nothing was calibrated on these patients."""
SEED = 15
"""Seed of the patients and of the controls."""
DEVICE = "workhorse-014"
"""The wire."""
WORLDS = 24
"""Worlds of each patient."""
SAMPLES = 120
"""Samples of each world: 60 s."""


@dataclass(frozen=True, eq=False)
class Scene:
    """A patient, a wire and the controls of some worlds: what the reference and what is measured simulate.

    Attributes:
        name: of the patient.
        anatomy: the vessel.
        device: the wire.
        initial: inserted length (mm) and rotation (rad) at the start.
        control: mm/s and rad/s.
    """

    name: str
    anatomy: Anatomy
    device: Wire
    initial: Float[np.ndarray, "worlds 1 2"]
    control: Float[np.ndarray, "worlds samples 1 2"]

    def run(self, config: SimulatorConfig, worlds: int | None = None, *, motion: Motion | None = None) -> Trajectory:
        """Simulate the worlds, or the first of them; the vessel lies still, or moves."""
        return simulate(
            self.anatomy,
            self.device,
            self.control[:worlds],
            initial=self.initial[:worlds],
            config=config,
            motion=motion,
        )


def make_scenes(worlds: int = WORLDS, samples: int = SAMPLES) -> list[Scene]:
    """Return the scenes of the reference.

    Args:
        worlds: of each patient.
        samples: of each world.
    """
    scenes = []
    for place, (name, kind) in enumerate(KINDS.items()):
        anatomy = with_world_zero(make_patient(AtlasConfig(vessel=kind, seed=SEED, population="textbook"), 0))
        initial, control = random_controls(
            ControlConfig(),
            n_sequences=worlds,
            n_samples=samples,
            seed=SEED,
            max_inserted_length_mm=float(anatomy.tree.longest_path().abscissa[-1]),
            first=place * worlds,
        )
        scenes.append(Scene(name, anatomy, read_wire(DEVICE), initial, control))
    return scenes


def simulated_s(scenes: Sequence[Scene]) -> float:
    """Return the simulated time of all worlds together, s."""
    return SAMPLE_PERIOD_S * sum(scene.control.shape[0] * scene.control.shape[1] for scene in scenes)


@dataclass(frozen=True, eq=False)
class Solution:
    """What is compared: recorded samples of the worlds of all scenes, one scene after the other.

    Attributes:
        tip_position: LPS mm.
        branch: that the tip lies in.
        wall_force: largest resultant of the wall's forces on 2 mm of the wire, N.
        contact_force_max: largest force of the wall on a node, N.
        base_force: of the base on the wire, N.
        base_torque: N·mm.
        valid: whether the world was valid.
        before_fork: whether the tip lies before the first bifurcation.
    """

    tip_position: Float[np.ndarray, "worlds samples 3"]
    branch: Int[np.ndarray, "worlds samples"]
    wall_force: Float[np.ndarray, "worlds samples"]
    contact_force_max: Float[np.ndarray, "worlds samples"]
    base_force: Float[np.ndarray, "worlds samples"]
    base_torque: Float[np.ndarray, "worlds samples"]
    valid: Bool[np.ndarray, "worlds samples"]
    before_fork: Bool[np.ndarray, "worlds samples"]

    @staticmethod
    def of(scenes: Iterable[Scene], rollouts: Iterable[Trajectory]) -> Solution:
        """Return what rollouts of the scenes recorded."""
        columns: dict[str, list[np.ndarray]] = {field.name: [] for field in fields(Solution)}
        for scene, rollout in zip(scenes, rollouts, strict=True):
            root_mm = float(scene.anatomy.tree.branches[0].centerline.abscissa[-1])
            tip = rollout.tip[:, :, 0]
            columns["branch"].append(tip.branch)
            columns["before_fork"].append((tip.branch == 0) & (tip.abscissa < root_mm))
            for name in ("wall_force", "contact_force_max", "valid"):
                columns[name].append(getattr(rollout, name))
            for name in ("tip_position", "base_force", "base_torque"):
                columns[name].append(getattr(rollout, name)[:, :, 0])
        return Solution(**{name: np.concatenate(parts) for name, parts in columns.items()})

    def worlds(self, rows: Int[np.ndarray, "n"]) -> Solution:
        """Return some of the worlds."""
        return Solution(**{field.name: getattr(self, field.name)[rows] for field in fields(self)})
