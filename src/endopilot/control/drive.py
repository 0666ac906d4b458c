"""A simulated drive with its own clock, behind TCP: one client sends signed commands; the drive stops on any error.

`Drive` is the machine: time and lines come in as arguments, so that it can be tested without either. `serve` gives it a
socket and the clock of this process. A drive that stopped stays so until it is armed again.
"""

from __future__ import annotations

import asyncio
import contextlib
import secrets
import time
from collections.abc import Callable

import numpy as np

from endopilot.control.drive_protocol import LONGEST_LINE, PROTOCOL, SILENCE_S, Message, Signer
from endopilot.control.robot import DriveMotion, RobotConfig
from endopilot.errors import InputError
from endopilot.simulation.drive_limits import DriveLimits

CYCLE_S = 0.01
"""Period of the process's loop, s."""
AUTHENTICATE_S = 2.0
"""Time in which a client must authenticate, s."""
MOST_WAITING = 8
"""Connections that may wait to authenticate; one more is closed at once."""


class Drive:
    """The machine: motion, watchdog, and who may command.

    Attributes:
        stopped: why the drive stands still, or None while it is armed: "start", "silence", "connection", "not-finite",
            "limit", "travel" or "asked".
        dropped: lines that were malformed, too long, not signed, or replayed.
        owner: the session that commands, if any.
    """

    def __init__(
        self,
        limits: DriveLimits,
        secret: bytes,
        *,
        now: float,
        config: RobotConfig | None = None,
        inserted_length: float = 0.0,
        report: Callable[[str], None] = lambda line: None,
    ) -> None:
        """Stand still, unarmed.

        Args:
            limits: a command beyond them, or the end of the travel, stops the drive.
            secret: shared with the client.
            now: time by the drive's clock, s.
            config: latency, backlash, accelerations and encoder noise.
            inserted_length: Δ at the start, mm.
            report: called with a line for people at every stop, and when a client comes or goes.
        """
        self._limits, self._secret, self._report, config = limits, secret, report, config or RobotConfig()
        self._motion = DriveMotion(limits, config, (inserted_length, 0.0))
        self._noise, self._random = np.array([config.encoder_sd_mm, config.encoder_sd_rad]), np.random.default_rng()
        self._began = self._now = self._commanded = now
        self.stopped: str | None = "start"
        self.dropped = 0
        self.owner: Session | None = None

    @property
    def position(self) -> tuple[float, float]:
        """Δ, mm, and φ, rad, as they are."""
        return float(self._motion.position[0]), float(self._motion.position[1])

    @property
    def at_rest(self) -> bool:
        """Whether the motor stands still."""
        return not self._motion.velocity.any()

    def open(self) -> Session:
        """Return the drive's side of a new connection."""
        return Session(self, Signer(self._secret, secrets.token_hex(16)))

    def tick(self, now: float) -> None:
        """Let the time pass up to now, s; the watchdog stops the drive when it is due, even if the call comes late."""
        due = self._commanded + SILENCE_S
        if self.stopped is None and now >= due:
            self._advance(max(due, self._now))
            self.stop("silence")
        self._advance(max(now, self._now))

    def stop(self, reason: str) -> None:
        """Brake, and stay so until the drive is armed again."""
        if self.stopped is None:
            self._report(f"stopped at {self._now - self._began:.3f} s: {reason}; {self.position[0]:.2f} mm inserted")
            self.stopped = reason
        self._motion.stop()

    def arm(self) -> None:
        """Take commands from now on, if stopped; the watchdog runs."""
        if self.stopped is not None:
            self.stopped, self._commanded = None, self._now

    def move(self, translation: float, rotation: float) -> None:
        """Take a command, mm/s and rad/s, if armed; what is not finite or beyond the limits stops the drive."""
        if self.stopped is not None:
            return
        if not np.isfinite([translation, rotation]).all():
            self.stop("not-finite")
        elif (translation, rotation) != self._limits.safe(translation, rotation):
            self.stop("limit")
        else:
            self._motion.command(translation, rotation)
            self._commanded = self._now

    def state(self) -> tuple[str, ...]:
        """Return the fields of a STATE reply: clock, s; Δ, mm, and φ, rad, by the encoders; and armed or why not."""
        inserted, rotation = self._motion.position + self._noise * self._random.standard_normal(2)
        status = "armed" if self.stopped is None else f"stopped:{self.stopped}"
        return f"{self._now - self._began:.4f}", f"{inserted:.4f}", f"{rotation:.5f}", status

    def greet(self, session: Session) -> tuple[str, ...]:
        """Make a session the owner, and return the limits as fields of the OK reply."""
        self.owner = session
        self._report("a client authenticated")
        low, high = self._limits.travel_mm
        numbers = (self._limits.max_velocity_mm_s, self._limits.max_rotation_rad_s, low, high)
        return tuple(repr(float(number)) for number in numbers)

    def lose_owner(self) -> None:
        """Stop, because the connection of the owner is closed."""
        self.stop("connection")
        self.owner = None
        self._report("the client has disconnected")

    def _advance(self, until: float) -> None:
        self._motion.advance(until - self._now)
        self._now = until
        (low, high), at, speed = self._limits.travel_mm, self._motion.position[0], self._motion.velocity[0]
        if self.stopped is None and ((at <= low and speed < 0) or (at >= high and speed > 0)):
            self.stop("travel")


