"""The web server: the page and its scripts, and one WebSocket a page. Loopback, a token, one driver, small messages."""

from __future__ import annotations

import asyncio
import base64
import contextlib
import hashlib
import hmac
import ipaddress
import re
import secrets
import socket
import threading
from collections.abc import AsyncIterator, Callable
from concurrent.futures import ThreadPoolExecutor
from contextlib import asynccontextmanager
from dataclasses import dataclass, field
from pathlib import Path
from time import monotonic, perf_counter

import uvicorn
from starlette.applications import Starlette
from starlette.requests import HTTPConnection, Request
from starlette.responses import HTMLResponse, PlainTextResponse, Response
from starlette.routing import Mount, Route, WebSocketRoute
from starlette.staticfiles import StaticFiles
from starlette.websockets import WebSocket, WebSocketDisconnect, WebSocketState

from endopilot.cockpit.frames import encode
from endopilot.cockpit.messages import LONGEST_MESSAGE, Message, Ping, Wheel, read_message
from endopilot.cockpit.session import Stage
from endopilot.errors import InputError
from endopilot.robot.drive import listen

WEB = Path(__file__).parent / "web"
MOST_PAGES = 8  # pages that may look at once
MOST_PER_SECOND = 200  # messages that a page may send in a second
MOST_FAULTS = 20  # messages of a page that may be refused before its connection is closed
REFUSED, BUSY = 4403, 4429  # why a WebSocket is closed: wrong token or origin; too many pages, messages, faults
_LATE_S = 0.25  # a cycle that is later than this lets the time go, s
_IDLE_S = 0.05  # time from one look for pages to the next, while nobody looks, s


@dataclass(eq=False)
class _Page:
    """One connected page: the newest message of each channel that it has not been sent yet."""

    number: int
    waiting: dict[str, bytes] = field(default_factory=dict)
    news: asyncio.Event = field(default_factory=asyncio.Event)
    faults: int = 0

    def put(self, channel: str, message: bytes) -> None:
        self.waiting[channel] = message  # what a slow page has not taken yet is replaced, never queued
        self.news.set()


