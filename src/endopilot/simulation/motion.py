"""The patient's motion: heartbeat and breathing move the vessel and with it the guiding catheter.

A point X of the vessel, as CT shows it, lies at x = o + u + R (1 + E) (X - o), with o the ostium. The shift u, the
rotation R and the symmetric strain E (of the heartbeat alone) are smooth and periodic in time. CT shows the vessel at
mid-diastole and at the end of expiration; there every motion begins.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Annotated, Any, Literal

import numpy as np
from jaxtyping import Float
from scipy.interpolate import PchipInterpolator

from endopilot.atlas.heart_reference import LEFT_VENTRICLE_AXIS
from endopilot.settings import Finite, Within, settings
from endopilot.simulation.config import CoreMotion, Processor, core_for

MotionName = Literal["still", "breathing", "heartbeat", "both"]  # names of motions: see `motion_named`
Axis = Float[np.ndarray, "3"]

AMPLITUDES = {
    "annulus_mm": (11.6, 2.9, 3.0, 19.0),
    "heart_volume_share": (0.082, 0.023, 0.048, 0.106),
    "breathing_caudal_mm": (4.9, 1.9, 2.4, 8.0),
    "breathing_anterior_mm": (1.3, 1.8, -0.4, 5.1),
    "breathing_dorsal_deg": (1.5, 0.9, 0.2, 3.5),
    "breathing_dextral_deg": (1.2, 1.3, -1.9, 3.2),
}
"""Amplitudes in which patients differ: published mean, standard deviation, least and most; `Motion` has the sources."""

_LONG_AXIS = np.array(LEFT_VENTRICLE_AXIS) / np.linalg.norm(LEFT_VENTRICLE_AXIS)  # from the heart's base to its apex
_LONG_AXIS_MM = 94.0  # length of the left ventricle's outside along it, mm, as in the atlas
_KNOTS = 64  # knots of the spline through a period
_PHASES, _CONTRACTED = (0.03, 0.34, 0.54, 0.74), (0.0, 1.0, 0.42, 0.22)
"""Shares of the contraction that are done at phases of the heartbeat, as shares of its period: where systole begins
and ends, where the rapid filling ends and where the filling by the atria begins. Shortening is greatest at 0.34 (4D CT
of 25 normal hearts; McVeigh et al., J Cardiovasc Comput Tomogr 2018). The others are such that the proximal and middle
right coronary artery stays within 1 mm for about as long as published (Shechter et al., Med Phys 2005): 94 ms at
end-systole, for 76 ± 34 ms, and 88 ms in mid-diastole, for 65 ± 42 ms."""
_MID_DIASTOLE = 0.68  # phase at which CT shows the vessel


@settings
class Motion:
    """How much the vessel moves. The defaults are the published means of the coronary arteries and of the heart."""

    heart_period_s: Annotated[float, Within(0.1, 60)] = 60 / 70
    """Time between heartbeats, s."""
    annulus_mm: Annotated[float, Within(0, 200)] = 11.6
    """Travel of the aortic annulus towards the apex in systole, mm: 11.6 ± 2.9, 3 to 19 (73 patients; Plonek et al.,
    BMC Cardiovasc Disord 2018). The apex stays where it is (Hoffman and Ritman, Am J Physiol 1985), so this is also how
    much the heart shortens along its axis."""
    heart_volume_share: Annotated[float, Within(0, 0.3)] = 0.082
    """Share of the whole heart's volume that is lost in systole: 0.082 ± 0.023, 0.048 to 0.106 (8 volunteers; Carlsson
    et al., Am J Physiol 2004). It is taken to be lost across the heart's axis."""
    heart_rotation_deg: Finite = 3.5
    """Rotation in systole about the heart's axis, anticlockwise as seen from the apex, degrees: the mean of the apex's
    10 and the base's -3 (Young and Cowan, J Cardiovasc Magn Reson 2012). The twist between them is no affine map and
    left out."""
    breathing_period_s: Annotated[float, Within(0.1, 600)] = 4.0
    """Time between breaths, s."""
    breathing_caudal_mm: Finite = 4.9
    """Shift towards the feet in inspiration, mm: 4.9 ± 1.9, 2.4 to 8.0 (ten patients' coronary arteries; Shechter et
    al., IEEE Trans Med Imaging 2004)."""
    breathing_anterior_mm: Finite = 1.3
    """Shift forwards in inspiration, mm: 1.3 ± 1.8, -0.4 to 5.1 (the same)."""
    breathing_dorsal_deg: Finite = 1.5
    """Rotation of the head's end backwards in inspiration, degrees: 1.5 ± 0.9, 0.2 to 3.5 (the same)."""
    breathing_dextral_deg: Finite = 1.2
    """Rotation of the feet's end to the right in inspiration, degrees: 1.2 ± 1.3, -1.9 to 3.2 (the same)."""

    def core(self, ostium: Axis, processor: Processor = "cpu") -> CoreMotion:
        """Return the motion about an ostium, LPS mm, as the core wants it."""
        cycles = [(self.heart_period_s, self._heartbeat()), (self.breathing_period_s, self._breathing())]
        used = [cycle for cycle in cycles if cycle[1].any()] or cycles[:1]
        return core_for(processor).make_motion(
            ostium=np.asarray(ostium, dtype=float),
            period=np.array([period for period, _ in used]),
            coefficients=np.array([_spline_coefficients(numbers) for _, numbers in used]),
        )

    def _heartbeat(self) -> Float[np.ndarray, "knots 12"]:
        """Return shift (mm), rotation vector (rad) and strain xx yy zz xy xz yz at equal times of a heartbeat."""
        along = np.outer(_LONG_AXIS, _LONG_AXIS)
        across = math.sqrt(1 - self.heart_volume_share) - 1
        strain = -self.annulus_mm / _LONG_AXIS_MM * along + across * (np.eye(3) - along)
        systole = [
            *(self.annulus_mm * _LONG_AXIS),
            *(math.radians(self.heart_rotation_deg) * _LONG_AXIS),
            *strain[[0, 1, 2, 0, 0, 1], [0, 1, 2, 1, 2, 2]],
        ]
        times = _MID_DIASTOLE + np.arange(_KNOTS) / _KNOTS
        return np.outer(contracted_share(times) - contracted_share(np.array([_MID_DIASTOLE])), systole)

    def _breathing(self) -> Float[np.ndarray, "knots 12"]:
        """Return the same of a breath: sin⁴, which lingers at the end of expiration (Lujan et al., Med Phys 1999)."""
        angles = np.radians([-self.breathing_dorsal_deg, self.breathing_dextral_deg])
        inspired = [0.0, -self.breathing_anterior_mm, -self.breathing_caudal_mm, *angles, *np.zeros(7)]
        return np.outer(np.sin(np.pi * np.arange(_KNOTS) / _KNOTS) ** 4, inspired)


