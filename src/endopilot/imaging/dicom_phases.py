"""Cardiac phases of one DICOM series: images at one slice position that a field of their headers distinguishes."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from endopilot.errors import InputError

PHASE_TAGS = {
    "NominalPercentageOfCardiacPhase": "%",
    "NominalCardiacTriggerDelayTime": " ms",
    "ActualCardiacTriggerDelayTime": " ms",
    "TriggerTime": " ms",
    "TemporalPositionIndex": "",
    "TemporalPositionIdentifier": "",
    "AcquisitionNumber": "",
}
"""Fields that may tell phases apart, the clearest first, and the unit of each."""

_POSITION_MM = 1e-3  # slices nearer to each other than this are at one position


def choose_phase(
    values: Mapping[str, Sequence[float | None]],
    positions_mm: np.ndarray,
    phase: str | None,
    folder: Path,
    *,
    named: int | None = None,
) -> tuple[np.ndarray, tuple[str, ...]]:
    """Return the slices of the one phase there is, or was asked for, and notes. `values` has each of `PHASE_TAGS` for
    every slice, None where it lacks; `named` is the slice given in place of the folder. Raises InputError for no single
    phase."""
    everything = np.arange(len(positions_mm))
    if np.diff(np.sort(positions_mm)).min(initial=np.inf) >= _POSITION_MM:
        return everything, _single(values, phase, folder)
    for tag in PHASE_TAGS:
        phases = _split(values[tag], positions_mm)
        if phases:
            break
    else:
        raise InputError(
            f"{folder}: several images at one slice position (cardiac phases, or a series stored twice), and nothing "
            "in their headers tells them apart; keep one phase in the folder"
        )
    unit = PHASE_TAGS[tag]
    if phase is not None:
        wanted = _number(phase)
        for value, indices in phases.items():
            if wanted is not None and abs(value - wanted) < 5e-3 * max(1.0, abs(value)):
                return indices, ()
    listed = "; ".join(f"{value:g}{unit}: {slices_text(len(indices))}" for value, indices in phases.items())
    known = f"{len(phases)} phases by {tag} ({listed})"
    if phase is None and named is not None:
        value = next(value for value, indices in phases.items() if named in indices)
        return phases[value], (f"the phase of the file given, {tag} {value:g}{unit}, was taken of {known}",)
    if phase is None:
        raise InputError(
            f"{folder}: the series holds {known}; choose one (--phase {next(iter(phases)):g}), or give one of its files"
        )
    raise InputError(f"{folder}: no phase {phase!r} (the series holds {known}); choose one with --phase")


def _single(values: Mapping[str, Sequence[float | None]], phase: str | None, folder: Path) -> tuple[str, ...]:
    """Check the phase asked for against that of a series with one image at each position."""
    nominal = sorted({value for value in values["NominalPercentageOfCardiacPhase"] if value is not None})
    if phase is not None:
        found = [(tag, {value for value in values[tag] if value is not None}) for tag in PHASE_TAGS]
        tag, there = next(((tag, there) for tag, there in found if there), ("", set()))
        if there != {_number(phase)}:
            said = f"{tag} {', '.join(f'{value:g}' for value in sorted(there))}" if there else "no phase in its headers"
            raise InputError(
                f"{folder}: no phase {phase!r}: the series has one image at each position, {said}; leave --phase out"
            )
    if len(nominal) > 1:
        shown = ", ".join(f"{value:g}" for value in nominal)
        return (f"its slices are of several cardiac phases (NominalPercentageOfCardiacPhase {shown})",)
    return ()


def _split(values: Sequence[float | None], positions_mm: np.ndarray) -> dict[float, np.ndarray]:
    """Return the slices of each phase by its value; none where the values do not tell phases apart. The time after the
    R wave may vary from beat to beat: then phases are distinguished by their order at each position."""
    if any(value is None or not np.isfinite(value) for value in values):
        return {}
    known = np.array(values, dtype=float)
    places: defaultdict[int, list[int]] = defaultdict(list)
    order = np.argsort(positions_mm, kind="stable")
    starts = np.diff(positions_mm[order], prepend=-np.inf) >= _POSITION_MM
    for place, index in zip(np.cumsum(starts), order, strict=True):
        places[int(place)].append(int(index))
    most = max(len(indices) for indices in places.values())
    exact = {float(value): np.flatnonzero(known == value) for value in np.unique(known)}
    if len(exact) == most and all(_alone(positions_mm[indices]) for indices in exact.values()):
        return exact
    counts = {len(indices) for indices in places.values()}
    if len(counts) != 1 or counts == {1}:
        return {}
    ranks = np.array([sorted(indices, key=lambda index: known[index]) for indices in places.values()])
    times = known[ranks]
    if np.any(times[:, :-1].max(axis=0) >= times[:, 1:].min(axis=0)):
        return {}
    return {float(np.median(times[:, rank])): ranks[:, rank] for rank in range(times.shape[1])}


def _alone(positions_mm: np.ndarray) -> bool:
    return bool(np.diff(np.sort(positions_mm)).min(initial=np.inf) >= _POSITION_MM)


def _number(phase: str) -> float | None:
    try:
        return float(phase.strip().removesuffix("%").removesuffix("ms"))
    except ValueError:
        return None


def slices_text(count: int) -> str:
    """Return a number of slices in words."""
    return f"{count} slice" if count == 1 else f"{count} slices"
