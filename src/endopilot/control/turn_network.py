"""The network that says how a wire is turned before a fork, in place of a search: `TurnNetwork`.

It is given a fork as `ForkView` has it, and returns how likely the wire passes into the route's branch when its tip
points to each side: a Fourier series of the azimuth, so that turning the fork turns the answer. `python -m benchmarks
turn-network` trains it by what became of trials in the rod core.

Its input is a fork as the tip meets it, `ForkView`. The frame of a place of the route has the tangent of the route
there, the side to which the route goes on from there, and the normal of both. So a network is given the same numbers
wherever in the body the fork lies.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float

from endopilot.devices.device import Wire, lateral_reach
from endopilot.files import stored_arrays, writing
from endopilot.lines import places_on
from endopilot.tasks.route import Route
from endopilot.types import Centerline

_ROUTE_MM = np.array([-15.0, -10.0, -6.0, -3.0, 0.0, 2.0, 4.0, 7.0, 11.0, 16.0])
_OTHER_MM = np.array([2.0, 4.0, 7.0, 11.0])
"""Places of the route, from the place on, and of the branch that is not taken, mm: points and radii there are given."""
_OFF_AXIS_MM = 8.0
"""How far from the place the route's side is looked for, mm."""
_TIP_MM = 10.0
"""Length of wire that the direction of its tip is compared with, mm."""
_SCALE_MM, _RADIUS_MM = 10.0, 2.0
"""Units of lengths and of radii."""
FEATURES = 4 * len(_ROUTE_MM) + 4 * len(_OTHER_MM) + 11


@dataclass(frozen=True)
class ForkView:
    """What a network is given of a fork and the wire before it.

    Attributes:
        features: geometry and wire, without units; of these a turn of the wire changes a little where its tip and its
            shaft lie.
        azimuth: to which side of the route's the wire's tip points, rad.
    """

    features: Float[np.ndarray, "features"]
    azimuth: float

    @staticmethod
    def of(route: Route, at_mm: float, nodes: Float[np.ndarray, "nodes 3"], device: Wire) -> ForkView:
        """Return what is seen of a place of a route, abscissa mm, by a wire with these nodes, its tip first, LPS mm."""
        here = route.position(at_mm)
        axes = _axes(route, at_mm)
        ahead = _sampled(route.line, at_mm + _ROUTE_MM, here, axes)
        other = _other(route, at_mm)
        beside = (
            np.zeros(4 * len(_OTHER_MM))
            if other is None
            else _sampled(other, other.abscissa[0] + _OTHER_MM, here, axes)
        )
        away = np.linalg.norm(nodes - nodes[0], axis=1)
        second, behind, further = (
            nodes[int(np.argmax(away >= min(share * _TIP_MM, away[-1])))] for share in (0.15, 1.0, 1.6)
        )
        tip, shaft = nodes[0] - second, behind - further
        across = (tip / max(np.linalg.norm(tip), 1e-9) - shaft / max(np.linalg.norm(shaft), 1e-9)) @ axes.T
        lean = shaft @ axes.T / max(np.linalg.norm(shaft), 1e-9)
        place = (nodes[0] - here) @ axes.T / _SCALE_MM
        wire = [
            float(other is not None),
            lateral_reach(device.tip_bend_rad, device.tip_bend_length_mm) / 5.0,
            device.tip_bend_rad,
            device.tip_bend_length_mm / _SCALE_MM,
            float(np.hypot(across[1], across[2])),
        ]
        return ForkView(np.concatenate([ahead, beside, wire, lean, place]), float(np.arctan2(across[2], across[1])))

    def mirrored(self) -> ForkView:
        """Return the same in a mirror that holds tangent and side."""
        features = self.features.copy()
        count = len(_ROUTE_MM) + len(_OTHER_MM)
        features[2 : 4 * count : 4] *= -1
        features[4 * count + 5 + 2] *= -1
        features[4 * count + 8 + 2] *= -1
        return ForkView(features, -self.azimuth)


def _axes(route: Route, at_mm: float) -> Float[np.ndarray, "3 3"]:
    """Return tangent, side and normal of the route at a place."""
    here, before, ahead = (route.position(at_mm + x) for x in (0.0, -2.0, _OFF_AXIS_MM))
    tangent = here - before
    if np.linalg.norm(tangent) < 1e-6:
        tangent = route.position(at_mm + 2.0) - here
    tangent = tangent / np.linalg.norm(tangent)
    side = ahead - here - ((ahead - here) @ tangent) * tangent
    if np.linalg.norm(side) < 1e-3:
        side = np.cross(tangent, np.eye(3)[int(np.argmin(np.abs(tangent)))])
    side = side / np.linalg.norm(side)
    return np.array([tangent, side, np.cross(tangent, side)])


