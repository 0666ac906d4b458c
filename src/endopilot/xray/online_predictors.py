"""What a model foretells while X-ray is off, and again after each exposure: a twin, our networks, the paper's."""

from __future__ import annotations

from dataclasses import fields, replace
from typing import Protocol, runtime_checkable

import numpy as np
from jaxtyping import Float, Int

from endopilot.dataset.loader import Dataset
from endopilot.models import open_loop
from endopilot.models.config import WINDOW
from endopilot.models.open_loop import Predictor
from endopilot.models.twin import TwinPredictor, weigh

Tips = Float[np.ndarray, "episodes samples 2"]


@runtime_checkable
class OnlinePredictor(Protocol):
    """Foretells the tips of navigations whose controls are known.

    Attributes:
        tip: (Δtip, γtip) at every sample, mm, from what was shown so far; of the past, as it was foretold.
        spread: what the model says of its own error, mm; 0 where it says nothing.
    """

    tip: Tips
    spread: Tips

    def restart(self) -> None:
        """Forget what was shown after the first `WINDOW` samples."""
        ...

    def show(self, episodes: Int[np.ndarray, "shown"], sample: int, tip: Float[np.ndarray, "shown 2"]) -> None:
        """Take what X-ray shows of some navigations at a sample, mm, and foretell the later ones anew."""
        ...


class _OnlineFiltered:
    """What is common to models that take tips seen at any time: which were shown, and what is foretold from those."""

    def __init__(self, episodes: Dataset) -> None:
        self._seen = np.tile(np.arange(episodes.valid.shape[1]) < WINDOW, (len(episodes), 1))
        self._shown = np.stack([episodes.tip_abscissa, episodes.tip_offset], axis=-1).astype(float)
        self._first = self._told(np.arange(len(episodes)))
        self.restart()

    def _told(self, episodes: Int[np.ndarray, "some"]) -> tuple[Tips, Tips]:
        """Return tips and spread, mm, of some navigations, from what was shown of them."""
        raise NotImplementedError

    def restart(self) -> None:
        """Forget what was shown after the first `WINDOW` samples."""
        self._seen[:, WINDOW:] = False
        self.tip, self.spread = (part.copy() for part in self._first)

    def show(self, episodes: Int[np.ndarray, "shown"], sample: int, tip: Float[np.ndarray, "shown 2"]) -> None:
        """Take what X-ray shows of some navigations at a sample, mm, and foretell the later ones anew."""
        self._seen[episodes, sample], self._shown[episodes, sample] = True, tip
        later = slice(sample + 1, None)
        self.tip[episodes, later], self.spread[episodes, later] = (part[:, later] for part in self._told(episodes))


class OnlineTwin(_OnlineFiltered):
    """A twin, whose ensemble is simulated once and weighed again at every exposure."""

    def __init__(self, twin: TwinPredictor, episodes: Dataset) -> None:
        """Simulate, and foretell from the first `WINDOW` samples.

        Args:
            twin: the model.
            episodes: their controls, and their tips as they are measured.
        """
        self._config, self._paths = twin.config, twin.ensemble(episodes, open_loop.given_states(episodes))
        super().__init__(episodes)

    def _told(self, episodes: Int[np.ndarray, "some"]) -> tuple[Tips, Tips]:
        return weigh(self._paths[:, episodes], self._shown[episodes], self._seen[episodes], self._config)


class OnlineCausal(_OnlineFiltered):
    """Our networks, which take tips that are seen at any time, and say how far they may be off."""

    def __init__(self, predictor: open_loop.ProbabilisticPredictor, episodes: Dataset) -> None:
        """Foretell from the first `WINDOW` samples.

        Args:
            predictor: the model.
            episodes: their controls, and their tips as they are measured.
        """
        self._predictor, self._episodes = predictor, episodes
        super().__init__(episodes)

    def _told(self, episodes: Int[np.ndarray, "some"]) -> tuple[Tips, Tips]:
        shown = replace(
            self._episodes.select(episodes),
            tip_abscissa=self._shown[episodes, :, 0],
            tip_offset=self._shown[episodes, :, 1],
        )
        found = self._predictor.foretell(shown, self._seen[episodes])
        return found.tip, found.spread


class OnlineWindowed:
    """The paper's networks: they go on from the last `WINDOW` states, those not seen as they foretold them."""

    def __init__(self, predictor: Predictor, episodes: Dataset) -> None:
        """Foretell from the first `WINDOW` samples.

        Args:
            predictor: the model.
            episodes: their controls, and their tips as they are measured.
        """
        self._predictor, self._episodes = predictor, episodes
        self.tip = np.stack([episodes.tip_abscissa, episodes.tip_offset], axis=-1).astype(float)
        self.spread = np.zeros_like(self.tip)
        self.tip[:, WINDOW:] = predictor.rollout_forward(episodes).tip
        self._first, self._known = self.tip.copy(), self.tip.copy()

    def restart(self) -> None:
        """Forget what was shown after the first `WINDOW` samples."""
        self.tip, self._known = self._first.copy(), self._first.copy()

    def show(self, episodes: Int[np.ndarray, "shown"], sample: int, tip: Float[np.ndarray, "shown 2"]) -> None:
        """Take what X-ray shows of some navigations at a sample, mm, and foretell the later ones anew."""
        self._known[episodes, sample] = tip
        known = self._known[episodes]
        data = replace(
            self._episodes.select(episodes),
            tip_abscissa=known[..., 0].astype(np.float32),
            tip_offset=known[..., 1].astype(np.float32),
        )
        if sample + 1 < known.shape[1]:
            found = self._predictor.rollout_forward(_from(data, sample + 1 - WINDOW))
            self.tip[episodes, sample + 1 :] = self._known[episodes, sample + 1 :] = found.tip


def online_predictor(predictor: Predictor, episodes: Dataset) -> OnlinePredictor:
    """Return what foretells the tips of navigations with a model.

    Args:
        predictor: of a run.
        episodes: their controls, and their tips as they are measured.
    """
    if isinstance(predictor, TwinPredictor):
        return OnlineTwin(predictor, episodes)
    if isinstance(predictor, open_loop.ProbabilisticPredictor):
        return OnlineCausal(predictor, episodes)
    return OnlineWindowed(predictor, episodes)


def _from(episodes: Dataset, first: int) -> Dataset:
    """Return the episodes from a sample on, mm and rad before it as their initial state."""
    if first == 0:
        return episodes
    later = {
        field.name: getattr(episodes, field.name)[:, first:]
        for field in fields(episodes)
        if isinstance(getattr(episodes, field.name), np.ndarray) and getattr(episodes, field.name).ndim > 1
    }
    return replace(
        episodes,
        **later,
        initial_inserted_length=episodes.inserted_length[:, first - 1],
        initial_rotation=episodes.rotation[:, first - 1],
    )
