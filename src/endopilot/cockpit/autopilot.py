"""A policy at the wheel of the cockpit's world.

Every decision period it observes, decides, and drives until the next. A policy that plans takes its time: it decides
in a thread of its own, and the world's clock stands still meanwhile. While a hand drives, a policy that can be led
watches.
"""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import replace
from typing import Any

import numpy as np

from endopilot.cockpit.frames import encode
from endopilot.cockpit.world import Snapshot, World
from endopilot.errors import InputError
from endopilot.navigation.policies import make_policy
from endopilot.navigation.policy import BelievedTip, Believer, Decision, Led, Observation, Policy
from endopilot.devices.stack import shown_part
from endopilot.tasks.navigation import DECISION_PERIOD_S, Navigation, Target
from endopilot.xray.fluoroscope import Fluoroscope, FluoroscopeConfig, TipMeasurement

SECONDS = 600.0
"""Time that a policy is given, s."""
_SEED = 1
_UNTURNED_RAD = np.radians(5.0)


class Autopilot:
    """A policy that drives, watches or waits.

    Attributes:
        status: "off", "thinking", "drives", "paused", "watches", "reached", "gave up" or "failed".
        policy_name: of the policy, once there is one.
        asks: why it asks for X-ray at its next decision; empty if it does not.
        failure: what went wrong or why the policy gave up, in a line.
    """

    def __init__(self, world: World) -> None:
        """Take the world; nobody drives yet."""
        self.status, self.policy_name, self.asks, self.failure = "off", "", "", ""
        self._world, self._pool = world, ThreadPoolExecutor(1)
        self._random = np.random.default_rng([_SEED, 2])
        self._policy: Policy | None = None
        self._target: Target | None = None
        self._pending: Future[Decision | None] | None = None
        self._believed: BelievedTip | None = None
        self._fluoroscope: Fluoroscope | None = None
        self._due = self._began = 0
        self._expose, self._started = True, False
        self._turned: tuple[float, ...] = ()  # of catheters as the policy began

    @property
    def drives(self) -> bool:
        """Whether the policy has the wheel."""
        return self.status in ("thinking", "drives")

    @property
    def waits(self) -> bool:
        """Whether the world must wait for the policy's decision."""
        return self.drives and (self._pending is not None or self._due <= self._world.cycle)

    def start(self, name: str, target: Target) -> None:
        """Hand the wheel to a policy, or back to it.

        Args:
            name: of the policy.
            target: where the tip is to go.

        """
        if self._policy is None or (name, target) != (self.policy_name, self._target) or not self._led:
            self._policy, self.policy_name, self._target = None, name, target
            self._began, self._started, self._believed = self._world.cycle, False, None
        self.status, self.failure, self._expose = "drives", "", True
        self._due = self._world.cycle

    def pause(self, paused: bool) -> None:
        """Let the policy wait, or go on."""
        if paused and self.drives:
            self.status = "paused"
        elif not paused and self.status == "paused":
            self.status, self._due = "drives", self._world.cycle

    def stop(self) -> None:
        """Take the wheel from the policy; one that can be led goes on watching."""
        if self.status not in ("off", "failed"):
            self.status = "watches" if self._led else "off"
        self.asks = ""

    def think(self, snapshot: Snapshot, expose: Callable[[], None]) -> Decision | None:
        """Go on with what the policy has to do now; return its decision when there is one.

        Args:
            snapshot: the world.
            expose: takes an X-ray image for the page, if the policy has one.
        """
        if self._pending is not None:
            return self._collect(snapshot)
        if self._due > self._world.cycle or not (self.drives or self.status == "watches"):
            return None
        if self.drives and self._world.reaches(self._target):
            self.status, self.asks = "reached", ""
            return Decision(0.0, 0.0)
        state, tip = self._world.robot.proximal_state(), None
        if not self._started:
            self._turned = tuple(turn for _, turn in state.catheters)
            if crooked := self._turned_catheter():
                self.status, self.asks = "failed", ""
                self.failure = f"{self.policy_name}: begins with unturned catheters; turn {crooked} back to 0° first"
                return Decision(0.0, 0.0)
        if self.drives and self._expose:
            expose()
            tip = self._measure(snapshot, state.inserted_length)
        time_s = (self._world.cycle - self._began) * self._world.config.cycle_s
        catheters = tuple((at, turn - began) for (at, turn), began in zip(state.catheters, self._turned, strict=True))
        observation = Observation(time_s, state.inserted_length, state.rotation, tip, catheters)
        start = None
        if not self._started:
            start = replace(
                self._world.navigation_to(self._target),
                start_inserted_mm=max(state.inserted_length, 0.0),
                start_rotation=state.rotation,
                start_catheter_mm=max([0.0, *(at for at, _ in state.catheters)]),
                seconds=SECONDS,
            )
            self._started = True
        if self.drives:
            self._pending = self._pool.submit(self._decide, start, observation)
        else:
            self._pending = self._pool.submit(self._watch, observation)
        self._due = self._world.cycle + round(DECISION_PERIOD_S / self._world.config.cycle_s)
        if self.drives:
            self.status = "thinking"
        return None

    def values(self) -> dict[str, Any]:
        """Return what the page shows of the policy."""
        believed = self._believed
        bands = None
        if believed is not None:
            bands = [None if not np.isfinite(value) else round(float(value), 3) for value in believed.half_width]
        return {
            "status": self.status,
            "policy": self.policy_name,
            "asks": self.asks,
            "failure": self.failure,
            "believed_mm": None if believed is None else round(believed.abscissa, 2),
            "half_width": bands,
        }

    def belief(self, snapshot: Snapshot) -> bytes | None:
        """Return the message with the wires that the policy holds possible and its band along the route, or None."""
        if self._target is None or not isinstance(self._policy, Believer) or self._believed is None:
            return None
        wires = self._policy.believed_wires()
        shown = wires[:, : len(shown_part(wires[0], snapshot.deepest_mm))]
        line = self._world.navigation.anatomy.tree.path(self._target.branch)
        half = self._believed.half_width[0]
        within = np.abs(line.abscissa - self._believed.abscissa) <= (half if np.isfinite(half) else -1.0)
        return encode(
            "belief",
            {"wires_shown": len(shown)},
            wires=np.nan_to_num(shown).astype("<f4"),
            band=line.points[within].astype("<f4"),
        )

    def close(self) -> None:
        """Stop thinking."""
        self._pool.shutdown(wait=False, cancel_futures=True)

    @property
    def _led(self) -> bool:
        return isinstance(self._policy, Led)

    def _collect(self, snapshot: Snapshot) -> Decision | None:
        """Take the decision that was pending, if it has been made."""
        pending = self._pending
        assert pending is not None
        if not pending.done():
            return None
        self._pending = None
        try:
            decision = pending.result()
        except Exception as error:  # a policy may be anybody's: whatever it raises is told in the page
            self.status, self.failure, self.asks = "failed", f"{self.policy_name}: {' '.join(str(error).split())}", ""
            self._policy = None
            return Decision(0.0, 0.0)
        if isinstance(self._policy, Believer):
            self._believed = self._policy.believed()
        if decision is None or self.status != "thinking":
            return None  # taken over or paused meanwhile
        if decision.gives_up:
            self.status, self.failure, self.asks = "gave up", f"{self.policy_name} gives up: {decision.gives_up}", ""
            return Decision(0.0, 0.0)
        self.status, self._expose = "drives", bool(decision.expose)
        told = "" if self._believed is None else self._believed.asks
        self.asks = (told or "the policy asks for it") if decision.expose else ""
        return decision

    def _turned_catheter(self) -> str:
        """Return the name of a curved catheter that the policy would take for unturned and is not; empty if none is."""
        for catheter, turn in zip(self._world.navigation.catheters, self._turned, strict=True):
            if catheter.shape and np.cos(turn) < np.cos(_UNTURNED_RAD):
                return catheter.name
        return ""

    def _measure(self, snapshot: Snapshot, inserted_mm: float) -> TipMeasurement:
        navigation = self._world.navigation
        if self._fluoroscope is None:
            self._fluoroscope = Fluoroscope(navigation.anatomy, navigation.device.tip_radius_mm, FluoroscopeConfig())
        return self._fluoroscope.expose(snapshot.nodes[0], snapshot.tip_direction, inserted_mm, self._random)

    def _decide(self, start: Navigation | None, observation: Observation) -> Decision:
        """Decide, in a thread of its own; a policy that is new is made and started first."""
        if self._policy is None:
            self._policy = make_policy(self.policy_name)
        if start is not None:
            self._policy.start(start, _SEED)
        return self._policy.decide(observation)

    def _watch(self, observation: Observation) -> None:
        if isinstance(self._policy, Led):
            self._policy.watch(observation)


def check_policy(name: str | None, offered: tuple[str, ...]) -> str:
    """Return the name of a policy that the page may choose.

    A page names no module of its own: only what is offered is imported.

    Raises:
        InputError: it is not offered.
    """
    if name not in offered:
        raise InputError(f"policy: {name!r}; choose from {', '.join(offered)}")
    return name
