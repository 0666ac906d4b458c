"""Segmentation of one vessel's lumen: the entry function of the imaging stage, settings, methods and first checks."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Literal, cast

import numpy as np
from jaxtyping import Float
from pydantic import model_validator
from scipy import ndimage

from endopilot.errors import InputError
from endopilot.imaging.geometry import farthest_apart_mm
from endopilot.imaging.grid import LEAST_BLOOD_HU
from endopilot.imaging.volume import read_volume
from endopilot.plugins import Registry
from endopilot.settings import Finite, public, settings
from endopilot.types import Insertion, LumenMask, Volume

METHODS = Registry(
    setting="method",
    shipped={
        "aorta": "endopilot.imaging.methods.aorta:segment_lumen",
        "coronary": "endopilot.imaging.methods.coronary:segment_lumen",
        "nnunet": "endopilot.imaging.methods.programs:NNUNET",
        "totalsegmentator": "endopilot.imaging.methods.programs:TOTALSEGMENTATOR",
    },
    group="endopilot.segmentation",
)
"""Where the segmentation methods are. Each is a `SegmentationMethod`, or just its function `segment_lumen`."""
_ROOT_MM = 5.0  # an ostium is on an aorta of 9 mm or more: nearer to the volume's edge, the root is cut off
_BLOCK_MM = 2.0  # voxels are averaged to blocks of about this size: noise goes, pools of blood stay
_CALM_HU = 25.0  # tissue with a smaller SD over 3 × 3 × 3 blocks is homogeneous: blood is, bone is not
_NOISE_FACTOR = 1.3  # in a noisy scan, the limit in lower quartiles of that SD in fat, muscle and blood
_BRIGHTEST_HU = 900.0  # metal and dense bone lie above this, no blood does
_LEAST_POOL_ML = 4.0  # less than any heart chamber holds; homogeneous bone of the thorax is smaller
_POOL_MM = 20.0  # diameter of a ball of that volume: a field of view that is shorter holds only a slice of a pool


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
        segment_lumen: from volume (HU) and settings to the lumen's mask on the volume's grid, with any ostium found.
        options: its own settings with their defaults; `config.settings(options)` returns them as given.
        blood_pools: whether it needs an aorta or a heart chamber; contrast is then looked for before it runs.
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
    if not isinstance(mask, LumenMask):
        raise InputError(f"method: {name!r} returned {type(mask).__name__}; return a LumenMask")
    voxels = mask.volume.voxels
    if voxels.shape != volume.voxels.shape or voxels.dtype != bool:
        raise InputError(
            f"method: {name!r} returned {voxels.dtype} voxels of shape {voxels.shape}; return bool voxels on the "
            f"volume's grid, {volume.voxels.shape}"
        )
    apart = farthest_apart_mm(mask.volume, volume)
    if not apart < volume.spacing_mm.min() / 2:  # nor NaN
        raise InputError(
            f"method: {name!r} returned a mask on another grid, up to {apart:.3g} mm from the volume's; return it with "
            "the volume's spacing_mm, origin_mm and direction"
        )
    if (ostium := mask.ostium) is not None:
        values = np.concatenate([np.ravel(ostium.position), np.ravel(ostium.direction)]).astype(float)
        if len(values) != 6 or not np.isfinite(values).all() or not values[3:].any():
            shown = " ".join(f"{value:g}" for value in values)
            raise InputError(
                f"method: {name!r} returned an ostium of position and direction {shown}; return three finite numbers "
                "each, or ostium=None"
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


def refuse_other_units(volume: Volume, seeds: Sequence[Sequence[float]] = ()) -> None:
    """Raise InputError for a volume that cannot be in HU: nothing is below 0, where fat, lung and air are, and at the
    seeds (LPS mm) it has not the HU of blood with contrast, as a CT that was cut off at 0 or stripped would."""
    low, high = float(volume.voxels.min()), float(volume.voxels.max())
    if low < 0:
        return
    if not seeds:
        raise InputError(
            f"the volume's values go from {low:g} to {high:g}, but fat, lung and air are below 0 HU: this is no CT, or "
            "its rescale is lost; export it in HU, or give seeds if it was cut off at 0"
        )
    places = np.rint(volume.world_to_index(np.array(seeds, dtype=float))).astype(int)[:, ::-1]
    around = [volume.voxels[tuple(slice(max(i - 1, 0), i + 2) for i in place)] for place in places]
    blood = float(np.median([np.median(box) for box in around]))
    if not LEAST_BLOOD_HU <= blood <= _BRIGHTEST_HU:
        raise InputError(
            f"the volume's values go from {low:g} to {high:g}, but fat, lung and air are below 0 HU, and blood with "
            f"contrast has {LEAST_BLOOD_HU:g} to {_BRIGHTEST_HU:g} HU, not {blood:g} as at the seeds: the rescale is "
            "lost, or the seeds lie beside the vessel"
        )


def refuse_without_contrast(volume: Volume) -> None:
    """Raise InputError for a CT of chest or abdomen without 4 connected ml (fewer in a short field of view) of
    homogeneous tissue above 130 HU: only blood with contrast fills millilitres there; without, it measures 30 to 60 HU.
    """
    extent_mm = float((volume.spacing_mm * volume.voxels.shape[::-1]).min())
    blocks, size_mm = _blocks(volume)
    mean = ndimage.uniform_filter(blocks, 3)
    variance = ndimage.uniform_filter(blocks**2, 3) - mean**2
    soft = (mean > -120.0) & (mean < LEAST_BLOOD_HU)
    noise_hu = float(np.sqrt(max(np.percentile(variance[soft], 25), 0.0))) if soft.any() else 0.0
    calm = variance < max(_CALM_HU, _NOISE_FACTOR * noise_hu) ** 2
    label, _ = ndimage.label(calm & (mean > LEAST_BLOOD_HU) & (mean < _BRIGHTEST_HU))  # pyright: ignore[reportGeneralTypeIssues]
    largest_ml = float(np.bincount(label.ravel())[1:].max(initial=0) * size_mm.prod() / 1000)
    if largest_ml >= _LEAST_POOL_ML * min(1.0, extent_mm / _POOL_MM):
        return
    if extent_mm < _POOL_MM:
        raise InputError(
            f"the volume is only {extent_mm:.0f} mm thick, and its largest piece of homogeneous tissue above "
            f"{LEAST_BLOOD_HU:.0f} HU has {largest_ml:.1f} ml, too little to recognise blood with contrast; give a CT "
            "angiogram that holds the aortic root, or seeds in the vessel"
        )
    count, edge = np.histogram(mean[calm], bins=np.arange(-20.0, 400.0, 10.0))
    peak = f"peaks at {edge[count.argmax()] + 5.0:.0f} HU" if count.any() else "is absent"
    raise InputError(
        f"no contrast: homogeneous soft tissue {peak}, and its largest piece above {LEAST_BLOOD_HU:.0f} HU, "
        f"as blood with contrast is, has {largest_ml:.1f} ml; give a CT angiogram in the arterial phase"
    )


def _blocks(volume: Volume) -> tuple[Float[np.ndarray, "mz my mx"], Float[np.ndarray, "3"]]:
    """Return the means of blocks of voxels, and the blocks' size along k, j and i, mm."""
    spacing = volume.spacing_mm[::-1]
    factor = np.maximum(np.round(_BLOCK_MM / spacing), 1).astype(int)
    factor = np.minimum(factor, volume.voxels.shape)
    result = volume.voxels
    for axis, step in enumerate(factor.tolist()):
        kept = result.shape[axis] // step * step
        shape = (*result.shape[:axis], kept // step, step, *result.shape[axis + 1 :])
        result = np.take(result, range(kept), axis=axis).reshape(shape).mean(axis=axis + 1, dtype=np.float32)
    return result, spacing * factor
