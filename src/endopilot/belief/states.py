"""The states of a belief, and the one table of how they follow each other: `State`, `Event`, `TRANSITIONS`."""

from __future__ import annotations

from enum import StrEnum


class State(StrEnum):
    """What is done with what is believed."""

    FOLLOWING = "following"
    """The given wire explains what X-ray showed: it is driven, and looked at when the adviser asks."""
    SEEKING = "seeking"
    """None does: the devices rest, and it is sought what does. Copies that are moved to and fro need X-ray for that."""
    LOST = "lost"
    """Nothing was found in time: the devices are pulled back until a wire explains what X-ray shows."""
    CHANGED = "changed"
    """The model erred: another wire, lumen, ostium, drive or motion is followed, under X-ray every 1.5 s."""


class Event(StrEnum):
    """What a period told."""

    TRUSTED = "a wire explains the image, and the model is trusted"
    DOUBTED = "a wire explains the image, and the model has yet to prove itself"
    UNEXPLAINED = "no wire explains the image"
    SPENT = "the state has lasted as long as it may"


TRANSITIONS: dict[tuple[State, Event], State] = {
    (State.FOLLOWING, Event.TRUSTED): State.FOLLOWING,
    (State.FOLLOWING, Event.DOUBTED): State.CHANGED,
    (State.FOLLOWING, Event.UNEXPLAINED): State.SEEKING,
    (State.CHANGED, Event.TRUSTED): State.FOLLOWING,
    (State.CHANGED, Event.DOUBTED): State.CHANGED,
    (State.CHANGED, Event.UNEXPLAINED): State.SEEKING,
    (State.SEEKING, Event.TRUSTED): State.FOLLOWING,
    (State.SEEKING, Event.DOUBTED): State.CHANGED,
    (State.SEEKING, Event.UNEXPLAINED): State.SEEKING,
    (State.SEEKING, Event.SPENT): State.LOST,
    (State.LOST, Event.TRUSTED): State.FOLLOWING,
    (State.LOST, Event.DOUBTED): State.CHANGED,
    (State.LOST, Event.UNEXPLAINED): State.LOST,
}
"""The state that follows from a state and what a period told. Devices that are back where they began, unseen, are
explained: they lie as they did. An oracle never doubts, so it never is in `CHANGED`."""
_SEEKS = 6
"""Periods that a belief may be in `SEEKING`."""


class States:
    """The state of a belief.

    Attributes:
        now: the state.
        losses: how often no wire explained an image any more.
    """

    def __init__(self) -> None:
        """Begin in `FOLLOWING`."""
        self.now, self.losses, self._sought = State.FOLLOWING, 0, 0

    def take(self, event: Event | None, *, seeks: bool = False) -> None:
        """Go over a period in which something was told, or nothing (None): the state then stays, as far as it may.

        Args:
            seeks: whether it goes on that something is sought which explains the last image.
        """
        before = self.lost
        if event is not None:
            self.now = TRANSITIONS[self.now, event]
        self.losses += self.lost and not before
        self._sought = self._sought + 1 if self.now is State.SEEKING else 0
        if self._sought > _SEEKS * seeks:
            self.now = TRANSITIONS[self.now, Event.SPENT]

    @property
    def lost(self) -> bool:
        """Whether no wire explains what X-ray showed last."""
        return self.now in (State.SEEKING, State.LOST)
