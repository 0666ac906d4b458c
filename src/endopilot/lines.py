"""Lines of points: the length along them, and places on them."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float


def length_along(points: Float[np.ndarray, "n d"]) -> Float[np.ndarray, "n"]:
    """Return the length along a line up to each of its points, in their unit."""
    return np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(points, axis=0), axis=1))])


def places_on(
    points: Float[np.ndarray, "n d"], along: Float[np.ndarray, "n"], at: Float[np.ndarray, "m"]
) -> Float[np.ndarray, "m d"]:
    """Return places at lengths along a line, linear between points at `length_along`, or from another begin."""
    return np.stack([np.interp(at, along, part) for part in points.T], axis=-1)
