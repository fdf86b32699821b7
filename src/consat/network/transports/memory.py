"""A network in memory, on a clock of its own: the same seed gives the same run, to the last bit. For tests and rehearsals."""

from __future__ import annotations

import heapq
import itertools
from collections import deque
from collections.abc import Collection, Iterable
from dataclasses import dataclass

import numpy as np

from consat.network.transports import Transport

QUEUE = 4096
"""An agent that does not fetch its messages keeps so many, the newest."""


@dataclass(frozen=True)
class Conditions:
    """What happens to messages on the way.

    Attributes:
        loss: probability that one is lost.
        delay: (low, high) how long one takes, s; as each draws its own, they come in disorder.
        repeat: probability that one comes twice.
    """

    loss: float = 0.0
    delay: tuple[float, float] = (1e-4, 1e-4)
    repeat: float = 0.0


class Air:
    """Through which all messages go.

    Args:
        conditions: what happens to them.
        seed: of the draws.
    """

    def __init__(self, conditions: Conditions | None = None, seed: int = 0) -> None:
        self.conditions = conditions or Conditions()
        self.now = 0.0
        self._random = np.random.default_rng(seed)
        self._flying: list[tuple[float, int, str, bytes]] = []
        self._order = itertools.count()
        self._open: dict[str, _Endpoint] = {}
        self._parts: tuple[frozenset[str], ...] = ()

    def clock(self) -> float:
        """Now, s."""
        return self.now

    def partition(self, *parts: Collection[str]) -> None:
        """From now on nothing passes between agents of different parts; without arguments, everything does again."""
        self._parts = tuple(map(frozenset, parts))

    def endpoint(self, me: str, neighbours: Iterable[str]) -> Transport:
        """The transport of one agent, in place of any that it had."""
        self._open[me] = _Endpoint(self, me, frozenset(neighbours))
        return self._open[me]

    def next(self) -> float:
        """When the next message arrives; ∞ if none is on its way."""
        return self._flying[0][0] if self._flying else np.inf

    def deliver(self) -> set[str]:
        """Hand over the messages that have arrived by now; to whom."""
        reached = set()
        while self._flying and self._flying[0][0] <= self.now:
            _, _, to, payload = heapq.heappop(self._flying)
            if to in self._open:
                self._open[to].queue.append(payload)
                reached.add(to)
        return reached

    def apart(self, a: str, b: str) -> bool:
        """Whether a partition lies between two agents."""
        return any((a in part) != (b in part) for part in self._parts)

    def up(self, agent: str) -> bool:
        """Whether an agent has an endpoint."""
        return agent in self._open

    def post(self, source: str, to: str, payload: bytes) -> None:
        """Send a message on its way."""
        conditions = self.conditions
        for _ in range(1 + (self._random.random() < conditions.repeat)):
            if self._random.random() >= conditions.loss and not self.apart(source, to):
                heapq.heappush(self._flying, (self.now + self._random.uniform(*conditions.delay), next(self._order), to, payload))

    def close(self, agent: str, endpoint: _Endpoint | None = None) -> None:
        """Take an agent off the air, as a crash does; or a certain endpoint of it, if it still has that."""
        if endpoint is None or self._open.get(agent) is endpoint:
            self._open.pop(agent, None)


class _Endpoint:
    """`Transport` of one agent."""

    def __init__(self, air: Air, me: str, neighbours: frozenset[str]) -> None:
        self._air, self._me, self._neighbours = air, me, neighbours
        self.queue: deque[bytes] = deque(maxlen=QUEUE)

    def send(self, neighbour: str, payload: bytes) -> None:
        if neighbour in self._neighbours:
            self._air.post(self._me, neighbour, payload)

    def receive(self) -> list[bytes]:
        found = list(self.queue)
        self.queue.clear()
        return found

    def wait(self, timeout: float) -> bool:
        """Time does not pass by waiting here: whoever moves the clock calls the agent when something has come."""
        return bool(self.queue)

    def alive(self) -> frozenset[str]:
        return frozenset(agent for agent in self._neighbours if self._air.up(agent) and not self._air.apart(self._me, agent))

    def close(self) -> None:
        self._air.close(self._me, self)
