"""How much harder a drive pushes than simulated devices predict: `LoadRatio`."""

from __future__ import annotations

_FORGETS, _PRIOR_N = 0.9, 0.1
"""What a period weighs a period later; and with what force the prior, that the drive pushes as predicted, counts, N."""
_LEAST_N, _LEAST_MM_S = 0.02, 0.5
"""A predicted force of less, or a slower advance, says nothing: noise and the valve's friction hide it."""
_MARGIN = 0.25
"""A ratio is believed this much smaller than it is found: by so much it errs where the model is right, found on
patients to improve agents on."""


class LoadRatio:
    """The force of a drive over the predicted one, by least squares with forgetting, while the wire advances.

    Walls press on a wire that is pushed harder by as much more: the ratio scales the wall forces of simulated wires.
    """

    def __init__(self) -> None:
        """Begin with a drive that pushes as predicted."""
        self._read = self._predicted = _PRIOR_N**2

    def take(self, read_n: float, predicted_n: float, *, speed_mm_s: float, valve: tuple[float, float]) -> None:
        """Take a reading.

        Args:
            predicted_n: what the wire ahead of the valve takes of it by the model, N.
            valve: friction of the introducer's valve, N, and its drag, N·s/mm.
        """
        if predicted_n < _LEAST_N or speed_mm_s < _LEAST_MM_S:
            return
        pushed_n, prior = read_n - valve[0] - valve[1] * speed_mm_s, (1 - _FORGETS) * _PRIOR_N**2
        self._read = _FORGETS * self._read + predicted_n * pushed_n + prior
        self._predicted = _FORGETS * self._predicted + predicted_n**2 + prior

    @property
    def value(self) -> float:
        """The ratio that is surely exceeded, 1 at least."""
        return max(1.0, self._read / self._predicted - _MARGIN)
