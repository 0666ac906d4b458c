"""The interface of a policy: `Policy`, what it observes (`Observation`) and what it commands (`Decision`)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol, runtime_checkable

from endopilot.tasks.navigation import Navigation
from endopilot.xray.fluoroscope import TipMeasurement


@dataclass(frozen=True, eq=False)
class Observation:
    """All that a policy is given at a decision.

    Attributes:
        time_s: since the start of the navigation, s.
        inserted_length: Δ by the robot's encoder, mm.
        rotation: φ by the robot's encoder, rad.
        tip: what X-ray shows now, or None where it is off.
    """

    time_s: float
    inserted_length: float
    rotation: float
    tip: TipMeasurement | None


@dataclass(frozen=True)
class Decision:
    """What is done until the next decision.

    Attributes:
        translation: of the wire's proximal end, mm/s.
        rotation: of the wire's proximal end, rad/s.
        expose: whether X-ray is to be on at the next decision.
    """

    translation: float
    rotation: float
    expose: bool = False


@runtime_checkable
class Policy(Protocol):
    """Drives one navigation."""

    def start(self, navigation: Navigation, seed: int) -> None:
        """Prepare for a navigation as it is known: reality may have another friction or ostium."""
        ...

    def decide(self, observation: Observation) -> Decision:
        """Return what to do until the next decision, `DECISION_PERIOD_S` later."""
        ...
