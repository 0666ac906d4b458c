"""What an X-ray exposure says of wire and guiding catheter: measurements with the errors of a C-arm, never the truth.

The tip is projected onto one or two detectors, is found there with an error in pixels, and is located in space as the
most likely place given the pixels and the vessel: the tip of a wire lies about as far from the vessel's axis as its
wall, and no deeper than the wire is inserted. It may be measured outside the lumen, which may be wider than it is
believed. The second view or, with a single one, the vessel gives the depth. The guiding catheter is a line in each
view. docs/concepts/exposure.md says where the numbers come from.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Float, Int

from endopilot.anatomy.projection import TipProjector
from endopilot.anatomy.tree import tangents
from endopilot.errors import InputError
from endopilot.lines import places_on
from endopilot.settings import Finite, Positive, settings
from endopilot.simulation.config import CoreMotion
from endopilot.simulation.motion import Motion, place, relative
from endopilot.simulation.simulator import Simulator
from endopilot.tasks.navigation import Navigation
from endopilot.types import Anatomy
from endopilot.xray.carm import CArmGeometry, Places, Vector, View, view_at

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

    position: Vector
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


class CArm:
    """A C-arm around one patient, whose vessel is known from the CT and registered to it.

    Attributes:
        known_motion: what is known of how the patient moves; an exposure takes it off.
        registration_mm: the wire shows displaced by this, LPS mm.
    """

    known_motion: Motion | None = None
    registration_mm: tuple[float, float, float] = (0.0, 0.0, 0.0)

    def __init__(self, anatomy: Anatomy) -> None:
        """Take the patient."""
        self._anatomy, self._project = anatomy, TipProjector(anatomy.tree, anatomy.insertion)

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
        nodes, tip, heading = simulator.position[0], simulator.tip_position[0, 0], simulator.tip_direction[0, 0]
        if any(self.registration_mm):
            nodes, tip = nodes + self.registration_mm, tip + self.registration_mm
        if simulator.set_up.motion is not None:
            known = self.known_motion and self.known_motion.core(self._anatomy.insertion.position)
            (maps,) = seen(simulator.vessel_to_laboratory[:1], known, np.array([time_s]))
            nodes, tip, heading = place(maps, nodes), place(maps, tip), turned(maps, heading)
        return self._show(nodes, tip, heading, inserted_length, random)

    def _show(
        self, nodes: Places, tip: Vector, heading: Vector, inserted_length: float, random: np.random.Generator
    ) -> TipMeasurement | None:
        """Return what an exposure shows of a wire: nodes from the foremost tip on, its tip, and the heading there."""
        raise NotImplementedError

    def _measured(
        self, places: Places, covariances: Float[np.ndarray, "n 3 3"], weight: Float[np.ndarray, "n"] | None = None
    ) -> TipMeasurement:
        """Return the measurement of a tip at one of some places, LPS mm, the likeliest first, with the covariance
        around each, if it is there, mm²; each is as likely as its weight says, or equally."""
        share = np.full(len(places), 1.0 / len(places)) if weight is None else weight / weight.sum()
        tips, insertion = self._project(places), self._anatomy.insertion
        branch, abscissa = int(tips.branch[0]), float(tips.abscissa[0])
        line, tangent = self._anatomy.tree.branches[branch].centerline, np.asarray(insertion.direction)
        centre = insertion.position + abscissa * tangent
        if abscissa > 0:
            at = np.array([abscissa])
            centre, tangent = (places_on(of, line.abscissa, at)[0] for of in (line.points, tangents(line.points)))
        outwards = places[0] - centre
        outwards = outwards / max(float(np.linalg.norm(outwards)), 1e-9)
        axes = np.array([tangent, outwards, np.cross(tangent, outwards)])
        within = np.einsum("p,pij->ij", share, covariances)
        along, out, around = np.sqrt(np.einsum("ai,ij,aj->a", axes, within, axes)).tolist()
        off, tip = places - places[0], np.stack([tips.abscissa, tips.offset], axis=-1)
        along, out = np.hypot([along, out], np.sqrt(share @ (tip - tip[0]) ** 2)).tolist()
        covariance = within + np.einsum("p,pi,pj->ij", share, off, off)
        return TipMeasurement(places[0], abscissa, float(tips.offset[0]), branch, covariance, (along, out), around)

    def measure_motion(self, motion: Motion | None, random: np.random.Generator) -> Motion | None:
        """Inject contrast and return how the patient moves by a run of images, None where that is nothing known;
        InputError where exposures cannot show it: what is assumed of errors says nothing of contrast."""
        raise InputError("measure_motion: exposures of assumed errors show no contrast; give xray: images")


def seen(
    placed: Float[np.ndarray, "n 3 4"], known: CoreMotion | None, times_s: Float[np.ndarray, "n"]
) -> Float[np.ndarray, "n 3 4"]:
    """Return the affine maps by which the C-arm sees points of the moving vessel displaced, mm in the vessel of the CT:
    truly placed so at these times, s, of which it takes the known motion off."""
    return placed if known is None else relative(placed, known.placements(times_s)[0])


def seen_in_episodes(
    motion: Motion | None, known: Motion | None, ostium: Vector, samples: int, period_s: float
) -> Float[np.ndarray, "samples 3 4"] | None:
    """Return `seen` at each sample of a dataset's navigations in one patient; None if the patient lies still."""
    if motion is None:
        return None
    times_s = period_s * np.arange(1, samples + 1)
    return seen(motion.core(ostium).placements(times_s)[0], known and known.core(ostium), times_s)


