"""What a device's line in an image says of the place of its tip in a vessel: observations for `tip_filter`.

A point of the line belongs to the point of the projected way that is nearest, among those about as far behind the tip;
its distance across the line is an observation. So are both coordinates of the line's end, and the line's length.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from endopilot.anatomy.tree import smoothed
from endopilot.lines import length_along, places_on
from endopilot.xray.camera import Camera
from endopilot.xray.carm import Places, Vector, View
from endopilot.xray.tip_posterior import VesselGrid

Line = Float[np.ndarray, "_ 2"]
_SAMPLE_MM = 6.0
"""Distance of the compared points of a line, mm."""
_POINT_SD_MM, _END_SD_MM = 0.4, 1.0
"""Standard deviations of the points of a line, and more of its end, mm. The lengths here and in `tip_filter` are those
that made the first half of the frames of a real patient's catheter likeliest; docs/evidence/locate.md names them."""
_SMOOTH_MM, _SMOOTH_ROUNDS, _SAMPLES = 2.0, 4, 4.0
"""A line is blurred along itself by a Gaussian of this standard deviation, mm, in so many rounds, with so many samples
to it. With 3 px of noise 97 % of the published catheter's frames 37 to 73 are right so; with 1 mm, blurred once, 73."""
_LENGTH_SD_MM, _LENGTH_SHARE = 2.0, 0.01
"""By how much, and by which share of the line, the way to the tip is longer than the line in an image, mm."""
_WINDOW, _SLACK_MM, _SLACK_SHARE = 30, 3.0, 0.25
"""A point of the line belongs to the way within so many places, and this length and share of the line, of where it
should be by its length."""


@dataclass(frozen=True, eq=False)
class DeviceFrame:
    """What the cameras show of a device at one time.

    Attributes:
        number: of the frame.
        lines: for each camera the device's line, pixels (column, row), from its tip backwards; a single point is the
            tip alone; None where that camera does not show it.
    """

    number: int
    lines: tuple[Line | None, ...]


def shown_by(camera: Camera | View, points: Places) -> tuple[Float[np.ndarray, "n 2"], Float[np.ndarray, "n 2 3"]]:
    """Return the pixels of points, and the derivative by the point, pixels/mm."""
    slope = [(camera.project(points + axis) - camera.project(points - axis)) / 2 for axis in np.eye(3)]
    return camera.project(points), np.stack(slope, axis=-1)


def smooth_line(line: Line, width: float) -> tuple[Line, float, float]:
    """Return a line blurred along itself, its ends kept, by a Gaussian of this standard deviation, its roughness and
    what is left of it, pixels.

    A rough line is longer than it should be, so that the blur is too narrow: each round measures the length anew, on
    what the round before has blurred. What the blur takes from bends, a second one of the difference gives back
    (twicing: Tukey, Exploratory Data Analysis, 1977).
    """
    if len(line) < 3:
        return line, 0.0, 0.0
    blurred, length = line, length_along(line)
    for _ in range(_SMOOTH_ROUNDS):
        even = np.linspace(0.0, length[-1], max(3, round(float(length[-1] * _SAMPLES / width))))
        drawn = places_on(line, length, even)
        once = smoothed(drawn, _SAMPLES)
        blurred = places_on(once + smoothed(drawn - once, _SAMPLES), even, length)
        length = length_along(blurred)
    rough = float(np.sqrt(((line - blurred) ** 2).mean()))
    # Of independent errors, so many points as lie under a Gaussian leave this much.
    averaged = max(2 * np.sqrt(np.pi) * width * len(line) / max(length[-1], width), 1.0)
    return blurred, rough, rough / float(np.sqrt(averaged))


def shift_onto(camera: Camera | View, point: Vector, pixel: Float[np.ndarray, "2"]) -> Vector:
    """Return the shift across the beam that takes a point, LPS mm, to the pixel that shows it."""
    shift = np.zeros(3)
    for _ in range(4):
        shown, slope = shown_by(camera, point[None] + shift)
        shift = shift + np.linalg.pinv(slope[0]) @ (pixel - shown[0])
    return shift


class Observations(NamedTuple):
    """Observations, for each of some places of the tip."""

    place: Int[np.ndarray, "m r"]
    """Of the grid that an observation is of."""
    towards: Float[np.ndarray, "m r 3"]
    """Unit vector of the displacement that it observes; 0 where it observes a length."""
    value: Float[np.ndarray, "m r"]
    variance: Float[np.ndarray, "r"]
    """Observed, mm, and of its own noise, mm²."""
    used: Bool[np.ndarray, "m r"]
    """Whether it was made."""

    @classmethod
    def joined(cls, parts: Sequence[Observations]) -> Observations:
        """Return several observations of the same places of the tip as one."""
        columns = zip(*parts, strict=True)
        return cls(*(np.concatenate(one, axis=min(1, one[0].ndim - 1)) for one in columns))


