"""Where the C-arms of many worlds find the tips of their wires: `TipFinder`, which is `Fluoroscope.locate` for all."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float, Int

from endopilot.xray import fluoroscope
from endopilot.xray.fluoroscope import Fluoroscope


class TipFinder:
    """C-arms around some patients, of which each world has one; world by world with the same results."""

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
