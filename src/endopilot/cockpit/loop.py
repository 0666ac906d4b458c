"""The session's thread: one cycle after the other, at real time."""

from __future__ import annotations

import queue
import threading
import time
from collections.abc import Callable
from typing import Protocol, runtime_checkable

from endopilot.cockpit.frames import encode
from endopilot.cockpit.messages import Message
from endopilot.errors import InputError

_LATE_S = 0.25
"""A loop that is later than this lets the time go, s."""


@runtime_checkable
class Stage(Protocol):
    """What the loop runs: a session that is driven, or one that is replayed."""

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


class Loop:
    """Runs a stage in a thread of its own. What pages send goes through a queue; what they get, to `publish`.

    Attributes:
        late_cycles: how often time was let go because a cycle took too long.
    """

    def __init__(self, stage: Stage, cycle_s: float, publish: Callable[[str, bytes], None]) -> None:
        """Take the stage.

        Args:
            publish: called in the thread with a channel's name and a message.
        """
        self._stage, self._cycle_s, self._publish = stage, cycle_s, publish
        self._inbox: queue.SimpleQueue[Message | str] = queue.SimpleQueue()
        self._thread = threading.Thread(target=self._run, name="cockpit", daemon=True)
        self._wanted, self._over = threading.Event(), threading.Event()
        self.late_cycles = 0

    def start(self) -> None:
        """Start the thread; time passes while `run` is set."""
        self._thread.start()

    def pause(self, paused: bool) -> None:
        """Let time stand still, as while nobody looks, or go on."""
        if paused:
            self._wanted.clear()
        else:
            self._wanted.set()

    def send(self, message: Message) -> None:
        """Give the stage a message of who drives."""
        self._inbox.put(message)

    def halt(self, why: str) -> None:
        """Let the stage stop the wire in its next cycle."""
        self._inbox.put(why)

    def stop(self) -> None:
        """End the thread and the stage."""
        self._over.set()
        self._wanted.set()
        if self._thread.ident is not None:
            self._thread.join(timeout=10)

    def _run(self) -> None:
        try:
            self._cycles()
        except Exception as error:
            text = f"{type(error).__name__}: {' '.join(str(error).split())}"
            self._publish("error", encode("error", {"text": f"The simulation has stopped. {text}", "fatal": True}))
            raise  # which the command line tells, too
        finally:
            self._stage.close()

    def _cycles(self) -> None:
        due = time.perf_counter()
        while not self._over.is_set():
            if not self._wanted.is_set():
                self._read(time.perf_counter())
                if not self._wanted.wait(timeout=0.05):
                    continue
                due = time.perf_counter()
            now = time.perf_counter()
            self._read(now)
            for channel, message in self._stage.cycle(now):
                self._publish(channel, message)
            due += self._cycle_s
            done = time.perf_counter()
            if done - due > _LATE_S:
                due, self.late_cycles = done, self.late_cycles + 1
            if due > done:
                time.sleep(due - done)

    def _read(self, now: float) -> None:
        while True:
            try:
                message = self._inbox.get_nowait()
            except queue.Empty:
                return
            try:
                if isinstance(message, str):
                    self._stage.halt(message)
                else:
                    self._stage.handle(message, now)
            except InputError as error:
                self._publish("notice", encode("notice", {"text": str(error)}))
