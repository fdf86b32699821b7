"""A simulated network in memory with a simulated clock. The same seed gives the same run, bit for bit. For tests and rehearsals."""

from __future__ import annotations

import heapq
import itertools
from collections import deque
from collections.abc import Collection, Iterable

import numpy as np

from consat.faults import Channel, Faults
from consat.network.transports import Transport

QUEUE = 4096
"""Largest number of messages that wait for an agent; the oldest are dropped."""
LATENCY = 1e-4
"""Time that every message takes, s."""


class MemoryNetwork:
    """The simulated network that carries the messages of all agents.

    Args:
        faults: faults of its messages, in addition to `LATENCY`.

    Attributes:
        now: simulated time, s; the owner of the network advances it.
    """

    def __init__(self, faults: Faults | None = None) -> None:
        self._faults = faults or Faults()
        self.now = 0.0
        self._random = np.random.default_rng(self._faults.seed)
        self._channels: dict[tuple[str, str], Channel] = {}
        self._flying: list[tuple[float, int, str, bytes]] = []
        self._order = itertools.count()
        self._open: dict[str, _Endpoint] = {}
        self._parts: tuple[frozenset[str], ...] = ()

    def clock(self) -> float:
        """The simulated time, s."""
        return self.now

    def partition(self, *parts: Collection[str]) -> None:
        """Block messages between agents of different parts from now on. Without arguments, remove the partition."""
        self._parts = tuple(map(frozenset, parts))

    def endpoint(self, me: str, neighbours: Iterable[str]) -> Transport:
        """A new transport for an agent, which replaces any earlier one.

        Args:
            me: id of the agent.
            neighbours: ids of its neighbours.
        """
        self._open[me] = _Endpoint(self, me, frozenset(neighbours))
        return self._open[me]

    def next(self) -> float:
        """The time at which the next message arrives, s; ∞ if none is under way."""
        return self._flying[0][0] if self._flying else np.inf

    def deliver(self) -> set[str]:
        """Deliver the messages that are due at `now`. Returns the ids of the agents that received any."""
        reached = set()
        while self._flying and self._flying[0][0] <= self.now:
            _, _, to, payload = heapq.heappop(self._flying)
            if to in self._open:
                self._open[to].queue.append(payload)
                reached.add(to)
        return reached

    def apart(self, a: str, b: str) -> bool:
        """Whether a partition separates two agents."""
        return any((a in part) != (b in part) for part in self._parts)

    def up(self, agent: str) -> bool:
        """Whether an agent has an open endpoint."""
        return agent in self._open

    def post(self, source: str, to: str, payload: bytes) -> None:
        """Send a message from `source` to `to`, subject to loss, delay, duplication and partitions."""
        channel = self._channels.setdefault((source, to), Channel(self._faults, self._random))
        for delay in channel.delays():
            if not self.apart(source, to):
                heapq.heappush(self._flying, (self.now + LATENCY + delay, next(self._order), to, payload))

    def close(self, agent: str, endpoint: _Endpoint | None = None) -> None:
        """Close the endpoint of an agent, as a crash does. If `endpoint` is given, only if it is still the agent's current one."""
        if endpoint is None or self._open.get(agent) is endpoint:
            self._open.pop(agent, None)


class _Endpoint:
    """The `Transport` of one agent on the simulated network."""

    def __init__(self, network: MemoryNetwork, me: str, neighbours: frozenset[str]) -> None:
        self._network, self._me, self._neighbours = network, me, neighbours
        self.queue: deque[bytes] = deque(maxlen=QUEUE)

    def send(self, neighbour: str, payload: bytes) -> None:
        if neighbour in self._neighbours:
            self._network.post(self._me, neighbour, payload)

    def receive(self) -> list[bytes]:
        found = list(self.queue)
        self.queue.clear()
        return found

    def wait(self, timeout: float) -> bool:
        """Whether messages have arrived. Returns at once, because waiting does not advance the simulated clock."""
        return bool(self.queue)

    def alive(self) -> frozenset[str]:
        return frozenset(agent for agent in self._neighbours if self._network.up(agent) and not self._network.apart(self._me, agent))

    def close(self) -> None:
        self._network.close(self._me, self)
