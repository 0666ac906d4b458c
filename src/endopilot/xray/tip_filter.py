"""★ The tip of a device in a vessel tree, followed over time through lines in images: a pose for each place of a grid.

The state is the place of the tip, one of a grid along all branches, and for each place a normal distribution of the
patient's pose: three shifts and three rotations. From frame to frame the tip travels a little, or, in a small share of
the frames, is anywhere: so a tip in the wrong branch is found again. Heart and breath move the way smoothly, and anew
in each frame.

In a frame the device's line is compared with the projected way to each place (`line_observations`), with what is known
of pose, of breathing, and of how far the device lies off its way.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float, Int

from endopilot.errors import InputError
from endopilot.progress import progress
from endopilot.settings import public
from endopilot.types import Anatomy, VesselTree
from endopilot.xray.camera import Camera
from endopilot.xray.carm import Places, Pose, Vector, View
from endopilot.xray.line_observations import DeviceFrame, Line, Observations, SeenLine, shift_onto, shown_by
from endopilot.xray.tip_posterior import LocateConfig, Status, TipEstimate, Told, VesselGrid

_STEP_MM = 1.0
"""Distance of the grid's places, mm."""
_BREATH_MM = 120.0
"""Length along the vessel over which breathing and heartbeat move it alike, mm."""
_BEND_SD_MM, _BEND_MM = 2.0, 30.0
"""How far the device bends the vessel, mm, and over which length of it alike."""
_ASIDE_SD_MM, _ASIDE_RADII, _ASIDE_MM = 1.5, 0.1, 20.0
"""How far the device lies off its way: this, and this share of the lumen's radius, mm; and over which length alike."""
_DRIFT_MM, _DRIFT_RAD = 0.5, np.deg2rad(0.2)
"""Standard deviations of how the pose drifts from frame to frame."""
_LANDMARK_SD_MM, _DEPTH_SD_MM, _TIP_SD_MM = 6.0, 12.0, 2.0
"""Of the shift that a landmark shows, since the vessel breathes; more along the beam, since a C-arm's distances are
known to some 1.5 % of 800 mm, and depth and scale look alike; and of a tip that is a landmark, along the vessel."""
_STRAY, _BEYOND = np.log(1 / 200), -2.5
"""Logarithm of the density, 1/mm, of a point that is not of the device, evenly in 200 mm; and of one in the catheter or
vessel before the root, where the way is not known."""
_LEAST_ODDS = 20.0
"""A line is the device's where it is likelier so, by this logarithm, than if its points were strays."""
_ROUNDS = 3
_PRUNE, _MOST = 18.0, 600
"""Places whose tip alone is less likely than the best one's by this logarithm are not compared further, nor more than
so many."""
_NEAR_MM = 12.0
"""Mean and covariance are those of the posterior within this distance of its mode, mm."""
_SURE = 0.9
"""A tip is ambiguous where less of the posterior lies there."""


@dataclass(frozen=True, eq=False)
class TipLocation:
    """Where the tip is in one frame; NaN where it is not found.

    Attributes:
        frame: its number.
        status: "found"; "ambiguous" where more than a tenth of the posterior lies elsewhere; "not found" where the
            frame shows no line, or one that no way through the vessel explains.
        position: of the tip, LPS mm of the CT.
        covariance: of the position, mm².
        share: of the posterior that lies near it.
        abscissa: along the centerline from the tree's root, mm.
        branch: index in the tree; -1 where it is not found.
        section: its name; empty where it is not found.
        moved_mm: how far the vessel lies there from where the cameras have the CT, by pose, heart and breath, LPS mm.
        residual_mm: mean distance of the line from the moved way, mm; NaN where only the tip is seen.
    """

    frame: int
    status: Status
    position: Vector
    covariance: Float[np.ndarray, "3 3"]
    share: float
    abscissa: float
    branch: int
    section: str
    moved_mm: Vector
    residual_mm: float

    @classmethod
    def nowhere(cls, frame: int) -> TipLocation:
        """Return that a frame shows no tip."""
        nothing = np.full(3, np.nan)
        return cls(frame, "not found", nothing, np.full((3, 3), np.nan), 0.0, np.nan, -1, "", nothing, np.nan)