def _other(route: Route, at_mm: float) -> Centerline | None:
    """Return the widest branch that leaves the route at a place and is not taken; None where no branch leaves."""
    if not len(route.junctions):
        return None
    at = int(np.argmin(np.abs(route.junctions - at_mm)))
    if abs(route.junctions[at] - at_mm) > 1e-6:
        return None
    tree, taken = route.anatomy.tree, route.branches[at + 1]
    others = [tree.branches[b].centerline for b in tree.children(route.branches[at]) if b != taken]
    return max(others, key=lambda line: float(line.radius[len(line.radius) // 2]), default=None)


def _sampled(line: Centerline, abscissa: np.ndarray, here: np.ndarray, axes: np.ndarray) -> Float[np.ndarray, "n"]:
    """Return points of a line in a frame, and radii."""
    points = places_on(line.points, line.abscissa, abscissa)
    beyond = np.minimum(abscissa - line.abscissa[0], 0.0)[:, None]
    first = line.points[min(2, len(line.points) - 1)] - line.points[0]
    points = points + beyond * first / max(np.linalg.norm(first), 1e-9)
    radius = np.interp(abscissa, line.abscissa, line.radius)
    return np.column_stack([(points - here) @ axes.T / _SCALE_MM, radius / _RADIUS_MM]).ravel()


SIDES = 72
"""Azimuths for which it is asked, evenly from −π on."""
AZIMUTH = 2 * np.pi * (np.arange(SIDES) / SIDES - 0.5)
"""These, rad."""
_LIMIT = 4.0
"""No feature is taken to be farther from the training's mean than this, standard deviations."""


@dataclass(frozen=True, eq=False)
class TurnNetwork:
    """Several dense networks of the same kind, whose answers are averaged.

    Attributes:
        mean, scale: of the features of the training.
        layers: weights and biases of each layer, of all networks: (networks, in, out) and (networks, out).
    """

    mean: Float[np.ndarray, "features"]
    scale: Float[np.ndarray, "features"]
    layers: tuple[tuple[np.ndarray, np.ndarray], ...]

    def passes(self, view: ForkView) -> Float[np.ndarray, "sides"]:
        """Return how likely the wire passes with its tip at each of `AZIMUTH`, by a fork and its mirror image."""
        mirrored = self._passes(view.mirrored())
        return 0.5 * (self._passes(view) + np.roll(mirrored[::-1], 1))

    def _passes(self, view: ForkView) -> Float[np.ndarray, "sides"]:
        hidden = np.clip((view.features - self.mean) / self.scale, -_LIMIT, _LIMIT)[None]
        for k, (weight, bias) in enumerate(self.layers):
            hidden = np.einsum("ni,nio->no", np.broadcast_to(hidden, (len(weight), hidden.shape[-1])), weight) + bias
            if k < len(self.layers) - 1:
                hidden = hidden / (1 + np.exp(-hidden))
        return np.mean(1 / (1 + np.exp(-hidden @ fourier(AZIMUTH, hidden.shape[-1]).T)), axis=0)

    def write(self, path: Path) -> None:
        """Write it as an .npz file."""
        arrays = {
            f"{name}{k}": each for k, pair in enumerate(self.layers) for name, each in zip("wb", pair, strict=True)
        }
        with writing(path) as partial:
            np.savez_compressed(partial, mean=self.mean, scale=self.scale, **arrays)  # pyright: ignore[reportArgumentType]

    @staticmethod
    def read(path: Path) -> TurnNetwork:
        """Read one, or raise `InputError` where there is none."""
        with stored_arrays(path, "network of turns", "make one by python -m benchmarks turn-network") as held:
            count = sum(name.startswith("w") for name in held.files)
            layers = tuple((held[f"w{k}"].astype(float), held[f"b{k}"].astype(float)) for k in range(count))
            return TurnNetwork(held["mean"].astype(float), held["scale"].astype(float), layers)


def fourier(azimuth: Float[np.ndarray, "*n"], terms: int) -> Float[np.ndarray, "*n terms"]:
    """Return the terms of a Fourier series: 1, then cosine and sine of each multiple of an azimuth, rad."""
    order = np.arange(1, (terms - 1) // 2 + 1)
    angle = azimuth[..., None] * order
    waves = np.stack([np.cos(angle), np.sin(angle)], axis=-1).reshape(*azimuth.shape, -1)
    return np.concatenate([np.ones((*azimuth.shape, 1)), waves], axis=-1)
