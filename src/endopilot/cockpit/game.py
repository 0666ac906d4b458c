"""A task of the ladder, driven by hand with X-ray as the only sight, and scored as policies are.

The clock begins when the page says so; wire in space, tip and wall force are sent at the end. The agent drives the same
patient in a process of its own, so that both scores (`ladder.attempt.scored`) stand side by side.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from concurrent.futures import Future
from dataclasses import dataclass, replace
from typing import Any

from endopilot.cockpit import messages
from endopilot.cockpit.fluoroscopy import XrayUnit
from endopilot.cockpit.frames import encode
from endopilot.cockpit.recording import Recorder
from endopilot.cockpit.session import Session
from endopilot.cockpit.world import BY_HAND, LiveWorld, Snapshot
from endopilot.devices.robot import RobotConfig
from endopilot.errors import InputError
from endopilot.ladder.attempt import Terms, attempt, navigation_seed, scored
from endopilot.parallel import Workers
from endopilot.tasks.task import CORE, Task

RIVAL = "agent"  # the policy whose score stands beside a person's
_SHOWN = ("success", "safe", "seconds", "exposures", "peak_force_n", "path_ratio", "reason")


@dataclass(frozen=True)
class Attempt:
    """Which task in which patient (`place` in the task's list), with which robot, for a person and for the agent."""

    task: Task
    place: int
    robot: RobotConfig = BY_HAND.robot

    @property
    def seed(self) -> int:
        """Of the navigation, the same for policies."""
        return navigation_seed(self.task, self.place)

    def world(self) -> LiveWorld:
        """Return the world at the task's start, with the ladder's rod core."""
        config = replace(BY_HAND, robot=self.robot, simulator=replace(CORE, threads=1))
        return LiveWorld(self.task.ladder_navigation(self.place), config, seed=self.seed)

    def session(self, *parts: Any) -> GameSession:
        """Return the session that plays and scores it, of the parts that every session takes."""
        return GameSession(self, *parts)


class GameSession(Session):
    """A session that "waits", is "on" as a game until it is "over", and then an ordinary one."""

    def __init__(
        self,
        tried: Attempt,
        world: LiveWorld,
        xray: XrayUnit,
        recorder: Recorder,
        policies: tuple[str, ...] = (),
    ) -> None:
        """Take the world at the task's start, and the policies that a page may choose at the end."""
        super().__init__(world, xray, recorder, policies)
        self.sight, self.phase = False, "waits"
        self.result: dict[str, Any] | None = None
        self._tried = tried
        self._rival: Future[dict[str, Any]] | None = None
        self._pool: Workers | None = None

    def handle(self, message: messages.Message, now_s: float) -> None:
        """Do what the page asks for; while the game is on, neither targets nor policies."""
        if isinstance(message, messages.Game):
            if self.phase == "waits" and not self.xray.ready:
                raise InputError("game: the C-arm still turns; start in a moment")
            if self.phase == "waits":
                self.phase = "on"
                self._record(game="start")
            return
        if self.phase != "over" and isinstance(message, messages.Target | messages.Autopilot):
            if isinstance(message, messages.Autopilot) and message.action == "stop":
                return  # the stop key
            raise InputError(f"{message.type}: not before the end of the task")
        if self.phase == "waits" and isinstance(message, messages.Drive | messages.Pedal | messages.Contrast):
            return
        super().handle(message, now_s)

    def cycle(self, now_s: float) -> list[tuple[str, bytes]]:
        """Let one cycle pass, unless the game has not begun."""
        if self.phase == "waits":
            return [("state", self.state(self.world.snapshot()))]
        sent = super().cycle(now_s)
        if self.phase == "on" and self.world.loop.reason is not None:
            sent.append(self._end())
        elif self._rival is not None and self._rival.done():
            sent.append(self._scores())
        return sent

    def values(self, snapshot: Snapshot) -> dict[str, Any]:
        """Return the figures that the page shows; none of what only the simulation knows, while the game is on."""
        navigation, task = self.world.navigation, self._tried.task
        shown = super().values(snapshot)
        if not self.sight:
            del shown["peak_force_n"]
        return shown | {
            "game": {
                "phase": self.phase,
                "task": task.name,
                "title": task.title,
                "level": task.level,
                "left_s": round(max(navigation.seconds - snapshot.time_s, 0.0), 1),
            }
        }

    def close(self) -> None:
        """Stop the wire, and the agent."""
        super().close()
        if self._pool is not None:
            self._pool.stop()

    def restore(self, history: Iterable[tuple[LiveWorld, Sequence[dict[str, Any]]]]) -> None:
        """Live through what was played again, and wait for the page to start the clock."""
        super().restore(history)
        if self.phase == "on":
            self.phase = "waits"

    def _relive(self, events: Sequence[dict[str, Any]]) -> None:
        super()._relive(events)
        if self.phase == "on" and self.world.loop.reason is not None:
            self._end()
        if any("game" in event for event in events):
            self.phase = "on"

    def _end(self) -> tuple[str, bytes]:
        self.result = scored(self.world.navigation, self.world.loop.record())
        self.halt("the task is over")
        self.phase, self.sight = "over", True
        self._record(score={name: self.result[name] for name in _SHOWN})
        self._pool = Workers(1)
        self._rival = self._pool.submit(_rival, self._tried)
        return self._scores()

    def _scores(self) -> tuple[str, bytes]:
        rival, failure = None, ""
        if self._rival is not None and self._rival.done():
            error = self._rival.exception()
            rival = None if error else self._rival.result()
            failure = f"{RIVAL} could not drive: {error}" if error else ""
            self._rival = None
        assert self.result is not None
        you = {name: self.result[name] for name in _SHOWN}
        scores = {"you": you, "rival": RIVAL, "agent": rival, "failure": failure}
        return "result", encode("result", {"scores": scores})


def _rival(tried: Attempt) -> dict[str, Any]:
    navigation = tried.task.ladder_navigation(tried.place)
    scored = attempt(RIVAL, navigation, seed=tried.seed, terms=Terms(robot=tried.robot))
    return {name: scored[name] for name in _SHOWN}
