"""Segmentation of one vessel's lumen: the entry of the imaging stage, its configuration and the registry of methods.

A method is a module of `endopilot.imaging.methods` with a function `segment_lumen(volume, config)`; its name is the
module's. Adding a method adds one file and touches no other. A module may also say

- `OPTIONS`, its own settings with their defaults, which `config.settings(OPTIONS)` returns as the user gave them;
- `BLOOD_POOLS = False`, if it needs no aorta or heart chamber in the volume: contrast is then not looked for.
"""

from __future__ import annotations

import importlib
import pkgutil
from collections.abc import Mapping
from dataclasses import dataclass, replace
from types import ModuleType
from typing import Literal

import numpy as np

from endopilot.errors import InputError
from endopilot.imaging import methods as method_modules
from endopilot.imaging.contrast import refuse_other_units, refuse_without_contrast
from endopilot.types import Insertion, LumenMask, Volume

_ROOT_MM = 5.0
"""An ostium is on an aorta of 9 mm radius or more: where it is nearer to the volume's edge, the root is cut off."""


@dataclass(frozen=True, kw_only=True)
class SegmentConfig:
    """How the lumen is segmented."""

    method: str = "coronary"
    """coronary (automatic, one coronary tree), aorta (from seeds), or your own totalsegmentator or nnunet."""
    seeds: tuple[tuple[float, float, float], ...] = ()
    """Points inside the lumen, LPS mm: first where the device enters, then farther along. Only aorta needs them."""
    vessel: Literal["rca", "lca"] = "rca"
    """Which coronary tree the coronary method segments."""
    options: tuple[str, ...] = ()
    """Settings of the method's own, each NAME=VALUE: model=FOLDER (nnunet), task=… structure=… (totalsegmentator)."""

    def __post_init__(self) -> None:
        """Refuse what no method could use."""
        if self.method not in available_methods():
            raise InputError(f"method={self.method!r} is unknown; choose one of {', '.join(available_methods())}")
        for seed in self.seeds:
            if not np.isfinite(seed).all():
                raise InputError(f"seeds: {seed} is no point; give three finite numbers x y z in LPS mm")
        known = getattr(_method(self.method), "OPTIONS", {}) if self.options else {}
        for option in self.options:
            name, sign, _ = option.partition("=")
            if not sign or name not in known:
                listed = f"give {'=…, '.join(known)}=…" if known else "leave --options out"
                raise InputError(f"options: {option!r} is no setting of method {self.method!r}; {listed}")

    def settings(self, defaults: Mapping[str, str]) -> dict[str, str]:
        """Return a method's own settings: its defaults, and what `options` puts in their place."""
        return {**defaults, **dict(option.split("=", 1) for option in self.options)}


def _method(name: str) -> ModuleType:
    return importlib.import_module(f"{method_modules.__name__}.{name}")


def available_methods() -> tuple[str, ...]:
    """Return the names of the segmentation methods."""
    return tuple(sorted(module.name for module in pkgutil.iter_modules(method_modules.__path__)))


def segment(volume: Volume, config: SegmentConfig) -> LumenMask:
    """Segment the lumen of one vessel tree from a CT angiogram.

    Args:
        volume: CT in HU.
        config: method, vessel and seeds.

    Returns:
        The mask on the grid of `volume`, with the ostium and the direction into the vessel.

    Raises:
        InputError: a seed lies outside the volume, there is no contrast, or the vessel was not found.
    """
    refuse_other_units(volume)
    _refuse_seeds_outside(volume, config)
    method = _method(config.method)
    if not config.seeds and getattr(method, "BLOOD_POOLS", True):
        refuse_without_contrast(volume)
    mask: LumenMask = method.segment_lumen(volume, config)
    if not mask.volume.voxels.any():
        raise InputError(f"method={config.method!r} found no lumen; give seeds inside the vessel")
    if not config.seeds and mask.ostium is not None:
        _refuse_cut_root(volume, mask.ostium)
    return replace(mask, method=config.method)


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
