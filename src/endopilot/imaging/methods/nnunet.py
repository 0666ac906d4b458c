"""nnU-Net v2, the user's own installation and trained model (https://github.com/MIC-DKFZ/nnUNet)."""

from __future__ import annotations

from pathlib import Path

from endopilot.errors import InputError
from endopilot.files import read_json
from endopilot.imaging.external import ostium_at_seeds, segment_by_program
from endopilot.imaging.segment import SegmentationMethod, SegmentConfig
from endopilot.imaging.volume import SUFFIXES
from endopilot.types import LumenMask, Volume

OPTIONS = {"model": "", "device": "", "label": ""}
"""Folder of the trained model, with dataset.json and fold_0, fold_1, …; device: cuda, cpu, mps; label of the lumen."""


def segment_lumen(volume: Volume, config: SegmentConfig) -> LumenMask:
    """Return the lumen as a trained nnU-Net finds it, all folds of it together; the first seed, if any, is the ostium.

    Raises:
        InputError: no or an unfit model is given, nnU-Net is missing, fails, or writes no or an empty mask.
    """
    settings = config.settings(OPTIONS)
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
    mask = segment_by_program(
        volume,
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
    return LumenMask(mask.volume, ostium_at_seeds(mask, config.seeds))


METHOD = SegmentationMethod(segment_lumen=segment_lumen, options=OPTIONS, blood_pools=False)
"""A model may be trained on any part of the body: a CT of the head holds no aorta and no heart chamber."""
