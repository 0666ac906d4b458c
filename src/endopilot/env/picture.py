"""What an environment shows: the vessel, the target and the devices in it, drawn by numpy alone."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float, UInt8

from endopilot.devices.stack import lines_from_tips, shown_part
from endopilot.lines import length_along, places_on
from endopilot.simulation.simulator import Simulator
from endopilot.tasks.navigation import Navigation

SIZE = 256
"""Pixels of a picture along a side."""
_MARGIN = 10
_WHITE, _VESSEL, _TARGET = (255, 255, 255), (226, 205, 205), (213, 94, 0)
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
        self._px_per_mm = (SIZE - 2 * _MARGIN) / float(np.ptp(points, axis=0).max())
        self._still = np.full((SIZE, SIZE, 3), _WHITE, dtype=np.uint8)
        for line in lines:
            self._draw(self._still, line.points, line.radius * self._px_per_mm, _VESSEL)
        self._draw(self._still, navigation.target.position(anatomy)[None], np.array([_TARGET_PX]), _TARGET)

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
