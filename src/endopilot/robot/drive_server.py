"""The process of a drive: it listens for clients over TLS and runs the drive on the clock of this process.

Nothing that a client or a stranger does holds it up. Answers wait in a buffer of bounded size, and a client that does
not read them is disconnected. Connections without a certificate wait for a bounded time, and few at once.
"""

from __future__ import annotations

import asyncio
import signal
import socket
import ssl
import time
from collections.abc import Callable

from endopilot.errors import InputError
from endopilot.robot.drive import Drive, Session
from endopilot.robot.drive_protocol import PROTOCOL
from endopilot.robot.robot import CYCLE_S

AUTHENTICATE_S = 2.0
"""Time in which a client must show its certificate, s."""
GONE_S = 10.0
"""Time without a line after which a client counts as gone, s: its machine or its network may be off."""
MOST_WAITING = 8
"""Connections that may wait to be let in; one more is closed at once."""
READ_BYTES = 1 << 12
"""Bytes that are taken as one read; the socket brings up to 64 times as many at once."""
MOST_UNREAD = 1 << 20
"""Bytes of answers that may wait for a client to read them, or belong to what the socket brings at once."""
REFUSALS_S = 1.0
"""Time between two lines for people on connections that were refused, s."""


async def serve(drive: Drive, context: ssl.SSLContext, host: str, port: int, say: Callable[[str], None]) -> None:
    """Let a drive listen and run until SIGTERM, or until it is cancelled.

    Args:
        drive: made with `now=time.monotonic()`.
        context: of `tls_context`.
        host: address to listen on.
        port: TCP port; 0 for a free one.
        say: called with each line for people.

    Raises:
        InputError: the address cannot be listened on.
    """
    terminated = asyncio.Event()
    asyncio.get_running_loop().add_signal_handler(signal.SIGTERM, terminated.set)
    with _listen(host, port) as listener:
        say(f"listening on {host}:{listener.getsockname()[1]}")
        door = asyncio.create_task(_Door(drive, context).keep(listener))
        while not (terminated.is_set() or door.done()):
            await asyncio.sleep(min(CYCLE_S, max(drive.due - time.monotonic(), 0.0)))
            drive.tick(time.monotonic())
            while drive.news:
                say(drive.news.popleft())
        if door.done():
            door.result()  # its error


def _listen(host: str, port: int) -> socket.socket:
    try:
        family, *_ = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)[0]
        listener = socket.create_server((host, port), family=family)
    except (OSError, UnicodeError) as error:
        why = str(getattr(error, "strerror", None) or error).partition(" (")[0]
        raise InputError(f"host, port: cannot listen on {host}:{port} ({why}); choose others") from error
    listener.setblocking(False)
    return listener


class _Door:
    """Lets clients in: one that has a certificate, while the drive has no other."""

    def __init__(self, drive: Drive, context: ssl.SSLContext) -> None:
        self._drive, self._context = drive, context
        self._waiting: set[asyncio.Task[None]] = set()
        self._refused = -REFUSALS_S

    async def keep(self, listener: socket.socket) -> None:
        """Let them in for ever."""
        loop = asyncio.get_running_loop()
        while True:
            try:
                connection, address = await loop.sock_accept(listener)
            except OSError:  # too many open files: the connections that wait will end
                await asyncio.sleep(CYCLE_S)
                continue
            if len(self._waiting) >= MOST_WAITING:
                connection.close()
                await asyncio.sleep(0)
                continue
            task = asyncio.create_task(self._admit(connection, address[0]))
            self._waiting.add(task)
            task.add_done_callback(self._waiting.discard)

    async def _admit(self, connection: socket.socket, address: str) -> None:
        client = _Connection(self._drive)
        try:
            await asyncio.get_running_loop().connect_accepted_socket(
                lambda: client,
                connection,
                ssl=self._context,
                ssl_handshake_timeout=AUTHENTICATE_S,
                ssl_shutdown_timeout=AUTHENTICATE_S,
            )
        except OSError as error:
            self._refuse(address, getattr(error, "verify_message", None) or getattr(error, "reason", None))
            return
        if not client.commands:
            await client.gone.wait()

    def _refuse(self, address: str, reason: str | None) -> None:
        now = time.monotonic()
        if now >= self._refused + REFUSALS_S:  # a line for each would be as many as a stranger likes
            self._refused = now
            why = (reason or "no TLS 1.3 handshake").replace("_", " ").lower()
            self._drive.news.append(f"refused a connection from {address}: {why}")


class _Connection(asyncio.Protocol):
    """A client that showed its certificate.

    Attributes:
        gone: set once the connection is closed.
    """

    def __init__(self, drive: Drive) -> None:
        self._drive = drive
        self._session: Session | None = None
        self._transport: asyncio.Transport | None = None
        self._watch: asyncio.TimerHandle | None = None
        self.gone = asyncio.Event()

    @property
    def commands(self) -> bool:
        """Whether this client commands the drive."""
        return self._session is not None

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        assert isinstance(transport, asyncio.Transport)
        self._transport, self._session = transport, self._drive.open()
        if self._session is None:
            transport.write(f"{PROTOCOL} BUSY\n".encode("ascii"))
            transport.close()
        else:
            transport.write(self._drive.greeting.encode("ascii"))
            self._expect()

    def data_received(self, data: bytes) -> None:
        if self._session is None or self._transport is None:
            return
        written = 0
        for begin in range(0, len(data), READ_BYTES):
            answers = self._session.receive(data[begin : begin + READ_BYTES], time.monotonic())
            self._transport.write(answers)
            written += len(answers)
            if self._session.closed:
                self._abort("a line of it has no end")
                return
            if max(written, self._transport.get_write_buffer_size()) > MOST_UNREAD:
                self._abort("it does not read the answers")
                return
        if written:
            self._expect()

    def connection_lost(self, exc: Exception | None) -> None:
        if self._watch is not None:
            self._watch.cancel()
        if self._session is not None:
            self._session.close(time.monotonic())
        self.gone.set()

    def _expect(self) -> None:
        """Wait `GONE_S` for the next line."""
        if self._watch is not None:
            self._watch.cancel()
        self._watch = asyncio.get_running_loop().call_later(GONE_S, self._abort, f"it was silent for {GONE_S:g} s")

    def _abort(self, why: str) -> None:
        """Close the connection at once; the drive stops."""
        self._drive.news.append(f"the client is sent away: {why}")
        if self._transport is not None:
            self._transport.abort()
        if self._session is not None:
            self._session.close(time.monotonic())
