"""A simulated drive: `Drive`, the machine that one client commands, and that stops on any error; `serve`, its process.

Time and bytes come into the machine as arguments, so that it can be tested without a clock or a socket. A drive that
stopped stays so until it is armed again. The process listens over TLS and runs the drive on its clock. Nothing that a
client or a stranger does holds it up: answers wait in a buffer of bounded size, a client that does not read them is
disconnected, and connections without a certificate wait for a bounded time.

What moves the drive bears a ticket, which proves when its client last heard the drive. Lines of ASCII text, `VERB
ARGUMENT...`, travel over TLS 1.3. docs/concepts/drive-protocol.md has tickets, messages and reasons to stop.
"""

from __future__ import annotations

import asyncio
import math
import re
import secrets
import shlex
import socket
import ssl
import stat
import time
from collections import OrderedDict, deque
from collections.abc import Callable
from pathlib import Path

import numpy as np

from endopilot.devices.drive_limits import DriveLimits
from endopilot.devices.robot import DriveMotion, RobotConfig
from endopilot.errors import InputError
from endopilot.robot.robot import CYCLE_S

PROTOCOL = "endopilot-drive 3"
"""Name and version; the drive's greeting begins with it."""
LONGEST_LINE = 200
"""Bytes of a line, newline included."""
SILENCE_S = 0.2
"""Time after which a drive stands still whose client has not heard it since, s."""
BRAKING_S = 0.05
"""Time in which the drive brakes from its top speeds, s (an assumption): a ticket lasts that much less."""
LASTS_S = SILENCE_S - BRAKING_S
"""Age at which a ticket is void, s."""
AUTHENTICATE_S = 2.0
"""Time in which a client must show its certificate, s."""
GONE_S = 10.0
"""Time without a line after which a client counts as gone, s: its machine or its network may be off."""
READ_BYTES = 1 << 12
"""Bytes that are taken as one read; twice as many may wait to be read."""
MOST_UNREAD = 1 << 20
"""Bytes of answers that may wait for a client to read them."""
_MOST_NEWS = 100
_NUMBER = re.compile(
    r"[+-]?(?:(?:[0-9]+(?:\.[0-9]*)?|\.[0-9]+)(?:e[+-]?[0-9]+)?|nan|inf|infinity)", re.ASCII | re.IGNORECASE
)


