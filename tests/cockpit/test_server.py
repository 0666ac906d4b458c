"""The web server: who may look, who drives, and that bad messages harm nobody."""

from __future__ import annotations

import json
import time

import pytest

pytest.importorskip("starlette", reason="the extra `cockpit` is not installed")
pytest.importorskip("httpx2", reason="httpx2, which Starlette's test client needs, is not installed")

from browser import Stage
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from starlette.testclient import TestClient
from starlette.websockets import WebSocketDisconnect

from endopilot.cockpit.frames import decode, encode
from endopilot.cockpit.server import BUSY, MOST_PER_SECOND, Cockpit

pytestmark = pytest.mark.timeout(120)  # where the server falls silent, a page's `receive_bytes` would wait for ever

HOST, TOKEN = "127.0.0.1:7000", "secret"
ORIGIN = {"origin": f"http://{HOST}", "host": HOST}


@pytest.fixture
def stage():
    return Stage()


@pytest.fixture
def client(stage):
    hosts = frozenset({"localhost", "127.0.0.1"})
    cockpit = Cockpit(stage, lambda: encode("scene", {}), token=TOKEN, hosts=hosts, cycle_s=0.005)
    with TestClient(cockpit.app, base_url=f"http://{HOST}") as made:
        yield made


def socket(client, *, token=TOKEN, headers=ORIGIN):
    return client.websocket_connect(f"ws://{HOST}/socket?token={token}", headers=headers)


def until(found, *, seconds=5.0):
    end = time.monotonic() + seconds
    while not found() and time.monotonic() < end:
        time.sleep(0.005)
    assert found()


def receive(page, kind):
    for _ in range(2000):
        header, _ = decode(page.receive_bytes())
        if header["type"] == kind:
            return header
    raise AssertionError(kind)


@pytest.mark.parametrize("path", ["/", "/scene", "/?token=wrong", "/scene?token=wrong"])
def test_the_page_needs_the_token(client, path):
    assert client.get(path).status_code == 403


def test_the_page_loads_nothing_from_elsewhere(client):
    answer = client.get(f"/?token={TOKEN}")
    assert answer.status_code == 200
    assert "default-src 'none'" in answer.headers["content-security-policy"]
    assert "Not a medical device" in answer.text
    assert "://" not in answer.text


@pytest.mark.parametrize(
    ("came_in", "host", "allowed"),
    [
        ("192.0.2.7", "192.0.2.7:7000", True),
        ("192.0.2.7", "localhost:7000", True),
        ("192.0.2.7", "LOCALHOST:7000", True),
        ("192.0.2.7", "192.0.2.8:7000", False),
        ("192.0.2.7", "192.0.2.7:7001", False),
        ("192.0.2.7", "192.0.2.7", False),
        ("192.0.2.7", "evil.example:7000", False),
        ("192.0.2.7", "192.0.2.7.evil.example:7000", False),
        ("192.0.2.7", "evil@192.0.2.7:7000", False),
        ("192.0.2.7", "192.0.2.7:7000/", False),
        ("192.0.2.7", "", False),
        ("192.0.2.7", "[", False),
        ("192.0.2.7", "localhost:99999", False),
        ("fe80::7%eth0", "[fe80::7]:7000", True),
        ("fe80::7", "[fe80::8]:7000", False),
        ("::ffff:192.0.2.7", "192.0.2.7:7000", True),
        ("::1", "[::1]:7000", True),
    ],
)
def test_the_page_is_asked_for_at_the_address_where_it_is(client, came_in, host, allowed):
    """A server on all interfaces is asked for at many addresses; a foreign name for one of them is DNS rebinding."""

    async def at(scope, receive, send):
        await client.app(scope | {"server": (came_in, 7000)}, receive, send)

    asking = TestClient(at, base_url=f"http://{HOST}")
    for origin in (None, f"http://{host}", "http://evil.example"):
        headers = {"host": host} | ({} if origin is None else {"origin": origin})
        status = asking.get(f"/?token={TOKEN}", headers=headers).status_code
        assert (status == 200) == (allowed and origin != "http://evil.example"), (origin, status)


