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
from endopilot.robot.drive import PROTOCOL, Drive
from endopilot.robot.robot import CYCLE_S

AUTHENTICATE_S = 2.0
"""Time in which a client must show its certificate, s."""
GONE_S = 10.0
"""Time without a line after which a client counts as gone, s: its machine or its network may be off."""
MOST_WAITING = 8
"""Connections that may wait to be let in; one more is closed at once."""
READ_BYTES = 1 << 12
"""Bytes that are taken as one read; twice as many may wait to be read."""
MOST_UNREAD = 1 << 20
"""Bytes of answers that may wait for a client to read them."""
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
        self._clients: set[asyncio.Task[None]] = set()
        self._waiting, self._refused = 0, -REFUSALS_S

    async def keep(self, listener: socket.socket) -> None:
        """Let them in for ever."""
        while True:
            try:
                connection, address = await asyncio.get_running_loop().sock_accept(listener)
            except OSError:  # too many open files: the connections that wait will end
                await asyncio.sleep(CYCLE_S)
                continue
            if self._waiting >= MOST_WAITING:
                connection.close()
                await asyncio.sleep(0)
                continue
            self._waiting += 1
            task = asyncio.create_task(self._admit(connection, address[0]))
            self._clients.add(task)
            task.add_done_callback(self._clients.discard)

    async def _admit(self, connection: socket.socket, address: str) -> None:
        reader = asyncio.StreamReader(limit=READ_BYTES)
        try:
            transport, _ = await asyncio.get_running_loop().connect_accepted_socket(
                lambda: asyncio.StreamReaderProtocol(reader),
                connection,
                ssl=self._context,
                ssl_handshake_timeout=AUTHENTICATE_S,
                ssl_shutdown_timeout=AUTHENTICATE_S,
            )
        except OSError as error:
            now = time.monotonic()
            if now >= self._refused + REFUSALS_S:  # a line for each would be as many as a stranger likes
                self._refused = now
                why = getattr(error, "verify_message", None) or getattr(error, "reason", None) or "no TLS 1.3 handshake"
                self._drive.news.append(f"refused a connection from {address}: {why.replace('_', ' ').lower()}")
            return
        finally:
            self._waiting -= 1
        assert isinstance(transport, asyncio.Transport)
        if self._drive.owner is not None:
            transport.write(f"{PROTOCOL} BUSY\n".encode("ascii"))
            transport.close()
        else:
            await self._obey(reader, transport)

    async def _obey(self, reader: asyncio.StreamReader, transport: asyncio.Transport) -> None:
        """Answer the lines of a client that showed its certificate, until it is gone; then the drive stops."""
        session, why = self._drive.open(), ""
        assert session is not None
        transport.write(self._drive.greeting.encode("ascii"))
        try:
            while True:
                async with asyncio.timeout(GONE_S):
                    data = await reader.read(READ_BYTES)
                if not data:
                    break
                transport.write(session.receive(data, time.monotonic()))
                await asyncio.sleep(0)  # what a client sends at once holds nobody up
                if session.closed:
                    why = "a line of it has no end"
                    break
                if transport.get_write_buffer_size() > MOST_UNREAD:
                    why = "it does not read the answers"
                    break
        except TimeoutError:
            why = f"it was silent for {GONE_S:g} s"
        except OSError:
            pass  # the connection is lost
        finally:
            if why:
                self._drive.news.append(f"the client is sent away: {why}")
            transport.abort()
            session.close(time.monotonic())