def turned(
    maps: Float[np.ndarray, "*maps 3 4"], directions: Float[np.ndarray, "*directions 3"]
) -> Float[np.ndarray, "*turned 3"]:
    """Return the unit vectors along lines, of such directions, after affine maps; both are broadcast."""
    along = (maps[..., :3] @ directions[..., None])[..., 0]
    return along / np.linalg.norm(along, axis=-1, keepdims=True)


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


class Fluoroscope(CArm):
    """A C-arm of assumed errors of detection."""

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
        super().__init__(anatomy)
        self.known_motion, self.registration_mm = known_motion, registration_mm
        self._config = config or FluoroscopeConfig()
        self._finder = TipFinder([(anatomy, wire_radius_mm)], self._config)

    def _show(
        self, nodes: Places, tip: Vector, heading: Vector, inserted_length: float, random: np.random.Generator
    ) -> TipMeasurement:
        return self.measure(tip, heading, inserted_length, random)

    def measure(
        self, tip_position: Vector, tip_direction: Vector, inserted_length: float, random: np.random.Generator
    ) -> TipMeasurement:
        """Take one exposure of every view and say where the tip is.

        Args:
            tip_position: where the tip truly is, LPS mm.
            tip_direction: unit vector along the wire at its tip.
            inserted_length: Δ by the robot's encoder, mm.
            random: where the errors are drawn from.
        """
        noise = random.standard_normal((len(self._finder.views[0]), 2))[None]
        given = tip_position[None], tip_direction[None], np.array([inserted_length])
        _, places, cost, information = self._finder.find(np.zeros(1, dtype=int), *given, noise)
        covariances = np.linalg.inv(information)
        # The likelihood of a place is that of its best point by the volume of its errors.
        weight = np.exp(0.5 * (cost[0] - cost)) * np.sqrt(np.linalg.det(covariances))
        return self._measured(places, covariances, weight)

    def catheter_axis(self, axis: Vector, random: np.random.Generator) -> Vector:
        """Take one exposure of every view and return the guiding catheter's axis as it shows, a unit vector.

        In a view the catheter is a line, and spans a plane with the source. The likeliest axis is returned, given these
        planes, each known as well as two points of the line, and how a catheter may lie before it is seen. The true
        axis points into the vessel.
        """
        insertion, pixel_sd = self._anatomy.insertion, self._config.pixel_sd
        ends = insertion.position - np.array([[0.0], [_CATHETER_MM]]) * axis
        information = np.eye(3) / _LEAN_SD**2
        for view in self._finder.views[0]:
            pixels = view.project(ends) + pixel_sd * random.standard_normal((2, 2))
            one, other = np.column_stack([pixels, np.full(2, view.scale)]) @ view.axes
            normal = np.cross(one, other)
            pixels_per_mm = view.scale / self._config.geometry.source_to_isocenter_mm
            sd = np.sqrt(2) * pixel_sd / (pixels_per_mm * _CATHETER_MM)
            information += np.outer(normal, normal) / (sd**2 * (normal @ normal))
        found = np.linalg.solve(information, insertion.direction / _LEAN_SD**2)
        return found / np.linalg.norm(found)


