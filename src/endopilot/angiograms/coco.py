"""Keypoints and masks as COCO has them: the entries of a frame (`frame_entries`), and a file of many (`coco`)."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np

from endopilot.angiograms.cine import KEYPOINTS, Cine, CineFrame
from endopilot.angiograms.masks import CLASSES, box_of, encoded

CATEGORIES: tuple[dict[str, Any], ...] = tuple(
    {"id": number, "name": name, "supercategory": "vessel" if name in ("vessel", "contrast") else "device"}
    | (
        {
            "keypoints": list(KEYPOINTS[name]),
            "skeleton": [[k, k + 1] for k in range(1, len(KEYPOINTS[name]))],
        }
        if name in KEYPOINTS
        else {}
    )
    for number, name in enumerate(CLASSES, 1)
)
"""COCO's categories: the masks by name, with the keypoints of the devices. Of several driven catheters, the mask is
that of all, and the keypoints are those of the inner one."""
_SEEN = 2
_MOST_FRAMES = 100_000
"""A cine's images are numbered from its own number times this."""


def frame_entries(
    cine: Cine, frame: CineFrame, image: str, number: int, cine_number: int
) -> tuple[dict[str, Any], list[dict[str, Any]]]:
    """Return a frame's entry in `images`, and its entries in `annotations`; what does not show has none."""
    pixels = len(frame.grey)
    image_id = cine_number * _MOST_FRAMES + number
    annotations, keypoints = [], cine.keypoints(frame)
    for category in CATEGORIES:
        name = category["name"]
        mask = frame.masks.get(name)
        if mask is None or not mask.any():
            continue
        entry = {
            "id": image_id * (len(CATEGORIES) + 1) + category["id"],
            "image_id": image_id,
            "category_id": category["id"],
            "segmentation": encoded(mask),
            "area": int(np.count_nonzero(mask)),
            "bbox": box_of(mask),
            "iscrowd": 0,
        }
        if name in keypoints:
            at = keypoints[name][1]
            shown = np.all((at >= -0.5) & (at < pixels - 0.5), axis=1)  # NaN, beyond the device's end, is not
            entry["keypoints"] = [
                value
                for (column, row), is_shown in zip(at.tolist(), shown.tolist(), strict=True)
                for value in ((round(column, 2), round(row, 2), _SEEN) if is_shown else (0, 0, 0))
            ]
            entry["num_keypoints"] = int(shown.sum())
        annotations.append(entry)
    entry = {"id": image_id, "file_name": image, "width": pixels, "height": pixels, "frame": number}
    return entry, annotations


def coco(parts: Iterable[Mapping[str, Any]], about: str) -> dict[str, Any]:
    """Return one COCO object of those of some cines."""
    parts = list(parts)
    return {
        "info": {"description": about},
        "images": [image for part in parts for image in part["images"]],
        "annotations": [entry for part in parts for entry in part["annotations"]],
        "categories": list(CATEGORIES),
    }
