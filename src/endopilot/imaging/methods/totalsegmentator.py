"""TotalSegmentator, the user's own installation, weights and licence (https://github.com/wasserth/TotalSegmentator).

Its task `coronary_arteries` needs a licence of the user's own; `--options task=total structure=aorta` does not.
"""

from __future__ import annotations

from endopilot.imaging.external import ostium_at_seeds, segment_by_program
from endopilot.imaging.segment import SegmentationMethod, SegmentConfig
from endopilot.types import LumenMask, Volume

OPTIONS = {"task": "coronary_arteries", "structure": "", "device": ""}
"""Task (`-ta`); structure whose mask is taken, by default the task's name; device (`-d`): gpu, cpu, gpu:1."""


def segment_lumen(volume: Volume, config: SegmentConfig) -> LumenMask:
    """Return the mask of one structure as TotalSegmentator finds it; the first seed, if any, is the ostium.

    Raises:
        InputError: TotalSegmentator is missing, fails, or writes no or an empty mask.
    """
    settings = config.settings(OPTIONS)
    task = settings["task"]
    structure = settings["structure"] or task
    chosen = ["--roi_subset", structure] if task == "total" else []
    device = ["--device", settings["device"]] if settings["device"] else []
    mask = segment_by_program(
        volume,
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
    return LumenMask(mask.volume, ostium_at_seeds(mask, config.seeds))


METHOD = SegmentationMethod(segment_lumen=segment_lumen, options=OPTIONS)
