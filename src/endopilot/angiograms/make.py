"""Angiograms of many patients, with the truth beside each frame: `make_angiograms`.

A patient's vessel and CT are one folder, and a cine is one. Each is written under a temporary name and renamed when
whole, and follows from the settings, the patient and the cine's number alone; so a run that was killed goes on with
whole folders, and ends with the same bits as one that was not.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path

from endopilot.angiograms.config import AngiogramsConfig
from endopilot.angiograms.describe import describe
from endopilot.angiograms.layout import CARD_FILE, MANIFEST_FILE, SAMPLES_FILE, Layout, lay_out
from endopilot.angiograms.write import write_cine, write_patient
from endopilot.devices.device import Wire
from endopilot.devices.stack import Stack
from endopilot.extras import require_extras
from endopilot.parallel import Workers
from endopilot.progress import progress
from endopilot.runs import claim, make_missing


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
        make_missing(title, paths, partial(work, layout), where)
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
