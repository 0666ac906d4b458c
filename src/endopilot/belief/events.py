"""What X-ray must not miss, defined once for agents, advice and every table: `count_events`.

An event is the onset of a state: the tip comes to the wall, lies astray of where it is believed, in another branch too,
or the wall presses with more than it may. An exposure shows one that is taken then or within 0.5 s after.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from endopilot.types import VesselTree


def astray_mm(
    tree: VesselTree, believed: tuple[np.ndarray, np.ndarray], true: tuple[np.ndarray, np.ndarray]
) -> Float[np.ndarray, "n"]:
    """Return how far tips lie from where they are believed, along the vessel, mm: by way of the fork between the two.

    Within the mouth of a branch, as far from the fork as the lumen there is wide, a tip counts as in both.

    Args:
        believed: branch and Δtip, mm, of each.
        true: the same.
    """
    fork = np.full(len(true[0]), np.inf)
    for k, (one, other) in enumerate(zip(believed[0].tolist(), true[0].tolist(), strict=True)):
        if one >= 0 and np.isfinite(leaves := tree.departures(one)[other]):
            line = tree.path(one)
            fork[k] = leaves + np.interp(leaves, line.abscissa, line.radius)
    at, there = believed[1], true[1]
    return at + there - 2 * np.minimum(fork, np.minimum(at, there))  # the nearer of two on one route is their fork


class Counted(NamedTuple):
    """Events of a kind."""

    happened: int
    missed: int
    missed_evenly: float
    """How many as many exposures at even times would miss, in the mean over when the first is."""


def count_events(
    state: Bool[np.ndarray, "*n samples"], exposed: Bool[np.ndarray, "*n samples"], *, before: bool = False
) -> Counted:
    """Return how many events there are, and how many of them are missed.

    One begins at a sample in the state that follows one which is not; it is missed if no exposure is near. The last
    sample is left out: the exposure that would show it may come after the end.

    Args:
        state: whether the tip is at the wall, astray, or pressed too hard.
        exposed: which samples have an exposure; the first is of the start, which even ones have too.
        before: whether one that comes a sample earlier shows it too, as in version 2 of the ladder.
    """
    begins, near = state[..., 1:-1] & ~state[..., :-2], exposed[..., 1:-1] | exposed[..., 2:]
    if before:
        near = near | exposed[..., :-2]
    happened, shows = int(begins.sum()), 3 if before else 2
    evenly = happened * max(0.0, 1.0 - shows * float(exposed[..., 1:].mean()))
    return Counted(happened, int((begins & ~near).sum()), evenly)
