"""What is shown of an environment's worlds: the last exposure of each, as a measured tip or images, and pictures."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cache

import numpy as np
from jaxtyping import Bool, Float, Float32, Int, UInt8

from endopilot.anatomy.projection import TipProjector
from endopilot.devices.stack import lines_from_tips, shown_part
from endopilot.lines import length_along, places_on
from endopilot.simulation.motion import place
from endopilot.simulation.simulator import Simulator
from endopilot.tasks.navigation import Navigation
from endopilot.types import Anatomy, TipProjection
from endopilot.xray.carm import view_at
from endopilot.xray.fluoroscope import FluoroscopeConfig, TipFinder, seen, turned
from endopilot.xray.image import ImageConfig, XrayImager, isocenter_of

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
            self._arm = np.array([own.index(navigation) for navigation in navigations])
            self._tips = TipFinder([(each.anatomy, each.device.tip_radius_mm) for each in own], config)
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
        row, places, *_ = self._tips.find(self._arm[chosen], tips, headings, exposed.encoders[chosen, 0], noise)
        exposed.position[chosen] = places[np.unique(row, return_index=True)[1]]
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


SIZE = 256
"""Pixels of a picture along a side."""
_BORDER_PX = 10
_WHITE, _VESSEL, _TARGET_COLOR = (255, 255, 255), (226, 205, 205), (213, 94, 0)
_DEVICES = ((0, 114, 178), (25, 181, 200), (142, 108, 240))
"""Of the wire and of the catheters around it, from the inside out."""
_TIP = (0, 0, 0)
_TARGET_PX, _DEVICE_PX, _TIP_PX = 4.0, (1.0, 1.9, 2.8), 2.0
"""Radii of the target's dot, the lines, and the dot of the foremost tip, pixels."""
_BEHIND_MM = 2.0
"""So much of the devices is shown behind the ostium, mm."""


class Picture:
    """The vessel of a navigation with its target, seen as `Anatomy.plot` shows it."""

    def __init__(self, navigation: Navigation) -> None:
        anatomy = navigation.anatomy
        lines = [branch.centerline for branch in anatomy.tree.branches]
        self._axes = list(anatomy.tree.widest_axes())
        points = np.concatenate([line.points for line in lines])[:, self._axes]
        self._middle = 0.5 * (points.min(axis=0) + points.max(axis=0))
        self._px_per_mm = (SIZE - 2 * _BORDER_PX) / float(np.ptp(points, axis=0).max())
        self._still = np.full((SIZE, SIZE, 3), _WHITE, dtype=np.uint8)
        for line in lines:
            self._draw(self._still, line.points, line.radius * self._px_per_mm, _VESSEL)
        self._draw(self._still, navigation.target.position(anatomy)[None], np.array([_TARGET_PX]), _TARGET_COLOR)

    def of(self, simulator: Simulator, world: int) -> UInt8[np.ndarray, "256 256 3"]:
        """Return the picture of a world as it is now, red, green and blue."""
        picture, inserted = self._still.copy(), simulator.inserted_length[world]
        nodes = shown_part(simulator.position[world], float(inserted.max()), _BEHIND_MM)
        lines = lines_from_tips(nodes, inserted)
        for line, radius, color in reversed(list(zip(lines, _DEVICE_PX, _DEVICES, strict=False))):
            self._draw(picture, line, np.full(len(line), radius), color)
        self._draw(picture, nodes[:1], np.array([_TIP_PX]), _TIP)
        return picture

    def _draw(
        self,
        picture: UInt8[np.ndarray, "256 256 3"],
        points: Float[np.ndarray, "n 3"],
        radius_px: Float[np.ndarray, "n"],
        color: tuple[int, int, int],
    ) -> None:
        """Draw a line through points, LPS mm, with a dot every half pixel; what lies beyond the picture is left out."""
        across, up = ((points[:, self._axes] - self._middle) * self._px_per_mm).T
        line = np.column_stack([SIZE / 2 - up, SIZE / 2 + across])
        along = length_along(line)
        at = np.linspace(0.0, along[-1], 1 + int(2 * along[-1]))
        centres = places_on(line, along, at)
        radius = np.maximum(np.round(4 * np.interp(at, along, radius_px)) / 4, 0.5)
        for each in np.unique(radius):
            reach = np.arange(-np.ceil(each), np.ceil(each) + 1)
            disc = np.array([(row, column) for row in reach for column in reach if np.hypot(row, column) <= each])
            pixels = np.floor(centres[radius == each, None] + disc).astype(int).reshape(-1, 2)
            row, column = pixels[((pixels >= 0) & (pixels < SIZE)).all(axis=1)].T
            picture[row, column] = color
