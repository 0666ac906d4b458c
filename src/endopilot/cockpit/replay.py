"""The stage that shows a film: it plays, pauses and seeks, and its X-ray shows what the C-arm would see."""

from __future__ import annotations

from typing import Any

from endopilot.cockpit import messages
from endopilot.cockpit.film import FRAME_S, Film
from endopilot.cockpit.fluoroscopy import XrayUnit
from endopilot.cockpit.frames import device_arrays, encode, motion_values, target_values, tip_values
from endopilot.errors import InputError


class ReplayStage:
    """A film in place of a session.

    Attributes:
        film: what is shown.
        playing: whether time passes.
        at: index of the frame that is shown.
    """

    def __init__(self, film: Film, xray: XrayUnit) -> None:
        """Begin at the start; the film is driven meanwhile."""
        self.film, self._xray = film, xray
        self.playing, self.at, self._shown = True, 0, -1
        film.start()

    def handle(self, message: messages.Message, now_s: float) -> None:
        """Play, pause, seek, expose, or set the C-arm."""
        if isinstance(message, messages.Replay):
            if message.playing is not None:
                ended = self.film.done and self.at >= len(self.film.frames) - 1
                self.playing, self.at = message.playing, 0 if message.playing and ended else self.at
            if message.at_s is not None:
                self.at = max(min(round(message.at_s / FRAME_S), len(self.film.frames) - 1), 0)
                self._shown = -1
        elif isinstance(message, messages.Pedal):
            self._xray.pedal = message.down
        elif isinstance(message, messages.Contrast):
            self._xray.inject(self._time_s)
        elif isinstance(message, messages.CArm):
            self._xray.configure(**message.model_dump(exclude={"type"}, exclude_none=True))
        elif not isinstance(message, messages.Drive | messages.Autopilot):
            raise InputError(f"{message.type}: not in a replay")

    def halt(self, why: str) -> None:
        """Let the pedal go."""
        self._xray.pedal = False

    def cycle(self, now_s: float) -> list[tuple[str, bytes]]:
        """Show the next frame."""
        if not self.film.frames:
            return []
        sent: list[tuple[str, bytes]] = []
        self.at = min(self.at, len(self.film.frames) - 1)
        frame = self.film.frames[self.at]
        if self._xray.ready:
            images = self._xray.pulse(frame.snapshot)
            if images is None and frame.exposed and self._shown != self.at:
                images = self._xray.expose(frame.snapshot)
            self._shown = self.at
            sent = [(f"image{number}", image) for number, image in enumerate(images or [])]
        sent.append(("state", encode("state", self._values(), **device_arrays(frame.snapshot))))
        if self.playing and self.at + 1 < len(self.film.frames):
            self.at += 1
        elif self.playing and self.film.done:
            self.playing = False
        return sent

    def close(self) -> None:
        """End it."""
        self._xray.close()

    @property
    def _time_s(self) -> float:
        return self.film.frames[self.at].snapshot.time_s if self.film.frames else 0.0

    def _values(self) -> dict[str, Any]:
        film, snapshot = self.film, self.film.frames[self.at].snapshot
        anatomy = film.navigation.anatomy
        return {
            "mode": "replay",
            **motion_values(snapshot),
            "command": snapshot.velocity,
            "stopped": "",
            "peak_force_n": round(film.frames[self.at].peak_n, 4),
            "sight": True,
            "target": target_values(anatomy, film.navigation.target),
            "xray": self._xray.values(snapshot.time_s),
            "target_px": self._xray.pixels(film.navigation.target.position(anatomy)),
            "replay": {
                "title": film.title,
                "seconds": round(film.seconds, 3),
                "ready_s": round(film.frames[-1].snapshot.time_s, 2),
                "playing": self.playing,
                "failure": film.failure,
            },
        } | tip_values(anatomy, snapshot)
