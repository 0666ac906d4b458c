"""Cardiac phases of one DICOM series: images at one slice position that a field of their headers distinguishes."""

from __future__ import annotations

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
    if np.diff(np.sort(positions_mm)).min(initial=np.inf) >= _POSITION_MM:
        if phase is not None:
            raise InputError(
                f"{folder}: no phase {phase!r}: the series has one image at each position; leave --phase out"
            )
        nominal = sorted({value for value in values["NominalPercentageOfCardiacPhase"] if value is not None})
        shown = ", ".join(f"{value:g}" for value in nominal)
        several = f"its slices are of several cardiac phases (NominalPercentageOfCardiacPhase {shown})"
        return np.arange(len(positions_mm)), (several,) if len(nominal) > 1 else ()
    for tag in PHASE_TAGS:
        phases = _split(values[tag], positions_mm)
        if phases:
            break
    else:
        raise InputError(
            f"{folder}: several images at one slice position (cardiac phases, or a series stored twice), and nothing "
            "in their headers tells them apart, or some phases lack slices; keep one phase in the folder"
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


def _split(values: Sequence[float | None], positions_mm: np.ndarray) -> dict[float, np.ndarray]:
    """Return the slices of each phase by its middle value; none where the values do not tell phases apart. The time
    after the R wave may vary from beat to beat: phases are distinguished by their order at each position."""
    if any(value is None or not np.isfinite(value) for value in values):
        return {}
    known = np.array(values, dtype=float)
    order = np.argsort(positions_mm, kind="stable")
    places = np.cumsum(np.diff(positions_mm[order], prepend=-np.inf) >= _POSITION_MM)
    counts = np.bincount(places)[1:]
    if np.ptp(counts):
        return {}
    ranks = order[np.lexsort((known[order], places))].reshape(-1, counts[0])
    times = known[ranks]
    if np.any(times[:, :-1].max(axis=0) >= times[:, 1:].min(axis=0)):
        return {}
    return {float(np.median(times[:, rank])): ranks[:, rank] for rank in range(times.shape[1])}


def _number(phase: str) -> float | None:
    try:
        return float(phase.strip().removesuffix("%").removesuffix("ms"))
    except ValueError:
        return None


def slices_text(count: int) -> str:
    """Return a number of slices in words."""
    return f"{count} slice" if count == 1 else f"{count} slices"