def located(tree: VesselTree, frame: int, found: TipEstimate, place: tuple[int, float], **rest: Any) -> TipLocation:
    """Return a location, given branch and abscissa, mm, of the place, and how the vessel and the line lie."""
    if found.status == "not found":
        return TipLocation.nowhere(frame)
    branch, abscissa = place
    line = tree.branches[branch]
    section = tree.section_names[line.section[np.abs(line.centerline.abscissa - abscissa).argmin()]]
    return TipLocation(
        frame, found.status, found.position, found.covariance, found.share, abscissa, branch, section, **rest
    )


class _Fit(NamedTuple):
    """What observations say of some places of the tip: their logarithm, and the pose with its covariance; how far the
    vessel is moved at each observation beyond the mean pose, mm, and how far the device lies aside of its way at the
    first one, mm, with its covariance, mm²."""

    log_density: Float[np.ndarray, "m"]
    mean: Float[np.ndarray, "m 6"]
    covariance: Float[np.ndarray, "m 6 6"]
    moved: Float[np.ndarray, "m r 3"]
    aside: Float[np.ndarray, "m 3"]
    aside_covariance: Float[np.ndarray, "m 3 3"]


class _Seen(NamedTuple):
    """A frame's number, what its lines say of some places, and with the frames before, the lines' residuals, mm; and
    how far the vessel lies there from where the cameras have the CT, LPS mm."""

    frame: int
    told: Told
    before: Float[np.ndarray, "m"]
    residual_mm: Float[np.ndarray, "m"]


