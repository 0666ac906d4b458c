"""What an X-ray exposure says of wire and guiding catheter: measurements with the errors of a C-arm, never the truth.

The tip is projected onto one or two detectors, is found there with an error in pixels, and is located in space as the
most likely place given the pixels and the vessel: the tip of a wire lies about as far from the vessel's axis as its
wall, and no deeper than the wire is inserted. It may be measured outside the lumen, which may be wider than it is
believed. The second view or, with a single one, the vessel gives the depth. The guiding catheter is a line in each
view. docs/concepts/exposure.md says where the numbers come from.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import NamedTuple, Protocol, runtime_checkable

import numpy as np
from jaxtyping import Float

from endopilot.anatomy.projection import TipProjector
from endopilot.anatomy.tree import tangents
from endopilot.errors import InputError
from endopilot.settings import Finite, Positive, settings
from endopilot.simulation.motion import Motion
from endopilot.simulation.simulator import Simulator
from endopilot.tasks.navigation import Navigation
from endopilot.types import Anatomy
from endopilot.xray.carm import CArmGeometry, View, view_at
from endopilot.xray.moving_patient import seen_wire

_CATHETER_MM = 20.0
"""Length of the guiding catheter behind the ostium that is straight, in which a tip may be found, mm."""
_LEAN_SD = np.sin(np.radians(20.0))
"""Standard deviation of a guiding catheter's axis, a unit vector, across the given one before it is seen."""
_ITERATIONS, _NEAR_ENOUGH_MM = 8, 1e-2
_UNCLAMPED = 3.0
"""Two views need the vessel to tell branches apart, not to place the tip: across it, the prior is this much wider, so
that a tip outside the lumen as it is believed is measured where it is."""
_HOPELESS = 30.0
"""Vertices that are this much less likely than the best of all (twice the log-likelihood) are left out."""
_NEAR_SHARE = 0.1
"""Standard deviation of (abscissa of the tip)/(inserted length): curved vessels are cut short, wires snake."""


@dataclass(frozen=True, eq=False)
class TipMeasurement:
    """What an X-ray exposure says of the tip; a measurement, never the truth.

    Attributes:
        position: of the tip, LPS mm.
        abscissa: Δtip of that position on the vessel's tree, mm.
        offset: γtip, mm.
        branch: index of the branch that it is observed in.
        covariance: of the position, mm²; 0 where it is not stated.
        tip_sd_mm: standard deviations of Δtip and γtip, mm; likewise.
        around_sd_mm: that of the position around the vessel's line, across both, mm; likewise.
    """

    position: Float[np.ndarray, "3"]
    abscissa: float
    offset: float
    branch: int
    covariance: Float[np.ndarray, "3 3"] = field(default_factory=lambda: np.zeros((3, 3)))
    tip_sd_mm: tuple[float, float] = (0.0, 0.0)
    around_sd_mm: float = 0.0

    def less(self, tip: Float[np.ndarray, "*n 2"]) -> Float[np.ndarray, "*n 2"]:
        """Return what was measured less (Δtip, γtip) as predicted, mm.

        A position that errs by σ around the vessel's line may be of any γtip from √(γ² − σ²) to √(γ² + σ²): what a
        single view shows near the line may lie on the wall before or behind it. Predictions between agree with it.
        """
        square, around = self.offset**2, self.around_sd_mm**2
        low, high = np.sqrt(max(square - around, 0.0)), np.sqrt(square + around)
        return np.stack([self.abscissa - tip[..., 0], np.clip(tip[..., 1], low, high) - tip[..., 1]], axis=-1)


@runtime_checkable
class CArm(Protocol):
    """A C-arm around one patient.

    Attributes:
        known_motion: what is known of how the patient moves; an exposure takes it off.
        registration_mm: the wire shows displaced by this, LPS mm.
    """

    known_motion: Motion | None
    registration_mm: tuple[float, float, float]

    def expose(
        self, simulator: Simulator, inserted_length: float, random: np.random.Generator, *, time_s: float
    ) -> TipMeasurement | None:
        """Take one exposure of every view and say where the wire's tip is; None where no wire is found.

        Args:
            simulator: of one world, the wire as it truly is.
            inserted_length: Δ by the robot's encoder, mm.
            random: where the errors are drawn from.
            time_s: of this moment, s.
        """
        ...

    def measure_motion(self, motion: Motion | None, random: np.random.Generator) -> Motion | None:
        """Inject contrast and return how the patient moves by a run of images; None where that is nothing known.

        Raises:
            InputError: this C-arm's exposures cannot show it.
        """
        ...


