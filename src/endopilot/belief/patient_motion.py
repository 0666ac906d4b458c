"""How heart and breath move a vessel, by what X-ray shows of the wire: `find_motion`.

The vessel was taken to lie still, or to move with known periods and with amplitudes that may be another patient's. A
tip that is predicted at a place of the vessel is seen where the motion has taken that place. For given periods of heart
and breath the displacement is linear in the amplitudes, whose published distributions are known before: the evidence of
each pair of periods has a closed form, and so have the likeliest amplitudes.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass, replace

import numpy as np
from jaxtyping import Float

from endopilot.models.hypotheses import DRIFT, HYPOTHESES, REGISTRATION
from endopilot.simulation.motion import AMPLITUDES, Motion, contracted_share, place

_HEART = {
    **{name: AMPLITUDES[name][:2] for name in ("annulus_mm", "heart_volume_share")},
    "heart_rotation_deg": (Motion().heart_rotation_deg, 2.0),
}
_BREATH = {name: AMPLITUDES[name][:2] for name in AMPLITUDES if name.startswith("breathing")}
_AMPLITUDES = _HEART | _BREATH
"""Mean and standard deviation of amplitudes before; that of the heart's rotation is an assumption."""
_LIMITS = {"annulus_mm": (0.0, 40.0), "heart_volume_share": (0.0, 0.3)}
"""Least and most of amplitudes that a motion cannot have smaller or larger."""
_WIDER = 1.5
"""Amplitudes may differ this much more: published samples are small, an assumption."""
_KINDS = (tuple(_HEART), tuple(_BREATH), tuple(_AMPLITUDES))
_STILL = replace(Motion(), **dict.fromkeys(_AMPLITUDES, 0.0), heart_period_s=1.0, breathing_period_s=2.0)
_SYSTOLE_S, _INSPIRED_S = 0.66, 1.0
"""When a heart of that period is contracted, and its breath drawn in; a motion begins in diastole, breath let out."""
_MID_DIASTOLE = 0.68
"""Phase of the heart at which a motion begins."""
_HEART_HZ, _BREATH_HZ = (0.75, 1.8), (0.15, 0.42)
"""Frequencies that are tried: 45 to 108 beats, 9 to 25 breaths a minute."""
_USUAL_HZ = (1.17, 0.2), (0.25, 0.06)
"""Means and standard deviations of these before: an assumption."""
_PHASE, _FINE = 0.08, np.arange(-8, 9) / 8
"""Frequencies that are tried differ by this share of a period over the whole time; and finer ones near the best, in
shares of that."""
_DRIFT_SD = np.array([each.parameters[0].other for each in HYPOTHESES if each.name in (REGISTRATION, DRIFT)])
"""Standard deviations of a registration that errs, mm, and of its drift, mm a minute."""
_ALONG_MM, _ACROSS_MM, _HEAVY = 3.0, 0.6, 12.0
"""Standard deviations of a predicted tip's error along and across the wire, mm: the motion also drives the wire to and
fro in its vessel; and the squares of errors, in these, beyond which a tip counts for less."""


@dataclass(frozen=True)
class FoundMotion:
    """A motion, and what speaks for it.

    Attributes:
        motion: with the likeliest periods and amplitudes.
        gain: logarithm of how much likelier it makes what X-ray showed than the known motion, or a vessel that lies
            still, with a registration that errs and drifts as is likeliest.
        misfit: mean square of the errors that are left, in standard deviations; near 1 where the motion explains them.
    """

    motion: Motion
    gain: float
    misfit: float

    @property
    def words(self) -> str:
        """The motion, in words."""
        found = self.motion
        heart = f"heart at {60 / found.heart_period_s:.0f} a minute, {found.annulus_mm:.0f} mm"
        breath = f"breath every {found.breathing_period_s:.1f} s, {found.breathing_caudal_mm:.0f} mm"
        beats = any(getattr(found, name) for name in _HEART)
        breathes = any(getattr(found, name) for name in _BREATH)
        return "the vessel moves: " + ", ".join([*[heart] * beats, *[breath] * breathes])


