"""A bolus of contrast, carried along a vessel tree by the blood: `Flow`.

Blood flows in at the ostium. At a fork the branches share it by the cubes of their radii (Murray, PNAS 12, 1926), and
within a branch it is the same everywhere, so that blood is fast where the vessel is narrow. Along the stream the blood
passes one well-mixed volume after another, each in the same time ("tanks in series"; Levenspiel, Chemical Reaction
Engineering). So the contrast at a place depends on the time alone that blood takes to get there: the course at the
ostium, delayed and dispersed, with a variance of the transit time times that of one volume. All contrast that flows in
is in the tree, or has flowed out of its ends.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from scipy.spatial import KDTree

from endopilot.types import VesselTree

MIXING_S = 0.03
"""Time in which blood passes one well-mixed volume, s: an assumption. After one second of transit a sharp front is then
spread by √(1 s · 0.03 s) = 0.17 s, standard deviation."""
_STEPS = 24
"""Steps of the balance of contrast in `MIXING_S`."""
_INLET_MM = 10.0
"""The blood's velocity at the ostium is that of the mean section of this length of vessel, mm."""


@dataclass(frozen=True)
class Injection:
    """Contrast that is injected through the guiding catheter.

    Attributes:
        rate_ml_s: ml/s; what the vessel does not take flows back into the aorta.
        ramp_s: time in which the rate rises and falls, s.
    """

    start_s: float
    duration_s: float
    rate_ml_s: float
    ramp_s: float = 0.2

    def rate(self, times_s: Float[np.ndarray, "n"]) -> Float[np.ndarray, "n"]:
        """Return the rate at some times, ml/s."""
        end = self.start_s + self.duration_s
        up, down = (times_s - self.start_s) / self.ramp_s, (end - times_s) / self.ramp_s
        return self.rate_ml_s * np.clip(np.minimum(up, down), 0.0, 1.0)


class Flow:
    """The blood's steady flow through a vessel tree.

    Attributes:
        points: of all centerlines, branch after branch, LPS mm.
        branch: that each belongs to.
        transit_s: time from the ostium to each, s.
        inflow_ml_s: blood that flows in at the ostium, ml/s.
    """

    def __init__(self, tree: VesselTree, velocity_mm_s: float) -> None:
        """Share the blood among the branches.

        Args:
            velocity_mm_s: of the blood behind the ostium, mean over the section, mm/s.
        """
        lines = [branch.centerline for branch in tree.branches]
        first = lines[0]
        near = first.abscissa <= first.abscissa[0] + _INLET_MM
        self.inflow_ml_s = float(velocity_mm_s * np.pi * np.mean(first.radius[near] ** 2) / 1000)
        inflow, arrival = np.zeros(len(lines)), np.zeros(len(lines))
        inflow[0] = self.inflow_ml_s
        transits = []
        for index, line in enumerate(lines):
            area = np.pi * line.radius**2
            slices = 0.5 * (area[1:] + area[:-1]) * np.diff(line.abscissa) / 1000
            transits.append(arrival[index] + np.append(0.0, np.cumsum(slices)) / inflow[index])
            children = tree.children(index)
            calibre = np.array([np.median(lines[child].radius) ** 3 for child in children])
            for child, share in zip(children, calibre / calibre.sum() if len(children) else (), strict=True):
                inflow[child], arrival[child] = inflow[index] * share, transits[-1][-1]
        sizes = [len(line.points) for line in lines]
        self.points = np.concatenate([line.points for line in lines])
        self.branch = np.repeat(np.arange(len(lines)), sizes)
        self.rate_ml_s, self.transit_s = inflow[self.branch], np.concatenate(transits)

    def contrast(
        self, injection: Injection, times_s: Float[np.ndarray, "frames"]
    ) -> tuple[Float[np.ndarray, "tanks"], Float[np.ndarray, "frames tanks"]]:
        """Return transit times, s, and the share of contrast in the blood there at some times from 0 on."""
        step = MIXING_S / _STEPS
        longest = min(float(self.transit_s.max()), float(times_s[-1]))
        tanks = int(np.ceil(longest / MIXING_S)) + 2
        share = np.zeros(1 + tanks)  # at the ostium, then in each volume
        inlet = np.minimum(injection.rate((np.arange(int(times_s[-1] / step) + 2) + 0.5) * step) / self.inflow_ml_s, 1)
        at_step, shares = np.rint(times_s / step).astype(int), np.zeros((len(times_s), len(share)))
        frame = 0
        for number, share[0] in enumerate(inlet):
            while frame < len(at_step) and at_step[frame] == number:
                shares[frame] = share
                frame += 1
            share[1:] -= np.diff(share) / _STEPS
        return np.append(0.0, (np.arange(tanks) + 0.5) * MIXING_S), shares

    def transit_of(self, places: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n"]:
        """Return the time, s, that blood takes from the ostium to the centerline nearest to each place, LPS mm."""
        return self.transit_s[KDTree(self.points).query(places)[1]]
