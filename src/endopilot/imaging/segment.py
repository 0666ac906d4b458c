"""Segmentation of one vessel's lumen: the entry of the imaging stage, its configuration and the registry of methods.

A method is a module of `endopilot.imaging.methods` with a function `segment_lumen(volume, config)`; its name is the
module's. Adding a method adds one file and touches no other.
"""

from __future__ import annotations

import importlib
import pkgutil
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from endopilot.errors import InputError
from endopilot.imaging import methods as method_modules
from endopilot.types import LumenMask, Volume


@dataclass(frozen=True, kw_only=True)
class SegmentConfig:
    """How the lumen is segmented."""

    method: str = "coronary"
    """Segmentation method: coronary (automatic, one coronary tree) or aorta (from one or two seeds)."""
    seeds: tuple[tuple[float, float, float], ...] = ()
    """Points inside the lumen, LPS mm: first where the device enters, then farther along. coronary needs none."""
    vessel: Literal["rca", "lca"] = "rca"
    """Which coronary tree the coronary method segments."""

    def __post_init__(self) -> None:
        """Refuse what no method could use."""
        if self.method not in available_methods():
            raise InputError(f"method={self.method!r} is unknown; choose one of {', '.join(available_methods())}")
        for seed in self.seeds:
            if not np.isfinite(seed).all():
                raise InputError(f"seeds: {seed} is no point; give three finite numbers x y z in LPS mm")


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
    method = importlib.import_module(f"{method_modules.__name__}.{config.method}")
    mask: LumenMask = method.segment_lumen(volume, config)
    if not mask.volume.voxels.any():
        raise InputError(f"method={config.method!r} found no lumen; give seeds inside the vessel")
    return replace(mask, method=config.method)
