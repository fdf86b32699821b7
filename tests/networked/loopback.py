"""What tests of real links need: free ports on 127.0.0.1, patience with an end, agents that are closed whatever happens."""

from __future__ import annotations

import contextlib
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Mapping
from typing import Any

import numpy as np

from consat.network.transports import Transport
from consat.network.transports.zenoh import connect
from consat.network.wire import Kind, Message, encode

PATIENCE = 20.0
"""Seconds after which a test gives up; nothing takes so long, even on a busy machine."""
SILENCE = 1.0
"""Seconds in which a message that passes would have come many times over: it takes a millisecond."""


def endpoints(count: int, protocol: str = "tcp") -> list[str]:
    """Addresses at which nobody listens yet."""
    with contextlib.ExitStack() as stack:
        sockets = [stack.enter_context(socket.socket()) for _ in range(count)]
        for each in sockets:
            each.bind(("127.0.0.1", 0))
        return [f"{protocol}/127.0.0.1:{each.getsockname()[1]}" for each in sockets]


def until(condition: Callable[[], Any], timeout: float = PATIENCE) -> float:
    """Wait for it; how long that took."""
    began = time.monotonic()
    while not condition():
        assert time.monotonic() - began < timeout, f"nothing after {timeout} s"
        time.sleep(0.002)
    return time.monotonic() - began


class Team:
    """Agents in this process."""

    def __init__(self, run: str = "test") -> None:
        self.run = run
        self.transports: list[Any] = []

    def join(self, me: str, listen: str, neighbours: Mapping[str, str], **options: Any) -> Any:
        """One more agent."""
        transport = connect(options.pop("run", self.run), me, listen, neighbours, **options)
        self.transports.append(transport)
        return transport

    def pair(self, a: str = "a", b: str = "b", **options: Any) -> tuple[Any, Any]:
        """Two that see each other."""
        at_a, at_b = endpoints(2)
        first, second = self.join(a, at_a, {b: at_b}, **options), self.join(b, at_b, {a: at_a}, **options)
        until(lambda: first.alive() and second.alive())
        return first, second


@contextlib.contextmanager
def team(run: str = "test") -> Iterator[Team]:
    """Agents that are closed in the end."""
    agents = Team(run)
    try:
        yield agents
    finally:
        for transport in agents.transports:
            transport.close()


@contextlib.contextmanager
def process(code: str, *arguments: str) -> Iterator[subprocess.Popen[bytes]]:
    """Another Python process, killed in the end."""
    child = subprocess.Popen([sys.executable, "-c", code, *arguments])
    try:
        yield child
    finally:
        child.kill()
        child.wait(PATIENCE)


def letter(source: str, destination: str, sequence: int = 1, *numbers: float) -> bytes:
    """A well-formed message."""
    arrays = (np.array(numbers or (0.5,)),)
    return encode(Message(Kind.STATE, bytes(8), source, destination, 1, sequence, 0.0, float("nan"), 0, 5.0, arrays))


def delivered(sender: Callable[[], Any], receiver: Transport, seconds: float = SILENCE) -> list[bytes]:
    """What the receiver gets while `sender` is called every 10 ms."""
    got: list[bytes] = []
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        sender()
        receiver.wait(0.01)
        got += receiver.receive()
    return got


def gathered(receiver: Transport, count: int) -> list[bytes]:
    """The next `count` messages, at least."""
    got: list[bytes] = []
    end = time.monotonic() + PATIENCE
    while len(got) < count:
        assert time.monotonic() < end, f"{len(got)} messages of {count} came"
        receiver.wait(0.1)
        got += receiver.receive()
    return got