class Cockpit:
    """The application around one stage."""

    def __init__(
        self, stage: Stage, scene: Callable[[], bytes], *, token: str, hosts: frozenset[str], cycle_s: float
    ) -> None:
        """Lay out the routes; a page's address must hold the token, and one of `hosts` or the connection's own."""
        self._token, self._hosts, self._scene = token, hosts, scene
        self._stage, self._cycle_s = stage, cycle_s
        self._inbox: list[Message | str] = []
        self._pages: list[_Page] = []
        self._driver: _Page | None = None
        self._counted = 0
        self._kept: dict[str, bytes] = {}
        self._index = (WEB / "index.html").read_text(encoding="utf-8")
        self.app = Starlette(
            routes=[
                Route("/", self._page),
                Route("/scene", self._scene_route),
                WebSocketRoute("/socket", self._socket),
                Mount("/web", StaticFiles(directory=WEB)),
            ],
            lifespan=self._lifespan,
        )

    @asynccontextmanager
    async def _lifespan(self, app: Starlette) -> AsyncIterator[None]:
        running = asyncio.create_task(self._run())
        try:
            yield
        finally:
            running.cancel()
            await asyncio.wait([running])

    async def _run(self) -> None:
        """Let the stage's cycles pass one after the other, in a thread of their own, and the time go that a cycle took
        too long."""
        due = perf_counter()
        try:
            with ThreadPoolExecutor(1, "cockpit") as thread:
                while True:
                    inbox, self._inbox = self._inbox, []
                    run = asyncio.get_running_loop().run_in_executor(thread, self._cycle, inbox)
                    passed, sent = await run
                    for channel, message in sent:
                        self._spread(channel, message)
                    done = perf_counter()
                    due += self._cycle_s
                    if not passed or done - due > _LATE_S:
                        due = done + (0.0 if passed else _IDLE_S)
                    await asyncio.sleep(max(due - done, 0.0))
        except Exception as error:
            text = f"{type(error).__name__}: {' '.join(str(error).split())}"
            self._spread("error", encode("error", {"text": f"The simulation has stopped. {text}", "fatal": True}))
            told = (type(error), error, error.__traceback__, threading.current_thread())
            threading.excepthook(threading.ExceptHookArgs(told))  # which the command line tells, too
        finally:
            self._stage.close()

    def _cycle(self, inbox: list[Message | str]) -> tuple[bool, list[tuple[str, bytes]]]:
        """Give the stage what the driver sent, or why the wire must stop, and let a cycle pass if somebody looks;
        return whether it did, and what the pages are to get."""
        now, notices = perf_counter(), list[tuple[str, bytes]]()
        for message in inbox:
            try:
                if isinstance(message, str):
                    self._stage.halt(message)
                else:
                    self._stage.handle(message, now)
            except InputError as error:
                notices.append(("notice", encode("notice", {"text": str(error)})))
        passes = bool(self._pages) or getattr(self._stage, "watched", bool)()
        return passes, notices + (self._stage.cycle(now) if passes else [])

    def _spread(self, channel: str, message: bytes) -> None:
        if channel.startswith("image") or channel in ("state", "error", "result"):
            self._kept[channel] = message
        for page in self._pages:
            page.put(channel, message)

    def _allowed(self, connection: HTTPConnection, *, need_origin: bool) -> bool:
        """Return whether host, origin and token are right: the host one of `hosts`, or the very address that the
        connection came in at, as another name may be a foreign page's (DNS rebinding); the origin the page itself."""
        host, origin = connection.headers.get("host", ""), connection.headers.get("origin")
        address, port = connection.scope.get("server") or ("", None)
        own = address.partition("%")[0].removeprefix("::ffff:")  # one of IPv4 may come in through a socket of IPv6
        named = {*self._hosts, f"[{own}]" if ":" in own else own}
        if host.lower() not in {f"{name}:{port}" for name in named} | (named if port == 80 else set()):
            return False
        if (need_origin or origin is not None) and origin != f"http://{host}":
            return False
        given = connection.query_params.get("token", "").encode()
        return hmac.compare_digest(given, self._token.encode())

    async def _page(self, request: Request) -> Response:
        if not self._allowed(request, need_origin=False):
            return PlainTextResponse("This page needs the address that `endopilot cockpit` printed.", status_code=403)
        return HTMLResponse(self._index, headers=_headers(self._index))

    async def _scene_route(self, request: Request) -> Response:
        if not self._allowed(request, need_origin=False):
            return PlainTextResponse("wrong token", status_code=403)
        message = await asyncio.to_thread(self._scene)
        return Response(message, media_type="application/octet-stream", headers={"Cache-Control": "no-store"})

    async def _socket(self, socket: WebSocket) -> None:
        await socket.accept()
        if not self._allowed(socket, need_origin=True):
            await socket.close(REFUSED, "wrong token or origin")
            return
        if len(self._pages) >= MOST_PAGES:
            await socket.close(BUSY, f"{MOST_PAGES} pages look already")
            return
        self._counted += 1
        page = _Page(self._counted)
        for channel, message in self._kept.items():
            page.put(channel, message)
        self._pages.append(page)
        if self._driver is None:
            self._driver = page
        self._tell_roles()
        sender = asyncio.create_task(self._send(socket, page))
        try:
            await self._receive(socket, page)
        finally:
            sender.cancel()
            self._pages.remove(page)
            if self._driver is page:
                self._driver = None
                self._inbox.append("connection")
            self._tell_roles()

    async def _send(self, socket: WebSocket, page: _Page) -> None:
        with contextlib.suppress(WebSocketDisconnect, RuntimeError):
            while True:
                await page.news.wait()
                page.news.clear()
                for channel in list(page.waiting):
                    await socket.send_bytes(page.waiting.pop(channel))

    async def _receive(self, socket: WebSocket, page: _Page) -> None:
        began, count = monotonic(), 0
        while socket.client_state == WebSocketState.CONNECTED:
            incoming = await socket.receive()
            if incoming["type"] == "websocket.disconnect":
                return
            if monotonic() - began > 1.0:
                began, count = monotonic(), 0
            count += 1
            if count > MOST_PER_SECOND:
                await socket.close(BUSY, "too many messages")
                return
            text = incoming.get("text") or incoming.get("bytes") or ""
            refused = self._take(page, text)
            if refused is not None:
                page.faults += 1
                page.put("notice", encode("notice", {"text": refused[:300]}))
                if page.faults >= MOST_FAULTS:
                    await socket.close(BUSY, "too many messages were refused")
                    return

    def _take(self, page: _Page, text: str | bytes) -> str | None:
        try:
            message = read_message(text)
        except ValueError as error:
            return str(error)
        if isinstance(message, Ping):
            page.put("pong", encode("pong", {"number": message.number}))
        elif isinstance(message, Wheel):
            return self._wheel(page, message.take)
        elif page is self._driver:
            self._inbox.append(message)
        else:
            return "this page only watches; take the wheel first"
        return None

    def _wheel(self, page: _Page, take: bool) -> str | None:
        if take and self._driver not in (None, page):
            return "another page drives; it must let the wheel go first"
        if take:
            self._driver = page
        elif page is self._driver:
            self._driver = None
            self._inbox.append("wheel")
        self._tell_roles()
        return None

    def _tell_roles(self) -> None:
        for page in self._pages:
            header = {"drives": page is self._driver, "taken": self._driver is not None, "pages": len(self._pages)}
            page.put("role", encode("role", header))


def _headers(index: str) -> dict[str, str]:
    """Return headers that let the page load nothing but its own scripts, styles and data."""
    inline = re.findall(r'<script type="importmap">(.*?)</script>', index, flags=re.DOTALL)
    hashes = [base64.b64encode(hashlib.sha256(text.encode()).digest()).decode() for text in inline]
    scripts = " ".join(f"'sha256-{digest}'" for digest in hashes)
    policy = (
        f"default-src 'none'; script-src 'self' {scripts}; style-src 'self'; img-src 'self' data:; connect-src 'self'; "
        "frame-ancestors 'none'; base-uri 'none'; form-action 'none'"
    )
    return {
        "Content-Security-Policy": policy,
        "X-Content-Type-Options": "nosniff",
        "Referrer-Policy": "no-referrer",
        "Cache-Control": "no-store",
    }


MOST_CONNECTIONS = 64  # connections at once, those that have not asked for anything yet included
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
    """Serve a stage until Ctrl-C; `listening` is called with the page's address, token included. InputError if `host`
    (0.0.0.0 or :: for all addresses of this machine) and `port` (0 for a free one) cannot be listened on."""
    token = secrets.token_urlsafe(_TOKEN_BYTES)
    with listen(host, port) as listener:
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
        shown = ("127.0.0.1" if listener.family == socket.AF_INET else "::1") if everywhere else host
        listening(f"http://{f'[{shown}]' if ':' in shown else shown}:{number}/?token={token}")
        uvicorn.Server(config).run(sockets=[listener])


def machine_names() -> set[str]:
    """Return the names that this machine has for others, in lower case."""
    name = socket.gethostname().lower()
    return {name, name.partition(".")[0], socket.getfqdn().lower()}
