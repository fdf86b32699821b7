"""Wraps a transport with seeded loss and delay of incoming messages, for experiments on a network that works."""

from __future__ import annotations

import heapq
import itertools
from collections.abc import Callable

import numpy as np

from consat.network.transports import Transport


class Weathered:
    """A transport that loses and delays the messages that arrive over another one.

    Args:
        inner: the wrapped transport.
        clock: clock of this agent, s.
        loss: probability that an incoming message is dropped.
        delay: (low, high) range of the random delay of each message, s. Different delays also reorder messages.
        seed: seed of the random draws.
    """

    def __init__(
        self, inner: Transport, clock: Callable[[], float], *, loss: float = 0.0, delay: tuple[float, float] = (0.0, 0.0), seed: int = 0
    ) -> None:
        self._inner, self._clock, self._loss, self._delay = inner, clock, loss, delay
        self._random = np.random.default_rng(seed)
        self._held: list[tuple[float, int, bytes]] = []
        self._order = itertools.count()

    def send(self, neighbour: str, payload: bytes) -> None:
        self._inner.send(neighbour, payload)

    def _take(self) -> None:
        now = self._clock()
        for payload in self._inner.receive():
            if self._random.random() >= self._loss:
                heapq.heappush(self._held, (now + self._random.uniform(*self._delay), next(self._order), payload))

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
