"""The interface of a policy: `Policy`, what it observes (`Observation`) and what it commands (`Decision`).

A policy that plans with simulated wires may also tell what it believes (`Believer`) and be led (`Led`).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import numpy as np
from jaxtyping import Float

from endopilot.belief.monitor import BelievedTip
from endopilot.devices.stack import Proximals
from endopilot.tasks.navigation import Navigation
from endopilot.xray.fluoroscope import TipMeasurement


@dataclass(frozen=True, eq=False)
class Observation:
    """All that a policy is given at a decision.

    Attributes:
        time_s: since the start of the navigation, s.
        devices: inserted length Δ (mm) and rotation φ (rad) of each device by the robot's encoders: of the wire, then
            of each catheter from the inside out.
        tip: what X-ray shows of the wire's tip now, or None where it is off.
        load: axial force (N) and torque (N·mm) of each drive as the robot measures them; empty where it does not.
    """

    time_s: float
    devices: Proximals
    tip: TipMeasurement | None
    load: Proximals = ()


@dataclass(frozen=True)
class Decision:
    """What is done until the next decision.

    Attributes:
        devices: translation (mm/s) and rotation (rad/s) of each device's proximal end: of the wire, then of each
            catheter from the inside out. Those that are not given stand still.
        expose: whether X-ray is to be on at the next decision.
        gives_up: where and why the policy ends the navigation with this decision, in words; empty if it goes on.
    """

    devices: Proximals = ()
    expose: bool = False
    gives_up: str = ""


@runtime_checkable
class Policy(Protocol):
    """Drives one navigation."""

    def start(self, navigation: Navigation, seed: int) -> None:
        """Prepare for a navigation as it is known: reality may have another friction or ostium."""
        ...

    def decide(self, observation: Observation) -> Decision:
        """Return what to do until the next decision, `DECISION_PERIOD_S` later."""
        ...


class Hand:
    """Whoever drives by hand, as a policy: it decides what the hand holds.

    Attributes:
        devices: mm/s and rad/s of each device, as in `Decision`.
    """

    def __init__(self, devices: Proximals = ()) -> None:
        """Hold some velocities; none to let all devices stand still."""
        self.devices = devices

    def start(self, navigation: Navigation, seed: int) -> None:
        """Need nothing."""

    def decide(self, observation: Observation) -> Decision:
        """Go on as the hand holds it."""
        return Decision(self.devices)


@runtime_checkable
class Believer(Protocol):
    """A policy that tells what it believes."""

    def believed(self) -> BelievedTip:
        """Return where the policy believed the tip to be at its last decision."""
        ...

    def believed_wires(self) -> Float[np.ndarray, "wires nodes 3"]:
        """Return the wires that it holds possible, the likeliest first: nodes from the tip on, LPS mm."""
        ...


@runtime_checkable
class Led(Protocol):
    """A policy that can go on from wherever somebody else has driven the wire to."""

    def watch(self, observation: Observation) -> None:
        """Take what is observed while somebody else decides."""
        ...
