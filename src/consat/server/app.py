"""The web server: one page and one socket. A slow client gets the latest content when it is ready; nothing is queued for it."""

from __future__ import annotations

import asyncio
import hmac
import itertools
import re
from contextlib import suppress
from typing import Final
from urllib.parse import urlsplit

from starlette.applications import Starlette
from starlette.requests import HTTPConnection, Request
from starlette.responses import HTMLResponse, PlainTextResponse, Response
from starlette.routing import Route, WebSocketRoute
from starlette.websockets import WebSocket, WebSocketDisconnect

from consat.server.client import MOST_CLIENTS, Client
from consat.server.page import page
from consat.server.simulation import Simulation

LOOPBACK: Final = ("127.0.0.1", "localhost", "::1")
"""Names of this machine, by which a page is served without a token."""


class Watcher(Client):
    """A page that watches over a socket.

    Attributes:
        came: event that is set when there may be news to send.
    """

    def __init__(self, number: int, simulation: Simulation, loop: asyncio.AbstractEventLoop) -> None:
        self.came, self._loop = asyncio.Event(), loop
        super().__init__(number, simulation, self._wake_up)

    def _wake_up(self) -> None:
        with suppress(RuntimeError):  # the server has ended
            self._loop.call_soon_threadsafe(self.came.set)


class Host:
    """Serves a simulation to the pages that may see it.

    Args:
        simulation: the simulation.
        token: token that the address must end with; None if only this machine can connect.
    """

    def __init__(self, simulation: Simulation, token: str | None = None) -> None:
        self.simulation, self._token = simulation, token
        self._clients: dict[int, Watcher] = {}
        self._numbers = itertools.count()
        self._loop: asyncio.AbstractEventLoop | None = None
        simulation.notify = self.notify
        self.app = Starlette(routes=[Route("/", self.page), WebSocketRoute("/socket", self.socket)])

    def notify(self) -> None:
        """Tell all clients that there is news. May be called from any thread."""
        if self._loop is not None:
            with suppress(RuntimeError):  # the server has ended
                self._loop.call_soon_threadsafe(self._wake)

    def _wake(self) -> None:
        for client in self._clients.values():
            client.came.set()

    def _refusal(self, connection: HTTPConnection) -> str | None:
        """Reason to refuse a connection; None to accept it."""
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
        return None if name in LOOPBACK else "this server answers to addresses of this machine only"

    async def page(self, request: Request) -> Response:
        """Serve the page."""
        if refusal := self._refusal(request):
            return PlainTextResponse(f"{refusal}\n", 403)
        host = request.headers.get("host", "")
        text, policy = page(self.simulation.name, f"ws://{host} wss://{host}" if re.fullmatch(r"[\w.:\[\]-]+", host) else "'self'")
        headers = {
            "Content-Security-Policy": f"{policy}; frame-ancestors 'none'",
            "X-Content-Type-Options": "nosniff",
            "Referrer-Policy": "no-referrer",
            "Cache-Control": "no-store",
        }
        return HTMLResponse(text, headers=headers)

    async def socket(self, socket: WebSocket) -> None:
        """Serve the socket of a page until it closes."""
        refusal = self._refusal(socket)
        if refusal is None and len(self._clients) >= MOST_CLIENTS:
            refusal = f"{MOST_CLIENTS} pages watch already"
        if refusal is not None:
            await socket.close(1008, refusal)
            return
        await socket.accept()
        self._loop = asyncio.get_running_loop()
        client = Watcher(next(self._numbers), self.simulation, self._loop)
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

    async def _listen(self, socket: WebSocket, client: Watcher) -> None:
        while True:
            message = await socket.receive()
            if message["type"] == "websocket.disconnect":
                return
            client.take(message.get("text") or message.get("bytes") or b"")

    async def _send(self, socket: WebSocket, client: Watcher) -> None:
        while True:
            client.came.clear()
            for content in client.news():
                if isinstance(content, bytes):
                    await socket.send_bytes(content)
                else:
                    await socket.send_text(content)
            if not self.simulation.alive:
                await socket.close(1001, "the session has ended")
                return
            if not client.answers:
                await client.came.wait()