def find_motion(
    tip: Float[np.ndarray, "n 3"],
    direction: Float[np.ndarray, "n 3"],
    seen: Float[np.ndarray, "n 3"],
    times_s: Float[np.ndarray, "n"],
    ostium: Float[np.ndarray, "3"],
    known: Motion | None = None,
) -> FoundMotion:
    """Return the motion of heart, breath or both that best explains where X-ray showed tips.

    Args:
        tip: predicted in the vessel as CT shows it, LPS mm.
        direction: unit vectors along the wire there.
        seen: by X-ray, LPS mm.
        times_s: of these exposures, s after the motion began.
        ostium: LPS mm.
        known: how the vessel is taken to move: its periods are kept, and amplitudes are sought around its own. A vessel
            that lies still if not given, for which the published means of both are where the search begins.
    """
    across = np.eye(3) / _ACROSS_MM + (1 / _ALONG_MM - 1 / _ACROSS_MM) * direction[:, :, None] * direction[:, None, :]
    error = np.einsum("nij,nj->ni", across, seen - tip)
    weight = 1 / (1 + (error**2).sum(axis=1) / _HEAVY / 10)
    kinds = _KINDS if known is None else _KINDS[-1:]
    fits = [
        _Fit(names, np.einsum("nij,njk->nik", across, _fields(tip, ostium, names)), error, known) for names in kinds
    ]
    _, _, left = max((fit.best(times_s, weight) for fit in fits), key=lambda each: each[0])
    gain, motion, left = max((fit.best(times_s, 1 / (1 + left / _HEAVY)) for fit in fits), key=lambda each: each[0])
    weight = 1 / (1 + left / _HEAVY)
    gain -= max(_drift_gain(across, error, times_s), 0.0)
    return FoundMotion(motion, gain, float((weight * left).sum() / (3 * weight.sum())))