class TipFinder:
    """C-arms around some patients, and where they find the tips of many worlds at once, of each with the same bits as
    alone."""

    def __init__(self, patients: Sequence[tuple[Anatomy, float]], config: FluoroscopeConfig) -> None:
        """Lay out the lines of all patients, each a vessel and the radius of the wire in it, mm, in tables, a row a
        patient; shorter rows end in vertices of no branch. `views` has those of each C-arm."""
        made = [_lines(anatomy, radius_mm, config) for anatomy, radius_mm in patients]
        self._config, self.views = config, [views for views, _ in made]
        count = max(len(of["points"]) for _, of in made)

        def table(name: str, fill: float | int) -> np.ndarray:
            rows = [of[name] for _, of in made]
            around = [[(0, count - len(row)), *[(0, 0)] * (row.ndim - 1)] for row in rows]
            return np.stack([np.pad(a, width, constant_values=fill) for a, width in zip(rows, around, strict=True)])

        self._points, self._tangents, shown = (table(name, 0.0) for name in ("points", "tangents", "shown"))
        self._sd, self._abscissa = table("sd", 1.0), table("abscissa", np.inf)
        self._first, self._last = table("first", count), table("last", count)
        self._window = np.arange((self._last - self._first).max() + 1)
        self._begins = np.diff(self._first, axis=1, prepend=-1) != 0
        self._by_axis = np.moveaxis(self._points, -1, 0).copy()
        self._shown = shown.transpose(3, 0, 2, 1).copy()
        self._source, self._axes, self._scale = (
            np.array([[getattr(view, name) for view in of] for of in self.views])
            for name in ("source", "axes", "scale")
        )

    def find(
        self,
        arm: Int[np.ndarray, "n"],
        tip: Places,
        heading: Places,
        inserted: Float[np.ndarray, "n"],
        noise: Float[np.ndarray, "n views 2"],
    ) -> tuple[Int[np.ndarray, "m"], Float[np.ndarray, "m 3"], Float[np.ndarray, "m"], Float[np.ndarray, "m 3 3"]]:
        """Take an exposure of every view in some worlds and return where the tips may be, LPS mm, world by world and
        the likeliest place of each first: numbers of the worlds, places, twice their negative log-likelihoods, and
        inverses of their covariances.

        A view may show several parts of the vessel at one place: the likeliest place of every such part is returned.
        `arm` is the number of each world's C-arm, `tip` where its tip truly is, `heading` along the wire there, and
        `inserted` is Δ by the encoders, mm; `noise` is standard normal, along and across the wire: the error is larger
        along it.
        """
        config = self._config
        pixel, slope = self._seen(arm, tip)
        along = (slope @ heading[:, None, :, None])[..., 0]
        along = along / np.maximum(np.sqrt(_dot(along, along)), 1e-9)[..., None]
        axes = np.stack([along, along[..., ::-1] * [-1.0, 1.0]], axis=-2)
        sd = np.array([config.along_sd, config.pixel_sd])
        pixel, whiten = pixel + ((noise * sd)[..., None, :] @ axes)[..., 0, :], axes / sd[:, None]
        length_sd = 2.0 + _NEAR_SHARE * np.maximum(inserted, 0.0)
        prior = ((self._abscissa[arm] - inserted[:, None]) / length_sd[:, None]) ** 2
        magnified = self._scale[arm, :1] / config.geometry.source_to_isocenter_mm
        right, up = ((self._shown[k][arm] - pixel[..., k, None]) ** 2 for k in range(2))
        squared = (right + up).sum(axis=1)
        cost = squared / (config.along_sd**2 + (magnified * self._sd[arm]) ** 2) + prior
        before = np.where(self._begins[arm], np.inf, np.roll(cost, 1, axis=1))
        after = np.where(np.roll(self._begins[arm], -1, axis=1), np.inf, np.roll(cost, -1, axis=1))
        likely = cost <= cost.min(axis=1, keepdims=True) + _HOPELESS
        row, vertex = np.nonzero(likely & (cost < before) & (cost <= after))
        place, refined, nearest, information = self._refined(arm[row], vertex, pixel[row], whiten[row])
        found = refined + prior[row, nearest]
        order = np.lexsort((found, row))
        return row[order], place[order], found[order], information[order]

    def _seen(
        self, arm: Int[np.ndarray, "n"], point: Places
    ) -> tuple[Float[np.ndarray, "n views 2"], Float[np.ndarray, "n views 2 3"]]:
        """Return the pixels of points, and their derivatives by the points, as `View.project` and `View.slope` do."""
        axes, scale = self._axes[arm], self._scale[arm]
        off = point[:, None] - self._source[arm]
        in_view = (off[..., None, :] @ axes.swapaxes(-1, -2))[..., 0, :]
        away = in_view[..., :2, None] / in_view[..., 2:, None]
        slope = (scale / in_view[..., 2])[..., None, None] * (axes[..., :2, :] - away * axes[..., 2:, :])
        return scale[..., None] * in_view[..., :2] / in_view[..., 2:], slope

    def _refined(
        self,
        arm: Int[np.ndarray, "n"],
        nearest: Int[np.ndarray, "n"],
        pixel: Float[np.ndarray, "n views 2"],
        whiten: Float[np.ndarray, "n views 2 2"],
    ) -> tuple[Places, Float[np.ndarray, "n"], Int[np.ndarray, "n"], Float[np.ndarray, "n 3 3"]]:
        """Return the likeliest places near vertices, twice their negative log-likelihoods, the vertices nearest to them
        and the inverses of their covariances: Gauss-Newton on the errors of the pixels, in units of the detection's
        error, and on the distance from the line, in units of what is usual in that lumen."""
        first, last, nearest = self._first[arm, nearest], self._last[arm, nearest], nearest.copy()
        place, cost, going = self._points[arm, nearest], np.zeros(len(arm)), np.arange(len(arm))
        information = np.zeros((len(arm), 3, 3))
        for _ in range(_ITERATIONS):
            own, at, here = arm[going], nearest[going], place[going]
            tangent = self._tangents[own, at]
            across = (np.eye(3) - tangent[:, :, None] * tangent[:, None]) / self._sd[own, at][:, None, None]
            seen, slope = self._seen(own, here)
            small = np.broadcast_to(1e-3 * np.eye(3), across.shape)
            rows = np.concatenate([across, small, (whiten[going] @ slope).reshape(len(own), -1, 3)], axis=1)
            off = (across @ (here - self._points[own, at])[..., None])[..., 0]
            missed = (whiten[going] @ (seen - pixel[going])[..., None]).reshape(len(own), -1)
            residual = np.concatenate([off, np.zeros_like(off), missed], axis=1)
            cost[going], turned = _dot(residual, residual), rows.transpose(0, 2, 1)
            information[going] = normal = turned @ rows
            step = np.linalg.solve(normal, turned @ residual[..., None])[..., 0]
            place[going] = here = here - step
            window = np.minimum(first[going, None] + self._window, last[going, None])
            x, y, z = (axis[own[:, None], window] - here[:, k, None] for k, axis in enumerate(self._by_axis))
            nearest[going] = first[going] + (x**2 + y**2 + z**2).argmin(axis=1)
            going = going[_dot(step, step) >= _NEAR_ENOUGH_MM**2]
            if not len(going):
                break
        if pixel.shape[1] == 1:  # the depth is the vessel's, and ends at its wall
            tangent, lateral = self._tangents[arm, nearest], place - self._points[arm, nearest]
            lateral = lateral - _dot(lateral, tangent)[:, None] * tangent
            width = np.maximum(np.sqrt(_dot(lateral, lateral)), 1e-9)
            place = place - np.maximum(1 - np.sqrt(2) * self._sd[arm, nearest] / width, 0.0)[:, None] * lateral
        return place, cost, nearest, information


