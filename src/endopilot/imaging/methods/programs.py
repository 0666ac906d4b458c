"""Segmentation by another program, run as a subprocess with the weights and the licence that its user has.

The program gets the CT in a temporary folder, with no header but its geometry, and writes its labels there. Of
TotalSegmentator (https://github.com/wasserth/TotalSegmentator) `coronary_arteries` needs a licence of the user's own,
`--options task=total structure=aorta` none; nnU-Net v2 (https://github.com/MIC-DKFZ/nnUNet) the user's own model.
"""

from __future__ import annotations

import shutil
import subprocess
import tempfile
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from endopilot.errors import InputError
from endopilot.files import read_json
from endopilot.imaging.geometry import farthest_apart_mm
from endopilot.imaging.grid import mask_like
from endopilot.imaging.segment import SegmentationMethod, SegmentConfig
from endopilot.imaging.volume import SUFFIXES, read_mask, write_volume
from endopilot.progress import progress
from endopilot.types import Insertion, LumenMask, Volume

_SEED_MM = 5.0  # a seed belongs to the lumen within this distance
_MOUTH_MM = 8.0  # the vessel's direction at the first seed is that to the middle of the lumen within this distance
_LONGEST_MESSAGE = 200
_TOTALSEGMENTATOR = {"task": "coronary_arteries", "structure": "", "device": ""}
"""Task (`-ta`); structure whose mask is taken, by default the task's name; device (`-d`): gpu, cpu, gpu:1."""
_NNUNET = {"model": "", "device": "", "label": ""}
"""Folder of the trained model, with dataset.json and fold_0, fold_1, …; device: cuda, cpu, mps; label of the lumen."""


def by_totalsegmentator(volume: Volume, config: SegmentConfig) -> LumenMask:
    """Return the mask of one structure as TotalSegmentator finds it; the first seed, if any, is the ostium. Raises
    InputError if it is missing, fails, or writes no or an empty mask."""
    settings = config.settings(_TOTALSEGMENTATOR)
    task = settings["task"]
    structure = settings["structure"] or task
    chosen = ["--roi_subset", structure] if task == "total" else []
    device = ["--device", settings["device"]] if settings["device"] else []
    return segment_by_program(
        volume,
        config.seeds,
        lambda source, target: [
            *("TotalSegmentator", "-i", str(source / "ct.nii.gz"), "-o", str(target), "--task", task),
            *chosen,
            *device,
            "--quiet",
        ],
        given="ct.nii.gz",
        answer=f"{structure}.nii.gz",
        mend="install TotalSegmentator in an environment of its own, with the task's weights and licence, and see that "
        f"`TotalSegmentator -i ct.nii.gz -o out --task {task}` runs",
    )


def by_nnunet(volume: Volume, config: SegmentConfig) -> LumenMask:
    """Return the lumen as all folds of a trained nnU-Net find it together; the first seed, if any, is the ostium.
    Raises InputError for an unfit model, a missing or failing nnU-Net, or an empty mask."""
    settings = config.settings(_NNUNET)
    model, label = Path(settings["model"]), settings["label"]
    folds = sorted(folder.name.removeprefix("fold_") for folder in model.glob("fold_*")) if settings["model"] else []
    if not folds or not (model / "dataset.json").is_file():
        raise InputError(
            f"options: model={settings['model']!r} holds no trained nnU-Net; give --options model=FOLDER, that with "
            "dataset.json and fold_0, such as …/nnUNetTrainer__nnUNetPlans__3d_fullres"
        )
    if label and not label.isdecimal():
        raise InputError(f"options: label={label!r} is no whole number; give the label of the lumen")
    content = read_json(model / "dataset.json")
    suffix = content.get("file_ending", ".nii.gz") if isinstance(content, dict) else ""
    if suffix not in SUFFIXES:
        raise InputError(f"{model}/dataset.json: file_ending {suffix!r} is unknown; known are {' '.join(SUFFIXES)}")
    return segment_by_program(
        volume,
        config.seeds,
        lambda source, target: [
            *("nnUNetv2_predict_from_modelfolder", "-i", str(source), "-o", str(target), "-m", str(model)),
            *("-f", *folds),
            *(("-device", settings["device"]) if settings["device"] else ()),
            "--disable_progress_bar",
        ],
        given=f"ct_0000{suffix}",
        answer=f"ct{suffix}",
        label=int(label) if label else None,
        mend="install nnunetv2 in an environment of its own, and see that `nnUNetv2_predict_from_modelfolder -m "
        f"{model}` runs; without a GPU, give --options device=cpu",
    )


