"""Registration: how the patient lies in the C-arm's frame, and moves, from one or two views of the contrasted vessel.

What contrast adds to an image, the logarithm of the image before it less that with it, is the attenuation of the
iodine times the path through the lumen. The lumen of the CT is placed by what is sought, a pose or the amplitudes of
heart and breath, and laid onto the detector; that is changed until all images agree, first blurred, then finely. Where
they do not agree in the end, registration has failed, and says so.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from jaxtyping import Float
from scipy.ndimage import gaussian_filter
from scipy.optimize import least_squares
from scipy.spatial import KDTree
from skimage.transform import downscale_local_mean

from endopilot.simulation.motion import AMPLITUDES, Motion
from endopilot.types import Anatomy
from endopilot.xray.absorbers import catheter_lumen_points, lumen_points
from endopilot.xray.carm import Image, Places, Pose, Vector, View, view_of
from endopilot.xray.image import ImageConfig, XrayImager, isocenter_of
from endopilot.xray.projector import Shadow

RUN_TIMES_S = tuple(0.5 * np.arange(1, 9))
"""When the images of a run are taken, s: over a breath, and at eight phases of the heart, two images a second."""
_PRIOR = np.concatenate([np.full(3, np.deg2rad(2.0)), np.full(3, 3.5)])
"""Standard deviations of a pose before any image: rad, mm. Poses of up to 3° and 5 mm lie within."""
_FAR, _AMPLITUDE_FAR = 3.0, 4.0
"""A pose this many of these standard deviations from where the patient was laid is not believed; and an amplitude is
sought up to so many from its published mean."""
_LEVELS = ((8, 3.0), (8, 1.5), (4, 1.5), (2, 1.0))
"""Pixels that are averaged along a side, and the blur of what is left, in averaged pixels: the first sees 5 mm."""
_MOTION_LEVELS = ((8, 3.0), (4, 1.5))
"""A vessel that moves by the published mean lies within the reach of the first."""
_POINTS = 30000
_STEP_SHARE = 0.01
"""The derivative is taken over this share of a standard deviation either way, times the averaged pixels."""
_DARKEST = 0.05
"""Share of the light below which none is taken to be unscattered."""
_AGREES = 0.8
"""Least correlation of image and projected vessel. Without contrast it is near 0."""
_FELT = 0.02
"""Pixels that a change moves by more than this share of the most show how well it fits."""
_WEAKEST = 0.05
"""Contrast is not taken to show weaker than by this share of what `ImageConfig.iodine_mm` says."""
_LITTLE = 0.01
"""Share of itself by which a change along the vessel costs: where a view shows little vessel, it is none."""
_MISFIT = 0.1
"""Residuals are scaled by this share of the full contrast; beyond it they count less."""

Images = Sequence[Image]


@dataclass(frozen=True, eq=False)
class Registration:
    """How a patient lies and moves, and whether to believe it.

    Attributes:
        pose: of the patient.
        covariance: of what was sought: the pose's rotation vector, rad, and translation, mm, or the motion's
            amplitudes, each in standard deviations of its published distribution.
        correlation: of the contrast in the images and of the vessel projected so, at the worst moment.
        failure: why it is not to be believed, in words; empty if it is.
        motion: as a run of images shows it; None where it was not sought.
    """

    pose: Pose
    covariance: Float[np.ndarray, "k k"]
    correlation: float
    failure: str
    motion: Motion | None = None

    def views(self, views: Sequence[View], isocenter: Vector) -> list[View]:
        """Return views that were given in the C-arm's frame in the CT's frame."""
        return [view_of(view, self.pose, isocenter) for view in views]

    def place_covariance(self, anatomy: Anatomy) -> Float[np.ndarray, "3 3"]:
        """Return what is left open of where the vessel lies, mm², the mean over it."""
        points, isocenter = anatomy.tree.line.points[::8], isocenter_of(anatomy)
        moved = [Pose.of_vector(self.pose.vector + step) for step in np.linalg.cholesky(self.covariance).T]
        off = np.array([one.move(points, isocenter) for one in moved]) - self.pose.move(points, isocenter)
        return np.einsum("kni,knj->ij", off, off) / len(points)


def register(
    anatomy: Anatomy,
    views: Sequence[View],
    contrasted: Images,
    before: Images,
    config: ImageConfig | None = None,
    start: Pose | None = None,
) -> Registration:
    """Find the pose in which the patient lies, given an image of the filled vessel, and one before, for each view.

    Views are in the C-arm's frame, images those of `XrayImager.signal`. A start is the pose that is looked around, such
    as that of the frame before, in a cine, whose contrast need not fill the vessel alike; without one it is the pose
    that the CT has, and the vessel is filled.
    """
    isocenter, lumen = isocenter_of(anatomy), sampled_lumen(anatomy, alike=start is None)
    laid = np.zeros(6) if start is None else start.vector

    def maps(pose: Float[np.ndarray, "6"]) -> Float[np.ndarray, "1 3 4"]:
        return Pose.of_vector(pose).affine(isocenter)[None]

    bounds = laid - _FAR * _PRIOR, laid + _FAR * _PRIOR
    fit = _Fit(maps, laid, _PRIOR, bounds, lumen, views, config or ImageConfig())
    levels = _LEVELS if start is None else _LEVELS[1:]
    found, covariance, correlation, failure = fit.best([contrasted], before, levels)
    # How far off a vessel lies that was laid by its images says nothing against it.
    far = float(np.abs((found - laid) / _PRIOR)[: 6 if start is None else 3].max()) + 1e-2
    if not failure and far > _FAR:
        failure = "the vessel fits the image only far from where the patient was laid; check the views' angles"
    return Registration(Pose.of_vector(found), covariance, correlation, failure)


def register_motion(
    anatomy: Anatomy,
    views: Sequence[View],
    contrasted: Sequence[Images],
    before: Images,
    mean: Motion,
    config: ImageConfig | None = None,
) -> Registration:
    """Find the amplitudes of a patient's motion; phase and period of heart and breath are known, by ECG and belt.

    Views are in the frame of the CT as the patient was registered. The vessel is filled in an image for each of
    `RUN_TIMES_S` and view; in those before, heart and breath are at rest. `mean` is what is known beforehand: the
    published mean of what moves, with the patient's periods.
    """
    names = [name for name in AMPLITUDES if getattr(mean, name) != 0]
    centre = np.array([getattr(mean, name) for name in names])
    deviation = np.array([AMPLITUDES[name][1] for name in names])
    least = np.array([0.0 if name in ("annulus_mm", "heart_volume_share") else -np.inf for name in names])
    bounds = np.maximum((least - centre) / deviation, -_AMPLITUDE_FAR), np.full(len(names), _AMPLITUDE_FAR)

    def motion(deviations: Float[np.ndarray, "k"]) -> Motion:
        found = centre + np.clip(deviations, *bounds) * deviation  # derivatives step across the bounds
        return replace(mean, **dict(zip(names, found.tolist(), strict=True)))

    def maps(deviations: Float[np.ndarray, "k"]) -> Float[np.ndarray, "times 3 4"]:
        core = motion(deviations).core(np.asarray(anatomy.insertion.position))
        return core.placements(np.array(RUN_TIMES_S))[0]

    none, one = np.zeros(len(names)), np.ones(len(names))
    fit = _Fit(maps, none, one, bounds, sampled_lumen(anatomy), views, config or ImageConfig())
    found, covariance, correlation, failure = fit.best(contrasted, before, _MOTION_LEVELS)
    return Registration(Pose(), covariance, correlation, failure, motion(found))


def take_run(
    imager: XrayImager,
    angles_deg: Sequence[tuple[float, float]],
    pose: Pose,
    motion: Motion,
    random: np.random.Generator,
) -> list[list[Image]]:
    """Inject contrast into a patient who lies and moves so; return an image for each of `RUN_TIMES_S` and view."""
    run, none = [], np.zeros((0, 3))
    for placed in motion.core(np.asarray(imager.anatomy.insertion.position)).placements(np.array(RUN_TIMES_S))[0]:
        planes = [imager.plane(angle, pose=pose, placed=placed) for angle in angles_deg]
        run.append([imager.signal(each, none, contrast=1.0, seed=int(random.integers(2**31))) for each in planes])
    return run


def lay(anatomy: Anatomy, views: Sequence[View], contrasted: Images, before: Images, config: ImageConfig) -> Pose:
    """Return the shift, up to half an image, in which the vessel fits the images best, with which a registration begins
    where nobody says how far the vessel lies from the isocenter; arguments as `register` has."""
    averaged, blur = _LEVELS[0]
    observed = observed_contrast(contrasted, before, averaged, blur, config)
    points, size, _ = sampled_lumen(anatomy)
    rows, shifts = [], []
    for view, theirs in zip(views, observed, strict=True):
        ours = Shadow(view.magnified(1 / averaged), config.pixels // averaged, points).of(size, blur_px=blur)
        ours, theirs = ours - ours.mean(), theirs - np.median(theirs)
        side = 2 * len(ours)
        alike = np.fft.irfft2(
            np.fft.rfft2(theirs, (side, side)) * np.fft.rfft2(ours, (side, side)).conj(), (side, side)
        )
        down, right = (int(at) - side * (at >= side // 2) for at in np.unravel_index(alike.argmax(), alike.shape))
        rows.append(view.slope(isocenter_of(anatomy)))
        shifts.append([averaged * right, -averaged * down])
    shift = np.linalg.pinv(np.concatenate(rows)) @ np.concatenate(shifts)
    return Pose(translation_mm=shift)


@dataclass(frozen=True, eq=False)
class _Fit:
    """Numbers that are sought, laid so with these standard deviations before any image, and the affine maps of the CT's
    points, LPS mm, that they make at each moment; and the comparison of the lumen, projected so, with what contrast
    added to each image then: `averaged` pixels along a side are one, and the blur is in these."""

    maps: Callable[[Float[np.ndarray, "k"]], Float[np.ndarray, "moments 3 4"]]
    laid: Float[np.ndarray, "k"]
    sd: Float[np.ndarray, "k"]
    bounds: tuple[Float[np.ndarray, "k"], Float[np.ndarray, "k"]]
    lumen: tuple[Places, Float[np.ndarray, "n"], Float[np.ndarray, "n"]]
    views: Sequence[View]
    config: ImageConfig
    observed: Sequence[Sequence[np.ndarray]] = ()
    averaged: int = 1
    blur: float = 0.0

    def best(
        self, contrasted: Sequence[Images], before: Images, levels: Sequence[tuple[int, float]]
    ) -> tuple[Float[np.ndarray, "k"], Float[np.ndarray, "k k"], float, str]:
        """Return the numbers that are sought, their covariance, the correlation, and why not to believe them."""
        found, covariance, correlation = self.laid, np.diag(self.sd**2), 0.0
        for averaged, blur in levels:
            observed = [observed_contrast(images, before, averaged, blur, self.config) for images in contrasted]
            if not any(np.ptp(image) for images in observed for image in images):
                return found, covariance, 0.0, "images with and without contrast are the same; inject contrast"
            points, size, along = (part[:: averaged // 2] for part in self.lumen)  # coarse images need fewer points
            fewer = points, size * (self.lumen[1].sum() / size.sum()), along
            level = replace(self, lumen=fewer, observed=observed, averaged=averaged, blur=blur)
            slope: Any = level.slope  # the annotation of scipy knows names of schemes alone
            how = {"bounds": self.bounds, "x_scale": self.sd, "max_nfev": 10, "xtol": 1e-4, "ftol": 1e-4}
            fit = least_squares(level.residuals, found, slope, **how)
            found, correlation, covariance = fit.x, level.correlation(fit.x), level.covariance(fit.jac, fit.fun)
        disagrees = f"the image and the vessel agree by {correlation:.2f} only; inject contrast, or choose another view"
        return found, covariance, correlation, "" if correlation >= _AGREES else disagrees

    def fitted(self, sought: Float[np.ndarray, "k"]) -> list[list[tuple[np.ndarray, np.ndarray, float]]]:
        """Return for each image what is expected, what is observed, and how strong the contrast shows.

        Unless the vessel is filled alike, by an injection of one's own, nobody knows how strong it shows, how that
        changes along the vessel as the blood carries it, and on which ground: each is what fits best.
        """
        (points, size, along), pixels = self.lumen, self.config.pixels // self.averaged
        fillings, found = (size, size * along) if along.any() else (size,), []
        for placed, observed in zip(self.maps(sought), self.observed, strict=True):
            found.append([])
            for view, theirs in zip(self.views, observed, strict=True):
                shadow = Shadow(view.magnified(1 / self.averaged), pixels, points, placed)
                parts = self.config.iodine_mm * np.stack([shadow.of(each, blur_px=self.blur) for each in fillings])
                found[-1].append(self._scaled(parts, theirs))
        return found

    def _scaled(self, parts: np.ndarray, theirs: np.ndarray) -> tuple[np.ndarray, np.ndarray, float]:
        along = self.lumen[2]
        if len(parts) == 1:
            return parts[0], theirs, 1.0
        flat = np.stack([part - part.mean() for part in parts]).reshape(2, -1)
        theirs = theirs - theirs.mean()
        square = flat @ flat.T
        square[np.diag_indices(2)] *= 1 + _LITTLE
        shares = np.linalg.lstsq(square, flat @ theirs.ravel(), rcond=None)[0]
        return (shares @ flat).reshape(theirs.shape), theirs, max(float(shares @ [1.0, along.mean()]), _WEAKEST)

    def residuals(self, sought: Float[np.ndarray, "k"]) -> Float[np.ndarray, "n"]:
        """Return how far the images are from what is expected, and what is sought from where it was laid, in sd."""
        full = _MISFIT * self.config.iodine_mm * 3.0  # a vessel of 3 mm
        fitted = [image for moment in self.fitted(sought) for image in moment]
        off = np.concatenate([((ours - theirs) / (strength * full)).ravel() for ours, theirs, strength in fitted])
        soft = np.sign(off) * np.sqrt(2 * (np.sqrt(1 + off**2) - 1))  # scipy's loss would soften the prior too
        return np.concatenate([soft / self._together, (sought - self.laid) / self.sd])

    @property
    def _together(self) -> float:
        """By how much less a pixel tells than one alone: a Gaussian blur makes 4π times its square err together."""
        return np.sqrt(4 * np.pi) * self.blur

    def slope(self, sought: Float[np.ndarray, "k"]) -> Float[np.ndarray, "n k"]:
        """Return the derivative of the residuals by what is sought."""
        steps = _STEP_SHARE * self.averaged * np.diag(self.sd)
        columns = [(self.residuals(sought + step) - self.residuals(sought - step)) / (2 * step.sum()) for step in steps]
        return np.stack(columns, axis=-1)

    def covariance(self, slope: Float[np.ndarray, "n k"], residual: Float[np.ndarray, "n"]) -> Float[np.ndarray, "k k"]:
        """Return the covariance of what fits: what the pixels leave open, with the prior."""
        slope, residual = (part[: -slope.shape[1]] for part in (slope, residual))
        near = np.abs(slope).max(axis=1) >= _FELT * np.abs(slope).max()
        misfit = float(np.sqrt(np.mean(residual[near] ** 2))) * self._together
        return np.linalg.inv(slope.T @ slope / misfit**2 + np.diag(self.sd**-2.0))

    def correlation(self, sought: Float[np.ndarray, "k"]) -> float:
        """Return the correlation of what was expected and observed around the vessel, at the worst moment."""
        found = []
        for images in self.fitted(sought):
            ours = np.concatenate([(one - one.min()).ravel() for one, _, _ in images])
            theirs = np.concatenate([one.ravel() for _, one, _ in images])
            near = ours > 0.02 * ours.max()
            wide = near | (gaussian_filter(near.astype(np.float32), 2.0) > 0)
            tells = wide.sum() >= 3 and np.ptp(theirs[wide]) > 0
            found.append(float(np.corrcoef(ours[wide], theirs[wide])[0, 1]) if tells else 0.0)
        return min(found)


def observed_contrast(
    contrasted: Images, before: Images, averaged: int, blur: float, config: ImageConfig
) -> list[np.ndarray]:
    """Return what contrast added to each image, as `_Fit` compares it; arguments as `register` has."""
    reach, added = config.scatter_mm / config.geometry.pixel_mm / averaged, []
    for pair in zip(contrasted, before, strict=True):
        light, empty = (downscale_local_mean(np.exp(image), (averaged, averaged)) for image in pair)
        # Scatter is estimated as the image before, spread out.
        scatter = config.scatter / (1 + config.scatter) * gaussian_filter(empty, reach, mode="constant")
        least = _DARKEST * empty
        ratio = np.maximum(empty - scatter, least) / np.maximum(light - scatter, least)
        added.append(gaussian_filter(np.log(ratio).astype(np.float32), blur))
    return added


def sampled_lumen(
    anatomy: Anatomy, *, alike: bool = True
) -> tuple[Places, Float[np.ndarray, "n"], Float[np.ndarray, "n"]]:
    """Return a sample of the lumen, and of the catheter's straight end, which contrast fills too: places, LPS mm, the
    volume that each stands for, mm³, and how far along the vessel it lies, from 0 to 1; 0 if contrast fills all of it
    alike, as when an injection waits for that."""
    behind, size_behind = catheter_lumen_points(anatomy)
    reach_mm, count = (10.0, _POINTS // 10) if alike else (30.0, _POINTS // 20)
    near = np.linalg.norm(behind - anatomy.insertion.position, axis=1) < reach_mm
    random, parts = np.random.default_rng(0), []
    for points, size, most in ((*lumen_points(anatomy), _POINTS), (behind[near], size_behind[near], count)):
        chosen = random.permutation(len(points))[:most]
        parts.append((points[chosen], size[chosen] * size.sum() / size[chosen].sum()))
    (inside, _), (others, _) = parts
    line = anatomy.tree.line
    share = 0.0 if alike else 1 / line.abscissa.max()
    along = share * line.abscissa[KDTree(line.points).query(inside)[1]]
    points, size = map(np.concatenate, zip(*parts, strict=True))
    return points, size, np.append(along, np.zeros(len(others)))
