"""Runner in lockstep: round r+1 waits for round r of every neighbour. Every protocol in rounds runs exactly as in a single process; message
loss and delay only cost time. An agent that is down stops its neighbours until it is back.

Each message contains the rounds r and r − 1, because a neighbour can lack only these: it waits for r − 1 or for r. A waiting agent repeats
its last message. An agent stores its state before it sends, so that it sends the same message again after a crash. An agent that has lost
its stored state restarts in the round of its slowest neighbour; a protocol that converges from every state tolerates that.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from collections.abc import Set as AbstractSet
from typing import Any, Final

import jax
import numpy as np

from consat.errors import InvalidSettings
from consat.network.node.core import IndexMap, Moment, Rows
from consat.network.node.persistence import Store
from consat.network.node.runner import Runner
from consat.network.node.station import SILENT, Station
from consat.network.wire import SUPPORT, Kind
from consat.runs.options import RATE as ROUNDS_A_SECOND

RESEND: Final = 0.006
"""Smallest time after which a waiting agent repeats its message, s. It is `USUAL` times the duration of the fastest recent rounds if that
is longer, and doubles with every repetition up to `SELDOM`."""
USUAL: Final = 4.0
SELDOM: Final = 0.2
"""Largest time between repetitions, s: where rounds are slow because the machine is busy, more messages would make it slower."""


class Lockstep(Runner):
    """Runner of one agent in lockstep. After the last round it still repeats it for neighbours that lack it."""

    def __init__(self, station: Station) -> None:
        super().__init__(station)
        self._turns, self._period = station.settings.turns, station.settings.period
        self._tick = self._period or 1.0 / ROUNDS_A_SECOND  # s per round for schedules, as in a single process
        self._message: dict[str, list[np.ndarray]] = {}
        self._blocks: dict[str, dict[int, Sequence[np.ndarray]]] = {neighbour: {} for neighbour in station.peers.all}
        self._rumours: dict[str, tuple[int, int]] = {}
        self._reached: dict[str, int] = {}
        self._lacking: set[str] = set()
        self._sent_at = -np.inf
        self._patience = self._usual = RESEND
        self._began = -np.inf
        self._outbox: tuple[Rows, Rows] | None = None
        memory = station.settings.memory
        self._store = None if memory is None else Store(memory, self._size())
        if self._store is not None and (record := self._store.load()) is not None:
            self._recall(np.frombuffer(record))

    def change(self, constraint: str, parameters: Mapping[str, Any]) -> None:
        """Raises: InvalidSettings: always; constraints cannot be changed in lockstep."""
        raise InvalidSettings("mode lockstep goes as consat run does, whose constraints stay; run another mode to change them")

    def step(self) -> float:
        """See `Runner.step`."""
        station = self.station
        self._receive()
        now = station.clock()
        if self._farewells:
            if now - self._sent_at >= RESEND:
                self._sent_at = now
                self._say_farewell()
            return self._sent_at + RESEND
        if self._state is None and station.body.position() is not None:
            self._state = station.core.begin(station.first())
        if self._state is not None:
            if station.changed:
                self._regroup()
            self._catch_up()
            if self._ready() and now - self._began >= self._period:
                self._turn(now)
            elif now - self._sent_at >= self._patience:
                self._repeat(now)
        if not self._over() and now - self._began > max(SILENT, 3.0 * self._period):  # knowledge expires while the agent waits
            station.conclude(float(self._round), lately=False)
        due = station.watch()
        if self._ready() and self._state is not None:
            return min(due, self._began + self._period)
        return min(due, self._sent_at + self._patience)

    def _receive(self) -> None:
        for message in self.station.receive():
            if message.kind is Kind.HELLO:
                self._lacking.add(message.source)
            elif message.kind is Kind.STATE:
                *frames, stamp = message.arrays
                half, reached = len(frames) // 2, int(stamp[0])
                current, previous = frames[:half], frames[half:]
                if reached > self._round and not self._confirmed(message.source, reached):
                    continue
                if reached == self._reached.get(message.source):
                    self._lacking.add(message.source)  # a repeated message: the neighbour waits
                self._reached[message.source] = reached
                self._take(message.source, reached, current, previous)
            elif message.kind is Kind.SAME:
                reached = int(message.arrays[0][0])
                before = self._blocks[message.source].get(reached - 1)
                if before is not None and reached <= self._round:  # else the neighbour will be asked for the whole message
                    self._reached[message.source] = reached
                    self._take(message.source, reached, self.station.codec.unchanged(before), before)

    def _take(self, neighbour: str, reached: int, current: Sequence[np.ndarray], previous: Sequence[np.ndarray]) -> None:
        """Store a neighbour's messages of round `reached` and of the round before it."""
        blocks = self._blocks[neighbour]
        due = {self._round - 1: blocks[self._round - 1]} if self._round - 1 in blocks else {}
        self._blocks[neighbour] = due | {reached: current, reached - 1: previous}

    def _confirmed(self, neighbour: str, reached: int) -> bool:
        """Whether a neighbour has reported an impossibly late round in `SUPPORT` consecutive messages. It can be true only if this agent
        has lost its state. A single wrong or forged number must not move this agent to a round that no other agent will reach."""
        before, times = self._rumours.get(neighbour, (reached, 0))
        times = times + 1 if 0 <= reached - before <= 1 else 1
        self._rumours[neighbour] = reached, times
        return times >= SUPPORT

    def _over(self) -> bool:
        return self._turns is not None and self._round >= self._turns

    def _ready(self) -> bool:
        if self._over():
            return False
        return self._round == 0 or all(map(self._heard, self.station.present))

    def _heard(self, neighbour: str) -> bool:
        """Whether the previous round of a neighbour was received, or cannot be received any more because the neighbour is too far ahead."""
        return self._round - 1 in self._blocks[neighbour] or self._reached.get(neighbour, 0) > self._round

    def _catch_up(self) -> None:
        """Move to the round of the slowest neighbour if all neighbours have reached this round and one is beyond it. In normal operation a
        neighbour is at most one round ahead; so this agent has lost its state, or has just joined."""
        reached = [self._reached.get(neighbour, -1) for neighbour in self.station.present]
        if min(reached, default=-1) >= self._round and max(reached) > self._round:
            self._round = min(reached)
            self.station.log("anew", round=self._round)
            self._turn(self.station.clock())

    def _turn(self, now: float) -> None:
        station = self.station
        inbox, arrived = station.core.empty()
        for neighbour in station.present if self._round else ():  # no messages before the first round
            if (block := self._blocks[neighbour].get(self._round - 1)) is not None:
                station.codec.decode(neighbour, block, inbox, arrived)
        moment = self._moment(self._round - self._regrouped)
        self._state, outbox, view = station.turn(self._state, inbox, arrived, moment)
        outbox, receivers = station.filter(outbox)
        self._outbox = outbox, outbox if self._outbox is None else self._outbox[0]
        self._round += 1
        self._usual = min(now - self._began, 1.05 * self._usual, SELDOM)
        self._patience = max(RESEND, min(USUAL * self._usual, SELDOM))
        self._began = now
        self._save()
        self._send(now, receivers)
        station.move(view, float(self._round))
        if self._over():
            station.log("finished", round=self._round)
            station.report()

    def _moment(self, number: int) -> Moment:
        """The `Moment` of a round: without delays, and with all neighbours fresh. `number`: rounds since the last change of membership."""
        count = len(self.station.core.ends)
        time = (self._round + 1.0) * self._tick
        return Moment(float(number), 0.0, np.zeros(count), np.ones(count, dtype=bool), self.station.place(), time=time)

    def _send(self, now: float, to: AbstractSet[str] | None = None) -> None:
        """Send the message of this round to the neighbours `to` (None for all), and to the others that it brings no news."""
        station = self.station
        assert self._outbox is not None
        current, previous = map(station.codec.encode, self._outbox)
        number = np.array([self._round - 1.0])
        self._message = {neighbour: [*arrays, *previous[neighbour], number] for neighbour, arrays in current.items()}
        self._lacking.clear()
        self._sent_at = now
        station.send(self._message, to)
        if to is not None:
            station.send_same(number, to)

    def _repeat(self, now: float) -> None:
        """Repeat the last message: to all neighbours while waiting, and after the last round to those that lack it."""
        station = self.station
        to = {neighbour for neighbour in station.present if not self._over() or neighbour in self._lacking}
        self._sent_at = now
        self._patience = min(2.0 * self._patience, SELDOM)
        self._lacking.clear()
        if self._message and to:
            station.send(self._message, to)
        elif not self._message:
            station.send_hello()

    def _regroup(self) -> None:
        station = self.station
        before = station.core
        self._state = station.regroup(self._state)
        self._regrouped = self._round
        if self._outbox is None:
            return
        ends = IndexMap.of(station.core.core, before.core).link
        if min(ends, default=0) >= 0 and not self._outbox[0].pair.size:
            nothing = np.zeros((len(station.present), 0))
            current, previous = (Rows(outbox.link[ends], nothing) for outbox in self._outbox)
            self._outbox = current, previous
        else:  # an agent has joined, or messages per neighbour refer to the old membership: compute new messages
            self._state, outbox, _ = station.turn(self._state, *station.core.empty(), self._moment(0))
            outbox, _ = station.filter(outbox)
            self._outbox = outbox, outbox
        self._save()
        self._send(station.clock())

    # -- stored state ------------------------------------------------------------------------------------------------------------------

    def _size(self) -> int:
        """Largest size of the stored record, in bytes: that with all agents present."""
        everyone = self.station.core.without(frozenset())
        outbox, _ = everyone.empty()
        return self._record(0, (outbox, outbox), everyone.begin(self.station.part.first)).nbytes

    def _record(self, round_: int, outbox: tuple[Rows, Rows], state: Any) -> np.ndarray:
        """The numbers of a record."""
        epochs = self.station.membership.of(self.station.part.team.ids)
        leaves = jax.tree.leaves((round_, epochs, outbox, state))
        return np.concatenate([np.asarray(leaf, dtype=float).ravel() for leaf in leaves])

    def _save(self) -> None:
        if self._store is not None and self._outbox is not None:
            self._store.save(self._record(self._round, self._outbox, self._state).tobytes())

    def _recall(self, record: np.ndarray) -> None:
        """Continue from a stored record."""
        station = self.station
        ids = station.part.team.ids
        (number,), epochs, numbers = np.split(record, [1, 1 + len(ids)])
        self._round = int(number)
        station.membership.restore(ids, epochs)
        station.regroup(None)
        nothing, _ = station.core.empty()
        like = (nothing, nothing), station.core.begin(station.first())
        leaves, structure = jax.tree.flatten(like)
        parts = np.split(numbers, np.cumsum([np.size(leaf) for leaf in leaves])[:-1])
        restored = [part.reshape(np.shape(leaf)) for part, leaf in zip(parts, leaves, strict=True)]
        self._outbox, self._state = jax.tree.unflatten(structure, restored)
        station.resume(self._outbox[0], self._state)
        station.log("resumed", round=self._round)
        self._send(station.clock())
