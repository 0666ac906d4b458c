"""Measures how far wires displace a compliant wall, for the table of docs/evidence/physics.md."""

from __future__ import annotations

import sys
import warnings
from pathlib import Path

import numpy as np
from jaxtyping import Float

sys.path.append(str(Path(__file__).parents[2]))  # where `benchmarks` is

from benchmarks.figures import fill
from endopilot.anatomy.distance import sample
from endopilot.atlas.atlas import AtlasConfig, make_patient
from endopilot.devices.device import Wire, read_wire
from endopilot.simulation.config import SimulatorConfig
from endopilot.simulation.controls import ControlConfig, random_controls
from endopilot.simulation.rod import lay_out
from endopilot.simulation.simulate import simulate
from endopilot.simulation.trajectory import Trajectory
from endopilot.types import Anatomy

HEAD = (
    "| patient, wire | wall | displacement, 99th percentile, mm | largest, mm | "
    "wall's force, median of the largest, N | largest push, N | valid |"
)
PATIENTS, SEQUENCES = (0, 1, 2, 3), 8
STIFFNESS_N_MM2 = (None, 0.05, 0.01)


def displaced_mm(
    patient: Anatomy, wire: Wire, rollout: Trajectory, config: SimulatorConfig
) -> Float[np.ndarray, "worlds samples"]:
    """Return by how much the wire displaces the wall at most, mm, at each sample."""
    assert rollout.shape is not None
    behind = lay_out(wire, element_mm=config.element_mm, length_mm=400.0).abscissa_mm[: rollout.shape.shape[2]]
    distance = sample(patient.distance_map, rollout.shape.reshape(-1, 3)).reshape(rollout.shape.shape[:3])
    ahead = behind < rollout.inserted_length - 1.0
    return np.where(ahead, np.maximum(wire.tip_radius_mm - distance, 0.0), 0.0).max(axis=-1)


def main() -> None:
    """Write the table."""
    rows = [HEAD, "|---|---|---|---|---|---|---|"]
    for number in PATIENTS:
        patient = make_patient(AtlasConfig(), number)
        longest = float(patient.tree.longest_path().abscissa[-1])
        start, control = random_controls(
            ControlConfig(), n_sequences=SEQUENCES, n_samples=60, seed=5, max_inserted_length_mm=0.9 * longest
        )
        for name in ("workhorse-014", "stiff-014"):
            wire = read_wire(name)
            for stiffness in STIFFNESS_N_MM2:
                config = SimulatorConfig(compliant_wall_n_mm2=stiffness)
                with warnings.catch_warnings():
                    warnings.simplefilter("ignore")  # the table counts worlds that fail
                    rollout = simulate(patient, wire, control, initial=start, config=config, record_shape=True)
                valid = rollout.valid
                displaced = displaced_mm(patient, wire, rollout, config)[valid]
                strongest = np.where(valid, rollout.wall_force, 0.0).max(axis=1)
                rows.append(
                    f"| {number}, {name} | {'rigid' if stiffness is None else f'{stiffness:g} N/mm²'} "
                    f"| {np.percentile(displaced, 99):.2f} | {displaced.max():.2f} "
                    f"| {np.median(strongest):.3f} | {rollout.base_force[valid].max():.3f} "
                    f"| {valid[:, -1].sum()} of {len(valid)} |"
                )
                print(rows[-1], flush=True)
    fill("evidence/physics.md", "yielding", rows)


if __name__ == "__main__":
    main()