def segment_by_program(
    volume: Volume,
    seeds: Sequence[tuple[float, float, float]],
    arguments: Callable[[Path, Path], Sequence[str]],
    *,
    given: str,
    answer: str,
    label: int | None = None,
    mend: str,
) -> LumenMask:
    """Return the lumen that a program finds, with the ostium at the first of `seeds` (LPS mm). `arguments` makes the
    command from the folder of the CT, there named `given`, and that of the `answer`; `label` is the lumen's value.
    Raises InputError, with `mend`, if it fails, marks nothing, or a seed lies farther than 5 mm from the lumen."""
    with tempfile.TemporaryDirectory(prefix="endopilot-") as temporary:
        source, target = Path(temporary) / "ct", Path(temporary) / "answer"
        target.mkdir()
        write_volume(volume, source / given)
        command = list(arguments(source, target))
        program = Path(command[0]).name
        with progress(f"Running {program}", 1) as advance:
            _run(command, mend)
            advance()
        file = target / answer
        if not file.exists():
            written = ", ".join(sorted(path.name for path in target.rglob("*") if path.is_file())[:10]) or "nothing"
            raise InputError(f"{program} wrote no {answer} (it wrote {written}); {mend}")
        try:
            found = read_mask(file, label=label)
        except InputError as error:
            reason = str(error).removeprefix(f"{file}: ")
            raise InputError(
                f"{program} wrote a {answer} that is not taken: {reason}; give --options label=NUMBER where there are "
                f"several, or {mend}"
            ) from error
    inside = found.volume.voxels
    if inside.shape != volume.voxels.shape or farthest_apart_mm(found.volume, volume) > volume.spacing_mm.min() / 2:
        inside = mask_like(found, volume)
        if not inside.any():
            raise InputError(f"{program} wrote a mask that lies outside the CT; {mend}")
    on_ct = replace(volume, voxels=inside)
    return LumenMask(on_ct, _ostium_at_seeds(on_ct, seeds) if seeds else None, warnings=found.warnings)


def _ostium_at_seeds(lumen: Volume, seeds: Sequence[tuple[float, float, float]]) -> Insertion:
    points = lumen.index_to_world(np.argwhere(lumen.voxels)[:, ::-1].astype(float))
    for seed in seeds:
        gap = float(np.linalg.norm(points - np.array(seed), axis=1).min())
        if gap > _SEED_MM:
            raise InputError(
                f"seeds: the lumen found is {gap:.0f} mm from {tuple(seed)}; move the seed into it (LPS mm)"
            )
    place = np.array(seeds[0], dtype=float)
    inward = points[np.linalg.norm(points - place, axis=1) < _MOUTH_MM].mean(axis=0) - place
    length = float(np.linalg.norm(inward))
    return Insertion(place, inward / length if length > 1e-6 else np.array([0.0, 0.0, -1.0]))


def _run(command: Sequence[str], mend: str) -> None:
    """Run a program and wait for it; its output is reported only if it fails."""
    program = Path(command[0]).name
    if shutil.which(command[0]) is None:
        raise InputError(f"the program {program} is not on the PATH; {mend}")
    try:
        answer = subprocess.run(
            command, stdin=subprocess.DEVNULL, capture_output=True, text=True, errors="replace", check=False
        )
    except OSError as error:
        raise InputError(f"{program} cannot be run ({error.strerror}); {mend}") from error
    if answer.returncode != 0:
        lines = [line.strip() for line in (answer.stderr + "\n" + answer.stdout).splitlines() if line.strip()]
        said = [line for line in lines if "error" in line.lower()] or lines or ["nothing"]
        raise InputError(f"{program} failed with exit code {answer.returncode}: {said[-1][:_LONGEST_MESSAGE]}; {mend}")


TOTALSEGMENTATOR = SegmentationMethod(segment_lumen=by_totalsegmentator, options=_TOTALSEGMENTATOR)
NNUNET = SegmentationMethod(segment_lumen=by_nnunet, options=_NNUNET, blood_pools=False)
"""A model may be trained on any part of the body: a CT of the head holds no aorta and no heart chamber."""
