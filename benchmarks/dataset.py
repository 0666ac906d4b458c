"""Time and size of the paper's full dataset, extrapolated from a part of it: `bench_dataset`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

from endopilot.anatomy.io import write_anatomy
from endopilot.atlas.atlas import AtlasConfig, make_patient
from endopilot.dataset.config import DatasetConfig
from endopilot.dataset.generate import generate_dataset
from endopilot.dataset.schema import MANIFEST_PATH
from endopilot.devices.device import read_wire
from endopilot.errors import InputError
from endopilot.files import processor_name, read_json
from endopilot.progress import progress
from endopilot.runs import OutputFolder, claim
from endopilot.settings import Within

PAPER_ANATOMIES, PAPER_SEQUENCES = 100, 1000
"""Kim et al. 2023: random navigations of 60 s in each of 100 anatomies."""
CORES = 2
"""Cores that the time of the full set is extrapolated to."""
AboveZero = Annotated[float, Within(0, 1, above_low=True)]
_DEVICE = "workhorse-014"


def bench_dataset(*, output: OutputFolder = Path("runs/bench-dataset"), share: AboveZero = 0.05) -> dict[str, Any]:
    """Make a share of the paper's set of 100 000 navigations, and extrapolate time and size of all of it.

    The part consists of whole files: 500 navigations of 60 s in each of some anatomies. An interrupted run goes on
    where it stopped; a finished one returns at once.

    Args:
        output: folder of this share, anatomies and dataset; an interrupted run goes on where it stopped.
        share: share of the paper's set, above 0, at most 1.

    Returns:
        What was measured: `navigations`, `samples`, `measured_share` of the full set, `processor_seconds`,
        `wall_seconds`, `simulated_seconds_per_processor_second`, `samples_per_processor_second`, `bytes_per_sample`,
        `invalid_navigations`; and extrapolated to the full set:
        `full_set_samples`, `extrapolated_minutes_on_2_cores` (from processor time), and `extrapolated_gigabytes`.

    Raises:
        InputError: the folder belongs to another run.
    """
    size = DatasetConfig().sequences_per_file
    count = max(1, round(share * PAPER_ANATOMIES * PAPER_SEQUENCES / size))
    claim(output, "python -m benchmarks dataset", share=share)
    folders = [output / "anatomies" / f"rca-{index:04d}" for index in range(count)]
    with progress("Synthetic patients", count) as advance:
        for index, folder in enumerate(folders):
            if not (folder / "anatomy.json").exists():
                write_anatomy(make_patient(AtlasConfig(count=count), index), output=folder)
            advance()
    config = DatasetConfig(sequences=size, anatomy_shares=(1.0, 0.0, 0.0))
    generate_dataset(folders, output=output / "dataset", device=read_wire(_DEVICE), config=config)
    record = read_json(output / "dataset" / MANIFEST_PATH)
    work, files = record["work"], [file for file in (output / "dataset").rglob("*") if file.is_file()]
    if not work["samples"]:
        raise InputError(f"{output}: was finished by a run that simulated nothing; choose another folder")
    samples = count * size * config.samples
    full = PAPER_ANATOMIES * PAPER_SEQUENCES * config.samples
    cost, stored = work["processor_seconds"] / work["samples"], sum(file.stat().st_size for file in files) / samples
    return {
        "processor": processor_name(),
        "navigations": count * size,
        "samples": samples,
        "measured_share": samples / full,
        "processor_seconds": round(work["processor_seconds"], 1),
        "wall_seconds": round(work["wall_seconds"], 1),
        "simulated_seconds_per_processor_second": round(config.seconds / config.samples / cost, 1),
        "samples_per_processor_second": round(1 / cost, 1),
        "bytes_per_sample": round(stored, 2),
        "invalid_navigations": record["invalid"]["episodes"],
        "full_set_samples": full,
        "extrapolated_minutes_on_2_cores": round(full * cost / CORES / 60, 1),
        "extrapolated_gigabytes": round(full * stored / 1e9, 3),
    }
