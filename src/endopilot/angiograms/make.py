"""Angiograms of many patients, with the truth beside each frame: `make_angiograms`.

A patient's vessel and CT are one folder, and a cine is one. Each is written under a temporary name and renamed when
whole, and follows from the settings, the patient and the cine's number alone; so a run that was killed goes on with
whole folders, and ends with the same bits as one that was not.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from endopilot.angiograms.config import CARD_FILE, MANIFEST_FILE, SAMPLES_FILE, AngiogramsConfig, Layout, lay_out
from endopilot.angiograms.draw import view_text
from endopilot.angiograms.masks import CLASSES
from endopilot.angiograms.write import COCO_FILE, RECORD_FILE, coco, write_cine, write_patient
from endopilot.dataset.layout import SPLITS
from endopilot.devices.device import Wire
from endopilot.devices.stack import Stack
from endopilot.extras import require_extras
from endopilot.files import manifest, read_json, write_json, writing
from endopilot.parallel import Workers
from endopilot.progress import progress
from endopilot.runs import claim, make_missing

_SHOWN = 12
_COLUMNS = 4
_COLOURS = {
    "contrast": (0, 114, 178),
    "vessel": (86, 180, 233),
    "guide": (240, 228, 66),
    "catheter": (0, 158, 115),
    "wire": (213, 94, 0),
}
_OPACITY = 0.5

_CARD = """---
pretty_name: Angiograms with the truth in them
task_categories: [image-segmentation, keypoint-detection]
tags: [x-ray, angiography, guidewire, simulated]
---

# Angiograms with the truth in them

{cines} cines of {frames} frames at {rate} frames a second, {pixels} × {pixels} pixels. Patients: {patients}.
Simulated by endopilot {version}; no patient was exposed. Devices: {devices}. With contrast: {injected} cines; with
devices: {driven}.

![Frames, and their masks](samples.png)

| split | patients | cines | frames |
| --- | --- | --- | --- |
{splits}

Splits are by patient. Seed {seed}. `manifest.json` holds all settings; `run.json` what the content follows from.

| file | holds |
| --- | --- |
| `annotations/SPLIT.json` | COCO: a mask of every class, and the keypoints of the devices, for every frame |
| `cines/NAME/cine.dcm` | DICOM X-ray angiographic image, multi-frame, 12 bits |
| `cines/NAME/frames/0000.png` | the same as a monitor shows it, 8 bits |
| `cines/NAME/masks/0000.png` | masks as bits: {bits} |
| `cines/NAME/truth.npz` | projection, motion, centerlines, device axes and keypoints, mm and pixels (column, row) |
| `cines/NAME/cine.json` | view, pose, dose, injection, motion, section names |
| `cines/NAME/coco.json` | what `annotations` holds of this cine |
| `patients/NAME/` | the vessel as `endopilot anatomy` writes it, and the CT that the X-rays pass |

For research and teaching. The images are simulated: the documentation of `endopilot angiograms` lists what they lack.
Who may use them depends on the CTs that they were made of.
"""


def describe(layout: Layout) -> None:
    """Write what describes a data set whose cines are there; the manifest comes last."""
    records = [read_json(folder / RECORD_FILE) for folder in layout.cines]
    for split in SPLITS:
        folders = [folder for folder, record in zip(layout.cines, records, strict=True) if record["split"] == split]
        if folders:
            about = f"endopilot angiograms, split {split}"
            parts = (read_json(folder / COCO_FILE) for folder in folders)
            write_json(layout.annotations(split), coco(parts, about), indented=False)
    _write_samples(layout, records)
    counts = _counts(layout, records)
    card = _card(layout, records, counts)
    with writing(layout.output / CARD_FILE) as partial:
        partial.write_text(card, encoding="utf-8")
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


def _counts(layout: Layout, records: Sequence[dict[str, Any]]) -> dict[str, dict[str, int]]:
    patients, cines = Counter(layout.splits), Counter(record["split"] for record in records)
    return {
        split: {"patients": patients[split], "cines": cines[split], "frames": cines[split] * layout.config.frames}
        for split in SPLITS
        if patients[split]
    }


def _card(layout: Layout, records: Sequence[dict[str, Any]], counts: dict[str, dict[str, int]]) -> str:
    config = layout.config
    return _CARD.format(
        cines=len(records),
        frames=config.frames,
        rate=config.frames_per_second,
        pixels=config.image.pixels,
        patients=len(layout.names),
        version=layout.settings["version"].removeprefix("endopilot "),
        devices=layout.stack.name,
        injected=sum(record["injection"] is not None for record in records),
        driven=sum(bool(record["devices"]) for record in records),
        splits="\n".join(f"| {s} | {n['patients']} | {n['cines']} | {n['frames']} |" for s, n in counts.items()),
        seed=config.seed,
        bits=", ".join(f"{bit} {name}" for name, bit in CLASSES.items()),
    )


def _write_samples(layout: Layout, records: Sequence[dict[str, Any]]) -> None:
    """Write a picture of some frames, each beside the same with its masks."""
    from matplotlib.figure import Figure  # slow to import

    chosen = np.unique(np.linspace(0, len(records) - 1, min(_SHOWN, len(records))).astype(int))
    columns = min(_COLUMNS, len(chosen))
    rows = -(-len(chosen) // columns)
    figure = Figure(figsize=(4.4 * columns, 2.45 * rows), layout="constrained")
    axes = np.atleast_1d(np.asarray(figure.subplots(rows, columns))).ravel()
    for place, index in zip(axes, chosen, strict=False):
        folder, record = layout.cines[index], records[index]
        injection, rate, last = record["injection"], record["frames_per_second"], record["frames"] - 1
        shown = last if injection is None else round((injection["start_s"] + injection["duration_s"]) * rate)
        place.imshow(_beside(folder, min(shown, last)))
        view = view_text(record["view_angles_deg"])
        place.set_title(f"{folder.name}: {view}, {record['split']}", fontsize=8)
    for place in axes:
        place.axis("off")
    with writing(layout.output / SAMPLES_FILE) as partial:
        figure.savefig(partial, dpi=110)


def _beside(folder: Path, number: int) -> np.ndarray:
    """Return a frame, and to its right the same with its masks, as colours."""
    grey, masks = (np.asarray(Image.open(folder / part / f"{number:04d}.png")) for part in ("frames", "masks"))
    plain = np.repeat(grey[..., None], 3, axis=-1)
    coloured = plain.astype(float)
    for name in ("vessel", "contrast", "guide", "catheter", "wire"):
        inside = (masks & CLASSES[name]) > 0
        coloured[inside] = (1 - _OPACITY) * plain[inside] + _OPACITY * np.array(_COLOURS[name])
    return np.concatenate([plain, coloured.astype(np.uint8)], axis=1)


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
    described = [layout.output / name for name in (MANIFEST_FILE, CARD_FILE, SAMPLES_FILE)]
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
    from endopilot.dataset.workers import run_on_cluster  # brings the libraries of data sets

    remote = replace(
        layout,
        output=layout.output.resolve(),
        sources=tuple(source.resolve() for source in layout.sources),
    )
    missing = [path.resolve() for path in paths if not path.exists()]
    with progress(title, len(missing)) as advance:
        run_on_cluster(partial(work, remote), missing, lambda path, _: advance(remark=path.name), where)
