"""`serve`: the socket that pages connect to."""

from __future__ import annotations

import asyncio
import socket

import pytest

uvicorn = pytest.importorskip("uvicorn", reason="the extra `cockpit` is not installed")

from endopilot.cockpit.launch import serve  # noqa: E402


class Nothing:
    def handle(self, message, now_s):
        pass

    def halt(self, why):
        pass

    def cycle(self, now_s):
        return []

    def close(self):
        pass


def test_messages_to_pages_do_not_wait_for_each_other(monkeypatch):
    """Without TCP_NODELAY, small messages wait until the page has acknowledged those before: 40 ms."""
    found = []

    async def connect(listener):
        def accepted(reader, writer):
            found.append(writer.get_extra_info("socket").getsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY))
            writer.close()

        async with await asyncio.start_server(accepted, sock=listener):
            reader, writer = await asyncio.open_connection(*listener.getsockname())
            await reader.read()
            writer.close()

    monkeypatch.setattr(uvicorn.Server, "run", lambda self, sockets: asyncio.run(connect(sockets[0])))
    serve(Nothing(), lambda: b"", cycle_s=0.0125, listening=lambda url: None)
    assert found == [1]
