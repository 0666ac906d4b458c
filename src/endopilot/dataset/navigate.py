"""Random navigations of one anatomy that stay inside the vessel that was imaged.

A segmented vessel ends where the scan no longer shows it, not where blood stops: a wire that is pushed against that end
buckles against a wall that is not there. So where a tip comes to the end of its branch, or is caught so firmly that the
drive slips, the drive is stopped short of that depth and the navigation is simulated again; its beginning, and so the
branch that it takes, stays the same.
"""

from __future__ import annotations

import warnings
from dataclasses import fields, is_dataclass
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int

from endopilot.simulation.device import Device
from endopilot.simulation.simulator import SimulatorConfig, simulate
from endopilot.types import SAMPLE_PERIOD_S, Anatomy, Rollout, VesselTree

ATTEMPTS = 4
"""Simulations of a navigation at most; the tree has few ends that one navigation can come to in turn."""
END_MM = 1.0
"""A tip nearer than this to the end of its branch has come to it, mm."""
STOP_SHORT_MM = 5.0
"""The drive is stopped this much before the length of the path that ends there, mm."""


def navigate(
    anatomy: Anatomy,
    device: Device,
    initial: Float[np.ndarray, "worlds 2"],
    control: Float[np.ndarray, "worlds samples 2"],
    friction: Float[np.ndarray, "worlds"],
    config: SimulatorConfig,
) -> tuple[Rollout, Bool[np.ndarray, "worlds"]]:
    """Simulate navigations, stopped short of the ends of the vessel.

    Args:
        anatomy: the vessel.
        device: the wire.
        initial: (Δ mm, φ rad) before the first period.
        control: (mm/s, rad/s), before it is stopped short and rounded to float32, as the disk keeps it.
        friction: friction coefficient of each world.
        config: settings of the rod core.

    Returns:
        What happened, and which worlds were stopped short.
    """
    ends = _ends(anatomy.tree)
    limit = np.full(len(control), ends[np.isfinite(ends)].max() - STOP_SHORT_MM)
    stopped = np.zeros(len(control), dtype=bool)
    again, rollout = np.arange(len(control)), None
    for _ in range(ATTEMPTS):
        started, driven = stop_short(initial[again], control[again], limit[again])
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # invalid worlds are listed in the dataset's manifest
            part = simulate(anatomy, device, driven, initial=started, config=config, friction=friction[again])
        if rollout is None:
            rollout = part
        else:
            _overwrite(rollout, again, part)
        depth = _depth_of_end(part, ends)
        came = np.isfinite(depth)
        again, depth = again[came], depth[came]
        if len(again) == 0:
            break
        stopped[again] = True
        limit[again] = np.minimum(limit[again], depth) - STOP_SHORT_MM
    assert rollout is not None
    return rollout, stopped


def stop_short(
    initial: Float[np.ndarray, "worlds 2"],
    control: Float[np.ndarray, "worlds samples 2"],
    limit: Float[np.ndarray, "worlds"],
) -> tuple[Float[np.ndarray, "worlds 2"], Float[np.ndarray, "worlds samples 2"]]:
    """Return initial states and controls of which the inserted length stays between 0 and each world's limit, mm.

    The controls are rounded to float32, so that simulating what the disk keeps repeats an episode exactly.
    """
    initial, control = initial.copy(), control.copy()
    initial[:, 0] = np.clip(initial[:, 0], 0, limit)
    inserted = initial[:, 0].copy()
    for sample in np.moveaxis(control, 1, 0):
        sample[:, 0] = np.clip(sample[:, 0], -inserted / SAMPLE_PERIOD_S, (limit - inserted) / SAMPLE_PERIOD_S)
        sample[:] = sample.astype(np.float32)
        inserted += SAMPLE_PERIOD_S * sample[:, 0]
    return initial, control


def _ends(tree: VesselTree) -> Float[np.ndarray, "branches"]:
    """Return the abscissa at which each branch ends distally, mm; infinity where it divides instead."""
    ends = np.full(len(tree.branches), np.inf)
    for leaf in tree.leaves():
        ends[leaf] = tree.branches[leaf].centerline.abscissa[-1]
    return ends


def _depth_of_end(rollout: Rollout, ends: Float[np.ndarray, "branches"]) -> Float[np.ndarray, "worlds"]:
    """Return how deep each world's wire came, mm: the abscissa of the first end that its tip came to, or the inserted
    length at which the drive first slipped; infinity if it did neither."""
    end: Float[np.ndarray, "worlds samples"] = ends[rollout.tip.branch]
    came, slipped = rollout.tip.abscissa > end - END_MM, rollout.slip != 0
    depth = np.where(came, end, rollout.inserted_length)
    first = np.argmax(came | slipped, axis=1)
    return np.where((came | slipped).any(axis=1), depth[np.arange(len(end)), first], np.inf)


def _overwrite(rollout: Any, worlds: Int[np.ndarray, "chosen"], part: Any) -> None:
    """Put the worlds of `part` in the place of some worlds of `rollout`."""
    for record in fields(rollout):
        whole, values = getattr(rollout, record.name), getattr(part, record.name)
        if isinstance(whole, np.ndarray):
            whole[worlds] = values
        elif is_dataclass(whole):
            _overwrite(whole, worlds, values)