class Session:
    """The drive's side of one connection."""

    def __init__(self, drive: Drive, signer: Signer) -> None:
        """Wait for the client to authenticate."""
        self._drive, self._signer, self._last = drive, signer, 0
        self.closed = False

    @property
    def greeting(self) -> bytes:
        """The first line: protocol and nonce."""
        return f"{PROTOCOL} {self._signer.nonce}\n".encode("ascii")

    def receive(self, line: bytes, now: float) -> bytes | None:
        """Take one line, without its newline, and return the reply; None for a line that gets none.

        Args:
            line: as it came.
            now: time by the drive's clock, s.
        """
        self._drive.tick(now)
        message = self._signer.read(line, of_drive=False)
        if message is None or message.number <= self._last:
            self._drive.dropped += 1
            return None
        self._last = message.number
        reply = self._answer(message)
        if reply is None:
            self._drive.dropped += 1
            return None
        return self._signer.line(reply, of_drive=True)

    def close(self, now: float) -> None:
        """Note that the connection is closed; a drive that it owned stops."""
        self._drive.tick(now)
        self.closed = True
        if self._drive.owner is self:
            self._drive.lose_owner()

    def _answer(self, message: Message) -> Message | None:
        """Do what a genuine message asks and return the reply; None for a message without meaning."""
        drive, verb, arguments = self._drive, message.verb, message.arguments
        if verb == "AUTH" and not arguments and drive.owner is None:
            return Message(message.number, "OK", drive.greet(self))
        if verb == "AUTH" and not arguments and drive.owner is not self:
            self.closed = True
            return Message(message.number, "BUSY")
        if drive.owner is not self:
            return None
        if verb == "MOVE" and len(arguments) == 2:
            try:
                translation, rotation = (float(argument) for argument in arguments)
            except ValueError:
                return None
            drive.move(translation, rotation)
        elif verb == "ARM" and not arguments:
            drive.arm()
        elif verb == "STOP" and not arguments:
            drive.stop("asked")
        elif verb != "STATE" or arguments:
            return None
        return Message(message.number, "STATE", drive.state())


class _Lines:
    """Cuts a stream of bytes into lines; one that is too long is left out, whatever its length, and counted."""

    def __init__(self, drive: Drive) -> None:
        self._drive, self._held, self._skipping = drive, b"", False

    def feed(self, data: bytes) -> list[bytes]:
        """Take bytes and return the lines that they end."""
        *lines, rest = (self._held + data).split(b"\n")
        if lines and self._skipping:
            lines, self._skipping = lines[1:], False
        if len(rest) >= LONGEST_LINE:
            self._drive.dropped += not self._skipping
            rest, self._skipping = b"", True
        self._held = b"" if self._skipping else rest
        return lines


async def serve(drive: Drive, host: str, port: int, ready: Callable[[int], None]) -> None:
    """Let a drive listen and run on the clock of this process until it is cancelled.

    Args:
        drive: made with `now=time.monotonic()`.
        host: address to listen on.
        port: TCP port; 0 for a free one.
        ready: called with the port once clients can connect.

    Raises:
        InputError: the address cannot be listened on.
    """
    connections: set[asyncio.StreamWriter] = set()

    async def talk(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        if len(connections) > MOST_WAITING:
            writer.close()
            return
        connections.add(writer)
        session, lines, began = drive.open(), _Lines(drive), time.monotonic()
        try:
            writer.write(session.greeting)
            while not session.closed:
                waiting = drive.owner is not session
                left = began + AUTHENTICATE_S - time.monotonic() if waiting else None
                data = await asyncio.wait_for(reader.read(4096), timeout=left)
                if not data:
                    break
                for line in lines.feed(data):
                    reply = session.receive(line, time.monotonic())
                    if reply is not None:
                        writer.write(reply)
                await writer.drain()
        except (TimeoutError, OSError):
            pass
        finally:
            session.close(time.monotonic())
            connections.discard(writer)
            writer.close()

    try:
        server = await asyncio.start_server(talk, host, port)
    except OSError as error:
        raise InputError(f"host, port: cannot listen on {host}:{port} ({error.strerror}); choose others") from error
    async with server:
        ready(server.sockets[0].getsockname()[1])
        with contextlib.suppress(asyncio.CancelledError):
            while True:
                await asyncio.sleep(CYCLE_S)
                drive.tick(time.monotonic())