class SeenLine(NamedTuple):
    """One view of a frame: the line, and the grid as this camera shows it."""

    tip: Float[np.ndarray, "2"]
    """Pixel of the line's end."""
    at: Float[np.ndarray, "k"]
    """Length from there to each of its points, mm in the patient."""
    points: Float[np.ndarray, "k 2"]
    across: Float[np.ndarray, "k 2"]
    """Of the line behind its end, pixels, and unit vectors across it there."""
    shown: Float[np.ndarray, "n 2"]
    slope: Float[np.ndarray, "n 2 3"]
    scale: Float[np.ndarray, "n"]
    """Pixels of the grid's places, their derivative by the place, pixels/mm, and pixels in a mm there."""
    along: Float[np.ndarray, "n"]
    """Length from the root to each place in the image, mm in the patient."""
    end_mm: float
    rough_mm: float
    """Standard deviations of the line's end and of its blurred points by its roughness, mm."""

    @classmethod
    def of(cls, grid: VesselGrid, camera: Camera | View, line: Line, way: Places) -> SeenLine:
        """Return a line's points, evenly apart, and the grid as the camera shows it where the pose has it."""
        shown, slope = shown_by(camera, way)
        scale = np.sqrt((slope**2).sum(axis=(1, 2)) / 2)
        usual = float(np.median(scale))
        line, end, rough = smooth_line(line, _SMOOTH_MM * usual)
        length = length_along(line)
        at = np.arange(_SAMPLE_MM * usual, length[-1], _SAMPLE_MM * usual)
        around = 0.4 * _SAMPLE_MM * usual
        ahead = places_on(line, length, at + around) - places_on(line, length, at - around)
        ahead /= np.maximum(np.linalg.norm(ahead, axis=1, keepdims=True), 1e-9)
        return cls(
            tip=line[0],
            at=at / usual,
            points=places_on(line, length, at),
            across=np.stack([-ahead[:, 1], ahead[:, 0]], axis=-1),
            shown=shown,
            slope=slope,
            scale=scale,
            along=grid.summed(np.linalg.norm(shown - shown[grid.parent], axis=1)) / usual,
            end_mm=end / usual,
            rough_mm=rough / usual,
        )

    def observe(
        self, grid: VesselGrid, places: Int[np.ndarray, "m"], moved: Float[np.ndarray, "m k 3"] | None
    ) -> tuple[Observations, Int[np.ndarray, "m"]]:
        """Return what a line's end says of places of its tip, in both directions, and its points and length; and how
        many points lie before the root. The way is moved so far at each, mm, as found so far; None is for the end
        alone."""
        scale = self.scale[places, None]
        end = Observations(
            place=np.repeat(places[:, None], 2, axis=1),
            towards=self.slope[places] / scale[..., None],
            value=(self.tip - self.shown[places]) / scale,
            variance=np.full(2, _POINT_SD_MM**2 + _END_SD_MM**2 + self.end_mm**2),
            used=np.ones((len(places), 2), dtype=bool),
        )
        if moved is None or not len(self.at):
            return end, np.zeros(len(places), dtype=np.int64)
        each, behind = np.arange(len(places)), grid.behind[places]
        arc = self.along[places, None] - self.along[behind]
        arc[np.arange(behind.shape[1]) > grid.depth[places, None]] = np.inf
        first = (arc[:, None, :] < self.at[:, None]).sum(axis=2)
        window = np.clip(first[..., None] + np.arange(-_WINDOW, _WINDOW + 1), 0, behind.shape[1] - 1)
        near = each[:, None, None]
        candidates = behind[near, window]
        slack = _SLACK_MM + _SLACK_SHARE * self.at
        wanted = self.points - np.einsum("mij,mkj->mki", self.slope[places], moved)
        gap = ((self.shown[candidates] - wanted[:, :, None]) ** 2).sum(axis=3)
        gap[np.abs(arc[near, window] - self.at[:, None]) > slack[:, None]] = np.inf
        chosen = gap.argmin(axis=2)[..., None]
        place = np.take_along_axis(candidates, chosen, axis=2)[..., 0]
        beyond = self.at > self.along[places, None]
        used = np.isfinite(np.take_along_axis(gap, chosen, axis=2)[..., 0]) & (place != 0) & ~beyond
        scale = self.scale[place]
        towards = np.einsum("ki,mkij->mkj", self.across, self.slope[place]) / scale[..., None]
        value = np.einsum("ki,mki->mk", self.across, self.points - self.shown[place]) / scale
        any_used = used.any(axis=1)
        last = np.where(any_used, len(self.at) - 1 - used[:, ::-1].argmax(axis=1), 0)
        longer = self.along[places] - self.along[place[each, last]] - self.at[last]
        points = np.full(len(self.at), _POINT_SD_MM**2 + self.rough_mm**2)
        line = Observations(
            place=np.column_stack([place, places]),
            towards=np.concatenate([towards, np.zeros((len(places), 1, 3))], axis=1),
            value=np.column_stack([value, longer]),
            variance=np.append(points, (_LENGTH_SD_MM + _LENGTH_SHARE * self.at[-1]) ** 2),
            used=np.column_stack([used, any_used]),
        )
        return Observations.joined([end, line]), beyond.sum(axis=1)