@settings
class FluoroscopeConfig:
    """Geometry of the C-arm and errors of detection."""

    biplane: bool = True
    """Two views at once; else the first alone."""
    view_angles_deg: tuple[tuple[Finite, Finite], tuple[Finite, Finite]] = ((-30.0, 0.0), (60.0, 0.0))
    """Of each view, LAO (positive) or RAO (negative), and cranial (positive) or caudal (negative), degrees."""
    geometry: CArmGeometry = field(default_factory=CArmGeometry)
    """Distances and pixels."""
    pixel_sd: Positive = 0.5
    """Standard deviation of the tip's place in the image across the wire, pixels."""
    along_sd: Positive = 2.6
    """Standard deviation along the wire, pixels: where a thin tip ends is harder to see than where it runs."""


class _Detection(NamedTuple):
    """A tip found at a pixel; `whiten` turns an error into parts along and across the wire, standard deviations."""

    view: View
    pixel: Float[np.ndarray, "2"]
    whiten: Float[np.ndarray, "2 2"]


def measurement_at(
    project: TipProjector,
    anatomy: Anatomy,
    places: Float[np.ndarray, "n 3"],
    covariances: Float[np.ndarray, "n 3 3"],
    weight: Float[np.ndarray, "n"] | None = None,
) -> TipMeasurement:
    """Return the measurement of a tip at one of some places, LPS mm, the likeliest first.

    It has a covariance around each place, if it is there, mm², and each is as likely as its weight says, or equally.
    """
    share = np.full(len(places), 1.0 / len(places)) if weight is None else weight / weight.sum()
    tips = project(places)
    branch, abscissa = int(tips.branch[0]), float(tips.abscissa[0])
    line, tangent = anatomy.tree.branches[branch].centerline, np.asarray(anatomy.insertion.direction)
    centre = anatomy.insertion.position + abscissa * tangent
    if abscissa > 0:
        centre, tangent = (
            np.array([np.interp(abscissa, line.abscissa, axis) for axis in values.T])
            for values in (line.points, tangents(line.points))
        )
    outwards = places[0] - centre
    outwards = outwards / max(float(np.linalg.norm(outwards)), 1e-9)
    axes = np.array([tangent, outwards, np.cross(tangent, outwards)])
    within = np.einsum("p,pij->ij", share, covariances)
    along, out, around = np.sqrt(np.einsum("ai,ij,aj->a", axes, within, axes)).tolist()
    off, tip = places - places[0], np.stack([tips.abscissa, tips.offset], axis=-1)
    tip_sd = np.hypot([along, out], np.sqrt(share @ (tip - tip[0]) ** 2)).tolist()
    covariance = within + np.einsum("p,pi,pj->ij", share, off, off)
    return TipMeasurement(
        places[0], abscissa, float(tips.offset[0]), branch, covariance, (tip_sd[0], tip_sd[1]), around
    )