def _lines(
    anatomy: Anatomy, wire_radius_mm: float, config: FluoroscopeConfig
) -> tuple[list[View], dict[str, np.ndarray]]:
    """Return the views of a C-arm, the middle of the vessel in its isocenter, and of the vertices of the guiding
    catheter and of each branch, line after line, points, pixels in each view, tangents, usual distance of a tip, mm,
    abscissae, and the first and the last vertex of their line."""
    lines, insertion = [branch.centerline for branch in anatomy.tree.branches], anatomy.insertion
    behind = np.linspace(-_CATHETER_MM, -0.5, 40)
    points = [insertion.position + behind[:, None] * insertion.direction, *(line.points for line in lines)]
    isocenter = np.concatenate(points[1:]).mean(axis=0)
    views = [view_at(angles, isocenter, config.geometry) for angles in config.view_angles_deg[: 1 + config.biplane]]
    # A wire that lies on the wall, anywhere around, lies clearance/√2 from it along either axis, root mean square.
    wider = _UNCLAMPED if len(views) > 1 else 1.0
    radius = np.concatenate([np.full(len(behind), anatomy.catheter_radius_mm), *(line.radius for line in lines)])
    along = [np.tile(insertion.direction, (len(behind), 1)), *(tangents(line) for line in points[1:])]
    counts = [len(line) for line in points]
    return views, {
        "points": np.concatenate(points),
        "shown": np.concatenate([np.stack([view.project(line) for view in views], axis=1) for line in points]),
        "tangents": np.concatenate(along),
        "sd": wider * np.maximum(radius - wire_radius_mm, 0.1) / np.sqrt(2),
        "abscissa": np.concatenate([behind, *(line.abscissa for line in lines)]),
        "first": np.repeat(np.cumsum(counts) - counts, counts),
        "last": np.repeat(np.cumsum(counts) - 1, counts),
    }


