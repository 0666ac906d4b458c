"""Images of synthetic patients with a known wire, to train a detector on and to measure it."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import numpy as np
from jaxtyping import Float, Float32

from endopilot.anatomy.io import read_anatomy
from endopilot.atlas.atlas import AtlasConfig, make_patient
from endopilot.devices.device import Wire, read_wire
from endopilot.progress import progress
from endopilot.settings import Finite, Seed, Within, settings
from endopilot.simulation.controls import ControlConfig, random_controls
from endopilot.simulation.simulate import simulate
from endopilot.types import Anatomy
from endopilot.xray.absorbers import surroundings
from endopilot.xray.carm import Pose, View, view_at
from endopilot.xray.image import ImageConfig, Plane, XrayImager

_SEQUENCES, _SAMPLES, _FIRST_SAMPLE = 6, 40, 4
_DEEPEST_SHARE = 0.9
_FRAME_S = 1 / 15
"""Time between the images that a temporal filter sees, s."""
_FORGOTTEN = 0.05
_EARLIER_SEED = 2**40
Signal = Float32[np.ndarray, "rows columns"]


@settings
class SceneConfig:
    """Patients, their poses and the C-arm's angles."""

    patients: Annotated[int, Within(1, 1000)] = 6
    """Synthetic patients, right and left coronary trees in turn."""
    seed: Seed = 0
    """Seed of patients, poses, wires and noise."""
    view_angles_deg: tuple[tuple[tuple[Finite, Finite], tuple[Finite, Finite]], ...] = (
        ((-30.0, 0.0), (60.0, 0.0)),
        ((-20.0, 25.0), (45.0, 20.0)),
    )
    """Pairs of views, LAO (positive) or RAO and cranial (positive) or caudal, degrees: patients take them in turn."""
    device: str = "workhorse-014"
    """The wire."""
    given: tuple[Path, ...] = ()
    """Folders of anatomies in place of synthetic patients; `patients` does not count then."""


@dataclass(frozen=True, eq=False)
class Scene:
    """One patient on the table, with the wires of some navigations.

    Attributes:
        anatomy: the vessel.
        device: the wire.
        imager: makes the images.
        angles_deg: of the two views.
        pose: in which the patient truly lies.
        planes: what does not move in each view, in that pose.
        nodes: of the wires, from the tip on, LPS mm of the CT.
        velocity: of the nodes, mm/s.
        inserted_length: Δ of each, mm.
    """

    anatomy: Anatomy
    device: Wire
    imager: XrayImager
    angles_deg: tuple[tuple[float, float], tuple[float, float]]
    pose: Pose
    planes: tuple[Plane, ...]
    nodes: Float[np.ndarray, "wires n 3"]
    velocity: Float[np.ndarray, "wires n 3"]
    inserted_length: Float[np.ndarray, "wires"]

    def view(self, index: int) -> View:
        """Return a view as the C-arm's angles give it, before registration."""
        return view_at(self.angles_deg[index], self.imager.isocenter, self.imager.config.geometry)

    def signals(
        self, wire: int | None, *, contrast: float = 0.0, dose: float = 1.0, seed: int = 0
    ) -> tuple[Signal, ...]:
        """Return what the detector reads in each view.

        Args:
            wire: which of the wires; none if not given.
            contrast: share of the full contrast in the vessel.
            dose: multiple of the usual dose.
            seed: of the noise.
        """
        nodes = self.nodes[wire] if wire is not None else np.zeros((0, 3))
        velocity = self.velocity[wire] if wire is not None else np.zeros((0, 3))
        weight, earlier = self.imager.config.temporal_weight, 0
        if weight > 0:  # images before, of a wire on its way, until they count for nothing
            earlier = int(np.ceil(np.log(_FORGOTTEN) / np.log(weight)))
        signals: list[Signal | None] = [None] * len(self.planes)
        for back in reversed(range(earlier + 1)):
            for index, plane in enumerate(self.planes):
                signals[index] = self.imager.signal(
                    plane,
                    nodes - back * _FRAME_S * velocity,
                    contrast=contrast,
                    dose=dose,
                    seed=2 * seed + index + back * _EARLIER_SEED,
                    velocity=velocity if wire is not None else None,
                    before=signals[index],
                )
        return tuple(signal for signal in signals if signal is not None)


def draw_scenes(config: SceneConfig, image: ImageConfig | None = None) -> Iterator[Scene]:
    """Yield one patient after another.

    Args:
        config: patients, poses and angles.
        image: detector and beam.

    Raises:
        InputError: a given folder holds no anatomy.
    """
    patients = len(config.given) or config.patients
    with progress("Patients on the table", patients) as advance:
        for index in range(patients):
            yield draw_scene(config, index, image)
            advance()


def draw_scene(config: SceneConfig, index: int, image: ImageConfig | None = None) -> Scene:
    """Return one patient of `draw_scenes`, by its number."""
    device, random = read_wire(config.device), np.random.default_rng([config.seed, index, 0x7363656E])
    atlas = AtlasConfig(vessel=("rca", "lca")[index % 2], seed=config.seed)
    anatomy = read_anatomy(config.given[index]) if config.given else make_patient(atlas, index)
    imager = XrayImager(anatomy, device, ct=surroundings(anatomy), config=image)
    angles = config.view_angles_deg[index // 2 % len(config.view_angles_deg)]
    pose = Pose.draw(random)
    planes = tuple(imager.plane(angle, pose=pose) for angle in angles)
    nodes, velocity, inserted = _wires(anatomy, device, int(random.integers(2**31)))
    return Scene(anatomy, device, imager, angles, pose, planes, nodes, velocity, inserted)


def _wires(anatomy: Anatomy, device: Wire, seed: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return nodes and velocities of the wires of random navigations, and their inserted lengths, mixed up."""
    deepest = _DEEPEST_SHARE * float(anatomy.tree.longest_path().abscissa[-1])
    initial, control = random_controls(
        ControlConfig(), n_sequences=_SEQUENCES, n_samples=_SAMPLES, seed=seed, max_inserted_length_mm=deepest
    )
    rollout = simulate(anatomy, device, control, initial=initial, record_shape=True)
    assert rollout.shape is not None
    period = rollout.period_s
    velocity = np.gradient(rollout.shape, period, axis=1)
    used: np.ndarray = rollout.valid & (rollout.inserted_length[..., 0] > 2.0)
    used[:, :_FIRST_SAMPLE] = False
    world, sample = np.nonzero(used)
    order = np.random.default_rng(seed).permutation(len(world))
    world, sample = world[order], sample[order]
    return rollout.shape[world, sample], velocity[world, sample], rollout.inserted_length[world, sample, 0]