@pytest.mark.parametrize(
    ("token", "headers"),
    [
        ("wrong", ORIGIN),
        ("", ORIGIN),
        (TOKEN, {"host": HOST}),
        (TOKEN, {"host": HOST, "origin": "http://evil.example"}),
        (TOKEN, {"host": HOST, "origin": "null"}),
        (TOKEN, {"host": "evil.example", "origin": f"http://{HOST}"}),
    ],
)
def test_a_socket_needs_token_origin_and_host(client, stage, token, headers):
    with socket(client, token=token, headers=headers) as page:
        page.send_text('{"type": "drive", "translation": 1, "rotation": 0}')
        with pytest.raises(WebSocketDisconnect) as closed:
            page.receive_bytes()
    assert closed.value.code == 4403
    assert not stage.heard


def test_the_first_page_drives_and_the_second_watches(client, stage):
    with socket(client) as first:
        assert receive(first, "role")["drives"]
        with socket(client) as second:
            assert not receive(second, "role")["drives"]
            assert receive(second, "state")["cycle"] > 0
            second.send_text('{"type": "drive", "translation": 1, "rotation": 0}')
            assert "watches" in receive(second, "notice")["text"]
            second.send_text('{"type": "wheel", "take": true}')
            assert "another page drives" in receive(second, "notice")["text"]
            first.send_text('{"type": "drive", "translation": 2, "rotation": 0}')
            until(lambda: stage.heard)
            assert [message.translation for message in stage.heard] == [2.0]
            first.send_text('{"type": "wheel", "take": false}')
            until(lambda: "wheel" in stage.halted)
            second.send_text('{"type": "wheel", "take": true}')
            second.send_text('{"type": "drive", "translation": 3, "rotation": 0}')
            until(lambda: len(stage.heard) == 2)


def test_a_lost_page_stops_the_wire_and_time(client, stage):
    with socket(client) as page:
        receive(page, "state")
    until(lambda: "connection" in stage.halted)
    time.sleep(0.1)
    cycles = stage.cycles
    time.sleep(0.1)
    assert stage.cycles == cycles


def test_too_many_faults_close_the_connection(client, stage):
    with socket(client) as page:
        for _ in range(30):
            page.send_text("nonsense")
        with pytest.raises(WebSocketDisconnect):
            for _ in range(2000):
                page.receive_bytes()
    assert not stage.heard


def test_too_many_messages_a_second_close_the_connection(client, monkeypatch):
    clock = [0.0]  # of its own: a busy machine sends more slowly than the limit
    monkeypatch.setattr("endopilot.cockpit.server.monotonic", lambda: clock[0])
    with socket(client) as page:
        for clock[0] in (0.0, 1.5):
            for number in range(MOST_PER_SECOND - 1):
                page.send_text(json.dumps({"type": "ping", "number": number}))
            while receive(page, "pong")["number"] < MOST_PER_SECOND - 2:
                pass
        for number in range(2):
            page.send_text(json.dumps({"type": "ping", "number": number}))
        with pytest.raises(WebSocketDisconnect) as closed:
            for _ in range(2000):
                page.receive_bytes()
    assert closed.value.code == BUSY


@pytest.mark.filterwarnings("ignore::pytest.PytestUnhandledThreadExceptionWarning")
def test_an_error_of_the_server_is_told_in_the_page(client, stage):
    stage.cycles = 4990
    with socket(client) as page:
        header = receive(page, "error")
    assert header["fatal"] and "broken" in header["text"]
    until(lambda: "closed" in stage.halted)


@settings(max_examples=30, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(st.lists(st.one_of(st.text(max_size=100), st.binary(max_size=100)), min_size=1, max_size=15))
def test_malformed_messages_harm_nobody(client, stage, texts):
    with socket(client) as page:
        for text in texts:
            if isinstance(text, str):
                page.send_text(text)
            else:
                page.send_bytes(text)
        page.send_text('{"type": "ping", "number": 7}')
        assert receive(page, "pong")["number"] == 7
    assert not stage.heard
