"""A small team that lives, for all tests of a module, and clients of it."""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Iterator
from typing import Any

import pytest
from starlette.testclient import TestClient, WebSocketTestSession

import consat as cs
from consat.server.app import Host
from consat.server.frames import HEADER
from consat.server.simulation import Simulation

SOCKET = "ws://127.0.0.1:8137/socket"


def pair() -> cs.Team:
    """Two agents, each with a goal, one near the other."""
    one = cs.Agent("a", [cs.within([2, 0], 1, name="goal")], [0, 1])
    other = cs.Agent("b", [cs.within([-2, 0], 1, name="goal"), cs.near("a", 5)], [0, -1])
    return cs.Team([one, other])


class Page:
    """What a page does, without one."""

    def __init__(self, socket: WebSocketTestSession) -> None:
        self.socket, self.number = socket, 2**40  # others than those of the fuzz
        self.newest: dict[str, Any] = {}
        self.frames = 0

    def read(self) -> dict[str, Any] | None:
        """The next message; of a frame its numbers."""
        message = self.socket.receive()
        if message.get("bytes") is not None:
            *_, round_, margin, scene = HEADER.unpack(message["bytes"][:16])
            self.newest["frame"] = {"round": round_, "margin": margin, "scene": scene, "bytes": message["bytes"]}
            self.frames += 1
            return None
        told: dict[str, Any] = json.loads(message["text"])
        self.newest[told["type"]] = told
        return told

    def send(self, order: dict[str, Any]) -> dict[str, Any]:
        """Give an order, and wait for its answer."""
        self.number += 1
        self.socket.send_text(json.dumps(order | {"id": self.number}))
        while True:
            told = self.read()
            if told is not None and told["type"] == "answer" and told["id"] == self.number:
                return told

    def until(self, holds: Callable[[dict[str, Any]], bool], seconds: float = 60.0) -> dict[str, Any]:
        """Read until something holds of the newest."""
        end = time.monotonic() + seconds
        while not holds(self.newest):
            assert time.monotonic() < end, self.newest.keys()
            self.read()
        return self.newest


@pytest.fixture(scope="module")
def host() -> Iterator[Host]:
    simulation = Simulation(pair(), seed=1)
    found = Host(simulation)
    simulation.start()
    yield found
    simulation.close()
    assert not simulation.alive


@pytest.fixture(scope="module")
def client(host: Host) -> Iterator[TestClient]:
    with TestClient(host.app, base_url="http://127.0.0.1:8137") as found:
        yield found


@pytest.fixture
def page(client: TestClient) -> Iterator[Page]:
    with client.websocket_connect(SOCKET) as socket:
        found = Page(socket)
        found.until(lambda newest: {"scene", "state", "frame"} <= newest.keys())
        yield found
