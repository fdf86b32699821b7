"""Wraps a transport with seeded faults of incoming messages, for experiments on a network that works."""

from __future__ import annotations

import heapq
import itertools
from collections.abc import Callable

import numpy as np

from consat.faults import Channel, Faults
from consat.network.transports import Transport


class FaultyTransport:
    """A transport on which incoming messages suffer faults.

    Args:
        inner: the wrapped transport.
        clock: clock of this agent, s.
        faults: what goes wrong with messages.
    """

    def __init__(self, inner: Transport, clock: Callable[[], float], faults: Faults) -> None:
        self._inner, self._clock = inner, clock
        self._channel = Channel(faults, np.random.default_rng(faults.seed))
        self._held: list[tuple[float, int, bytes]] = []
        self._order = itertools.count()

    def send(self, neighbour: str, payload: bytes) -> None:
        self._inner.send(neighbour, payload)

    def _take(self) -> None:
        now = self._clock()
        for payload in self._inner.receive():
            for delay in self._channel.delays():
                heapq.heappush(self._held, (now + delay, next(self._order), payload))

    def receive(self) -> list[bytes]:
        self._take()
        now, ripe = self._clock(), []
        while self._held and self._held[0][0] <= now:
            ripe.append(heapq.heappop(self._held)[2])
        return ripe

    def wait(self, timeout: float) -> bool:
        end = self._clock() + timeout
        while True:
            self._take()
            now = self._clock()
            if self._held and self._held[0][0] <= now:
                return True
            if now >= end:
                return False
            self._inner.wait(min(end, self._held[0][0] if self._held else end) - now)

    def alive(self) -> frozenset[str]:
        return self._inner.alive()

    def close(self) -> None:
        self._inner.close()
