"""Speed of `make_angiograms`, what takes its time, and how much its cines look like real ones: `bench_angiograms`."""

from __future__ import annotations

import cProfile
import pstats
import resource
import shutil
import time
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any

from benchmarks.figures import Bar, judged
from benchmarks.imaging.angiogram_looks import body_beyond, looks
from endopilot.anatomy.io import write_anatomy
from endopilot.angiograms.config import AngiogramsConfig, lay_out
from endopilot.angiograms.make import make_angiograms
from endopilot.angiograms.write import write_cine
from endopilot.atlas.atlas import AtlasConfig, make_patient
from endopilot.devices.stack import Stack
from endopilot.errors import InputError
from endopilot.files import processor_name
from endopilot.runs import OutputFolder
from endopilot.settings import Within

CORES = 2
BARS = {"frames_per_second_on_2_cores": Bar(20.0, at_least=True)}
_DEVICE, _PATIENTS = "workhorse-014", 70
"""The wire, and the patients' seed, to which that of the data set is added."""
_PARTS = {
    "cast rays through the CT": "patient",
    "lumen and contrast": "of",
    "fine branches": "grow",
    "beam and harmonisation": "harmonised",
    "guiding catheter, and contrast in it": "cloud",
    "wire": "wire",
    "light and noise, with the wire": "signal",
    "simulate the devices": "drive_devices",
    "read the patient": "_imager",
    "masks of devices": "_device_masks",
    "COCO": "frame_entries",
    "PNG": "png_image",
    "DICOM": "write_xa",
}


def bench_angiograms(
    *,
    output: OutputFolder = Path("runs/bench-angiograms"),
    patients: Annotated[int, Within(1, 100)] = 4,
    config: AngiogramsConfig = AngiogramsConfig(cines=4),
) -> dict[str, Any]:
    """Make angiograms of synthetic patients with all that is written beside them, and say what takes the time.

    Args:
        output: a new folder.
        patients: right and left coronary trees in turn.
        config: of the data set.

    Returns:
        `frames_per_second_on_2_cores`, extrapolated from the processor time of everything, the patients' chests
        included, with its bar; `looks` beside real cines; `body_beyond_ct`, as `body_beyond` has it;
        `processor_ms_a_frame`, `wall_seconds`, `megabytes_a_frame`; and `parts_ms_a_frame`, measured in one more cine
        by a profiler, which slows it; parts overlap where one calls the other.

    Raises:
        InputError: the folder is there already.
    """
    if output.exists():
        raise InputError(f"{output}: is there already; remove it, or choose another folder")
    folders = []
    for index in range(patients):
        anatomy = make_patient(AtlasConfig(vessel=("rca", "lca")[index % 2], seed=_PATIENTS + config.seed), index)
        folders.append(output / "anatomies" / anatomy.name)
        write_anatomy(anatomy, output=folders[-1])
    if config.anatomy_shares is None and patients < 3:
        config = replace(config, anatomy_shares=(1.0, 0.0, 0.0))
    made, begin = output / "angiograms", time.perf_counter()
    spent = -_processor_s()
    make_angiograms(folders, output=made, device=_DEVICE, config=config)
    spent += _processor_s()
    wall_s = time.perf_counter() - begin
    frames = patients * config.cines * config.frames
    size = sum(file.stat().st_size for file in (made / "cines").rglob("*") if file.is_file())
    return {
        "processor": processor_name(),
        "frames": frames,
        **judged({"frames_per_second_on_2_cores": CORES * frames / spent}, BARS),
        "processor_ms_a_frame": round(1000 * spent / frames, 1),
        "wall_seconds": round(wall_s, 1),
        "megabytes_a_frame": round(size / frames / 1e6, 3),
        "looks": looks(sorted((made / "cines").iterdir())),
        "body_beyond_ct": body_beyond(),
        "parts_ms_a_frame": _parts(folders, made, config),
    }


def _processor_s() -> float:
    """Return the processor time of this process, and of those that it started and that have ended, s."""
    used = [resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)]
    return sum(one.ru_utime + one.ru_stime for one in used)


def _parts(folders: list[Path], made: Path, config: AngiogramsConfig) -> dict[str, float]:
    """Return processor time by part, ms a frame, of the first cine."""
    layout = lay_out(folders, made, Stack.of(_DEVICE), config)
    first = layout.cines[0]
    shutil.rmtree(first)
    profile = cProfile.Profile(time.process_time)
    profile.runcall(write_cine, layout, first)
    stats: Any = pstats.Stats(profile).stats  # pyright: ignore[reportAttributeAccessIssue]
    took = {}
    for (_, _, function), (_, _, _, seconds, _) in stats.items():
        took[function] = took.get(function, 0.0) + seconds
    return {title: round(1000 * took.get(function, 0.0) / config.frames, 1) for title, function in _PARTS.items()}
