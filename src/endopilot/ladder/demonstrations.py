"""Recorded navigations of the ladder as a LeRobot data set with X-ray images: `write_demonstrations`."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pyarrow as pa

from endopilot.dataset import parquet, schema
from endopilot.devices.stack import column_prefixes, lines_from_tips
from endopilot.env.exposures import Views
from endopilot.errors import InputError
from endopilot.files import manifest, png_image, sha256, write_json, write_whole
from endopilot.ladder.attempt import Recording, begun, navigation_seed
from endopilot.ladder.submission import Submission, read_submission
from endopilot.progress import progress
from endopilot.runs import claim
from endopilot.tasks.task import Task
from endopilot.types import SAMPLE_PERIOD_S
from endopilot.xray.fluoroscope import FluoroscopeConfig

PIXELS = 128
"""Columns and rows of an image."""
_C_ARM = FluoroscopeConfig()
_VIEWS = tuple(f"observation.images.view_{1 + k}" for k in range(1 + _C_ARM.biplane))
_AT_DRIVE = ("inserted_length_mm", "rotation_rad", "drive_force_n", "drive_torque_nmm")
_CHANNELS = 3
"""Of an image, all alike: networks that were trained on photographs take three."""


def write_demonstrations(submission: str | Path, *, output: str | Path) -> dict[str, Any]:
    """Drive the navigations of a submission again, and write what was seen and decided as a LeRobot v3 data set.

    An episode is a navigation, a sample a decision, two a second; docs/concepts/dataset.md describes the columns. The
    folder and numbers are returned. InputError where the file is no submission, its tasks have different numbers of
    devices, or the folder holds something else.
    """
    path, output = Path(submission), Path(output)
    read, key = read_submission(path), sha256(path)
    tasks = [read.terms.task(name) for name in read.navigations]
    if len(number := {1 + bool(task.catheter) for task in tasks}) > 1:
        raise InputError(f"{path}: some tasks are of a wire alone and some have a catheter; give one kind")
    described = _features(*number)
    claim(output, "endopilot ladder", submission=key)
    chosen = [(task, place) for task in tasks for place in range(len(read.navigations[task.name]))]
    titles = list(dict.fromkeys(task.title for task in tasks))
    sums, samples, exposures = parquet.Sums(), 0, 0
    with progress("Writing the data set", total=len(chosen)) as advance:
        for episode, (task, place) in enumerate(chosen):
            columns, about = _navigation(read, task, place)
            count = len(columns["action"])
            columns |= {
                "timestamp": np.arange(count) * SAMPLE_PERIOD_S,
                "index": samples + np.arange(count),
                "episode_index": np.full(count, episode),
                "frame_index": np.arange(count),
                "task_index": np.full(count, titles.index(task.title)),
            }
            chunk, file = divmod(episode, schema.FILES_PER_CHUNK)
            row = {"episode_index": episode, "tasks": [task.title], "length": count}
            row |= {"dataset_from_index": samples, "dataset_to_index": samples + count}
            row |= {"data/chunk_index": chunk, "data/file_index": file} | about
            row |= {"meta/episodes/chunk_index": chunk, "meta/episodes/file_index": file}
            stored = {name: _column(columns[name], each) for name, each in described.items()}
            rows = {name: [value] for name, value in row.items()}
            parquet.write_tables(output, episode, key, episodes=rows, samples=stored)
            for name, values in columns.items():
                white = np.concatenate([image.reshape(-1) for image in values]) / 255 if name in _VIEWS else None
                sums.add(name, np.asarray(values) if white is None else white)
            samples, exposures = samples + count, exposures + int(columns["exposed"].sum())
            advance()
    stats: dict[str, Any] = sums.stats()
    for name in _VIEWS:  # a row and a column, both of 1, for each channel
        low_to_std = {key: [[value] for value in values] for key, values in stats[name].items() if key != "count"}
        stats[name] |= {key: [value] * _CHANNELS for key, value in low_to_std.items()}
    write_json(output / schema.STATS_PATH, stats)
    tasks = pd.DataFrame({"task_index": range(len(titles))}, index=pd.Index(titles, name="task"))
    write_whole(output / schema.TASKS_PATH, tasks.to_parquet())
    about = schema.info(described, episodes=len(chosen), samples=samples, tasks=len(titles))
    write_json(output / schema.INFO_PATH, about)
    write_json(output / schema.MANIFEST_PATH, manifest(config=None, inputs={path.name: key}, policy=read.policy))
    return {"dataset": output, "episodes": len(chosen), "samples": samples, "exposures": exposures}


def _features(devices: int) -> dict[str, Any]:
    """Return the `features` entry of `meta/info.json`."""
    prefixes = column_prefixes(devices)
    vectors = {
        "observation.state": [*(p + name for p in prefixes for name in _AT_DRIVE), "exposure_age_s"],
        "action": [*(p + name for p in prefixes for name in schema.VELOCITY), "expose"],
    }
    image = {"dtype": "image", "shape": [PIXELS, PIXELS, _CHANNELS], "names": ["height", "width", "channels"]}
    scalar = {"shape": [1], "names": None}
    return {
        "timestamp": {"dtype": "float32", **scalar},
        **{name: {"dtype": "int64", **scalar} for name in schema.INDEX_COLUMNS},
        **{name: {"dtype": "float32", "shape": [len(of)], "names": of} for name, of in vectors.items()},
        **dict.fromkeys(_VIEWS, image),
        "exposed": {"dtype": "bool", **scalar},
        **{name: {"dtype": "float32", **scalar} for name in ("contact_force_max_n", "next.reward")},
        **{name: {"dtype": "bool", **scalar} for name in ("next.done", "next.success")},
    }


def _navigation(submission: Submission, task: Task, place: int) -> tuple[dict[str, Any], dict[str, Any]]:
    """Drive a navigation again, and return its columns and what the episode table says of it."""
    packed = submission.navigations[task.name][place].recording
    navigation, seed = task.ladder_navigation(place), navigation_seed(task, place)
    recording = Recording.unpacked(vars(packed), len(navigation.devices), submission.terms)
    loop = begun(recording, navigation, seed=seed)
    views = Views(navigation, loop.simulator.set_up.anatomies[0], _C_ARM, PIXELS)
    record = loop.run()
    count = len(record.control) - 1
    random, images = np.random.default_rng([seed, 7]), []
    exposed = np.flatnonzero(record.exposed[:count] | (np.arange(count) == 0))
    for at in exposed.tolist():
        nodes = record.shape[at] + np.asarray(loop.world.registration_mm)
        devices = lines_from_tips(nodes[np.isfinite(nodes[:, 0])], record.inserted_length[at])
        images.append(views.image(devices, random))
    shown = np.searchsorted(exposed, np.arange(count), side="right") - 1
    age_s = (np.arange(count) - exposed[shown]) * SAMPLE_PERIOD_S
    drives = np.concatenate([record.encoders[:count], record.load[:count]], axis=-1).reshape(count, -1)
    asked, last = np.append(record.exposed[1:count], False), np.arange(count) == count - 1
    columns = {
        "observation.state": np.column_stack([drives, age_s]),
        "action": np.column_stack([record.control[:count].reshape(count, -1), asked]),
        "exposed": record.exposed[:count],
        "contact_force_max_n": record.contact_force_max[1:],
        "next.reward": last * float(record.success and record.safe),
        "next.done": last,
        "next.success": last & record.success,
        **{name: [images[of][k] for of in shown] for k, name in enumerate(_VIEWS)},
    }
    names = ("success", "safe", "reason", "peak_force_n", "exposures")
    about = {"ladder_task": task.name, "anatomy": navigation.anatomy.name, "seed": seed}
    return columns, about | {name: getattr(record, name) for name in names}


_IMAGE = pa.struct([("bytes", pa.binary()), ("path", pa.string())])


def _column(values: Any, feature: Mapping[str, Any]) -> pa.Array:
    if feature["dtype"] == "image":
        files = {id(image): png_image(np.repeat(image[..., None], 3, axis=-1)) for image in values}
        return pa.array([{"bytes": files[id(image)], "path": None} for image in values], _IMAGE)
    return parquet.column(np.asarray(values), feature["dtype"], feature["names"])