class TipFilter:
    """Follows the tip of one device, one of the places of a `grid`, through the frames of a sequence."""

    def __init__(self, tree: VesselTree, cameras: Sequence[Camera | View], config: LocateConfig | None = None) -> None:
        """Take the vessel and what sees it; `config` says what is known before the first frame."""
        self.config = config or LocateConfig()
        self._tree, self._cameras = tree, tuple(cameras)
        self.grid: VesselGrid = VesselGrid.of(tree, step_mm=_STEP_MM)
        self._way = self.grid.straightened(self.config.stiff_mm)
        count = len(self.grid.middle)
        self._centre = self._way.mean(axis=0)
        self._aside = _ASIDE_SD_MM + _ASIDE_RADII * self.grid.radius
        turn = np.deg2rad(self.config.turn_sd_deg)
        spread = np.array([*[self.config.registration_sd_mm] * 3, *[turn] * 3])
        self._log = np.full(count, -np.log(count))
        self._mean = np.zeros((count, 6))
        self._covariance = np.tile(np.diag(spread**2), (count, 1, 1))
        self._begun, self._registers_itself = False, self.config.landmark_mm is None and len(self._cameras) == 1
        self._seen: list[_Seen] = []

    def update(self, frame: int, lines: Sequence[Line | None]) -> TipLocation:
        """Return where the tip is, by this frame and those before; a frame's number and lines are as `DeviceFrame` has
        them."""
        if self._begun:
            self._predict(max(frame - self._frame, 1))
        else:
            self._begun = self._begin(lines)
        self._frame = frame
        if all(line is None for line in lines):
            return TipLocation.nowhere(frame)
        share = np.exp(self._log)
        base = share @ self._mean
        pairs, way = zip(self._cameras, lines, strict=True), self._moved(base)
        seen = [SeenLine.of(self.grid, camera, line, way) for camera, line in pairs if line is not None]
        everywhere = np.arange(len(self._log))
        score = self._log + self._compare(seen, everywhere, base, rounds=0)[0].log_density
        best = np.argsort(-score, kind="stable")[:_MOST]
        places = np.sort(best[score[best] > score[best[0]] - _PRUNE])
        whole = any(len(one.at) for one in seen)
        fit, rows, beyond = self._compare(seen, places, base, rounds=_ROUNDS if whole else 0)
        # Points that fit no place are strays; so would all be that lie in the vessel, were there no device.
        odds = fit.log_density - _STRAY * rows.used.sum(axis=1)
        if np.logaddexp.reduce(self._log[places] + odds) < (_LEAST_ODDS if whole else 0.0):
            return TipLocation.nowhere(frame)
        odds = odds + (_BEYOND - _STRAY) * beyond
        before = self._log[places]
        self._log = np.full_like(self._log, -np.inf)
        self._log[places] = before + odds - np.logaddexp.reduce(before + odds)
        self._mean[places], self._covariance[places] = fit.mean, fit.covariance
        left = np.abs(rows.value - np.einsum("mri,mri->mr", rows.towards, fit.moved))
        of_line = rows.used & (rows.place != places[:, None])
        moved = (self._moved(base) - self._way)[places] + fit.moved[:, 0]
        residual = np.where(of_line, left, 0.0).sum(axis=1) / np.where(of_line.any(1), of_line.sum(1), np.nan)
        spread = np.zeros((len(places), 6, 6))
        spread[:, :3, :3] = fit.aside_covariance
        told = Told(places, odds, np.concatenate([fit.aside, moved], axis=1), spread)
        self._seen.append(_Seen(frame, told, before, residual))
        return self._answer(self._seen[-1], before)

    def smooth(self) -> dict[int, TipLocation]:
        """Return where the tip is in each frame that shows it, by all frames, those after too. None is returned where
        one view of a patient whom the device alone registers shows travel and shift alike: what later frames say of the
        tip's place is what they say of the pose, and tells nothing more."""
        if self._registers_itself:
            return {}
        frames = np.diff(np.array([one.frame for one in self._seen], dtype=float))
        told = self.grid.told_by_later(self.config, [one.told for one in self._seen], frames)
        return {one.frame: self._answer(one, one.before + later) for one, later in zip(self._seen, told, strict=True)}

    def _begin(self, lines: Sequence[Line | None]) -> bool:
        """Register the patient by the landmark, if there is one; return whether it was seen or is not needed."""
        if self.config.landmark_mm is None:
            return True
        point, line = np.array(self.config.landmark_mm), lines[0]
        pixel = self.config.landmark_px
        if pixel is None:
            if line is None:
                return False
            pixel = tuple(line[0])
            nearest = int(np.linalg.norm(self.grid.middle - point, axis=1).argmin())
            log = -self.grid.distance[nearest] / _TIP_SD_MM
            self._log = log - np.logaddexp.reduce(log)
        shift = shift_onto(self._cameras[0], point, np.array(pixel))
        self._mean[:, :3] = shift
        beam = np.linalg.svd(shown_by(self._cameras[0], point[None] + shift)[1][0])[2][2]
        self._covariance[:, :3, :3] = _LANDMARK_SD_MM**2 * np.eye(3) + _DEPTH_SD_MM**2 * np.outer(beam, beam)
        return True

    def _predict(self, frames: int) -> None:
        """Let the tip travel and the pose drift for some frames; what comes together at a place is one normal there."""
        flow = self.grid.goes(self.config, float(frames)) * np.exp(self._log)[:, None]
        total = flow.sum(axis=0)
        flow /= total
        drift = np.diag(np.array([*[_DRIFT_MM] * 3, *[_DRIFT_RAD] * 3]) ** 2)
        square = self._covariance + self._mean[:, :, None] * self._mean[:, None]
        mean = flow.T @ self._mean
        square = (flow.T @ square.reshape(len(total), -1)).reshape(square.shape)
        self._log, self._mean = np.log(total), mean
        self._covariance = square - mean[:, :, None] * mean[:, None] + frames * drift

    def _moved(self, pose: Float[np.ndarray, "6"]) -> Places:
        return Pose(pose[3:], pose[:3]).move(self._way, self._centre)

    def _compare(
        self, seen: Sequence[SeenLine], places: Int[np.ndarray, "m"], base: Float[np.ndarray, "6"], *, rounds: int
    ) -> tuple[_Fit, Observations, Int[np.ndarray, "m"]]:
        """Return what lines say of some places of the tip, and how many of their points lie before the root. At first
        the ends alone are compared; then, so many times, the points with the way as it is moved by then."""
        parts = [one.observe(self.grid, places, None) for one in seen]
        rows = Observations.joined([part for part, _ in parts])
        fit = self._fit(places, rows, base)
        moved = [np.repeat(fit.moved[:, :1], len(one.at), axis=1) for one in seen]
        for _ in range(rounds):
            parts = [one.observe(self.grid, places, shift) for one, shift in zip(seen, moved, strict=True)]
            rows = Observations.joined([part for part, _ in parts])
            fit = self._fit(places, rows, base)
            bounds = np.cumsum([part.value.shape[1] for part, _ in parts])[:-1]
            of_lines = zip(seen, np.split(fit.moved, bounds, axis=1), strict=True)
            moved = [of_line[:, 2 : 2 + len(one.at)] for one, of_line in of_lines]
        return fit, rows, np.sum([outside for _, outside in parts], axis=0)

    def _fit(self, places: Int[np.ndarray, "m"], rows: Observations, base: Float[np.ndarray, "6"]) -> _Fit:
        """Return the density of observations, and the posterior of what they depend on."""
        arm = self._moved(base)[rows.place] - self._centre - base[:3]
        towards, used = rows.towards, rows.used
        lever = np.concatenate([towards, np.cross(arm, towards)], axis=-1)
        prior, covariance = self._mean[places] - base, self._covariance[places]
        apart = self.grid.abscissa[rows.place]
        apart = apart[:, :, None] - apart[:, None]
        smooth = self.config.breathing_sd_mm**2 * _alike(apart, _BREATH_MM) + _BEND_SD_MM**2 * _alike(apart, _BEND_MM)
        aside = self._aside[rows.place]
        aside = aside[:, :, None] * aside[:, None] * _alike(apart, _ASIDE_MM)
        of_pose = lever @ covariance
        expected = (towards @ towards.swapaxes(1, 2)) * (smooth + aside) + of_pose @ lever.swapaxes(1, 2)
        one = np.eye(len(rows.variance))
        both = used[:, :, None] & used[:, None]
        expected = np.where(both, expected + np.diag(rows.variance), one)
        error = np.where(used, rows.value - np.einsum("mri,mi->mr", lever, prior), 0.0)
        gains = np.concatenate([error[..., None], of_pose, aside[:, :1].swapaxes(1, 2) * towards], axis=-1)
        gains[~used] = 0.0
        solved = np.linalg.solve(expected, gains)
        weight = solved[..., 0]
        _, log_size = np.linalg.slogdet(expected)
        log_density = -0.5 * ((error * weight).sum(axis=1) + log_size + used.sum(axis=1) * np.log(2 * np.pi))
        change = np.einsum("mri,mr->mi", of_pose, weight)
        pose = prior + change
        across = np.cross(pose[:, None, 3:6], arm)
        moved = pose[:, None, :3] + across + smooth @ (weight[..., None] * towards)
        own = gains[..., 7:]
        left = covariance - gains[..., 1:7].swapaxes(1, 2) @ solved[..., 1:7]
        beside = aside[:, :1, :1] * np.eye(3) - own.swapaxes(1, 2) @ solved[..., 7:]
        return _Fit(log_density, base + pose, left, moved, np.einsum("mri,mr->mi", own, weight), beside)

    def _answer(self, seen: _Seen, prior: Float[np.ndarray, "m"]) -> TipLocation:
        """Return where the tip is, given what other frames say of the places."""
        found, places = self.grid.estimate(seen.told, prior, _NEAR_MM), seen.told.places
        near = places[np.linalg.norm(self.grid.middle[places] - self.grid.middle[found.mode], axis=1) <= _NEAR_MM]
        place = near[np.linalg.norm(self.grid.middle[near] - found.position, axis=1).argmin()]
        best = np.searchsorted(places, found.mode)
        return located(
            self._tree,
            seen.frame,
            found if found.share >= _SURE else replace(found, status="ambiguous"),
            (int(self.grid.branch[place]), float(self.grid.abscissa[place])),
            moved_mm=seen.told.mean[best, 3:],
            residual_mm=float(seen.residual_mm[best]),
        )