class Drive:
    """The machine: motion, watchdog, and its client, if one has `taken` it. `stopped` is why it stands still, or None
    while it is armed: "start", "silence", "connection", "not-finite", "limit", "travel", "malformed" or "asked"; `news`
    are lines for people, who take them out."""

    def __init__(
        self, limits: DriveLimits, *, now: float, config: RobotConfig | None = None, inserted_length: float = 0.0
    ) -> None:
        """Stand still, unarmed, at Δ (mm) and at a time by the drive's clock (s); a command beyond the limits, or the
        end of the travel, will stop it. The encoders sit at the motor, for there is no wire."""
        config = config or RobotConfig()
        self._limits, start = limits, np.array([[[inserted_length, 0.0]]])
        self._motion = DriveMotion(config, [[limits]], start)
        self._noise = config.of_drives(1, "encoder_sd_mm", "encoder_sd_rad", "load_sd_n", "load_sd_n_mm")[0]
        self._random = np.random.default_rng()
        self._began = self._now = self._heard = now
        self._tickets: OrderedDict[str, float] = OrderedDict()
        self._wanted: tuple[float, float] | None = None
        self._state: str | None = None
        self.stopped: str | None = "start"
        self.taken, self._held = False, b""
        self.news: deque[str] = deque(maxlen=_MOST_NEWS)

    @property
    def position(self) -> tuple[float, float]:
        """Δ, mm, and φ, rad, by the motor, as they are."""
        return float(self._motion.motor[0, 0, 0]), float(self._motion.motor[0, 0, 1])

    @property
    def due(self) -> float:
        """Time by the drive's clock at which the watchdog will stop it, s; infinite while it is stopped."""
        return self._heard + LASTS_S if self.stopped is None else math.inf

    def tick(self, now: float) -> None:
        """Let the time pass up to now, s; the watchdog stops the drive when it is due, even if the call comes late."""
        if now >= self.due:
            self._advance(max(self.due, self._now))
            self.stop("silence")
        self._advance(max(now, self._now))

    def stop(self, reason: str) -> None:
        """Brake, and stay so until the drive is armed again; what was sent before the client knows of it is void."""
        self._wanted, self._state = None, None
        self._tickets.clear()
        self._motion.stop(within_s=BRAKING_S)
        before = self.stopped
        if before in (None, "silence"):  # of all reasons, a client takes silence alone back by itself
            self.stopped = reason
        if before is None:
            self.news.append(
                f"stopped at {self._now - self._began:.3f} s: {reason}; {self.position[0]:.2f} mm inserted"
            )

    def _move(self, heard: float | None, translation: float | None, rotation: float | None) -> None:
        """Take a command, mm/s and rad/s, if armed and its ticket lasts; the newest of one instant alone is obeyed, and
        one that is no number, not finite or beyond the limits stops the drive."""
        if translation is None or rotation is None:
            self.stop("malformed")
        elif heard is None or self.stopped is not None:
            pass
        elif not (math.isfinite(translation) and math.isfinite(rotation)):
            self.stop("not-finite")
        elif abs(translation) > self._limits.max_velocity_mm_s or abs(rotation) > self._limits.max_rotation_rad_s:
            self.stop("limit")
        else:
            self._wanted, self._heard = (translation, rotation), max(heard, self._heard)

    def state(self) -> str:
        """Return a STATE answer: clock, s; Δ, mm, and φ, rad, by the encoders; load, N and N·mm; status; ticket."""
        if self._state is None:  # one instant has one reading
            true = np.array([*self.position, 0.0, 0.0])  # without a wire there is no load
            inserted, rotation, force, torque = true + self._noise * self._random.standard_normal(4)
            status = "armed" if self.stopped is None else f"stopped:{self.stopped}"
            read = f"{self._now - self._began:.4f} {inserted:.4f} {rotation:.5f} {force:.4f} {torque:.4f}"
            self._state = f"STATE {read} {status} {self._ticket()}\n"
        return self._state

    def open(self) -> bytes:
        """Take a client, of which there is one at a time, and return the first line to it: protocol and limits."""
        assert not self.taken
        self.taken, self._held = True, b""
        self.news.append("a client is connected")
        limits = (self._limits.max_velocity_mm_s, self._limits.max_rotation_rad_s, *self._limits.travel_mm)
        return f"{PROTOCOL} {' '.join(repr(float(value)) for value in limits)}\n".encode("ascii")

    def receive(self, data: bytes, now: float) -> bytes | None:
        """Take bytes of the client as they came, cut anywhere, and return an answer for each line that they end; None
        for a line that never ends, after which the connection is to be closed."""
        self.tick(now)
        *lines, self._held = (self._held + data).split(b"\n")
        answers = [self._answer(line) for line in lines]
        if len(self._held) >= LONGEST_LINE:
            self.stop("malformed")
            return None
        return "".join(answers).encode("ascii")

    def close(self, now: float) -> None:
        """Note that the client's connection is closed, at a time by the drive's clock, s; the drive stops."""
        self.tick(now)
        self.stop("connection")
        self.taken = False
        self.news.append("the client has disconnected")

    def _answer(self, line: bytes) -> str:
        """Do what a line asks and return the answer; a line that is not of the protocol stops the drive."""
        text = line.decode("ascii", "replace") if len(line) < LONGEST_LINE else ""
        match text.split(" "):
            case ["STATE"]:
                pass
            case ["STOP"]:
                self.stop("asked")
            case ["ARM", ticket]:
                if (heard := self._given(ticket)) is not None and self.stopped is not None:
                    self.stopped, self._state, self._heard = None, None, heard
            case ["MOVE", ticket, translation, rotation]:
                self._move(self._given(ticket), number(translation), number(rotation))
            case _:
                self.stop("malformed")
        return self.state()

    def _ticket(self) -> str:
        """Return a new ticket, and forget those that are too old to move anything."""
        while self._tickets and self._now >= next(iter(self._tickets.values())) + LASTS_S:
            self._tickets.popitem(last=False)
        ticket = secrets.token_hex(8)
        self._tickets[ticket] = self._now
        return ticket

    def _given(self, ticket: str) -> float | None:
        """Return when a ticket was given, s, or None if it can move nothing."""
        given = self._tickets.get(ticket, -math.inf)
        return given if self._now < given + LASTS_S else None

    def _advance(self, until: float) -> None:
        if self._wanted is not None:
            self._motion.command(np.array([[self._wanted]]))
            self._wanted = None
        if until > self._now:
            self._motion.advance(until - self._now)
            self._motion.motor[..., 0] = np.clip(self._motion.motor[..., 0], *self._limits.travel_mm)
            self._now, self._state = until, None
        (low, high), at, speed = self._limits.travel_mm, self.position[0], self._motion.velocity[0, 0, 0]
        if self.stopped is None and ((at <= low and speed < 0) or (at >= high and speed > 0)):
            self.stop("travel")


def number(text: str) -> float | None:
    """Return the number that a field holds, in decimal digits, NaN or infinite; None for anything else.

    Python's own `float` also takes underscores, white space and the digits of other scripts.
    """
    return float(text) if _NUMBER.fullmatch(text) else None


