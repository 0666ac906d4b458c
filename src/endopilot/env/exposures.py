"""What C-arms show of an environment's worlds: the last exposure of each world, as a measured tip or as images."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cache

import numpy as np
from jaxtyping import Bool, Float, Float32, Int, UInt8

from endopilot.anatomy.projection import TipProjector
from endopilot.devices.stack import lines_from_tips
from endopilot.simulation.motion import place
from endopilot.simulation.simulator import Simulator
from endopilot.tasks.navigation import Navigation
from endopilot.types import Anatomy, TipProjection
from endopilot.xray import fluoroscope
from endopilot.xray.carm import view_at
from endopilot.xray.fluoroscope import Fluoroscope, FluoroscopeConfig
from endopilot.xray.image import ImageConfig, XrayImager, isocenter_of
from endopilot.xray.moving_patient import seen, turned

_FULL_PIXELS = ImageConfig().pixels
"""Of the house's detector; a coarser one has fewer and larger pixels on the same square."""
_NOISE = 2**18
"""Numbers of the table from which images take their noise: drawing it anew would cost as much as all else."""
_MARGIN = 0.95
"""Share of an image's half width within which all centerlines lie."""
_TARGET = np.arange(-1, 2)
"""Rows and columns about the target's pixel that mark it."""


@dataclass(eq=False)
class Exposed:
    """The last exposure of each world; a row a world.

    `count` and `time_s` count from the episode's start. `encoders` are Δ, mm, and φ, rad, of the wire as measured then;
    `position` is where its tip was found, LPS mm, `tip` the projection of that. Without images `image` has no rows.
    """

    count: Int[np.ndarray, "worlds"]
    time_s: Float[np.ndarray, "worlds"]
    encoders: Float[np.ndarray, "worlds 2"]
    position: Float[np.ndarray, "worlds 3"]
    tip: TipProjection
    image: UInt8[np.ndarray, "worlds views rows columns"]
    random: list[np.random.Generator]


