"""Segmentation of one vessel's lumen: the entry function of the imaging stage, its settings and its methods."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Literal, cast

import numpy as np
from pydantic import model_validator

from endopilot.errors import InputError
from endopilot.imaging.contrast import refuse_other_units, refuse_without_contrast
from endopilot.imaging.volume import read_volume
from endopilot.plugins import Registry
from endopilot.settings import Finite, public, settings
from endopilot.types import Insertion, LumenMask, Volume

METHODS = Registry(
    setting="method",
    shipped={
        "aorta": "endopilot.imaging.methods.aorta:segment_lumen",
        "coronary": "endopilot.imaging.methods.coronary:segment_lumen",
        "nnunet": "endopilot.imaging.methods.nnunet:METHOD",
        "totalsegmentator": "endopilot.imaging.methods.totalsegmentator:METHOD",
    },
    group="endopilot.segmentation",
)
"""Where the segmentation methods are. Each is a `SegmentationMethod`, or just its function `segment_lumen`."""
_ROOT_MM = 5.0
"""An ostium is on an aorta of 9 mm radius or more: where it is nearer to the volume's edge, the root is cut off."""


@settings
class SegmentConfig:
    """How the lumen is segmented."""

    method: str = "coronary"
    """coronary (automatic, one coronary tree), aorta (from seeds), totalsegmentator or nnunet (your own installation),
    or MODULE:OBJECT of a method of your own."""
    seeds: tuple[tuple[Finite, Finite, Finite], ...] = ()
    """Points inside the lumen, LPS mm: first where the device enters, then farther along. aorta needs them."""
    vessel: Literal["rca", "lca"] = "rca"
    """Which coronary tree the coronary method segments."""
    options: tuple[str, ...] = ()
    """Settings of the method's own, each NAME=VALUE: model=FOLDER (nnunet), task=… structure=… (totalsegmentator)."""

    @model_validator(mode="after")
    def _consistent(self) -> SegmentConfig:
        METHODS.check(self.method)
        known = _method(self.method).options if self.options else {}
        for option in self.options:
            name, sign, _ = option.partition("=")
            if not sign or name not in known:
                listed = f"give {'=…, '.join(known)}=…" if known else "leave --options out"
                raise ValueError(f"options: {option!r} is no setting of method {self.method!r}; {listed}")
        return self

    def settings(self, defaults: Mapping[str, str]) -> dict[str, str]:
        """Return a method's own settings: its defaults, and what `options` puts in their place."""
        return {**defaults, **dict(option.split("=", 1) for option in self.options)}


@dataclass(frozen=True, kw_only=True)
class SegmentationMethod:
    """A method that finds the lumen of a vessel in a CT angiogram.

    Attributes:
        segment_lumen: takes the volume (HU) and the settings, and returns the mask of the lumen on the volume's grid,
            with the ostium if it finds one.
        options: the method's own settings with their defaults; `config.settings(options)` returns them as given.
        blood_pools: whether the method needs an aorta or a heart chamber in the volume; contrast is then looked for
            before it runs.
    """

    segment_lumen: Callable[[Volume, SegmentConfig], LumenMask]
    options: Mapping[str, str] = field(default_factory=dict)
    blood_pools: bool = True


def _method(name: str) -> SegmentationMethod:
    found = METHODS.load(name)
    if isinstance(found, SegmentationMethod):
        return found
    if callable(found):
        return SegmentationMethod(segment_lumen=cast(Callable[[Volume, SegmentConfig], LumenMask], found))
    raise InputError(f"method: {name!r} is no function and no SegmentationMethod; name one")


@public
def segment(volume: Volume | str | Path, *, config: SegmentConfig | None = None) -> LumenMask:
    """Segment the lumen of one vessel tree from a CT angiogram.

    Args:
        volume: CT in HU, or where it is: a DICOM folder or file, NIfTI, NRRD or MHA.
        config: method, vessel and seeds.

    Returns:
        The mask on the grid of `volume`, with the ostium and the direction into the vessel. Its warnings begin with the
        volume's notes.

    Raises:
        InputError: the CT cannot be read, a seed lies outside the volume, there is no contrast, or the vessel was
            not found.
    """
    config = config or SegmentConfig()
    if not isinstance(volume, Volume):
        volume = read_volume(volume)
    _refuse_seeds_outside(volume, config)
    refuse_other_units(volume, config.seeds)
    method = _method(config.method)
    if not config.seeds and method.blood_pools:
        refuse_without_contrast(volume)
    with METHODS.running(config.method, "failed"):
        mask = method.segment_lumen(volume, config)
    _refuse_no_mask(mask, volume, config.method)
    if not mask.volume.voxels.any():
        raise InputError(f"method: {config.method!r} found no lumen; give seeds inside the vessel")
    if not config.seeds and mask.ostium is not None:
        _refuse_cut_root(volume, mask.ostium)
    return replace(mask, method=config.method, warnings=(*volume.notes, *mask.warnings))


def _refuse_no_mask(mask: object, volume: Volume, name: str) -> None:
    """Refuse what a method of one's own may return in place of a mask of the volume."""
    if not isinstance(mask, LumenMask):
        raise InputError(f"method: {name!r} returned {type(mask).__name__}; return a LumenMask")
    voxels = mask.volume.voxels
    if voxels.shape != volume.voxels.shape or voxels.dtype != bool:
        raise InputError(
            f"method: {name!r} returned {voxels.dtype} voxels of shape {voxels.shape}; return bool voxels on the "
            f"volume's grid, {volume.voxels.shape}"
        )


def _refuse_seeds_outside(volume: Volume, config: SegmentConfig) -> None:
    size = np.array(volume.voxels.shape[::-1])
    for seed in config.seeds:
        index = volume.world_to_index(np.array(seed, dtype=float))
        if np.any(index < 0) or np.any(index > size - 1):
            corners = volume.index_to_world(np.array([[0, 0, 0], size - 1]))
            low, high = corners.min(axis=0).round(), corners.max(axis=0).round()
            raise InputError(
                f"seeds: {tuple(seed)} lies outside the volume, which spans x {low[0]:g}…{high[0]:g}, "
                f"y {low[1]:g}…{high[1]:g}, z {low[2]:g}…{high[2]:g} mm (LPS); give a point inside"
            )


def _refuse_cut_root(volume: Volume, ostium: Insertion) -> None:
    """Refuse an ostium at the volume's edge: the true one is outside, and the end of a cut vessel was taken for it."""
    index = volume.world_to_index(ostium.position)
    room = np.minimum(index, np.array(volume.voxels.shape[::-1]) - 1 - index) * volume.spacing_mm
    if room.min() < _ROOT_MM:
        raise InputError(
            f"the vessel found begins {max(room.min(), 0.0):.0f} mm from the volume's edge: the ostium is probably "
            "outside; give a CT that holds the aortic root, or seeds: the begin first, then points along the vessel"
        )