def contracted_share(phase: Float[np.ndarray, "n"]) -> Float[np.ndarray, "n"]:
    """Return the share of the heart's contraction that is done at phases of the heartbeat, as shares of its period."""
    beats = np.arange(-1, 3)[:, None]
    course = PchipInterpolator((beats + _PHASES).ravel(), np.tile(_CONTRACTED, len(beats)))
    return course(np.mod(phase, 1.0))


_STILL: dict[str, tuple[str, ...]] = {
    "breathing": ("annulus_mm", "heart_volume_share", "heart_rotation_deg"),
    "heartbeat": tuple(name for name in AMPLITUDES if name.startswith("breathing")),
    "both": (),
}
"""What does not move in motions, by their names."""


def motion_named(name: MotionName, seed: int | None = None) -> Motion | None:
    """Return a motion by its name; None for "still". The seed draws one patient's amplitudes from the published
    distributions, within the published ranges; without it they are the published means."""
    if name == "still":
        return None
    return replace(Motion() if seed is None else draw_motion(seed), **dict.fromkeys(_STILL[name], 0.0))


def published_mean(motion: Motion) -> Motion | None:
    """Return published mean amplitudes of what moves in a patient's motion, with the patient's periods, or None."""
    beats, breathes = (any(getattr(motion, each) for each in _STILL[name]) for name in ("breathing", "heartbeat"))
    still = dict.fromkeys((() if beats else _STILL["breathing"]) + (() if breathes else _STILL["heartbeat"]), 0.0)
    periods = {"heart_period_s": motion.heart_period_s, "breathing_period_s": motion.breathing_period_s}
    return replace(Motion(), **still, **periods) if beats or breathes else None


def draw_motion(seed: int) -> Motion:
    """Return the motion of one patient, drawn from normal distributions as published, within the published ranges."""
    random = np.random.default_rng(seed)

    def within(mean: float, deviation: float, low: float, high: float) -> float:
        drawn: Any = random.normal(mean, deviation, 64)
        fits = drawn[(drawn >= low) & (drawn <= high)]
        return float(fits[0]) if len(fits) else mean

    return Motion(**{name: within(*published) for name, published in AMPLITUDES.items()})


def place(
    maps: Float[np.ndarray, "*maps 3 4"], points: Float[np.ndarray, "*points 3"]
) -> Float[np.ndarray, "*placed 3"]:
    """Return points after affine maps, such as where points of the vessel lie in the laboratory; both are broadcast."""
    return np.einsum("...ij,...j->...i", maps[..., :3], points) + maps[..., 3]


def relative(
    maps: Float[np.ndarray, "*maps 3 4"], to: Float[np.ndarray, "*maps 3 4"]
) -> Float[np.ndarray, "*maps 3 4"]:
    """Return the affine maps `to`⁻¹ ∘ `maps`: where points that `maps` moves lie in a frame that `to` moves."""
    away = maps.copy()
    away[..., 3] -= to[..., 3]
    return np.linalg.solve(to[..., :3], away)


def _spline_coefficients(values: Float[np.ndarray, "knots 12"]) -> Float[np.ndarray, "knots 12"]:
    """Return the coefficients of the periodic cubic B-spline through values at equal times."""
    wave = np.cos(2 * np.pi * np.arange(len(values)) / len(values))
    return np.fft.ifft(np.fft.fft(values, axis=0) / ((2 + wave) / 3)[:, None], axis=0).real
