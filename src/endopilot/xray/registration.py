"""Registration: how the patient lies in the C-arm's frame, from one or two images of the contrasted vessel.

What contrast adds to an image, the logarithm of the image before it less that with it, is the attenuation of the
iodine times the path through the lumen. The lumen of the CT is laid onto the detector in a pose, and the pose is moved
until both agree, first blurred, then finely. Where they do not agree in the end, registration has failed, and says so.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from jaxtyping import Float, Float32
from scipy.ndimage import gaussian_filter
from scipy.optimize import least_squares
from scipy.spatial import KDTree
from skimage.transform import downscale_local_mean

from endopilot.types import Anatomy
from endopilot.xray.absorbers import catheter_lumen_points, lumen_points
from endopilot.xray.carm import Pose, View, view_of
from endopilot.xray.image import ImageConfig, isocenter_of
from endopilot.xray.projector import Shadow

_PRIOR = np.concatenate([np.full(3, np.deg2rad(2.0)), np.full(3, 3.5)])
"""Standard deviations of a pose before any image: rad, mm. Poses of up to 3° and 5 mm lie within."""
_FAR = 3.0
"""A pose this many of these standard deviations from where the patient was laid is not believed."""
_LEVELS = ((8, 3.0), (8, 1.5), (4, 1.5), (2, 1.0))
"""Pixels that are averaged along a side, and the blur of what is left, in averaged pixels: the first sees 5 mm."""
_POINTS = 30000
_STEP_SHARE = 0.01
"""The derivative is taken over this share of a standard deviation either way, times the averaged pixels."""
_DARKEST = 0.05
"""Share of the light below which none is taken to be unscattered."""
AGREES = 0.8
"""Least correlation of image and projected vessel. Without contrast it is near 0."""
_FELT = 0.02
"""Pixels that a pose changes by more than this share of what it changes the most show how well it fits."""
_WEAKEST = 0.05
"""Contrast is not taken to show weaker than by this share of what `ImageConfig.iodine_mm` says."""
_LITTLE = 0.01
"""Share of itself by which a change along the vessel costs: where a view shows little vessel, it is none."""
_MISFIT = 0.1
"""Residuals are scaled by this share of the full contrast; beyond it they count less."""


@dataclass(frozen=True, eq=False)
class Registration:
    """A pose, and whether to believe it.

    Attributes:
        pose: of the patient.
        covariance: of its rotation vector, rad, and translation, mm.
        correlation: of the contrast in the images and of the vessel projected in this pose.
        failure: why it is not to be believed, in words; empty if it is.
    """

    pose: Pose
    covariance: Float[np.ndarray, "6 6"]
    correlation: float
    failure: str

    def views(self, views: Sequence[View], isocenter: Float[np.ndarray, "3"]) -> list[View]:
        """Return views that were given in the C-arm's frame in the CT's frame."""
        return [view_of(view, self.pose, isocenter) for view in views]


def register(
    anatomy: Anatomy,
    views: Sequence[View],
    contrasted: Sequence[Float32[np.ndarray, "rows columns"]],
    before: Sequence[Float32[np.ndarray, "rows columns"]],
    config: ImageConfig | None = None,
    start: Pose | None = None,
) -> Registration:
    """Find the pose in which the patient lies.

    Args:
        anatomy: the vessel of the CT.
        views: of the images, in the C-arm's frame.
        contrasted: an image of the filled vessel for each view, from `XrayImager.signal`.
        before: the image before the injection, likewise.
        config: detector and beam.
        start: the pose that is looked around, such as that of the frame before, in a cine, whose contrast need not fill
            the vessel alike; the pose that the CT has, and a vessel that is filled, if not given.
    """
    config, isocenter = config or ImageConfig(), isocenter_of(anatomy)
    lumen = sampled_lumen(anatomy, alike=start is None)
    laid = np.zeros(6) if start is None else start.vector
    found, correlation, covariance, misfit = laid, 0.0, np.diag(_PRIOR**2), _MISFIT
    for averaged, blur in _LEVELS if start is None else _LEVELS[1:]:
        observed = observed_contrast(contrasted, before, averaged, blur, config)
        if not any(np.ptp(image) for image in observed):
            said = "images with and without contrast are the same; inject contrast"
            return Registration(Pose.of_vector(laid), np.diag(_PRIOR**2), 0.0, said)
        points, size, along = (part[:: averaged // 2] for part in lumen)  # coarse images need fewer points
        size = size * (lumen[1].sum() / size.sum())
        level = Comparison(points, size, along, views, observed, averaged, blur, config, isocenter, laid, misfit)
        slope: Any = level.slope  # the annotation of scipy knows names of schemes alone
        found = least_squares(
            level.residuals,
            found,
            slope,
            bounds=(laid - _FAR * _PRIOR, laid + _FAR * _PRIOR),
            x_scale=_PRIOR,
            loss="soft_l1",
            max_nfev=10,
            xtol=1e-4,
            ftol=1e-4,
        ).x
        correlation, covariance = level.correlation(found), level.covariance(found)
        misfit = max(_MISFIT, misfit * level.misfit_of(found))
    # How far off a vessel lies that was laid by its images says nothing against it.
    far = float(np.abs((found - laid) / _PRIOR)[: 6 if start is None else 3].max()) + 1e-2
    failure = ""
    if correlation < AGREES:
        failure = f"the image and the vessel agree by {correlation:.2f} only; inject contrast, or choose another view"
    elif far > _FAR:
        failure = "the vessel fits the image only far from where the patient was laid; check the views' angles"
    return Registration(Pose.of_vector(found), covariance, correlation, failure)


def lay(
    anatomy: Anatomy,
    views: Sequence[View],
    contrasted: Sequence[Float32[np.ndarray, "rows columns"]],
    before: Sequence[Float32[np.ndarray, "rows columns"]],
    config: ImageConfig,
) -> tuple[Pose, float]:
    """Return the shift, up to half an image, in which the vessel fits the images best, and their correlation then.

    It begins a registration where nobody says how far the vessel lies from the isocenter; arguments as `register` has.
    """
    averaged, blur = _LEVELS[0]
    observed = observed_contrast(contrasted, before, averaged, blur, config)
    laid = Comparison(*sampled_lumen(anatomy), views, observed, averaged, blur, config, isocenter_of(anatomy))
    rows, shifts, fits = [], [], []
    for view, ours, theirs in zip(views, laid.expected(np.zeros(6)), observed, strict=True):
        ours, theirs = ours[0] - ours[0].mean(), theirs - np.median(theirs)
        side = 2 * len(ours)
        alike = np.fft.irfft2(
            np.fft.rfft2(theirs, (side, side)) * np.fft.rfft2(ours, (side, side)).conj(), (side, side)
        )
        fits.append(alike.max() / max(float(np.linalg.norm(ours) * np.linalg.norm(theirs)), 1e-12))
        down, right = (int(at) - side * (at >= side // 2) for at in np.unravel_index(alike.argmax(), alike.shape))
        rows.append(view.slope(laid.isocenter))
        shifts.append([averaged * right, -averaged * down])
    shift = np.linalg.pinv(np.concatenate(rows)) @ np.concatenate(shifts)
    return Pose(translation_mm=shift), float(np.mean(fits))


@dataclass(frozen=True, eq=False)
class Comparison:
    """The comparison of images and projected vessel at one resolution.

    Attributes:
        points: of the lumen, LPS mm.
        size: volume that each stands for, mm³.
        along: how far along the vessel each lies, as a share of the deepest.
        views: of the images.
        observed: what contrast added to each image, pixels averaged and blurred.
        averaged: pixels along a side that are averaged.
        blur: of what is left, in averaged pixels.
        config: detector and beam.
        isocenter: about which poses turn, LPS mm.
        laid: pose that is likeliest before any image.
        misfit: usual difference of image and projected vessel, as a share of the full contrast.
    """

    points: Float[np.ndarray, "n 3"]
    size: Float[np.ndarray, "n"]
    along: Float[np.ndarray, "n"]
    views: Sequence[View]
    observed: Sequence[np.ndarray]
    averaged: int
    blur: float
    config: ImageConfig
    isocenter: Float[np.ndarray, "3"]
    laid: Float[np.ndarray, "6"] = field(default_factory=lambda: np.zeros(6))
    misfit: float = _MISFIT

    def expected(self, pose: Float[np.ndarray, "6"]) -> list[np.ndarray]:
        """Return what contrast would add to each image in a pose: everywhere alike, and growing along the vessel."""
        images = []
        for view in self.views:
            coarse = view_of(view, Pose.of_vector(pose), self.isocenter).magnified(1 / self.averaged)
            shadow = Shadow(coarse, self.config.pixels // self.averaged, self.points)
            parts = [shadow.of(size, blur_px=self.blur) for size in (self.size, self.size * self.along)]
            images.append(self.config.iodine_mm * np.stack(parts))
        return images

    def fitted(self, pose: Float[np.ndarray, "6"]) -> list[tuple[np.ndarray, np.ndarray, float]]:
        """Return for each image what is expected in a pose, what is observed, and how strong the contrast shows.

        Unless the vessel is filled alike, by an injection of one's own, nobody knows how strong it shows, how that
        changes along the vessel as the blood carries it, and on which ground: each is what fits best.
        """
        found = []
        for parts, theirs in zip(self.expected(pose), self.observed, strict=True):
            if not self.along.any():
                found.append((parts[0], theirs, 1.0))
                continue
            flat = np.stack([part - part.mean() for part in parts]).reshape(2, -1)
            theirs = theirs - theirs.mean()
            square = flat @ flat.T
            square[np.diag_indices(2)] *= 1 + _LITTLE
            shares = np.linalg.lstsq(square, flat @ theirs.ravel(), rcond=None)[0]
            strength = max(float(shares @ [1.0, self.along.mean()]), _WEAKEST)
            found.append(((shares @ flat).reshape(theirs.shape), theirs, strength))
        return found

    def residuals(self, pose: Float[np.ndarray, "6"]) -> Float[np.ndarray, "n"]:
        """Return all differences, and that of the pose from the prior."""
        return np.concatenate([self.differences(pose), (pose - self.laid) / _PRIOR])

    def differences(self, pose: Float[np.ndarray, "6"]) -> Float[np.ndarray, "n"]:
        """Return how the images differ from what is expected in a pose, in units of the usual misfit."""
        full = self.misfit * self.config.iodine_mm * 3.0  # a vessel of 3 mm
        return np.concatenate(
            [((ours - theirs) / (strength * full)).ravel() for ours, theirs, strength in self.fitted(pose)]
        )

    def slope(self, pose: Float[np.ndarray, "6"]) -> Float[np.ndarray, "n 6"]:
        """Return the derivative of the residuals by the pose."""
        steps = _STEP_SHARE * self.averaged * np.diag(_PRIOR)
        columns = [(self.residuals(pose + step) - self.residuals(pose - step)) / (2 * step.sum()) for step in steps]
        return np.stack(columns, axis=-1)

    def covariance(self, pose: Float[np.ndarray, "6"]) -> Float[np.ndarray, "6 6"]:
        """Return the covariance of a pose that fits: what the pixels leave open, with the prior.

        Neighbouring pixels that were blurred together err together.
        """
        slope, misfit = self.slope(pose)[:-6], self.misfit_of(pose)
        return np.linalg.inv(slope.T @ slope / misfit**2 + np.diag(_PRIOR**-2.0))

    def misfit_of(self, pose: Float[np.ndarray, "6"]) -> float:
        """Return how large the differences near the vessel are, in units of the usual misfit, as if none were alike."""
        slope, residual = self.slope(pose)[:-6], self.residuals(pose)[:-6]
        near = np.abs(slope).max(axis=1) >= _FELT * np.abs(slope).max()
        return float(np.sqrt(np.mean(residual[near] ** 2) * 4 * np.pi)) * self.blur

    def correlation(self, pose: Float[np.ndarray, "6"]) -> float:
        """Return the correlation of what was expected and observed around the vessel."""
        pairs = [(ours - ours.min(), theirs) for ours, theirs, _ in self.fitted(pose)]
        ours, theirs = (np.concatenate([image.ravel() for image in images]) for images in zip(*pairs, strict=True))
        near = ours > 0.02 * ours.max()
        wide = near | (gaussian_filter(near.astype(np.float32), 2.0) > 0)
        if wide.sum() < 3 or np.ptp(theirs[wide]) == 0:
            return 0.0
        return float(np.corrcoef(ours[wide], theirs[wide])[0, 1])


def observed_contrast(
    contrasted: Sequence[Float32[np.ndarray, "rows columns"]],
    before: Sequence[Float32[np.ndarray, "rows columns"]],
    averaged: int,
    blur: float,
    config: ImageConfig,
) -> list[np.ndarray]:
    """Return what contrast added to each image, as `Comparison` takes it.

    Args:
        contrasted: an image of the filled vessel for each view.
        before: the image before the injection, likewise.
        averaged: pixels along a side that are averaged.
        blur: of what is left, in averaged pixels.
        config: detector and beam.
    """
    pairs = zip(contrasted, before, strict=True)
    return [gaussian_filter(_added(lit, mask, averaged, config), blur) for lit, mask in pairs]


def _added(
    lit: Float32[np.ndarray, "rows columns"],
    mask: Float32[np.ndarray, "rows columns"],
    averaged: int,
    config: ImageConfig,
) -> Float32[np.ndarray, "r c"]:
    """Return the attenuation that contrast added, pixels averaged; scatter is estimated as the mask, spread out."""
    light, before = (downscale_local_mean(np.exp(image), (averaged, averaged)) for image in (lit, mask))
    reach = config.scatter_mm / config.geometry.pixel_mm / averaged
    scatter = config.scatter / (1 + config.scatter) * gaussian_filter(before, reach, mode="constant")
    least = _DARKEST * before
    return np.log(np.maximum(before - scatter, least) / np.maximum(light - scatter, least)).astype(np.float32)


def sampled_lumen(
    anatomy: Anatomy, *, alike: bool = True
) -> tuple[Float[np.ndarray, "n 3"], Float[np.ndarray, "n"], Float[np.ndarray, "n"]]:
    """Return a sample of the lumen, and of the catheter's straight end, which contrast fills too.

    Args:
        anatomy: the vessel.
        alike: whether contrast fills all of it alike, as when an injection waits for that.

    Returns:
        Places, LPS mm, the volume that each stands for, mm³, and how far along the vessel it lies, from 0 to 1; 0 if
        it is filled alike.
    """
    points, size = lumen_points(anatomy)
    behind, size_behind = catheter_lumen_points(anatomy)
    near = np.linalg.norm(behind - anatomy.insertion.position, axis=1) < 10.0
    random = np.random.default_rng(0)
    chosen = random.permutation(len(points))[:_POINTS]
    inside = np.flatnonzero(near)
    inside = inside[random.permutation(len(inside))[: _POINTS // 20]]
    line = anatomy.tree.line
    share = 0.0 if alike else 1 / line.abscissa.max()
    along = share * line.abscissa[KDTree(line.points).query(points[chosen])[1]]
    return (
        np.concatenate([points[chosen], behind[inside]]),
        np.concatenate(
            [
                size[chosen] * size.sum() / size[chosen].sum(),
                size_behind[inside] * size_behind[near].sum() / size_behind[inside].sum(),
            ]
        ),
        np.concatenate([along, np.zeros(len(inside))]),
    )


def vessel_error_mm(anatomy: Anatomy, true: Pose, found: Pose) -> float:
    """Return how far a vessel in one pose lies from itself in another: the mean over its centerlines, mm."""
    points = anatomy.tree.line.points
    isocenter = isocenter_of(anatomy)
    return float(np.linalg.norm(true.move(points, isocenter) - found.move(points, isocenter), axis=1).mean())
