"""Models that predict the tip while X-ray is off, and predict anew after each exposure: `online_predictor`."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from jaxtyping import Float, Int

from endopilot.models.config import WINDOW
from endopilot.models.ensemble import weigh
from endopilot.models.episodes import EachObserved, Episodes, Predictor, given_states
from endopilot.models.simulated_wires import SimulatedWires

Tips = Float[np.ndarray, "episodes samples 2"]


class OnlinePredictor:
    """Predicts the tips of navigations whose controls are known, from the first `WINDOW` samples and from exposures.

    Attributes:
        tip: (Δtip, γtip) at every sample, mm, from what has been observed so far; for past samples, as predicted then.
        spread: the model's estimate of its own error, mm; 0 where it makes none.
    """

    def __init__(self, episodes: Episodes, observed: EachObserved) -> None:
        self._observed = observed & given_states(episodes)
        self._tip, self._branch = episodes.tip.astype(float), episodes.branch.copy()
        self._sd = episodes.tip_sd.astype(float)
        self._first = self._predict(np.arange(len(episodes)), WINDOW - 1)
        self.reset()

    def _predict(self, chosen: Int[np.ndarray, "some"], sample: int) -> tuple[Tips, Tips]:
        """Return tips and spread, mm, of some navigations, from what was observed of them up to a sample."""
        raise NotImplementedError

    def reset(self) -> None:
        """Forget what was observed after the first `WINDOW` samples."""
        self._observed[:, WINDOW:] = False
        self.tip, self.spread = (part.copy() for part in self._first)

    def observe(
        self,
        episodes: Int[np.ndarray, "some"],
        sample: int,
        tip: Float[np.ndarray, "some 2"],
        branch: Int[np.ndarray, "some"],
        sd_mm: Float[np.ndarray, "some 2"] | None = None,
    ) -> None:
        """Take what X-ray shows of some navigations at a sample, and predict the later samples anew.

        Args:
            tip: (Δtip, γtip) in the image, mm.
            sd_mm: standard deviations of both as the detector states them, mm; none if not given. Simulated wires are
                weighed by them; networks have no such input.
        """
        self._observed[episodes, sample] = True
        self._tip[episodes, sample], self._branch[episodes, sample] = tip, branch
        self._sd[episodes, sample] = 0.0 if sd_mm is None else sd_mm
        later, found = slice(sample + 1, None), self._predict(episodes, sample)
        self.tip[episodes, later], self.spread[episodes, later] = (part[:, later] for part in found)


class OnlineWires(OnlinePredictor):
    """Simulated wires, which are simulated once and weighted again at every exposure."""

    def __init__(self, wires: SimulatedWires, episodes: Episodes, observed: EachObserved) -> None:
        self._paths = wires.paths(episodes, observed & given_states(episodes))
        super().__init__(episodes, observed)

    def _predict(self, chosen: Int[np.ndarray, "some"], sample: int) -> tuple[Tips, Tips]:
        return weigh(self._paths[:, chosen], self._tip[chosen], self._observed[chosen], self._sd[chosen])


class OnlineWindowed(OnlinePredictor):
    """The paper's networks: they go on from the last `WINDOW` states, those not observed as they predicted them.

    Of the first `WINDOW` they need every one.
    """

    def __init__(self, predictor: Predictor, episodes: Episodes) -> None:
        self._predictor, self._episodes = predictor, episodes
        super().__init__(episodes, np.ones(episodes.branch.shape, dtype=bool))

    def _predict(self, chosen: Int[np.ndarray, "some"], sample: int) -> tuple[Tips, Tips]:
        if sample + 1 < self._tip.shape[1]:
            known = replace(self._episodes.select(chosen), tip=self._tip[chosen].astype(np.float32))
            found = self._predictor.rollout_forward(known.from_sample(sample + 1 - WINDOW))
            self._tip[chosen, sample + 1 :] = found.tip
        return self._tip[chosen], np.zeros_like(self._tip[chosen])

    def reset(self) -> None:
        """Forget what was observed after the first `WINDOW` samples."""
        super().reset()
        self._tip = self.tip.copy()


def online_predictor(predictor: Predictor, episodes: Episodes, observed: EachObserved | None = None) -> OnlinePredictor:
    """Return what predicts the tips of navigations with a model as exposures come in.

    Args:
        observed: which of the first `WINDOW` samples were measured; all if not given. The paper's networks take the
            others' tips as they stand in `episodes`.
    """
    if observed is None:
        observed = np.ones(episodes.branch.shape, dtype=bool)
    if isinstance(predictor, SimulatedWires):
        return OnlineWires(predictor, episodes, observed)
    return OnlineWindowed(predictor, episodes)
