"""The patient's pose, refined by images of the wire: a wire lies in the lumen, so the vessel lies around it.

Registration knows a pose with a covariance; one view leaves the depth along its beam open. Where a wire is followed in
an image, it crosses the vessel's projection within the lumen's radius of the centerline. A pose in which it does not is
unlikely. The likeliest pose, given registration and all images of the wire so far, is looked for anew after each image.

A wire inside the projected lumen, wherever it lies there, says nothing: it rests on one wall for long, and counting its
place again in every image would draw the vessel's middle onto it. So the images only bound the pose. The true pose lies
within the bounds, and a step towards them never leads away from it, measured by the registration's covariance.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from scipy.optimize import least_squares

from endopilot.types import Anatomy
from endopilot.xray.carm import Pose, View, view_of
from endopilot.xray.corridor import CATHETER_MM, STEP_MM
from endopilot.xray.image import isocenter_of
from endopilot.xray.registration import Registration
from endopilot.xray.tip_posterior import TipEstimate

_EVERY = 4
"""Every so many cross-sections of the wire count, 1 mm apart."""
_END_SECTIONS = 12
"""Cross-sections of the wire's end that do not count, 3 mm: where it ends is uncertain."""
_PIXEL_SD = 1.0
"""Standard deviation of the followed wire's place in an image, pixels, at places 1 mm apart: they err together."""
_MOST_IMAGES = 4
"""However many images there are, they count no more than so many: a wire that is followed wrongly stays so for long."""
_BEYOND_MM = 0.1
"""A wire's axis may seem to lie this far outside the lumen at no cost: the grid that it is followed on is 0.2 mm."""
_SEEN_SHARE = 0.35
"""Where the vessel is foreshortened to less than this share of its length, it has no side in the image."""
_SURE_SHARE = 0.9
"""Images in which less than this of the tip's posterior lies in one place do not count."""
_MOST_SDS = 3.0
"""A wire is looked for outside the lumen up to this many standard deviations of the registered vessel's place."""
_MOST_PLACES = 4000
"""Places that are remembered; the oldest are forgotten."""


@dataclass(frozen=True, eq=False)
class _Places:
    """Places of one wire in one image.

    Attributes:
        view: of the image, in the C-arm's frame.
        pixel: of the wire: to the right of the image's middle, and up from it.
        middle: the vessel's centerline there, LPS mm of the CT.
        tangent: of the centerline, unit vectors.
        room: how far from the centerline the wire's axis may lie, mm.
    """

    view: View
    pixel: Float[np.ndarray, "n 2"]
    middle: Float[np.ndarray, "n 3"]
    tangent: Float[np.ndarray, "n 3"]
    room: Float[np.ndarray, "n"]

    def beyond(self, pose: Pose, isocenter: Float[np.ndarray, "3"]) -> Float[np.ndarray, "n"]:
        """Return how far the wire lies outside the projected lumen in a pose, in standard deviations, 0 inside."""
        view = view_of(self.view, pose, isocenter)
        shown = view.project(self.middle)
        per_mm = view.scale / ((self.middle - view.source) @ view.axes[2])
        along = view.project(self.middle + self.tangent) - shown
        seen = np.linalg.norm(along, axis=1)
        aside = np.stack([-along[:, 1], along[:, 0]], axis=-1) / np.maximum(seen, 1e-9)[:, None]
        off = np.abs(((self.pixel - shown) * aside).sum(axis=1))
        outside = np.maximum(off - (self.room + _BEYOND_MM) * per_mm, 0.0) / _PIXEL_SD
        return np.where(seen > _SEEN_SHARE * per_mm, outside, 0.0)


class PoseRefiner:
    """Bounds a patient's pose by images of the wire.

    Attributes:
        pose: the likeliest so far.
    """

    def __init__(self, anatomy: Anatomy, registration: Registration) -> None:
        """Begin with what the contrast has shown.

        Args:
            anatomy: the vessel.
            registration: its pose and how sure it is.
        """
        self.pose, self._prior = registration.pose, registration.pose.vector
        self._isocenter = isocenter_of(anatomy)
        self._whiten = np.linalg.inv(np.linalg.cholesky(registration.covariance))
        self._covariance = registration.covariance
        points = [branch.centerline.points for branch in anatomy.tree.branches]
        self._points = np.concatenate(points)[::_EVERY]
        self._places: list[_Places] = []

    def views(self, views: Sequence[View]) -> list[View]:
        """Return views that were given in the C-arm's frame in the CT's frame of the likeliest pose."""
        return [view_of(view, self.pose, self._isocenter) for view in views]

    def slack_mm(self, views: Sequence[View], least_mm: float) -> float:
        """Return how far outside the lumen a wire is to be looked for, mm, because registration is not sure.

        Args:
            views: of the images, in the C-arm's frame.
            least_mm: what it is at least, mm.
        """
        steps = np.linalg.cholesky(self._covariance).T
        largest = 0.0
        for view in views:
            before = view_of(view, Pose.of_vector(self._prior), self._isocenter)
            shown = before.project(self._points)
            per_mm = before.scale / ((self._points - before.source) @ before.axes[2])
            moved = [
                view_of(view, Pose.of_vector(self._prior + step), self._isocenter).project(self._points) - shown
                for step in steps
            ]
            variance = (np.square(moved) / per_mm[:, None] ** 2).sum(axis=0).max(axis=1)
            largest = max(largest, float(np.sqrt(variance.max())))
        return max(least_mm, _MOST_SDS * largest)

    def refine(self, views: Sequence[View], found: TipEstimate, slack_mm: float) -> Pose:
        """Return the likeliest pose after one more exposure.

        Args:
            views: of its images, in the C-arm's frame.
            found: the wire in them, as it was followed with `pose`.
            slack_mm: how far outside the lumen it was looked for, mm.
        """
        first, last = round(CATHETER_MM / STEP_MM), len(found.wire) - _END_SECTIONS
        at = np.arange(first, last, _EVERY)
        if len(at) < 2 or found.share < _SURE_SHARE:
            return self.pose
        ahead = found.middle[at + 1] - found.middle[at - 1]
        tangent = ahead / np.linalg.norm(ahead, axis=1, keepdims=True)
        for view, shown in zip(views, self.views(views), strict=True):
            pixel = shown.project(found.wire[at])
            self._places.append(_Places(view, pixel, found.middle[at], tangent, found.room[at] - slack_mm))
        while sum(len(one.pixel) for one in self._places) > _MOST_PLACES:
            self._places.pop(0)
        solved = least_squares(self._residuals, self.pose.vector, x_scale=np.sqrt(np.diag(self._covariance)))
        self.pose = Pose.of_vector(solved.x)
        return self.pose

    def _residuals(self, vector: Float[np.ndarray, "6"]) -> Float[np.ndarray, "n"]:
        """Return how unlikely a pose is: its difference from registration, and how far wires lie outside the lumen."""
        pose = Pose.of_vector(vector)
        outside = np.concatenate([one.beyond(pose, self._isocenter) for one in self._places])
        # Square to the half where it is large: a place that was followed wrongly does not decide alone.
        share = min(1.0, _MOST_IMAGES / len(self._places))
        bounded = np.sqrt(2 * share * (np.sqrt(1 + outside**2) - 1))
        return np.concatenate([self._whiten @ (vector - self._prior), bounded])