class CArms:
    """A C-arm around each patient of an environment; `exposed` is what they showed last."""

    def __init__(
        self,
        navigations: Sequence[Navigation],
        simulator: Simulator,
        *,
        config: FluoroscopeConfig,
        pixels: int,
    ) -> None:
        """Bring each vessel's middle to the isocenter; without `pixels` of a row, exposures say where the tip is."""
        count, own = len(navigations), list(dict.fromkeys(navigations))
        self._pixels, motions = pixels, [(each.known_motion, each.anatomy.insertion.position) for each in navigations]
        self._known = [motion and motion.core(np.asarray(ostium)) for motion, ostium in motions]
        self._of: list[Views] = []
        if pixels:
            made: dict[tuple[int, str], Views] = {}
            for navigation, real in zip(navigations, simulator.set_up.anatomies, strict=True):
                key = (id(navigation), real.identity)
                made[key] = made.get(key) or Views(navigation, real, config, pixels)
                self._of.append(made[key])
        else:
            arms = [Fluoroscope(each.anatomy, each.device.tip_radius_mm, config=config) for each in own]
            self._arm = np.array([own.index(navigation) for navigation in navigations])
            self._tips = TipFinder(arms, self._arm)
            self._project = [TipProjector(each.anatomy.tree, each.anatomy.insertion) for each in own]
        views, zeros = 1 + config.biplane, np.zeros((count, 1))
        self.exposed = Exposed(
            count=np.zeros(count, dtype=np.int64),
            time_s=np.zeros(count),
            encoders=np.zeros((count, 2)),
            position=np.tile(np.asarray(navigations[0].anatomy.insertion.position, dtype=float), (count, 1)),
            tip=TipProjection(
                abscissa=zeros.copy(), offset=zeros.copy(), branch=zeros.astype(np.int64), radius=zeros + 1.0
            ),
            image=np.zeros((count, views, pixels, pixels), dtype=np.uint8),
            random=[np.random.default_rng()] * count,
        )

    def begin(self, mask: Bool[np.ndarray, "worlds"], generators: Sequence[np.random.Generator]) -> None:
        """Start an episode in the worlds of a mask; errors and noise follow from what generators of the worlds draw."""
        for world in np.flatnonzero(mask).tolist():
            self.exposed.random[world] = np.random.default_rng(int(generators[world].integers(2**62)))
        self.exposed.count[mask] = 0

    def expose(
        self,
        mask: Bool[np.ndarray, "worlds"],
        simulator: Simulator,
        encoders: Float[np.ndarray, "worlds devices 2"],
        registration_mm: Float[np.ndarray, "worlds 3"],
        time_s: Float[np.ndarray, "worlds"],
    ) -> None:
        """Take an exposure of every view in the worlds of a mask; wires show displaced by `registration_mm`."""
        chosen = np.flatnonzero(mask & simulator.valid)
        if not len(chosen):
            return
        exposed = self.exposed
        exposed.count[chosen] += 1
        exposed.time_s[chosen], exposed.encoders[chosen] = time_s[chosen], encoders[chosen, 0]
        maps = None
        if simulator.set_up.motion is not None:
            placed = simulator.vessel_to_laboratory
            one = ((slice(world, world + 1), self._known[world]) for world in chosen.tolist())
            maps = np.concatenate([seen(placed[of], known, time_s[of]) for of, known in one])
        if self._pixels:
            nodes = simulator.position[chosen] + registration_mm[chosen, None]
            nodes = nodes if maps is None else place(maps[:, None], nodes)
            for world, line in zip(chosen.tolist(), nodes, strict=True):
                devices = lines_from_tips(line[np.isfinite(line[:, 0])], simulator.inserted_length[world])
                exposed.image[world] = self._of[world].image(devices, exposed.random[world])
            return
        tips, headings = simulator.tip_position[chosen, 0], simulator.tip_direction[chosen, 0]
        tips = tips + registration_mm[chosen]
        if maps is not None:
            tips, headings = place(maps, tips), turned(maps, headings)
        noise = np.stack([exposed.random[world].standard_normal((exposed.image.shape[1], 2)) for world in chosen])
        exposed.position[chosen] = self._tips.locate(chosen, tips, headings, exposed.encoders[chosen, 0], noise)
        for number, project in enumerate(self._project):
            worlds = chosen[self._arm[chosen] == number]
            found = project(exposed.position[worlds])
            for name in TipProjection.__dataclass_fields__:
                getattr(exposed.tip, name)[worlds, 0] = getattr(found, name)


@cache
def _noise() -> Float32[np.ndarray, "n"]:
    return np.random.default_rng(0).standard_normal(_NOISE, dtype=np.float32)


class Views:
    """The views of one navigation: what all its images have in common, such as the roadmap with the target."""

    def __init__(self, navigation: Navigation, real: Anatomy, config: FluoroscopeConfig, pixels: int) -> None:
        geometry = replace(config.geometry, pixel_mm=config.geometry.pixel_mm * _FULL_PIXELS / pixels)
        self._imager = XrayImager(real, navigation.stack, config=ImageConfig(geometry=geometry, pixels=pixels))
        given = navigation.anatomy
        roadmaps = self._imager if given is real else XrayImager(given, navigation.stack, config=self._imager.config)
        lines = given.tree.line.points
        self._planes, self._roadmaps, self._targets, self._size = [], [], [], pixels
        for angles in config.view_angles_deg[: 1 + config.biplane]:
            farthest = np.abs(view_at(angles, isocenter_of(given), geometry).project(lines)).max()
            fits = float(_MARGIN * pixels / 2 / farthest)
            self._planes.append(self._imager.plane(angles, fits))
            plane = self._planes[-1] if given is real else roadmaps.plane(angles, fits)
            self._roadmaps.append(plane.vessel_mm)
            row, column = np.rint(plane.pixel(navigation.target.position(given))).astype(int)
            self._targets.append(np.ix_(row + _TARGET, column + _TARGET))

    def image(
        self, devices: Sequence[Float[np.ndarray, "_ 3"]], random: np.random.Generator
    ) -> UInt8[np.ndarray, "views rows columns"]:
        """Return the images of devices, each a line from its tip on, LPS mm; noise is a random part of a table."""
        (wire, *catheters), size = devices, self._size
        shown, noise = np.empty((len(self._planes), size, size), dtype=np.uint8), _noise()
        begins = random.integers(len(noise) - size**2, size=len(shown))
        for k, plane in enumerate(self._planes):
            own = noise[begins[k] : begins[k] + size**2].reshape(size, size)
            signal = self._imager.signal(plane, wire, noise=own, catheters=catheters)
            shown[k] = self._imager.grey(signal, roadmap=self._roadmaps[k])
            shown[k][self._targets[k]] = 255
        return shown


