"""Angiograms of many patients, with the truth beside each frame: `make_angiograms`.

A patient's vessel and CT are one folder, and a cine is one. Each is written under a temporary name and renamed when
whole, and follows from the settings, the patient and the cine's number alone; so a run that was killed goes on with
whole folders, and ends with the same bits as one that was not.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from endopilot.angiograms.cine import CLASSES
from endopilot.angiograms.config import MANIFEST_FILE, SAMPLES_FILE, AngiogramsConfig, Layout, lay_out
from endopilot.angiograms.write import COCO_FILE, RECORD_FILE, coco, write_cine, write_patient
from endopilot.dataset.layout import SPLITS
from endopilot.devices.device import Wire
from endopilot.devices.stack import Stack
from endopilot.extras import require_extras
from endopilot.files import manifest, read_json, write_json, writing
from endopilot.parallel import Workers
from endopilot.progress import progress
from endopilot.runs import claim, make_missing

_SHOWN, _COLUMNS = 12, 4
_COLOURS = {
    "vessel": (86, 180, 233),
    "contrast": (0, 114, 178),
    "guide": (240, 228, 66),
    "catheter": (0, 158, 115),
    "wire": (213, 94, 0),
}


def describe(layout: Layout) -> None:
    """Write what describes a data set whose cines are there; the manifest comes last."""
    records = [read_json(folder / RECORD_FILE) for folder in layout.cines]
    counts: dict[str, dict[str, int]] = {}
    for split in SPLITS:
        folders = [folder for folder, record in zip(layout.cines, records, strict=True) if record["split"] == split]
        if folders:
            parts = (read_json(folder / COCO_FILE) for folder in folders)
            path = layout.output / "annotations" / f"{split}.json"
            write_json(path, coco(parts, f"endopilot angiograms, split {split}"), indented=False)
            frames = len(folders) * layout.config.frames
            counts[split] = {"patients": layout.splits.count(split), "cines": len(folders), "frames": frames}
    with writing(layout.output / SAMPLES_FILE) as partial:
        _samples(layout, records).save(partial, format="png")
    record = manifest(
        config=layout.config,
        seed=layout.config.seed,
        inputs=layout.settings["patients"],
        key=layout.key,
        settings=layout.settings,
        splits=counts,
        motions_redrawn=sum(record["motions_redrawn"] for record in records),
    )
    write_json(layout.output / MANIFEST_FILE, record)


def _samples(layout: Layout, records: Sequence[dict[str, Any]]) -> Image.Image:
    """Return some frames at the end of their injection, each beside the same with its masks as colours."""
    chosen = np.unique(np.linspace(0, len(records) - 1, min(_SHOWN, len(records))).astype(int))
    side, columns = records[0]["pixels"], min(_COLUMNS, len(chosen))
    sheet = np.zeros((-(-len(chosen) // columns) * side, 2 * columns * side, 3), dtype=np.uint8)
    for place, index in enumerate(chosen):
        injection = records[index]["injection"] or {"start_s": 0, "duration_s": layout.config.seconds}
        shown = (injection["start_s"] + injection["duration_s"]) * layout.config.frames_per_second
        name = f"{min(round(shown), layout.config.frames - 1):04d}.png"
        grey, masks = (np.asarray(Image.open(layout.cines[index] / part / name)) for part in ("frames", "masks"))
        plain = np.repeat(grey[..., None], 3, axis=-1)
        coloured = plain.copy()
        for kind, colour in _COLOURS.items():
            inside = (masks & CLASSES[kind]) > 0
            coloured[inside] = plain[inside] // 2 + np.array(colour, dtype=np.uint8) // 2
        row, column = place // columns * side, place % columns * 2 * side
        sheet[row : row + side, column : column + 2 * side] = np.concatenate([plain, coloured], axis=1)
    return Image.fromarray(sheet)


def make_angiograms(
    anatomies: Sequence[str | Path],
    *,
    output: str | Path,
    device: Wire | Stack | str | Path = "workhorse-014",
    config: AngiogramsConfig | None = None,
    scheduler: str | None = None,
) -> None:
    """Make cines of contrast and devices in patients' vessels, with masks, lines, keypoints and poses of each frame.

    A run that was interrupted goes on where it stopped when it is started again with the same arguments; a finished
    one returns at once.

    Args:
        anatomies: folders of anatomies, or CT angiograms, with different names. In an anatomy's folder `ct.nii.gz` is
            what the X-rays pass; without it, it is a synthetic chest around a coronary artery, else 200 mm of water.
        output: folder of the data set.
        device: the wire or its name, or the wire and its catheters.
        config: how many cines, and what they show; the defaults if not given.
        scheduler: address of a Dask scheduler whose workers make the cines; the cores of this machine if not given.

    Raises:
        InputError: an input that is neither, a CT in which no vessel is found, two patients of one name, too few for
            the splits, an output folder that holds something else or was begun with other settings, devices that do
            not fit, no such policy, or a scheduler that cannot be reached.
    """
    require_extras("imaging")
    layout = lay_out([Path(path) for path in anatomies], Path(output), Stack.of(device), config or AngiogramsConfig())
    claim(layout.output, "endopilot angiograms", **layout.settings)
    described = [layout.output / name for name in (MANIFEST_FILE, SAMPLES_FILE)]
    if all(path.exists() for path in (*described, *layout.patients, *layout.cines)):
        return
    (layout.output / MANIFEST_FILE).unlink(missing_ok=True)
    with Workers() as pool:
        where = pool if scheduler is None else scheduler
        _make("Patients", layout.patients, write_patient, layout, where)
        _make("Making cines", layout.cines, write_cine, layout, where)
    describe(layout)


def _make(
    title: str, paths: Sequence[Path], work: Callable[[Layout, Path], None], layout: Layout, where: Workers | str
) -> None:
    """Make the folders that are not there yet, in processes of this machine or on the cluster of a scheduler."""
    if isinstance(where, Workers):
        make_missing(title, paths, partial(work, layout), where if len(paths) > 1 else None)
        return
    from endopilot.dataset.generate import run_on_cluster  # brings the libraries of data sets

    missing = [path for path in paths if not path.exists()]
    with progress(title, len(missing)) as advance:
        run_on_cluster(partial(work, layout), missing, lambda path, _: advance(remark=path.name), where)
