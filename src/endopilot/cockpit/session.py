"""A session: what happens in a cycle. Messages come in, the world moves on, X-ray pulses, frames go out, all of it by
the world's clock; the only real time is the watchdog's."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from itertools import chain
from typing import Any, Protocol, runtime_checkable

import numpy as np

from endopilot.cockpit import messages
from endopilot.cockpit.autopilot import Autopilot
from endopilot.cockpit.fluoroscopy import XrayUnit
from endopilot.cockpit.frames import device_arrays, encode, motion_values, tip_values
from endopilot.cockpit.messages import Message
from endopilot.cockpit.recording import Recorder
from endopilot.cockpit.world import LiveWorld, Snapshot
from endopilot.devices.stack import Proximals
from endopilot.errors import InputError
from endopilot.tasks.navigation import Target
from endopilot.tasks.targets import find_target

SILENCE_S = 0.2  # the drive stops after this time without a message from whose hand drives, s
HICCUP_S = 0.5  # what a hand holds goes on after a silence up to this long; after a longer one it must let go first, s
AUTOPILOT_SILENCE_S = 1.0  # the autopilot pauses after this time without a message from the page that started it, s


class Session:
    """One world driven from a page, and a policy that may drive; `sight`: may the page show the wire in space?"""

    def __init__(self, world: LiveWorld, xray: XrayUnit, recorder: Recorder, policies: tuple[str, ...] = ()) -> None:
        """Take the parts; `policies` are the names that a page may choose from."""
        self.world, self.xray, self._recorder, self._policies = world, xray, recorder, policies
        self._record = recorder.event
        self._rest = ((0.0, 0.0),) * len(world.navigation.devices)
        self.autopilot = Autopilot(world)
        self.sight = True
        self._command, self._asked = self._rest, self._rest  # what the robot has taken, and of what
        self._moving, self._heard_s = False, -np.inf
        self._stopped = ""
        self._held: set[str] = set()  # what silence stopped
        self._locked: set[str] = set()  # what of it must be let go

    @property
    def target(self) -> Target:
        """Where the tip is to go."""
        return self.world.navigation.target

    def handle(self, message: messages.Message, now_s: float) -> None:
        """Do what the page of who drives asks for; InputError says in one line why it cannot be done."""
        if isinstance(message, messages.Drive):
            self._hear(now_s)
            self._drive(((message.translation, message.rotation), *message.catheters))
        elif isinstance(message, messages.Pedal):
            self._hear(now_s)
            self._pedal(message.down)
        elif isinstance(message, messages.Contrast):
            self.xray.inject(self.world.time_s)
            self._record(contrast=True)
        elif isinstance(message, messages.CArm):
            changes = message.model_dump(exclude={"type"}, exclude_none=True)
            self.xray.configure(**changes)
            self._record(c_arm=changes)
        elif isinstance(message, messages.Target):
            self._aim(message)
        elif isinstance(message, messages.Autopilot):
            self._hear(now_s)
            self._steer(message)
        else:
            raise InputError(f"{message.type}: not here")

    def restore(self, history: Iterable[tuple[LiveWorld, Sequence[dict[str, Any]]]]) -> None:
        """Live through what `recording.replayed` yields of a session: take over its target and exposures, and stop."""
        for _, events in history:
            self._relive(events)
        self.world.stop()
        self._command = self._rest
        self._record(stop="resumed")

    def _relive(self, events: Sequence[dict[str, Any]]) -> None:
        for event in events:
            if "target" in event:
                self.world.loop.aim(Target(branch=event["target"][0], abscissa=event["target"][1]))
            elif "exposure" in event:
                self.xray.frames = event["exposure"]
                self.xray.seconds, self.xray.kerma_ugy = event["seconds"], event["kerma_ugy"]

    def halt(self, why: str) -> None:
        """Brake at once and let the pedal go."""
        if self.autopilot.drives:
            self.autopilot.pause(True)
            self._moving = True
        if self._moving or self.xray.pedal:
            self._stopped = why
        self.xray.pedal = False
        if self._moving:
            self.world.stop()
            self._command, self._asked, self._moving = self._rest, self._rest, False
            self._record(stop=why)

    def cycle(self, now_s: float) -> list[tuple[str, bytes]]:
        """Let one cycle pass, and return what the pages are to get: a channel's name and a message each."""
        limit = AUTOPILOT_SILENCE_S if self.autopilot.drives else SILENCE_S
        if (self._moving or self.autopilot.drives or self.xray.pedal) and now_s - self._heard_s > limit:
            self._held = {"drive"} if self._moving else set()
            self._held |= {"pedal"} if self.xray.pedal else set()
            self.halt("silence")
        sent = self._think()
        if not self.autopilot.waits:
            self.world.advance()
            self._recorder.cycle()
        snapshot = self.world.snapshot()
        if pulse := self.xray.pulse(snapshot):
            self.world.loop.exposed()
            self._count()
        return [*sent, *pulse, ("state", self.state(snapshot))]

    def state(self, snapshot: Snapshot) -> bytes:
        """Return the message that shows the world as it is."""
        arrays = device_arrays(snapshot) if self.sight else {}
        return encode("state", self.values(snapshot), **arrays)

    def values(self, snapshot: Snapshot) -> dict[str, Any]:
        """Return the figures that the page shows."""
        shown = {
            "mode": "drive",
            **motion_values(snapshot, self.world.loop.robot.counted),
            **self.xray.seen(snapshot.time_s, self.target),
            "command": tuple(chain.from_iterable(self._command)),
            "stopped": self._stopped,
            "peak_force_n": round(self.world.peak_force_n, 4),
            "sight": self.sight,
            "reserve": round(self.world.reserve, 1),
            "autopilot": self.autopilot.values(),
        }
        return shown | (tip_values(self.world.navigation.anatomy, snapshot) if self.sight else {})

    def close(self) -> None:
        """Stop the wire and close the recording."""
        self.halt("closed")
        self.xray.close()
        self.autopilot.close()
        self._recorder.close()

    def _hear(self, now_s: float) -> None:
        """Take a sign of life of who drives, the first one after a silence perhaps."""
        if self._held:
            self._locked = self._held if now_s - self._heard_s > HICCUP_S else set()
            self._held = set()
        self._heard_s = now_s

    def _pedal(self, down: bool) -> None:
        if not down:
            self._locked.discard("pedal")
        self.xray.pedal = down and "pedal" not in self._locked
        if self.xray.pedal and not self._locked and self._stopped == "silence":
            self._stopped = ""

    def _drive(self, devices: Proximals) -> None:
        if not np.any(devices):
            self._locked.discard("drive")
        elif "drive" in self._locked:
            return
        if self.autopilot.drives:
            if not np.any(devices):
                return  # the page only says that it is there
            self._take_over()
        if devices != self._asked:
            self._move(devices)
        self._moving = self._command != self._rest
        if self._moving:
            self._stopped = ""

    def _aim(self, message: messages.Target) -> None:
        tree = self.world.navigation.anatomy.tree
        if message.section is not None:
            self.world.loop.aim(find_target(tree, message.section))
        elif message.branch is not None and message.abscissa is not None:
            self.world.loop.aim(find_target(tree, Target(branch=message.branch, abscissa=message.abscissa)))
        else:
            raise InputError("target: give a section, or a branch and an abscissa")
        self._record(target=[self.target.branch, self.target.abscissa])

    def _steer(self, message: messages.Autopilot) -> None:
        if message.action == "start":
            if message.policy not in self._policies:  # a page names no module of its own
                raise InputError(f"policy: {message.policy!r}; choose from {', '.join(self._policies)}")
            self.autopilot.start(message.policy, self.target)
            if self._moving:
                self._move(self._rest)
                self._moving = False
            self._stopped = ""
        elif message.action == "stop":
            self._take_over()
        else:
            self.autopilot.pause(message.action == "pause")
            if message.action == "pause":
                self._move(self._rest)
        self._record(autopilot=message.action, policy=message.policy)

    def _take_over(self) -> None:
        if self.autopilot.drives:
            self._move(self._rest)
        self.autopilot.stop()

    def _move(self, devices: Proximals) -> None:
        self._note(self.world.command(devices), devices)

    def _note(self, taken: Proximals, asked: Proximals) -> None:
        self._command, self._asked = taken, asked
        self._record(move=list(chain.from_iterable(self._command)))

    def _think(self) -> list[tuple[str, bytes]]:
        if self.autopilot.status == "off" or (self.autopilot.drives and not self.xray.ready):
            return []
        snapshot, sent = self.world.snapshot(), list[tuple[str, bytes]]()
        before = self.autopilot.values()

        def expose() -> None:
            sent.extend(self.xray.expose(snapshot))
            self._count()

        taken = self.autopilot.think(expose)
        if taken is not None:
            self._note(taken, taken)
        if self.sight and self.autopilot.values() != before:
            belief = self.autopilot.belief(snapshot)
            sent += [] if belief is None else [("belief", belief)]
        return sent

    def _count(self) -> None:
        """Write an exposure into the recording."""
        xray = self.xray
        self._record(exposure=xray.frames, seconds=xray.seconds, kerma_ugy=xray.kerma_ugy)


@runtime_checkable
class Stage(Protocol):
    """What the server runs: a session that is driven, or one that is replayed."""

    def handle(self, message: Message, now_s: float) -> None:
        """Do what a page asks for, at a real time, s."""
        ...

    def halt(self, why: str) -> None:
        """Stop the wire."""
        ...

    def cycle(self, now_s: float) -> list[tuple[str, bytes]]:
        """Let one cycle pass at a real time, s, and return messages for the pages by channel."""
        ...

    def close(self) -> None:
        """End it."""
        ...