class TipFinder:
    """C-arms around some patients, of which each world has one: `Fluoroscope.locate` for all worlds at once, world by
    world with the same results."""

    def __init__(self, arms: Sequence[Fluoroscope], arm: Int[np.ndarray, "worlds"]) -> None:
        """Lay out the lines of all patients, of `arms` of one configuration, in tables, a row an arm.

        A shorter one ends in vertices of no branch. `arm` is the number of each world's.
        """
        self._arm, self._config, views = arm, arms[0]._config, [each._views for each in arms]
        lengths = [[len(line) for line in each._points] for each in arms]
        count = max(map(sum, lengths))

        def table(rows: Sequence[Sequence[np.ndarray]], fill: float | int) -> np.ndarray:
            made = [np.concatenate(list(row)) for row in rows]
            return np.stack([np.pad(a, [(0, count - len(a)), (0, 0)][: a.ndim], constant_values=fill) for a in made])

        self._points = table([each._points for each in arms], 0.0)
        self._tangents = table([each._tangents for each in arms], 0.0)
        self._sd = table([each._lateral_sd for each in arms], 1.0)
        self._abscissa = table([each._abscissa for each in arms], np.inf)
        self._first = table([[np.repeat(np.cumsum(of) - of, of)] for of in lengths], count)
        self._last = table([[np.repeat(np.cumsum(of) - 1, of)] for of in lengths], count)
        self._window = np.arange(max(map(max, lengths)))
        self._begins = np.diff(self._first, axis=1, prepend=-1) != 0
        self._by_axis = np.moveaxis(self._points, -1, 0).copy()
        shown = [table([each._shown[view] for each in arms], 0.0) for view in range(len(views[0]))]
        self._shown = np.moveaxis(np.stack(shown, axis=1), -1, 0).copy()
        self._source = np.array([[view.source for view in of] for of in views])
        self._axes = np.array([[view.axes for view in of] for of in views])
        self._scale = np.array([[view.scale for view in of] for of in views])

    def locate(
        self,
        worlds: Int[np.ndarray, "n"],
        tip: Float[np.ndarray, "n 3"],
        heading: Float[np.ndarray, "n 3"],
        inserted: Float[np.ndarray, "n"],
        noise: Float[np.ndarray, "n views 2"],
    ) -> Float[np.ndarray, "n 3"]:
        """Take an exposure of every view in some worlds and return where the tips are found to be, LPS mm.

        `tip` is where they truly are, `heading` along the wires there, and `inserted` is Δ by the encoders, mm; `noise`
        is standard normal, along and across the wire.
        """
        arm, config = self._arm[worlds], self._config
        pixel, slope = self._seen(arm, tip)
        along = (slope @ heading[:, None, :, None])[..., 0]
        along /= np.maximum(np.linalg.norm(along, axis=-1, keepdims=True), 1e-9)
        axes = np.stack([along, along[..., ::-1] * [-1.0, 1.0]], axis=-2)
        sd = np.array([config.along_sd, config.pixel_sd])
        pixel, whiten = pixel + ((noise * sd)[..., None, :] @ axes)[..., 0, :], axes / sd[:, None]
        length_sd = 2.0 + fluoroscope._NEAR_SHARE * np.maximum(inserted, 0.0)
        prior = ((self._abscissa[arm] - inserted[:, None]) / length_sd[:, None]) ** 2
        magnified = self._scale[arm, :1] / config.geometry.source_to_isocenter_mm
        right, up = ((self._shown[k][arm] - pixel[..., k, None]) ** 2 for k in range(2))
        squared = (right + up).sum(axis=1)
        cost = squared / (config.along_sd**2 + (magnified * self._sd[arm]) ** 2) + prior
        before = np.where(self._begins[arm], np.inf, np.roll(cost, 1, axis=1))
        after = np.where(np.roll(self._begins[arm], -1, axis=1), np.inf, np.roll(cost, -1, axis=1))
        likely = cost <= cost.min(axis=1, keepdims=True) + fluoroscope._HOPELESS
        row, vertex = np.nonzero(likely & (cost < before) & (cost <= after))
        place, refined, nearest = self._refined(arm[row], vertex, pixel[row], whiten[row])
        order = np.lexsort((refined + prior[row, nearest], row))
        return place[order[np.unique(row[order], return_index=True)[1]]]

    def _seen(
        self, arm: Int[np.ndarray, "n"], point: Float[np.ndarray, "n 3"]
    ) -> tuple[Float[np.ndarray, "n views 2"], Float[np.ndarray, "n views 2 3"]]:
        """Return the pixels of points, and their derivatives by the points, as `View.project` and `View.slope` do."""
        axes, scale = self._axes[arm], self._scale[arm][..., None]
        across, up, depth = np.moveaxis((axes @ (point[:, None] - self._source[arm])[..., None])[..., 0], -1, 0)
        there = np.stack([across, up], axis=-1) / depth[..., None]
        slope = (scale / depth[..., None])[..., None] * (axes[..., :2, :] - there[..., None] * axes[..., 2:, :])
        return scale * there, slope

    def _refined(
        self,
        arm: Int[np.ndarray, "n"],
        nearest: Int[np.ndarray, "n"],
        pixel: Float[np.ndarray, "n views 2"],
        whiten: Float[np.ndarray, "n views 2 2"],
    ) -> tuple[Float[np.ndarray, "n 3"], Float[np.ndarray, "n"], Int[np.ndarray, "n"]]:
        """Return the likeliest places near vertices, their costs, and the vertices nearest to them."""
        first, last, nearest = self._first[arm, nearest], self._last[arm, nearest], nearest.copy()
        place, cost, going = self._points[arm, nearest], np.zeros(len(arm)), np.arange(len(arm))
        for _ in range(fluoroscope._ITERATIONS):
            own, at, here = arm[going], nearest[going], place[going]
            tangent = self._tangents[own, at]
            across = (np.eye(3) - tangent[:, :, None] * tangent[:, None]) / self._sd[own, at][:, None, None]
            seen, slope = self._seen(own, here)
            rows = np.concatenate([across[:, None], np.broadcast_to(1e-3 * np.eye(3), (len(own), 1, 3, 3))], axis=1)
            of_views = (whiten[going] @ slope).reshape(len(own), -1, 3)
            rows = np.concatenate([rows.reshape(len(own), 6, 3), of_views], axis=1)
            off = (across @ (here - self._points[own, at])[..., None])[..., 0]
            missed = (whiten[going] @ (seen - pixel[going])[..., None]).reshape(len(own), -1)
            residual = np.concatenate([off, np.zeros_like(off), missed], axis=1)
            cost[going] = (residual**2).sum(axis=1)
            turned = rows.transpose(0, 2, 1)
            step = np.linalg.solve(turned @ rows, turned @ residual[..., None])[..., 0]
            place[going] = here = here - step
            window = np.minimum(first[going, None] + self._window, last[going, None])
            x, y, z = (axis[own[:, None], window] - here[:, k, None] for k, axis in enumerate(self._by_axis))
            nearest[going] = first[going] + (x**2 + y**2 + z**2).argmin(axis=1)
            going = going[(step**2).sum(axis=1) >= fluoroscope._NEAR_ENOUGH_MM**2]
            if not len(going):
                break
        if pixel.shape[1] == 1:  # the depth is the vessel's, and ends at its wall
            tangent, lateral = self._tangents[arm, nearest], place - self._points[arm, nearest]
            lateral = lateral - (lateral * tangent).sum(axis=1, keepdims=True) * tangent
            width = np.maximum(np.linalg.norm(lateral, axis=1), 1e-9)
            place = place - np.maximum(1 - np.sqrt(2) * self._sd[arm, nearest] / width, 0.0)[:, None] * lateral
        return place, cost, nearest