def _dot(a: Float[np.ndarray, "*n k"], b: Float[np.ndarray, "*n k"]) -> Float[np.ndarray, "*n"]:
    return (a[..., None, :] @ b[..., None])[..., 0, 0]


def make_c_arm(
    navigation: Navigation,
    *,
    config: FluoroscopeConfig | None = None,
    seed: int = 0,
    registration_mm: tuple[float, float, float] = (0.0, 0.0, 0.0),
) -> CArm:
    """Return the C-arm of a navigation, whose exposures are what `Navigation.xray` says. The seed is that of the pose
    in which a patient lies whose images are taken, and of these images' noise. Raises InputError for images of a wire
    in a catheter, or of a vessel that is not recognised in them."""
    anatomy, device = navigation.anatomy, navigation.device
    if navigation.xray == "assumed":
        arm: CArm = Fluoroscope(anatomy, device.tip_radius_mm, config=config)
    elif navigation.catheters:
        names = ", ".join(catheter.name for catheter in navigation.catheters)
        raise InputError(
            f"xray: images: the detector takes a wire alone, and there is {names} around it; leave the catheter out"
        )
    else:
        from endopilot.xray.image_fluoroscope import ImageFluoroscope  # slow to import

        arm = ImageFluoroscope(anatomy, device, config=config, seed=seed)
    arm.known_motion, arm.registration_mm = navigation.known_motion, registration_mm
    return arm
