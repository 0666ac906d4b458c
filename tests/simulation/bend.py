"""An analytic vessel: a tube that goes straight, bends and goes on to a blind end."""

from __future__ import annotations

import numpy as np

from benchmarks.verification.contact import bent_tube
from endopilot.types import Anatomy, Branch, Centerline, DistanceMap, Insertion, VesselTree

RADIUS, BEND, LEAD = 1.5, 20.0, 35.0


def vessel(angle: float = np.pi / 2) -> Anatomy:
    """Return a tube that goes straight, bends and goes on, with a blind end; the ostium is 5 mm before the bend.

    At φ = 0 a tip's bend points to the outer side of the vessel's.
    """
    s = np.linspace(0, 1, 80)
    arc = BEND * np.column_stack([np.sin(angle * s), 1 - np.cos(angle * s), 0 * s])
    out = np.array([np.cos(angle), np.sin(angle), 0.0])
    points = np.concatenate([np.linspace([-5, 0, 0], [-0.1, 0, 0], 20), arc, arc[-1] + np.outer(np.arange(1, 30), out)])
    abscissa = np.append(0, np.cumsum(np.linalg.norm(np.diff(points, axis=0), axis=1)))
    line = Centerline(points, np.full(len(points), RADIUS), abscissa, np.tile([0.0, 0.0, 1.0], (len(points), 1)))
    field = bent_tube(angle, radius_mm=RADIUS, bend_radius_mm=BEND, lead_mm=LEAD, spacing_mm=0.3)
    k, j, i = np.indices(field.values.shape)
    grid = field.origin_mm + field.spacing_mm * np.stack([i, j, k], axis=-1)
    end = arc[-1] + 30 * out
    blind = np.minimum(field.values, np.maximum((end - grid) @ out, -1.0))
    return Anatomy(
        name="bend",
        tree=VesselTree((Branch(line, -1, np.zeros(len(points), dtype=int)),), ("all",)),
        distance_map=DistanceMap(blind, field.spacing_mm, field.origin_mm),
        insertion=Insertion(points[0], np.array([1.0, 0.0, 0.0]), rotation_zero=np.array([0.0, -1.0, 0.0])),
        catheter_radius_mm=RADIUS,
    )
