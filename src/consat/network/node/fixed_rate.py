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
from consat.network.node.runner import Runner
from consat.network.node.station import SILENT, Station
from consat.network.wire import Kind

PATIENCE: Final = 3.0
"""Largest waiting time for further neighbours after the first one was heard, s."""
GREETING: Final = 0.05
"""Time between greetings, s."""


class FixedRate(Runner):
    """Runner of one agent with a fixed rate."""

    def __init__(self, station: Station) -> None:
        super().__init__(station)
        self._period = station.settings.period
        self._latest: dict[str, Sequence[np.ndarray]] = {}
        self._due = self._last = station.clock()
        self._first_heard: float | None = None

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
            self._due += self._period
            self._say_farewell()
        elif self._state is not None or self._ready(now):
            self._due = max(self._due + self._period, now)
            self._turn(now)
        else:
            self._due = now + GREETING
            station.send_hello()
        station.watch()
        return self._due

    def _ready(self, now: float) -> bool:
        """Whether the agent can begin; then it has a state."""
        station = self.station
        if station.body.position() is None or not station.timed:
            return False
        heard = [np.isfinite(station.peers.all[neighbour].heard) for neighbour in station.present]
        if any(heard) and self._first_heard is None:
            self._first_heard = now
        if not (all(heard) or (self._first_heard is not None and now - self._first_heard > PATIENCE)):
            return False
        self._due = self._last = now
        self._state = station.core.begin(station.first(), station.now())
        return True

    def _turn(self, now: float) -> None:
        station = self.station
        if station.changed:
            self._state = station.regroup(self._state)
            self._regrouped = self._round
        self._state = station.check_restarts(self._state)
        inbox, arrived = station.core.empty()
        for neighbour, arrays in self._latest.items():
            station.codec.decode(neighbour, arrays, inbox, arrived)
        self._latest.clear()
        fresh = station.fresh(max(SILENT, 3.0 * self._period))
        number, elapsed = float(self._round - self._regrouped), now - self._last
        moment = Moment(number, elapsed, station.delays(), fresh, station.place(), time=station.now())
        self._state, outbox, view = station.turn(self._state, inbox, arrived, moment)
        self._last = now
        self._round += 1
        outbox, listeners = station.filter(outbox)
        station.send(station.codec.encode(outbox), listeners)
        station.move(view, now)
        self.done = station.settings.turns is not None and self._round >= station.settings.turns