class Fluoroscope:
    """A C-arm around one patient, whose vessel is known from the CT and registered to it."""

    def __init__(
        self,
        anatomy: Anatomy,
        wire_radius_mm: float,
        *,
        config: FluoroscopeConfig | None = None,
        known_motion: Motion | None = None,
        registration_mm: tuple[float, float, float] = (0.0, 0.0, 0.0),
    ) -> None:
        """Bring the middle of the vessel to the isocenter; `wire_radius_mm` is the tip's, the rest as `CArm` says."""
        self._anatomy, self._config = anatomy, config or FluoroscopeConfig()
        self.known_motion, self.registration_mm = known_motion, registration_mm
        lines = [branch.centerline for branch in anatomy.tree.branches]
        insertion = anatomy.insertion
        behind = np.linspace(-_CATHETER_MM, -0.5, 40)
        points = [line.points for line in lines]
        catheter = insertion.position + behind[:, None] * insertion.direction
        isocenter = np.concatenate(points).mean(axis=0)
        shown = self._config.view_angles_deg[: 2 if self._config.biplane else 1]
        self._views = [view_at(angles, isocenter, self._config.geometry) for angles in shown]
        radius = [np.full(len(behind), anatomy.catheter_radius_mm), *(line.radius for line in lines)]
        # A wire that lies on the wall, anywhere around, lies clearance/√2 from it along either axis, root mean square.
        wider = _UNCLAMPED if len(self._views) > 1 else 1.0
        self._lateral_sd = [wider * np.maximum(r - wire_radius_mm, 0.1) / np.sqrt(2) for r in radius]
        self._points = [catheter, *points]
        self._tangents = [np.tile(insertion.direction, (len(behind), 1)), *(tangents(p) for p in points)]
        self._abscissa = [behind, *(line.abscissa for line in lines)]
        self._shown = [[view.project(line) for line in self._points] for view in self._views]
        self._project = TipProjector(anatomy.tree, anatomy.insertion)

    def expose(
        self, simulator: Simulator, inserted_length: float, random: np.random.Generator, *, time_s: float
    ) -> TipMeasurement:
        """Take one exposure of every view and say where the wire's tip is, as `CArm` says."""
        ostium = self._anatomy.insertion.position
        _, tip, heading = seen_wire(simulator, self.known_motion, ostium, time_s, self.registration_mm)
        return self.measure(tip, heading, inserted_length, random)

    def measure_motion(self, motion: Motion | None, random: np.random.Generator) -> Motion | None:
        """Refuse to: what is assumed of errors says nothing of contrast.

        Raises:
            InputError: always.
        """
        raise InputError("measure_motion: exposures of assumed errors show no contrast; give xray: images")

    def measure(
        self,
        tip_position: Float[np.ndarray, "3"],
        tip_direction: Float[np.ndarray, "3"],
        inserted_length: float,
        random: np.random.Generator,
    ) -> TipMeasurement:
        """Take one exposure of every view and say where the tip is.

        Args:
            tip_position: where the tip truly is, LPS mm.
            tip_direction: unit vector along the wire at its tip.
            inserted_length: Δ by the robot's encoder, mm.
            random: where the errors are drawn from.
        """
        found = self._likeliest(tip_position, tip_direction, inserted_length, random)
        return measurement_at(self._project, self._anatomy, *found)

    def catheter_axis(self, axis: Float[np.ndarray, "3"], random: np.random.Generator) -> Float[np.ndarray, "3"]:
        """Take one exposure of every view and return the guiding catheter's axis as it shows, a unit vector.

        In a view the catheter is a line, and spans a plane with the source. The likeliest axis is returned, given these
        planes, each known as well as two points of the line, and how a catheter may lie before it is seen. The true
        axis points into the vessel.
        """
        insertion, pixel_sd = self._anatomy.insertion, self._config.pixel_sd
        ends = insertion.position - np.array([[0.0], [_CATHETER_MM]]) * axis
        information = np.eye(3) / _LEAN_SD**2
        for view in self._views:
            pixels = view.project(ends) + pixel_sd * random.standard_normal((2, 2))
            one, other = np.column_stack([pixels, np.full(2, view.scale)]) @ view.axes
            normal = np.cross(one, other)
            pixels_per_mm = view.scale / self._config.geometry.source_to_isocenter_mm
            sd = np.sqrt(2) * pixel_sd / (pixels_per_mm * _CATHETER_MM)
            information += np.outer(normal, normal) / (sd**2 * (normal @ normal))
        found = np.linalg.solve(information, insertion.direction / _LEAN_SD**2)
        return found / np.linalg.norm(found)

    def _detect(
        self,
        view: View,
        position: Float[np.ndarray, "3"],
        direction: Float[np.ndarray, "3"],
        random: np.random.Generator,
    ) -> _Detection:
        """Return where the tip is found in the image: the error is larger along the wire than across it."""
        slope = view.slope(position) @ direction
        along = slope / max(float(np.linalg.norm(slope)), 1e-9)
        axes = np.array([along, [-along[1], along[0]]])
        sd = np.array([self._config.along_sd, self._config.pixel_sd])
        error = random.standard_normal(2) * sd
        return _Detection(view, view.project(position) + error @ axes, axes / sd[:, None])

    def _likeliest(
        self,
        position: Float[np.ndarray, "3"],
        direction: Float[np.ndarray, "3"],
        inserted_length: float,
        random: np.random.Generator,
    ) -> tuple[Float[np.ndarray, "n 3"], Float[np.ndarray, "n 3 3"], Float[np.ndarray, "n"]]:
        """Return where the tip may be, LPS mm, the likeliest place first, with covariances and weights.

        A view may show several parts of the vessel at one place: the likeliest place of every such part is returned.
        """
        detections = [self._detect(view, position, direction, random) for view in self._views]
        length_sd = 2.0 + _NEAR_SHARE * max(inserted_length, 0.0)
        prior = [((abscissa - inserted_length) / length_sd) ** 2 for abscissa in self._abscissa]
        magnified = self._views[0].scale / self._config.geometry.source_to_isocenter_mm
        seen, first = list(zip(self._shown, detections, strict=True)), []
        for branch, (sd, unlikely) in enumerate(zip(self._lateral_sd, prior, strict=True)):
            squared = sum(((shown[branch] - one.pixel) ** 2).sum(axis=1) for shown, one in seen)
            first.append(squared / (self._config.along_sd**2 + (magnified * sd) ** 2) + unlikely)
        least = min(float(cost.min()) for cost in first)
        found = list[tuple[float, Float[np.ndarray, "3"], Float[np.ndarray, "3 3"]]]()
        for branch, guess in enumerate(first):
            fence = np.pad(guess, 1, constant_values=np.inf)
            valleys = (guess <= least + _HOPELESS) & (guess < fence[:-2]) & (guess <= fence[2:])
            for vertex in np.flatnonzero(valleys).tolist():
                place, cost_there, nearest, covariance = self._refine(detections, branch, vertex)
                found.append((cost_there + float(prior[branch][nearest]), place, covariance))
        cost, places, covariances = (
            np.array(each) for each in zip(*sorted(found, key=lambda each: each[0]), strict=True)
        )
        # The likelihood of a place is that of its best point by the volume of its errors.
        return places, covariances, np.exp(0.5 * (cost[0] - cost)) * np.sqrt(np.linalg.det(covariances))

    def _refine(
        self, detections: list[_Detection], branch: int, nearest: int
    ) -> tuple[Float[np.ndarray, "3"], float, int, Float[np.ndarray, "3 3"]]:
        """Return the likeliest place near one branch, LPS mm, twice its negative log-likelihood, vertex and covariance.

        Gauss-Newton on the errors of the pixels, in units of the detection's error, and on the distance from the line,
        in units of what is usual in that lumen.
        """
        points, tangent, sd = self._points[branch], self._tangents[branch], self._lateral_sd[branch]
        place, cost, jacobian = points[nearest], np.inf, np.eye(3)
        for _ in range(_ITERATIONS):
            across = (np.eye(3) - np.outer(tangent[nearest], tangent[nearest])) / sd[nearest]
            rows, residuals = [across, 1e-3 * np.eye(3)], [across @ (place - points[nearest]), np.zeros(3)]
            for one in detections:
                rows.append(one.whiten @ one.view.slope(place))
                residuals.append(one.whiten @ (one.view.project(place) - one.pixel))
            jacobian, residual = np.concatenate(rows), np.concatenate(residuals)
            cost = float(residual @ residual)
            step = np.linalg.solve(jacobian.T @ jacobian, jacobian.T @ residual)
            place = place - step
            nearest = int(np.argmin(((points - place) ** 2).sum(axis=1)))
            if step @ step < _NEAR_ENOUGH_MM**2:
                break
        if len(detections) == 1:  # the depth is the vessel's, and ends at its wall
            lateral = place - points[nearest]
            lateral = lateral - (lateral @ tangent[nearest]) * tangent[nearest]
            beyond = 1 - np.sqrt(2) * sd[nearest] / max(float(np.linalg.norm(lateral)), 1e-9)
            place = place - max(beyond, 0.0) * lateral
        return place, cost, nearest, np.linalg.inv(jacobian.T @ jacobian)


def make_c_arm(
    navigation: Navigation,
    *,
    config: FluoroscopeConfig | None = None,
    seed: int = 0,
    registration_mm: tuple[float, float, float] = (0.0, 0.0, 0.0),
) -> CArm:
    """Return the C-arm of a navigation, whose exposures are what `Navigation.xray` says.

    The seed is that of the pose in which a patient lies whose images are taken, and of these images' noise.

    Raises:
        InputError: images of a wire in a catheter, or of a vessel that is not recognised in them.
    """
    anatomy, device, known = navigation.anatomy, navigation.device, navigation.known_motion
    if navigation.xray == "assumed":
        return Fluoroscope(
            anatomy, device.tip_radius_mm, config=config, known_motion=known, registration_mm=registration_mm
        )
    from endopilot.xray.image_fluoroscope import ImageFluoroscope  # slow to import

    if navigation.catheters:
        names = ", ".join(catheter.name for catheter in navigation.catheters)
        raise InputError(
            f"xray: images: the detector takes a wire alone, and there is {names} around it; leave the catheter out"
        )
    return ImageFluoroscope(
        anatomy, device, config=config, seed=seed, known_motion=known, registration_mm=registration_mm
    )
