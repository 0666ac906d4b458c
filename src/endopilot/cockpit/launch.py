"""`serve`: the server on this machine's loopback, from the first moment on until Ctrl-C."""

from __future__ import annotations

import secrets
import socket
from collections.abc import Callable

import uvicorn

from endopilot.cockpit.loop import Stage
from endopilot.cockpit.messages import LONGEST_MESSAGE
from endopilot.cockpit.server import Cockpit
from endopilot.errors import InputError

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
        stage: what is driven or replayed.
        scene: makes the message with what does not move.
        cycle_s: length of a cycle, s.
        host: address to listen on; by default only this machine can connect.
        port: TCP port; 0 for a free one.
        listening: called with the page's address, token included.

    Raises:
        InputError: the address cannot be listened on.
    """
    token = secrets.token_urlsafe(_TOKEN_BYTES)
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    # The protocol is named so that asyncio sends each message at once: it asks for that (TCP_NODELAY) only then.
    with socket.socket(family, socket.SOCK_STREAM, socket.IPPROTO_TCP) as listener:
        listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            listener.bind((host, port))
        except OSError as error:
            raise InputError(f"port: {port} on {host}: {error.strerror}; choose another") from error
        number = listener.getsockname()[1]
        name = f"[{host}]" if ":" in host else host
        hosts = (f"{name}:{number}", f"localhost:{number}")
        cockpit = Cockpit(stage, scene, token=token, hosts=hosts, cycle_s=cycle_s)
        config = uvicorn.Config(
            cockpit.app,
            log_level="warning",
            access_log=False,
            ws="websockets-sansio",
            ws_max_size=LONGEST_MESSAGE,
            ws_per_message_deflate=False,
            ws_ping_interval=2.0,
            ws_ping_timeout=4.0,
            timeout_graceful_shutdown=1,
            server_header=False,
        )
        listener.listen()
        listening(f"http://{name}:{number}/?token={token}")
        uvicorn.Server(config).run(sockets=[listener])
