"""How far heart and breath move one patient's vessel, from a run of contrast.

The vessel of the CT is moved by a motion and projected, and the amplitudes are changed until every image of the run
agrees with it. Phase and period of heart and breath are known, by ECG and belt; of the amplitudes, their published
distributions.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float, Float32
from scipy.ndimage import gaussian_filter
from scipy.optimize import least_squares

from endopilot.simulation.motion import AMPLITUDES, Motion, place
from endopilot.types import Anatomy
from endopilot.xray.carm import Pose, View
from endopilot.xray.image import ImageConfig, XrayImager, isocenter_of
from endopilot.xray.registration import AGREES, Comparison, added, sampled_lumen

RUN_TIMES_S = tuple(0.5 * np.arange(1, 9))
"""When the images of a run are taken, s: over a breath, and at eight phases of the heart, two images a second."""

_LEVELS = ((8, 3.0), (4, 1.5))
"""As those of `registration`; a vessel that moves by the published mean lies within the reach of the first."""
_FAR = 4.0
"""An amplitude is sought up to so many standard deviations from its published mean."""
_STEP = 0.02
"""Step of the derivative, in standard deviations."""


@dataclass(frozen=True, eq=False)
class MotionRegistration:
    """A patient's motion, and whether to believe it.

    Attributes:
        motion: as the images show it.
        correlation: of the contrast in all images and of the vessel projected as it moves.
        failure: why it is not to be believed, in words; empty if it is.
    """

    motion: Motion
    correlation: float
    failure: str


def register_motion(
    anatomy: Anatomy,
    views: Sequence[View],
    contrasted: Sequence[Sequence[Float32[np.ndarray, "rows columns"]]],
    before: Sequence[Float32[np.ndarray, "rows columns"]],
    mean: Motion,
    config: ImageConfig | None = None,
) -> MotionRegistration:
    """Find the amplitudes of a patient's motion.

    Args:
        anatomy: the vessel of the CT.
        views: of the images, in the frame of the CT as the patient was registered.
        contrasted: an image of the filled vessel for each of `RUN_TIMES_S` and view, from `XrayImager.signal`.
        before: an image for each view before the injection, with heart and breath at rest.
        mean: what is known beforehand: the published mean of what moves, with the patient's periods.
        config: detector and beam.
    """
    config = config or ImageConfig()
    seen = _Run(anatomy, views, mean, config)
    found, correlation = np.zeros(len(seen.names)), 0.0
    for averaged, blur in _LEVELS:
        observed = [
            [
                gaussian_filter(added(lit, mask, averaged, config), blur)
                for lit, mask in zip(images, before, strict=True)
            ]
            for images in contrasted
        ]
        found = least_squares(
            seen.residuals,
            found,
            bounds=seen.bounds,
            diff_step=_STEP,
            x_scale=1.0,
            loss="soft_l1",
            max_nfev=8,
            xtol=1e-3,
            ftol=1e-3,
            args=(observed, averaged, blur),
        ).x
        correlation = seen.correlation(found, observed, averaged, blur)
    failure = ""
    if correlation < AGREES:
        failure = f"the images and the moving vessel agree by {correlation:.2f} only; inject contrast, or hold the pose"
    return MotionRegistration(seen.motion(found), correlation, failure)


def take_run(
    imager: XrayImager,
    angles_deg: Sequence[tuple[float, float]],
    pose: Pose,
    motion: Motion,
    random: np.random.Generator,
) -> list[list[Float32[np.ndarray, "rows columns"]]]:
    """Inject contrast, and return an image for each of `RUN_TIMES_S` and view, as `register_motion` takes them.

    Args:
        imager: of the patient.
        angles_deg: of the views: LAO (positive) or RAO, and cranial (positive) or caudal, degrees.
        pose: in which the patient lies.
        motion: how the patient moves.
        random: where the noise is drawn from.
    """
    run, none = [], np.zeros((0, 3))
    for placed in motion.core(np.asarray(imager.anatomy.insertion.position)).placements(np.array(RUN_TIMES_S))[0]:
        planes = [imager.plane(angle, pose=pose, placed=placed) for angle in angles_deg]
        run.append([imager.signal(each, none, contrast=1.0, seed=int(random.integers(2**31))) for each in planes])
    return run


def motion_error_mm(anatomy: Anatomy, true: Motion, taken: Motion) -> float:
    """Return how far a vessel that moves in one way lies from itself moving in another, mm.

    The mean is taken over its centerlines and over two breaths.
    """
    points = np.concatenate([branch.centerline.points for branch in anatomy.tree.branches])
    ostium, times_s = np.asarray(anatomy.insertion.position), np.linspace(0, 2 * true.breathing_period_s, 49)
    lies, taken_to_lie = (
        np.stack([place(maps, points) for maps in one.core(ostium).placements(times_s)[0]]) for one in (true, taken)
    )
    return float(np.linalg.norm(lies - taken_to_lie, axis=-1).mean())


class _Run:
    """A run of images, and what would be seen in them with other amplitudes."""

    def __init__(self, anatomy: Anatomy, views: Sequence[View], mean: Motion, config: ImageConfig) -> None:
        """Take the parts of the motion that are not at rest.

        Args:
            anatomy: the vessel of the CT.
            views: as `register_motion` takes them.
            mean: the same.
            config: detector and beam.
        """
        self.names = [name for name in AMPLITUDES if getattr(mean, name) != 0]
        self._mean, self._views, self._config = mean, views, config
        self._points, self._size = sampled_lumen(anatomy)
        self._ostium, self._isocenter = np.asarray(anatomy.insertion.position), isocenter_of(anatomy)
        centre = np.array([getattr(mean, name) for name in self.names])
        self._deviation = np.array([AMPLITUDES[name][1] for name in self.names])
        least = [0.0 if name in ("annulus_mm", "heart_volume_share") else -np.inf for name in self.names]
        self.bounds = np.maximum((np.array(least) - centre) / self._deviation, -_FAR), np.full(len(centre), _FAR)

    def motion(self, deviations: Float[np.ndarray, "amplitudes"]) -> Motion:
        """Return the motion whose amplitudes lie so many standard deviations from the mean."""
        pairs = zip(self.names, deviations * self._deviation, strict=True)
        return replace(self._mean, **{name: float(getattr(self._mean, name) + more) for name, more in pairs})

    def residuals(
        self,
        deviations: Float[np.ndarray, "amplitudes"],
        observed: Sequence[Sequence[np.ndarray]],
        averaged: int,
        blur: float,
    ) -> Float[np.ndarray, "n"]:
        """Return the differences of all images, and those of the amplitudes from the mean."""
        frames = self._compared(deviations, observed, averaged, blur)
        return np.concatenate([*(frame.differences(np.zeros(6)) for frame in frames), deviations])

    def correlation(
        self,
        deviations: Float[np.ndarray, "amplitudes"],
        observed: Sequence[Sequence[np.ndarray]],
        averaged: int,
        blur: float,
    ) -> float:
        """Return the correlation of what was expected and observed, the least of all moments."""
        frames = self._compared(deviations, observed, averaged, blur)
        return min(frame.correlation(np.zeros(6)) for frame in frames)

    def _compared(
        self,
        deviations: Float[np.ndarray, "amplitudes"],
        observed: Sequence[Sequence[np.ndarray]],
        averaged: int,
        blur: float,
    ) -> list[Comparison]:
        """Return the comparison of the images of each moment with the vessel as it would lie."""
        maps = self.motion(deviations).core(self._ostium).placements(np.array(RUN_TIMES_S))[0]
        points = [place(each, self._points) for each in maps]
        at = averaged, blur, self._config, self._isocenter
        return [
            Comparison(lie, self._size, self._views, images, *at) for lie, images in zip(points, observed, strict=True)
        ]
