"""A policy at the wheel of the cockpit's world, which hands its navigation loop over to it, and back to the hand. One
that plans decides in a thread of its own while the world's clock stands still; while a hand drives, one that can be led
watches."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import replace
from typing import Any

import numpy as np

from endopilot.cockpit.frames import encode
from endopilot.cockpit.world import LiveWorld, Snapshot
from endopilot.devices.stack import Proximals, shown_part
from endopilot.navigation.policies import make_policy
from endopilot.navigation.policy import BelievedTip, Believer, Decision, Led, Observation, Policy
from endopilot.tasks.navigation import Navigation, Target

SECONDS = 600.0  # time that a policy is given, s
_SEED = 1
_UNTURNED_RAD = np.radians(5.0)


class Autopilot:
    """A policy that drives, watches or waits: `status` is "off", "thinking", "drives", "paused", "watches", "reached",
    "gave up" or "failed", `failure` what went wrong or why it gave up, and `asks` why it asks for X-ray next, if so."""

    def __init__(self, world: LiveWorld) -> None:
        self.status, self.policy_name, self.asks, self.failure = "off", "", "", ""
        self._world, self._pool = world, ThreadPoolExecutor(1)
        self._policy: Policy | None = None
        self._target: Target | None = None
        self._pending: Future[Decision | None] | None = None
        self._believed: BelievedTip | None = None
        self._began_s, self._started = 0.0, False
        self._turned: tuple[float, ...] = ()  # each device as the policy began; the wire's turns are known

    @property
    def drives(self) -> bool:
        """Whether the policy has the wheel."""
        return self.status in ("thinking", "drives")

    @property
    def waits(self) -> bool:
        """Whether the world must wait for the policy's decision."""
        return self.drives and (self._pending is not None or self._world.loop.between_periods)

    def start(self, name: str, target: Target) -> None:
        """Hand the wheel to a policy, or back to it, from the next decision on."""
        if self._policy is None or (name, target) != (self.policy_name, self._target) or not self._led:
            self._policy, self.policy_name, self._target = None, name, target
            self._started, self._believed = False, None
        self.status, self.failure = "drives", ""
        self._world.loop.hand_over(None)

    def pause(self, paused: bool) -> None:
        """Let the policy wait, or go on."""
        if paused and self.drives:
            self._let_go("paused")
        elif not paused and self.status == "paused":
            self.status = "drives"
            self._world.loop.hand_over(None)

    def stop(self) -> None:
        """Take the wheel from the policy; one that can be led goes on watching."""
        if self.status not in ("off", "failed"):
            self._let_go("watches" if self._led else "off")
        self.asks = ""

    def think(self, expose: Callable[[], None]) -> Proximals | None:
        """Go on with what the policy has to do now; return what the robot has been commanded, if anything."""
        if self._pending is not None:
            return self._collect()
        loop = self._world.loop
        if not loop.between_periods or not (self.drives or self.status == "watches"):
            return None
        if self.drives and loop.reached:
            return self._end("reached")
        if not self._started:
            self._turned = (0.0, *(turn for _, turn in loop.robot.proximal_state().devices[1:]))
            for catheter, turn in zip(self._world.navigation.catheters, self._turned[1:], strict=True):
                if catheter.shape and np.cos(turn) < np.cos(_UNTURNED_RAD):  # which the policy would take for unturned
                    why = f"{self.policy_name}: begins with unturned catheters; turn {catheter.name} back to 0° first"
                    return self._end("failed", why)
        observation = self._world.observe() if self.drives else self._world.begin()
        if observation.tip is not None:
            expose()
        start = None
        if not self._started:
            start, self._began_s, self._started = self._navigation(observation), observation.time_s, True
        devices = zip(observation.devices, self._turned, strict=True)
        seen = replace(
            observation,
            time_s=observation.time_s - self._began_s,
            devices=tuple((at, turn - began) for (at, turn), began in devices),
        )
        self._pending = self._pool.submit(self._decide if self.drives else self._watch, start, seen)
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

    def _collect(self) -> Proximals | None:
        pending = self._pending
        assert pending is not None
        if not pending.done():
            return None
        self._pending = None
        try:
            decision = pending.result()
        except Exception as error:  # a policy may be anybody's: whatever it raises is shown in the page
            self._policy = None
            return self._end("failed", f"{self.policy_name}: {' '.join(str(error).split())}")
        if isinstance(self._policy, Believer):
            self._believed = self._policy.believed()
        if decision is None or self.status != "thinking":
            return None  # taken over or paused meanwhile
        if decision.gives_up:
            return self._end("gave up", f"{self.policy_name} gives up: {decision.gives_up}")
        self.status = "drives"
        asks, found = ("", "") if self._believed is None else (self._believed.asks, self._believed.found)
        asks = f"{asks or 'the policy asks for it'}{f'; found: {found}' if found else ''}"
        self.asks = asks if decision.expose else ""
        return self._world.loop.take(decision).devices

    def _let_go(self, status: str) -> None:
        self.status = status
        self._world.loop.hand_over(self._world.hand)

    def _end(self, status: str, failure: str = "") -> Proximals:
        """Let the hand drive from now on, and the devices stand still."""
        self._let_go(status)
        self.asks, self.failure = "", failure
        return self._world.command(())

    def _navigation(self, observation: Observation) -> Navigation:
        (inserted, turned), *around = observation.devices
        return replace(
            self._world.navigation,
            start_inserted_length_mm=max(inserted, 0.0),
            start_rotation_rad=turned,
            start_catheter_mm=max([0.0, *(at for at, _ in around)]),
            seconds=SECONDS,
        )

    def _decide(self, start: Navigation | None, observation: Observation) -> Decision:
        if self._policy is None:
            self._policy = self._world.loop.policy = make_policy(self.policy_name)
        if start is not None:
            self._policy.start(start, _SEED)
        return self._world.loop.decide(observation)

    def _watch(self, start: Navigation | None, observation: Observation) -> None:
        if isinstance(self._policy, Led):
            self._policy.watch(observation)