def _drift_gain(
    across: Float[np.ndarray, "n 3 3"], error: Float[np.ndarray, "n 3"], times_s: Float[np.ndarray, "n"]
) -> float:
    """Return the logarithm of how much likelier a wrong registration that drifts makes the images than none."""
    field = np.concatenate([across, across * (times_s / 60)[:, None, None]], axis=-1)
    precision = np.diag(np.repeat(_DRIFT_SD, 3) ** -2.0)

    def fitted(left: Float[np.ndarray, "n 3"]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        weight = 1 / (1 + (left**2).sum(axis=1) / _HEAVY)
        normal, right = np.einsum("n,nik,nil->kl", weight, field, field), np.einsum("n,nik,ni->k", weight, field, error)
        return np.linalg.solve(normal + precision, right), normal, right

    found, normal, right = fitted(error - field @ fitted(error)[0])
    occam = np.linalg.slogdet(normal + precision)[1] - np.linalg.slogdet(precision)[1]
    return float(0.5 * (found @ right - occam))


def _fields(
    points: Float[np.ndarray, "n 3"], ostium: Float[np.ndarray, "3"], names: tuple[str, ...]
) -> Float[np.ndarray, "n 3 amplitudes"]:
    """Return how far each amplitude takes points when it is at its largest, mm a unit of it."""
    fields = []
    for name in names:
        mean = _AMPLITUDES[name][0]
        when = _SYSTOLE_S if name in _HEART else _INSPIRED_S
        (maps,) = replace(_STILL, **{name: mean}).core(ostium).placements(np.array([when]))[0]
        fields.append((place(maps, points) - points) / mean)
    return np.stack(fields, axis=-1)


class _Fit:
    """Linear fits of some amplitudes, for many periods at once."""

    def __init__(
        self,
        names: tuple[str, ...],
        field: Float[np.ndarray, "n 3 k"],
        error: Float[np.ndarray, "n 3"],
        known: Motion | None,
    ) -> None:
        self.names, self._error, self._known = names, error, known
        self._heart = len([name for name in names if name in _HEART])
        self._field = field
        before = {name: mean for name, (mean, _) in _AMPLITUDES.items()} if known is None else asdict(known)
        self._mean = np.array([before[name] for name in names])
        self._sd = _WIDER * np.array([_AMPLITUDES[name][1] for name in names])

    def best(
        self, times_s: Float[np.ndarray, "n"], weight: Float[np.ndarray, "n"]
    ) -> tuple[float, Motion, Float[np.ndarray, "n"]]:
        """Return the logarithm of the evidence over that of the known motion, or of a vessel that lies still; the
        likeliest motion; and the squared errors that it leaves."""
        step, known = _PHASE / max(float(times_s.max()), 1.0), self._known
        tried = [
            np.arange(low, high, step) if any_of else np.array([usual])
            for (low, high), (usual, _), any_of in zip(
                (_HEART_HZ, _BREATH_HZ), _USUAL_HZ, (self._heart, len(self.names) - self._heart), strict=True
            )
        ]
        if known is not None:
            tried = [np.array([1 / period_s]) for period_s in (known.heart_period_s, known.breathing_period_s)]
        evidence, _ = self._evidence(tried[0], tried[1], times_s, weight)
        top = np.unravel_index(np.argmax(evidence), evidence.shape)
        total = float(evidence.max() + np.log(np.exp(evidence - evidence.max()).mean()))
        near = [hz[k] + step * _FINE if len(hz) > 1 else hz for hz, k in zip(tried, top, strict=True)]
        evidence, amplitude = self._evidence(near[0], near[1], times_s, weight)
        k, m = np.unravel_index(np.argmax(evidence), evidence.shape)
        found = np.clip(amplitude[k, m], *np.array([_LIMITS.get(name, (-np.inf, np.inf)) for name in self.names]).T)
        motion = replace(
            _STILL,
            **dict(zip(self.names, found.tolist(), strict=True)),
            heart_period_s=float(1 / near[0][k]),
            breathing_period_s=float(1 / near[1][m]),
        )
        shape = self._shapes(near[0][k : k + 1], near[1][m : m + 1], times_s)
        done = [each[0][:, None, None] for each in shape]
        parts = np.split(self._field, [self._heart], axis=-1)
        moved = np.concatenate([share * part for share, part in zip(done, parts, strict=True)], axis=-1)
        left, as_known = (((self._error - moved @ each) ** 2).sum(axis=1) for each in (found, self._mean))
        if known is not None:
            total -= 0.5 * float(weight @ ((self._error**2).sum(axis=1) - as_known))
        return total, motion, left

    def _shapes(
        self, heart_hz: Float[np.ndarray, "f"], breath_hz: Float[np.ndarray, "g"], times_s: Float[np.ndarray, "n"]
    ) -> tuple[Float[np.ndarray, "f n"], Float[np.ndarray, "g n"]]:
        """Return the shares of heartbeat and breath that are done at some times, for frequencies."""
        rest = contracted_share(np.array([_MID_DIASTOLE]))[0]
        phase = _MID_DIASTOLE + np.outer(heart_hz, times_s)
        beat = (contracted_share(phase.ravel()).reshape(phase.shape) - rest) / (1 - rest)
        return beat, np.sin(np.pi * np.outer(breath_hz, times_s)) ** 4

    def _evidence(
        self,
        heart_hz: Float[np.ndarray, "f"],
        breath_hz: Float[np.ndarray, "g"],
        times_s: Float[np.ndarray, "n"],
        weight: Float[np.ndarray, "n"],
    ) -> tuple[Float[np.ndarray, "f g"], Float[np.ndarray, "f g k"]]:
        """Return the logarithms of the evidence over that of no motion, and the likeliest amplitudes."""
        h, size = self._heart, len(self.names)
        beat, breath = self._shapes(heart_hz, breath_hz, times_s)
        field = np.sqrt(weight)[:, None, None] * self._field
        error = np.sqrt(weight)[:, None] * self._error
        gram, onto = np.einsum("nik,nil->nkl", field, field), np.einsum("nik,ni->nk", field, error)
        normal = np.empty((len(heart_hz), len(breath_hz), size, size))
        normal[..., :h, :h] = np.einsum("fn,nkl->fkl", beat**2, gram[:, :h, :h])[:, None]
        normal[..., h:, h:] = np.einsum("gn,nkl->gkl", breath**2, gram[:, h:, h:])[None]
        mixed = np.einsum("fn,gn,nkl->fgkl", beat, breath, gram[:, :h, h:], optimize=True)
        normal[..., :h, h:], normal[..., h:, :h] = mixed, np.swapaxes(mixed, -1, -2)
        right = np.empty(normal.shape[:-1])
        right[..., :h], right[..., h:] = (beat @ onto[:, :h])[:, None], (breath @ onto[:, h:])[None]
        normal += np.diag(self._sd**-2)
        right += self._mean / self._sd**2
        amplitude = np.linalg.solve(normal, right[..., None])[..., 0]
        explained = (amplitude * right).sum(axis=-1) - float(self._mean**2 @ self._sd**-2)
        evidence = 0.5 * explained - 0.5 * np.linalg.slogdet(normal)[1] - float(np.log(self._sd).sum())
        if self._known is not None:
            return evidence, amplitude
        (heart, heart_sd), (breathing, breathing_sd) = _USUAL_HZ
        evidence -= 0.5 * (((heart_hz - heart) / heart_sd) ** 2)[:, None] * (h > 0)
        return evidence - 0.5 * ((breath_hz - breathing) / breathing_sd) ** 2 * (h < size), amplitude
