"""The process of a drive: it listens for clients over TLS and runs the drive on the clock of this process.

Nothing that a client or a stranger does holds it up. Answers wait in a buffer of bounded size, and a client that does
not read them is disconnected. Connections without a certificate wait for a bounded time.
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
READ_BYTES = 1 << 12
"""Bytes that are taken as one read; twice as many may wait to be read."""
MOST_UNREAD = 1 << 20
"""Bytes of answers that may wait for a client to read them."""


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

    async def admit(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        if drive.owner is None:
            await _obey(drive, reader, writer)
        else:
            writer.write(f"{PROTOCOL} BUSY\n".encode("ascii"))
            writer.close()

    terminated = asyncio.Event()
    asyncio.get_running_loop().add_signal_handler(signal.SIGTERM, terminated.set)
    listener = _listen(host, port)
    server = await asyncio.start_server(
        admit, sock=listener, ssl=context, limit=READ_BYTES,
        ssl_handshake_timeout=AUTHENTICATE_S, ssl_shutdown_timeout=AUTHENTICATE_S,
    )  # fmt: skip
    say(f"listening on {host}:{listener.getsockname()[1]}")
    try:
        while not terminated.is_set():
            await asyncio.sleep(min(CYCLE_S, max(drive.due - time.monotonic(), 0.0)))
            drive.tick(time.monotonic())
            while drive.news:
                say(drive.news.popleft())
    finally:
        server.close()


def _listen(host: str, port: int) -> socket.socket:
    try:
        family, *_ = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)[0]
        return socket.create_server((host, port), family=family)
    except (OSError, UnicodeError) as error:
        why = str(getattr(error, "strerror", None) or error).partition(" (")[0]
        raise InputError(f"host, port: cannot listen on {host}:{port} ({why}); choose others") from error


async def _obey(drive: Drive, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
    """Answer the lines of a client that showed its certificate, until it is gone; then the drive stops."""
    session, why = drive.open(), ""
    writer.write(drive.greeting.encode("ascii"))
    try:
        while not why:
            async with asyncio.timeout(GONE_S):
                data = await reader.read(READ_BYTES)
            if not data:
                break
            writer.write(session.receive(data, time.monotonic()))
            await asyncio.sleep(0)  # what a client sends at once holds nobody up
            if session.closed:
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
        session.close(time.monotonic())
