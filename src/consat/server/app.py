"""The web server: one page and one socket. A client that is slow gets the newest when it is ready for it; nothing is kept for it."""

from __future__ import annotations

import asyncio
import base64
import hashlib
import hmac
import itertools
import json
import re
import time
from collections import deque
from contextlib import suppress
from html import escape
from importlib import resources
from typing import Any, Final
from urllib.parse import urlsplit

from starlette.applications import Starlette
from starlette.requests import HTTPConnection, Request
from starlette.responses import HTMLResponse, PlainTextResponse, Response
from starlette.routing import Route, WebSocketRoute
from starlette.websockets import WebSocket, WebSocketDisconnect

from consat import __version__
from consat.errors import InvalidSettings
from consat.server.orders import number_of, parse
from consat.server.simulation import Simulation

MOST_CLIENTS, MOST_ANSWERS = 16, 64
RATE, BURST = 200.0, 400.0
"""Messages a second that a client may send, and how many at once."""
LOOPBACK: Final = ("127.0.0.1", "localhost", "::1")


class Allowance:
    """How much a client may still send: a bucket that fills at a rate.

    Args:
        rate: messages a second.
        burst: what it holds.
    """

    def __init__(self, rate: float = RATE, burst: float = BURST) -> None:
        self._rate, self._burst = rate, burst
        self._left, self._at = burst, time.monotonic()

    def take(self) -> bool:
        """Whether one more is allowed."""
        now = time.monotonic()
        self._left = min(self._burst, self._left + self._rate * (now - self._at))
        self._at = now
        if self._left < 1.0:
            return False
        self._left -= 1.0
        return True


class Client:
    """One page that watches.

    Attributes:
        number: tells clients apart.
        news: set when there may be something to send.
        answers: to its orders; of too many the oldest are lost.
    """

    def __init__(self, number: int, loop: asyncio.AbstractEventLoop) -> None:
        self.number, self._loop = number, loop
        self.news = asyncio.Event()
        self.answers: deque[str] = deque(maxlen=MOST_ANSWERS)
        self.allowance = Allowance()

    def answer(self, told: dict[str, Any]) -> None:
        """Answer an order; from any thread."""
        self.answers.append(json.dumps(told, allow_nan=False))
        with suppress(RuntimeError):  # the server has ended
            self._loop.call_soon_threadsafe(self.news.set)


class Host:
    """Shows a simulation to everybody who may see it.

    Args:
        simulation: what is shown.
        token: what the address must end with; None where the loopback is the only way in.
        hosts: names under which the server is reached; any, where a token is asked for.
    """

    def __init__(self, simulation: Simulation, token: str | None = None, hosts: tuple[str, ...] = LOOPBACK) -> None:
        self.simulation, self._token, self._hosts = simulation, token, hosts
        self._clients: dict[int, Client] = {}
        self._numbers = itertools.count()
        self._loop: asyncio.AbstractEventLoop | None = None
        simulation.notify = self.notify
        self.app = Starlette(routes=[Route("/", self.page), WebSocketRoute("/socket", self.socket)])

    def notify(self) -> None:
        """Tell all clients that there is news; from any thread."""
        if self._loop is not None:
            with suppress(RuntimeError):  # the server has ended
                self._loop.call_soon_threadsafe(self._wake)

    def _wake(self) -> None:
        for client in self._clients.values():
            client.news.set()

    # ---- who may come in ----------------------------------------------------------------------------------------------------------------

    def _refusal(self, connection: HTTPConnection) -> str | None:
        """Why somebody may not come in."""
        host = connection.headers.get("host", "")
        origin = connection.headers.get("origin")
        if origin is not None and urlsplit(origin).netloc != host:
            return "this page may not be asked by pages of other origins"
        if self._token is not None:
            given = connection.query_params.get("token", "")
            fits = hmac.compare_digest(given.encode(), self._token.encode())
            return None if fits else "the address lacks the token that consat live printed"
        try:
            name = urlsplit(f"//{host}").hostname
        except ValueError:
            name = None
        return None if name in self._hosts else "this server answers to addresses of this machine only"

    async def page(self, request: Request) -> Response:
        """The page."""
        if refusal := self._refusal(request):
            return PlainTextResponse(f"{refusal}\n", 403)
        text, policy = page(self.simulation.name, request.headers.get("host", ""))
        headers = {
            "Content-Security-Policy": policy,
            "X-Content-Type-Options": "nosniff",
            "Referrer-Policy": "no-referrer",
            "Cache-Control": "no-store",
        }
        return HTMLResponse(text, headers=headers)

    async def socket(self, socket: WebSocket) -> None:
        """What a page sends and is sent."""
        refusal = self._refusal(socket)
        if refusal is None and len(self._clients) >= MOST_CLIENTS:
            refusal = f"{MOST_CLIENTS} pages watch already"
        if refusal is not None:
            await socket.close(1008, refusal)
            return
        await socket.accept()
        self._loop = asyncio.get_running_loop()
        client = Client(next(self._numbers), self._loop)
        self._clients[client.number] = client
        self.simulation.watch(len(self._clients))
        sending = asyncio.create_task(self._send(socket, client))
        try:
            await self._listen(socket, client)
        finally:
            del self._clients[client.number]
            self.simulation.watch(len(self._clients))
            sending.cancel()
            with suppress(asyncio.CancelledError, WebSocketDisconnect, RuntimeError):
                await sending

    async def _listen(self, socket: WebSocket, client: Client) -> None:
        while True:
            message = await socket.receive()
            if message["type"] == "websocket.disconnect":
                return
            raw: str | bytes = message.get("text") or message.get("bytes") or b""
            if not client.allowance.take():
                client.answer(_no(raw, f"more than {RATE:g} messages a second; this one was ignored"))
                continue
            try:
                order = parse(raw)
            except InvalidSettings as error:
                client.answer(_no(raw, str(error)))
                continue
            self.simulation.ask(order, client.number, client.answer)

    async def _send(self, socket: WebSocket, client: Client) -> None:
        seen: dict[str, int] = {}
        while True:
            client.news.clear()
            ready = len(client.answers)  # what they tell of is among the news by now, and is sent first
            for content in self.simulation.board.news(seen):
                if isinstance(content, bytes):
                    await socket.send_bytes(content)
                else:
                    await socket.send_text(content)
            for _ in range(min(ready, len(client.answers))):
                await socket.send_text(client.answers.popleft())
            if not self.simulation.alive:
                await socket.close(1001, "the session has ended")
                return
            if not client.answers:
                await client.news.wait()


def _no(raw: str | bytes, words: str) -> dict[str, Any]:
    return {"type": "answer", "id": number_of(raw), "ok": False, "words": words[:1000]}


def page(name: str, host: str) -> tuple[str, str]:
    """The page, and the policy that lets it run what it came with and nothing else."""
    views, own = resources.files("consat.views"), resources.files("consat.server")
    style = "".join((views / each).read_text(encoding="utf-8") for each in ("page.css", "live.css"))
    script, html = (views / "live.js").read_text(encoding="utf-8"), (own / "live.html").read_text(encoding="utf-8")
    hashes = [f"'sha256-{base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()}'" for text in (script, style)]
    reach = f"ws://{host} wss://{host}" if re.fullmatch(r"[\w.:\[\]-]+", host) else "'self'"
    policy = (
        f"default-src 'none'; script-src {hashes[0]}; style-src {hashes[1]}; connect-src 'self' {reach}; "
        "img-src data:; base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
    )
    parts = {"version": __version__, "name": escape(name), "style": style, "script": script}
    return re.sub(r"@(\w+)@", lambda found: parts[found[1]], html), policy
