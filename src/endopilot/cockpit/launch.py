"""`serve`: the server, on this machine's loopback or where it is asked to listen, until Ctrl-C."""

from __future__ import annotations

import errno
import ipaddress
import secrets
import socket
from collections.abc import Callable

import uvicorn

from endopilot.cockpit.loop import Stage
from endopilot.cockpit.messages import LONGEST_MESSAGE
from endopilot.cockpit.server import Cockpit
from endopilot.errors import InputError

MOST_CONNECTIONS = 64
"""Connections at once, those that have not asked for anything yet included."""
_TOKEN_BYTES = 16


def serve(
    stage: Stage,
    scene: Callable[[], bytes],
    *,
    cycle_s: float,
    host: str = "127.0.0.1",
    port: int = 0,
    listening: Callable[[str], None] = lambda url: print(url, flush=True),
) -> None:
    """Serve a stage until Ctrl-C.

    Args:
        host: address to listen on; by default only this machine can connect. 0.0.0.0 or :: listens on all of this
            machine's addresses.
        port: TCP port; 0 for a free one.
        listening: called with the page's address, token included.

    Raises:
        InputError: the address cannot be listened on.
    """
    token = secrets.token_urlsafe(_TOKEN_BYTES)
    with _listener(host, port) as listener:
        address, number = listener.getsockname()[:2]
        everywhere = ipaddress.ip_address(address).is_unspecified
        names = {"localhost", host.lower()} | (machine_names() if everywhere else set())
        cockpit = Cockpit(stage, scene, token=token, hosts=frozenset(names), cycle_s=cycle_s)
        config = uvicorn.Config(
            cockpit.app,
            log_config=None,
            access_log=False,
            ws="websockets-sansio",
            ws_max_size=LONGEST_MESSAGE,
            ws_per_message_deflate=False,
            ws_ping_interval=2.0,
            ws_ping_timeout=4.0,
            timeout_graceful_shutdown=1,
            limit_concurrency=MOST_CONNECTIONS,
            server_header=False,
        )
        listener.listen()
        shown = ("127.0.0.1" if listener.family == socket.AF_INET else "::1") if everywhere else host
        listening(f"http://{f'[{shown}]' if ':' in shown else shown}:{number}/?token={token}")
        uvicorn.Server(config).run(sockets=[listener])


def machine_names() -> set[str]:
    """Return the names that this machine has for others, in lower case."""
    name = socket.gethostname().lower()
    return {name, name.partition(".")[0], socket.getfqdn().lower()}


def _listener(host: str, port: int) -> socket.socket:
    """Return a socket that is bound to an address.

    Raises:
        InputError: there is no such address here, or the port is taken or not for this user.
    """
    try:
        found = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM, flags=socket.AI_PASSIVE)
        family, _, _, _, address = found[0]
    except (OSError, UnicodeError) as error:
        raise InputError(f"host: {host!r} is no address; give one of this machine's, such as 127.0.0.1") from error
    # The protocol is named so that asyncio sends each message at once: it asks for that (TCP_NODELAY) only then.
    listener = socket.socket(family, socket.SOCK_STREAM, socket.IPPROTO_TCP)
    try:
        listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        if family == socket.AF_INET6:
            listener.setsockopt(socket.IPPROTO_IPV6, socket.IPV6_V6ONLY, 0)  # :: takes IPv4, too
        listener.bind(address)
    except OSError as error:
        listener.close()
        if error.errno == errno.EADDRNOTAVAIL:
            raise InputError(f"host: {host!r} is no address of this machine; give one that is") from error
        raise InputError(f"port: {port} on {host}: {error.strerror}; choose another") from error
    return listener
