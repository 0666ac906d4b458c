"""The states of a belief, and the one table of how they follow each other: `State`, `Event`, `TRANSITIONS`."""

from __future__ import annotations

from enum import StrEnum


class State(StrEnum):
    """What is done with what is believed."""

    FOLLOWING = "following"
    """The given wire explains what X-ray showed: it is driven, and looked at when the adviser asks."""
    SEEKING = "seeking"
    """None does: the devices rest under X-ray, and copies that are moved to and fro are compared with each image."""
    LOST = "lost"
    """No copy does either, or there is none: the devices are pulled back until a wire explains what X-ray shows."""
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
SEEKS = 6
"""Periods that a belief with copies may be in `SEEKING`, an exposure each; 0 for one without copies."""


class States:
    """The state of a belief.

    Attributes:
        now: the state.
        losses: how often no wire explained an image any more.
    """

    def __init__(self, seeks: int) -> None:
        """Begin in `FOLLOWING`, with so many periods that `SEEKING` may last."""
        self.now, self.losses, self._seeks, self._sought = State.FOLLOWING, 0, seeks, 0

    def take(self, event: Event | None) -> None:
        """Go over a period in which something was told, or nothing (None): the state then stays, as far as it may."""
        before = self.lost
        if event is not None:
            self.now = TRANSITIONS[self.now, event]
        self.losses += self.lost and not before
        self._sought = self._sought + 1 if self.now is State.SEEKING else 0
        if self._sought > self._seeks:
            self.now = TRANSITIONS[self.now, Event.SPENT]

    @property
    def lost(self) -> bool:
        """Whether no wire explains what X-ray showed last."""
        return self.now in (State.SEEKING, State.LOST)