def _alike(apart: np.ndarray, length: float) -> np.ndarray:
    """Return the correlation of what lies so far apart along the vessel, mm."""
    return np.exp(-0.5 * (apart / length) ** 2)


@public
def locate(
    anatomy: Anatomy,
    *,
    frames: Sequence[DeviceFrame],
    cameras: Sequence[Camera | View],
    config: LocateConfig | None = None,
) -> tuple[TipLocation, ...]:
    """Find the tip of a device in each frame of a sequence, by all frames.

    Args:
        anatomy: the vessel; only its tree is used.
        frames: what the cameras show, in the order of time.
        cameras: one or two, or views, whose pixels count from the image's middle; their coordinates are those of the CT
            as far as the patient is registered.
        config: what is known of patient and device before the first frame.

    Raises:
        InputError: a frame has another number of lines than there are cameras.
    """
    for frame in frames:
        if len(frame.lines) != len(cameras):
            raise InputError(
                f"frame {frame.number}: {len(frame.lines)} lines for {len(cameras)} cameras; give one for each, or None"
            )
    follow, found = TipFilter(anatomy.tree, cameras, config), []
    with progress(f"locate {anatomy.name}", len(frames)) as advance:
        for frame in frames:
            found.append(follow.update(frame.number, frame.lines))
            advance()
    return tuple(({one.frame: one for one in found} | follow.smooth()).values())
