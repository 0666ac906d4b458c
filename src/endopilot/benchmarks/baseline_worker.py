"""Simulates worlds with an older build of endopilot; run by `Baseline` as a script, apart from today's package.

Arguments: the build's folder and, as JSON, kinds of patients, seed, device, worlds and samples. For each line read, it
simulates them all on one thread and prints the processor time, s. It uses only what the older build has; its
patients are those that are called textbook today.
"""

from __future__ import annotations

import json
import sys
import time
from pathlib import Path

import endopilot
from endopilot.atlas.atlas import AtlasConfig, make_patient
from endopilot.devices.device import read_device
from endopilot.simulation.config import SimulatorConfig
from endopilot.simulation.controls import ControlConfig, random_controls
from endopilot.simulation.simulate import simulate


def main(folder: str, work: dict) -> None:
    """Make the scenes and simulate them whenever a line comes in."""
    assert Path(folder).resolve() in Path(endopilot.__file__).resolve().parents, "another endopilot comes first"
    scenes = []
    for place, kind in enumerate(work["kinds"]):
        anatomy = make_patient(AtlasConfig(anatomy=kind, seed=work["seed"]), 0)
        initial, control = random_controls(
            ControlConfig(),
            n_sequences=work["worlds"],
            n_samples=work["samples"],
            seed=work["seed"],
            max_inserted_length_mm=float(anatomy.tree.longest_path().abscissa[-1]),
            first=place * work["worlds"],
        )
        scenes.append((anatomy, read_device(work["device"]), initial, control))
    for _ in sys.stdin:
        started = time.process_time()
        for anatomy, device, initial, control in scenes:
            simulate(anatomy, device, control, initial=initial, config=SimulatorConfig(threads=1))
        print(time.process_time() - started, flush=True)


if __name__ == "__main__":
    main(sys.argv[1], json.loads(sys.argv[2]))