def tls_context(folder: Path, *, of_drive: bool) -> ssl.SSLContext:
    """Return the TLS settings of the drive or of its client: its own key and certificate, and the one that it trusts,
    PEM files in a folder (`drive.key`, `drive.crt`, `client.crt`; `client.key`, `client.crt`, `drive.crt`). InputError
    where one is missing or holds something else, or the key is encrypted, open to others, or of another certificate."""
    side, other = ("drive", "client") if of_drive else ("client", "drive")
    key, own, trusted = folder / f"{side}.key", folder / f"{side}.crt", folder / f"{other}.crt"
    place = shlex.quote(str(folder))
    request = (
        "openssl req -x509 -newkey rsa:3072 -nodes -days 3650 -subj /CN=$side "
        f"-keyout {place}/$side.key -out {place}/$side.crt"
    )
    recipe = f"mkdir -p {place}; for side in drive client; do {request}; done"
    mend = f"copy it there, or make both sides' with `{recipe}`"
    for path in (key, own, trusted):
        if not path.is_file():
            raise InputError(f"certificates: {path}: no such file; {mend}")
    if key.stat().st_mode & (stat.S_IRWXG | stat.S_IRWXO):
        raise InputError(f"certificates: {key} is open to other users; close it with `chmod 600 {key}`")
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER if of_drive else ssl.PROTOCOL_TLS_CLIENT)
    context.minimum_version = ssl.TLSVersion.TLSv1_3
    context.check_hostname = False  # the certificate itself is known, whatever name it bears
    context.verify_mode = ssl.CERT_REQUIRED
    context.verify_flags |= ssl.VERIFY_X509_PARTIAL_CHAIN
    what = f"{own} and {key} are no certificate and its unencrypted key"
    try:
        context.load_cert_chain(own, key, password=lambda: "")  # an encrypted key would ask at the terminal
        what = f"{trusted} holds no certificate"
        context.load_verify_locations(trusted)
    except OSError as error:
        reason = getattr(error, "reason", None) or error.strerror or error
        raise InputError(f"certificates: {what} ({reason}); {mend}") from error
    return context


async def serve(drive: Drive, context: ssl.SSLContext, host: str, port: int, say: Callable[[str], None]) -> None:
    """Let a drive, made with `now=time.monotonic()`, listen (on a free port with 0) and run until it is cancelled, or a
    signal ends it; `say` is called with each line for people. InputError where the address cannot be listened on."""

    async def admit(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        if drive.taken:
            writer.write(f"{PROTOCOL} BUSY\n".encode("ascii"))
            writer.close()
        else:
            await _obey(drive, reader, writer)

    listener = listen(host, port)
    server = await asyncio.start_server(
        admit, sock=listener, ssl=context, limit=READ_BYTES,
        ssl_handshake_timeout=AUTHENTICATE_S, ssl_shutdown_timeout=AUTHENTICATE_S,
    )  # fmt: skip
    say(f"listening on {host}:{listener.getsockname()[1]}")
    try:
        while True:
            await asyncio.sleep(min(CYCLE_S, max(drive.due - time.monotonic(), 0.0)))
            drive.tick(time.monotonic())
            while drive.news:
                say(drive.news.popleft())
    finally:
        server.close()


def listen(host: str, port: int, named: str = "host, port") -> socket.socket:
    """Return a TCP socket that listens on an address of this machine (0.0.0.0 or :: for all of them) and a port (0 for
    a free one). InputError, which begins with the options' names, where that cannot be had."""
    try:
        family, *_ = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM, flags=socket.AI_PASSIVE)[0]
        both = family == socket.AF_INET6 and socket.has_dualstack_ipv6()
        listener = socket.create_server((host, port), family=family, dualstack_ipv6=both)
    except (OSError, UnicodeError) as error:
        why = str(getattr(error, "strerror", None) or error).partition(" (")[0]
        raise InputError(f"{named}: cannot listen on {host}:{port} ({why}); choose others") from error
    # The protocol is named so that asyncio sends each message at once: it asks for that (TCP_NODELAY) only then.
    return socket.socket(listener.family, listener.type, socket.IPPROTO_TCP, listener.detach())


async def _obey(drive: Drive, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
    """Answer the lines of a client that showed its certificate, until it is gone; then the drive stops."""
    writer.write(drive.open())
    why = ""
    try:
        while not why:
            async with asyncio.timeout(GONE_S):
                data = await reader.read(READ_BYTES)
            if not data:
                break
            answers = drive.receive(data, time.monotonic())
            writer.write(answers or b"")
            await asyncio.sleep(0)  # what a client sends at once holds nobody up
            if answers is None:
                why = "a line of it has no end"
            elif writer.transport.get_write_buffer_size() > MOST_UNREAD:
                why = "it does not read the answers"
    except TimeoutError:
        why = f"it was silent for {GONE_S:g} s"
    except OSError:
        pass  # the connection is lost
    finally:
        if why:
            drive.news.append(f"the client is sent away: {why}")
        writer.transport.abort()
        drive.close(time.monotonic())
