"""Each agent takes its turns at a rate of its own, with whatever has come by then: for protocols that bear loss, delay and disorder.

After a start or restart an agent stands still and is silent but for greetings, until it has heard its neighbours, or one of them and then
`PATIENCE`; with none it waits.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, Final

import numpy as np

from consat.network.node.core import Moment
from consat.network.node.station import Station
from consat.network.wire import Kind

PATIENCE: Final = 3.0
"""s."""
GREETING: Final = 0.05
"""Time between greetings, s."""
FAREWELLS: Final = 30
"""So often an agent that leaves for good says so: enough under heavy loss."""


class Paced:
    """One agent in time.

    Args:
        station: its own.
        rate: turns a second, Hz.
        turns: how many; None for no end.
        stale: a neighbour not heard for so long, s, does not count as fresh; if None, as long as `Station` takes it to be up.
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
        """Leave for good: say so for a while, then be done."""
        self.station.membership.drop(self.station.part.me)
        self._farewells = FAREWELLS

    def change(self, constraint: str, parameters: Mapping[str, Any]) -> None:
        """See `Station.change`."""
        self._state = self.station.change(self._state, constraint, parameters)

    def step(self) -> float:
        """Do what is due; when to be called again at the latest."""
        station = self.station
        for message in station.hear():
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
            station.greet()
        station.watch()
        return self._due

    def _farewell(self) -> None:
        self._due += self._period
        self._farewells -= 1
        self.done = self._farewells == 0
        self.station.greet()

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
            self._state = station.core.begin(station.among(station.first()), station.now())
        return self._begun

    def _turn(self, now: float) -> None:
        station = self.station
        if station.changed:
            self._state = station.regroup(self._state, station.first())
            self._regrouped = self._count
        self._state = station.reborn(self._state)
        inbox, arrived = station.empty()
        for neighbour, told in self._latest.items():
            station.sort(neighbour, told, inbox, arrived)
        self._latest.clear()
        moment = Moment(
            float(self._count - self._regrouped), now - self._last, station.delays(), station.fresh(self._stale), station.place(),
            time=station.now(),
        )  # fmt: skip
        self._state, outbox, look = station.turn(self._state, inbox, arrived, moment)
        self._last = now
        self._count += 1
        outbox, listeners = station.sift(outbox)
        station.say(station.blocks(outbox), among=listeners)
        station.move(look, now)
        if self._turns is not None and self._count >= self._turns:
            self.done = True
