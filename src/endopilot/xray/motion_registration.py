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
from scipy.optimize import least_squares

from endopilot.simulation.motion import AMPLITUDES, Motion, place
from endopilot.types import Anatomy
from endopilot.xray.carm import Pose, View
from endopilot.xray.image import ImageConfig, XrayImager, isocenter_of
from endopilot.xray.registration import AGREES, Comparison, observed_contrast, sampled_lumen

RUN_TIMES_S = tuple(0.5 * np.arange(1, 9))
"""When the images of a run are taken, s: over a breath, and at eight phases of the heart, two images a second."""

_LEVELS = ((8, 3.0), (4, 1.5))
"""As those of `registration`; a vessel that moves by the published mean lies within the reach of the first."""
_FAR = 4.0
"""An amplitude is sought up to so many standard deviations from its published mean."""
_STEP = 0.02
"""Step of the derivative, as a share of the amplitude's distance from its mean; at the mean, what rounding allows."""


@dataclass(frozen=True, eq=False)
class MotionRegistration:
    """A patient's motion, and whether to believe it.

    Attributes:
        motion: as the images show it.
        correlation: of the contrast in the images and of the vessel projected as it moves, at the worst moment.
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
    config, isocenter = config or ImageConfig(), isocenter_of(anatomy)
    lumen = sampled_lumen(anatomy)
    amplitudes = _Amplitudes(mean, np.asarray(anatomy.insertion.position))
    found, correlation = np.zeros(len(amplitudes.names)), 0.0
    for averaged, blur in _LEVELS:
        observed = [observed_contrast(images, before, averaged, blur, config) for images in contrasted]
        at_rest = [Comparison(*lumen, views, images, averaged, blur, config, isocenter) for images in observed]
        found = least_squares(
            amplitudes.residuals,
            found,
            bounds=amplitudes.bounds,
            diff_step=_STEP,
            x_scale=1.0,
            loss="soft_l1",
            max_nfev=8,
            xtol=1e-3,
            ftol=1e-3,
            args=(at_rest,),
        ).x
        correlation = min(each.correlation(np.zeros(6)) for each in amplitudes.moved(found, at_rest))
    failure = ""
    if correlation < AGREES:
        failure = f"the images and the moving vessel agree by {correlation:.2f} only; inject contrast, or hold the pose"
    return MotionRegistration(amplitudes.motion(found), correlation, failure)


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
    points = anatomy.tree.line.points
    ostium, times_s = np.asarray(anatomy.insertion.position), np.linspace(0, 2 * true.breathing_period_s, 49)
    lies, taken_to_lie = (
        np.stack([place(maps, points) for maps in one.core(ostium).placements(times_s)[0]]) for one in (true, taken)
    )
    return float(np.linalg.norm(lies - taken_to_lie, axis=-1).mean())


class _Amplitudes:
    """The amplitudes that are sought, in standard deviations from the published mean."""

    def __init__(self, mean: Motion, ostium: Float[np.ndarray, "3"]) -> None:
        """Take the parts of the motion that are not at rest.

        Args:
            mean: as `register_motion` takes it.
            ostium: about which the vessel moves, LPS mm.
        """
        self.names = [name for name in AMPLITUDES if getattr(mean, name) != 0]
        self._mean, self._ostium = mean, ostium
        centre = np.array([getattr(mean, name) for name in self.names])
        self._deviation = np.array([AMPLITUDES[name][1] for name in self.names])
        least = [0.0 if name in ("annulus_mm", "heart_volume_share") else -np.inf for name in self.names]
        self.bounds = np.maximum((np.array(least) - centre) / self._deviation, -_FAR), np.full(len(centre), _FAR)

    def motion(self, deviations: Float[np.ndarray, "amplitudes"]) -> Motion:
        """Return the motion whose amplitudes lie so many standard deviations from the mean."""
        pairs = zip(self.names, deviations * self._deviation, strict=True)
        return replace(self._mean, **{name: float(getattr(self._mean, name) + more) for name, more in pairs})

    def moved(self, deviations: Float[np.ndarray, "amplitudes"], at_rest: Sequence[Comparison]) -> list[Comparison]:
        """Return the comparison of the images of each moment with the vessel as it would lie then.

        Args:
            deviations: the amplitudes.
            at_rest: the comparison of the same images with the vessel of the CT.
        """
        maps = self.motion(deviations).core(self._ostium).placements(np.array(RUN_TIMES_S))[0]
        return [replace(each, points=place(one, each.points)) for one, each in zip(maps, at_rest, strict=True)]

    def residuals(
        self, deviations: Float[np.ndarray, "amplitudes"], at_rest: Sequence[Comparison]
    ) -> Float[np.ndarray, "n"]:
        """Return the differences of all images, and those of the amplitudes from the mean."""
        differences = [each.differences(np.zeros(6)) for each in self.moved(deviations, at_rest)]
        return np.concatenate([*differences, deviations])
