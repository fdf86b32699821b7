"""Runner with a fixed rate: each agent steps at its own rate with the messages received so far. For protocols that tolerate message loss,
delay and reordering.

After a start or restart an agent stands still and sends only greetings. It begins when it has heard all its neighbours, or `PATIENCE` after
the first one; while it has heard none it waits. An agent without neighbours begins at once.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, Final

import numpy as np

from consat.network.node.core import Moment
from consat.network.node.station import Station
from consat.network.wire import Kind

PATIENCE: Final = 3.0
"""Largest waiting time for further neighbours after the first one was heard, s."""
GREETING: Final = 0.05
"""Time between greetings, s."""
FAREWELLS: Final = 30
"""Number of messages in which a leaving agent announces it: enough under heavy message loss."""


class FixedRate:
    """Runner of one agent with a fixed rate.

    Args:
        station: the agent's station.
        rate: steps per second, Hz.
        turns: number of steps; None for no end.
        stale: time without a message, s, after which a neighbour does not count as fresh; at least 3 periods.
    """

    def __init__(self, station: Station, rate: float, turns: int | None = None, stale: float = 0.5) -> None:
        self.station = station
        self.done = False
        self._period, self._turns, self._stale = 1.0 / rate, turns, max(stale, 3.0 / rate)
        self._latest: dict[str, Sequence[np.ndarray]] = {}
        self._state: Any = None
        self._count = self._regrouped = 0
        self._due = self._last = station.clock()
        self._begun = False
        self._first_heard: float | None = None
        self._farewells = 0

    def leave(self) -> None:
        """Leave for good: announce it in `FAREWELLS` messages, then be done."""
        self.station.membership.drop(self.station.part.me)
        self._farewells = FAREWELLS

    def change(self, constraint: str, parameters: Mapping[str, Any]) -> None:
        """See `Runner.change` and `Station.change`."""
        self._state = self.station.change(self._state, constraint, parameters)

    def step(self) -> float:
        """See `Runner.step`."""
        station = self.station
        for message in station.receive():
            if message.kind is Kind.STATE:
                self._latest[message.source] = message.arrays
        now = station.clock()
        if now < self._due:
            return self._due
        if self._farewells:
            self._farewell()
        elif self._begun or self._ready(now):
            self._due = max(self._due + self._period, now)
            self._turn(now)
        else:
            self._due = now + GREETING
            station.send_hello()
        station.watch()
        return self._due

    def _farewell(self) -> None:
        self._due += self._period
        self._farewells -= 1
        self.done = self._farewells == 0
        self.station.send_hello()

    def _ready(self, now: float) -> bool:
        station = self.station
        if station.body.position() is None or not station.timed:
            return False
        heard = [np.isfinite(station.peers.all[neighbour].heard) for neighbour in station.present]
        if any(heard) and self._first_heard is None:
            self._first_heard = now
        late = self._first_heard is not None and now - self._first_heard > PATIENCE
        self._begun = all(heard) or late
        if self._begun:
            self._due = self._last = now
            self._state = station.core.begin(station.present_rows(station.first()), station.now())
        return self._begun

    def _turn(self, now: float) -> None:
        station = self.station
        if station.changed:
            self._state = station.regroup(self._state, station.first())
            self._regrouped = self._count
        self._state = station.check_restarts(self._state)
        inbox, arrived = station.core.empty()
        for neighbour, arrays in self._latest.items():
            station.deliver(neighbour, arrays, inbox, arrived)
        self._latest.clear()
        moment = Moment(
            float(self._count - self._regrouped), now - self._last, station.delays(), station.fresh(self._stale), station.place(),
            time=station.now(),
        )  # fmt: skip
        self._state, outbox, view = station.turn(self._state, inbox, arrived, moment)
        self._last = now
        self._count += 1
        outbox, listeners = station.filter(outbox)
        station.send(station.blocks(outbox), among=listeners)
        station.move(view, now)
        if self._turns is not None and self._count >= self._turns:
            self.done = True
