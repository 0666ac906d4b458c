"""`serve`: the socket that pages connect to."""

from __future__ import annotations

import asyncio
import socket

import pytest
from browser import Stage

uvicorn = pytest.importorskip("uvicorn", reason="the extra `cockpit` is not installed")

from endopilot.cockpit.server import serve  # noqa: E402
from endopilot.errors import InputError  # noqa: E402


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
    serve(Stage(), lambda: b"", cycle_s=0.0125, listening=lambda url: None)
    assert found == [1]


@pytest.mark.parametrize(
    ("host", "page"), [("0.0.0.0", "http://127.0.0.1:"), ("::", "http://[::1]:"), ("::1", "http://[::1]:")]
)
def test_the_address_that_is_printed_can_be_asked_for(monkeypatch, host, page):
    if ":" in host and not socket.has_ipv6:
        pytest.skip("no IPv6 here")
    printed = []
    monkeypatch.setattr(uvicorn.Server, "run", lambda self, sockets: None)
    serve(Stage(), lambda: b"", cycle_s=0.0125, host=host, listening=printed.append)
    assert printed[0].startswith(page)


@pytest.mark.parametrize("host", ["256.1.1.1", "a..b", "192.0.2.77", "nonesuch.invalid", "http://x", "[::1]"])
def test_what_is_no_address_of_this_machine_is_refused(host):
    with pytest.raises(InputError, match=r"host, port: cannot listen on .*; choose others"):
        serve(Stage(), lambda: b"", cycle_s=0.0125, host=host)


def test_a_port_in_use_is_refused():
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        with pytest.raises(InputError, match=r"host, port: cannot listen on .*in use.*; choose others"):
            serve(Stage(), lambda: b"", cycle_s=0.0125, port=taken.getsockname()[1])
