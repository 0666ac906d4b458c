"""What a data set of angiograms holds: COCO files of its splits, samples to look at, a card and the manifest."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from endopilot.angiograms.coco import coco
from endopilot.angiograms.draw import view_text
from endopilot.angiograms.layout import CARD_FILE, MANIFEST_FILE, SAMPLES_FILE, Layout
from endopilot.angiograms.masks import CLASSES
from endopilot.angiograms.write import COCO_FILE, RECORD_FILE
from endopilot.dataset.splits import SPLITS
from endopilot.files import manifest, read_json, write_json, writing

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
    """Return the numbers of patients, cines and frames of each split."""
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
