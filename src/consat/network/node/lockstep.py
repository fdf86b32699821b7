"""Round r+1 waits for every neighbour's round r, so that loss and delay change nothing but the time it takes: any protocol in rounds goes
exactly as in one process. One agent that is down stops its neighbours until it is back.

Each message carries the rounds r and r − 1, which is all that a neighbour can lack: it waits for r − 1 or for r. Whoever waits says again
what it said last. An agent writes its state down before it speaks, so that after a crash it says the same again. One that has lost its
memory starts anew in the round of the slowest neighbour, which a protocol that converges from any state survives.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from collections.abc import Set as AbstractSet
from pathlib import Path
from typing import Any, Final

import jax
import numpy as np

from consat.errors import InvalidSettings
from consat.network.node.core import Moment, Rows
from consat.network.node.paced import FAREWELLS
from consat.network.node.persistence import Store
from consat.network.node.station import SILENT, Station
from consat.network.wire import SUPPORT, Kind
from consat.runs.options import RATE as ROUNDS_A_SECOND

RESEND: Final = 0.006
"""Whoever waits repeats itself after so long, s, or after `USUAL` times as long as rounds take at best; then after twice as long …"""
USUAL: Final = 4.0
SELDOM: Final = 0.2
"""… up to this: where rounds are slow because the machine is busy, more messages would only make it busier."""


class Lockstep:
    """One agent in rounds.

    Args:
        station: its own.
        turns: how many rounds; None for no end. After the last it goes on to answer whoever lacks it.
        rate: at most so many rounds a second, Hz; as many as there can be if None. Schedules go by rounds: round r is at r/rate.
        memory: a file in which to keep the state; none if None.
    """

    def __init__(self, station: Station, turns: int | None = None, rate: float | None = None, memory: Path | None = None) -> None:
        self.station = station
        self.done = False
        self._turns, self._period = turns, 0.0 if rate is None else 1.0 / rate
        self._tick = 1.0 / (rate or ROUNDS_A_SECOND)  # time is counted in rounds, as in one process
        self._round = 0  # so many are spoken
        self._regrouped = 0  # so many were, when somebody last came or went: a protocol begins anew then
        self._said: dict[str, list[np.ndarray]] = {}
        self._blocks: dict[str, dict[int, Sequence[np.ndarray]]] = {neighbour: {} for neighbour in station.peers.all}
        self._rumours: dict[str, tuple[int, int]] = {}
        self._reached: dict[str, int] = {}
        self._lacking: set[str] = set()
        self._spoke = -np.inf
        self._patience = self._usual = RESEND
        self._began = -np.inf
        self._farewells = 0
        self._outbox: tuple[Rows, Rows] | None = None
        self._state: Any = None
        self._store = None if memory is None else Store(memory, self._size())
        self._recall()

    def leave(self) -> None:
        """Leave for good: say so for a while, then be done."""
        self.station.membership.drop(self.station.part.me)
        self._farewells = FAREWELLS

    def change(self, constraint: str, parameters: Mapping[str, Any]) -> None:
        """Raises: InvalidSettings: rounds go as in one process, whose constraints are those of the scenario."""
        raise InvalidSettings("mode lockstep goes as consat run does, whose constraints stay; run another mode to change them")

    def step(self) -> float:
        """Do what is due; when to be called again at the latest."""
        station = self.station
        self._hear()
        now = station.clock()
        if self._farewells:
            if now - self._spoke >= RESEND:
                self._spoke = now
                self._farewells -= 1
                self.done = self._farewells == 0
                station.greet()
            return self._spoke + RESEND
        if self._state is None and station.body.position() is not None:
            self._state = station.core.begin(station.among(station.first()))
        if self._state is not None:
            if station.changed:
                self._regroup()
            self._catch_up()
            if self._ready() and now - self._began >= self._period:
                self._turn(now)
            elif now - self._spoke >= self._patience:
                self._repeat(now)
        if not self._over() and now - self._began > max(SILENT, 3.0 * self._period):  # while the agent waits, what it knew grows old
            station.conclude(float(self._round), lately=False)
        due = station.watch()
        if self._ready() and self._state is not None:
            return min(due, self._began + self._period)
        return min(due, self._spoke + self._patience)

    def _hear(self) -> None:
        for message in self.station.hear():
            if message.kind is Kind.HELLO:
                self._lacking.add(message.source)
            elif message.kind is Kind.STATE:
                *frames, stamp = message.arrays
                half, reached = len(frames) // 2, int(stamp[0])
                current, previous = frames[:half], frames[half:]
                if reached > self._round and not self._confirmed(message.source, reached):
                    continue
                if reached == self._reached.get(message.source):
                    self._lacking.add(message.source)  # it says again what it has said: it waits
                self._reached[message.source] = reached
                self._take(message.source, reached, current, previous)
            elif message.kind is Kind.SAME:
                reached = int(message.arrays[0][0])
                before = self._blocks[message.source].get(reached - 1)
                if before is not None and reached <= self._round:  # else the neighbour is asked to say it all
                    self._reached[message.source] = reached
                    self._take(message.source, reached, self.station.same(before), before)

    def _take(self, neighbour: str, reached: int, current: Sequence[np.ndarray], previous: Sequence[np.ndarray]) -> None:
        """Keep what a neighbour said in a round and in the one before."""
        blocks = self._blocks[neighbour]
        due = {self._round - 1: blocks[self._round - 1]} if self._round - 1 in blocks else {}
        self._blocks[neighbour] = due | {reached: current, reached - 1: previous}

    def _confirmed(self, neighbour: str, reached: int) -> bool:
        """Whether a neighbour that is farther on than it can be, while this agent remembers, has said so several times on end: one
        mistaken or forged number must not lead this agent into a round that nobody else will ever reach."""
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
        """Whether a neighbour has nothing more to say about the round before: it was heard, or is too far on to repeat that."""
        return self._round - 1 in self._blocks[neighbour] or self._reached.get(neighbour, 0) > self._round

    def _catch_up(self) -> None:
        """A neighbour can be one round ahead. If one is farther, this agent has lost its memory, or has just joined: it goes where the
        slowest is."""
        reached = [self._reached.get(neighbour, -1) for neighbour in self.station.present]
        if min(reached, default=-1) >= self._round and max(reached) > self._round:
            self._round = min(reached)
            self.station.log("anew", round=self._round)
            self._turn(self.station.clock())

    def _turn(self, now: float) -> None:
        station = self.station
        inbox, arrived = station.empty()
        for neighbour in station.present if self._round else ():  # there is no round before the first
            if (block := self._blocks[neighbour].get(self._round - 1)) is not None:
                station.sort(neighbour, block, inbox, arrived)
        moment = self._moment(self._round - self._regrouped)
        self._state, outbox, look = station.turn(self._state, inbox, arrived, moment)
        outbox, told = station.sift(outbox)
        self._outbox = outbox, outbox if self._outbox is None else self._outbox[0]
        self._round += 1
        self._usual = min(now - self._began, 1.05 * self._usual, SELDOM)
        self._patience = max(RESEND, min(USUAL * self._usual, SELDOM))
        self._began = now
        self._save()
        self._speak(now, told)
        station.move(look, float(self._round))
        if self._over():
            station.log("finished", round=self._round)
            station.report()

    def _moment(self, number: int) -> Moment:
        """Of a round, in which everybody was heard, however long it took."""
        count = len(self.station.core.ends)
        time = (self._round + 1.0) * self._tick
        return Moment(float(number), 0.0, np.zeros(count), np.ones(count, dtype=bool), self.station.place(), time=time)

    def _speak(self, now: float, among: AbstractSet[str] | None = None) -> None:
        """Say what there is to say of this round; that nothing is new to those who are not `among` some."""
        station = self.station
        assert self._outbox is not None
        current, previous = (station.blocks(outbox) for outbox in self._outbox)
        number = np.array([self._round - 1.0])
        self._said = {neighbour: [*told, *previous[neighbour], number] for neighbour, told in current.items()}
        self._lacking.clear()
        self._spoke = now
        station.say(self._said, among=among)
        if among is not None:
            station.say_same(number, station.silent(among))

    def _repeat(self, now: float) -> None:
        """Say again what was said last: to all while waiting, and after the last round to those who ask."""
        station = self.station
        to = [neighbour for neighbour in station.present if not self._over() or neighbour in self._lacking]
        self._spoke = now
        self._patience = min(2.0 * self._patience, SELDOM)
        self._lacking.clear()
        if self._said and to:
            station.say(self._said, to)
        elif not self._said:
            station.greet()

    def _regroup(self) -> None:
        station = self.station
        before = station.core
        self._state = station.regroup(self._state, station.first())
        self._regrouped = self._round
        if self._outbox is None:
            return
        place = {end: k for k, end in enumerate(before.ends)}
        rows = [place.get(end, -1) for end in station.core.ends]
        if min(rows, default=0) >= 0 and not self._outbox[0].pair.size:
            self._outbox = self._among(rows, self._outbox[0]), self._among(rows, self._outbox[1])
        else:  # somebody joined, to whom nothing was said yet; or what was said to neighbours as a whole is of a team that is no more
            inbox, nothing = station.empty()
            self._state, outbox, _ = station.turn(self._state, inbox, nothing, self._moment(0))
            outbox, _ = station.sift(outbox)
            self._outbox = outbox, outbox
        self._save()
        self._speak(station.clock())

    def _among(self, rows: list[int], said: Rows) -> Rows:
        """What was said to those who are still there, in protocols that say nothing to neighbours as a whole."""
        return Rows(said.link[rows], np.zeros((len(self.station.present), 0)))

    # -- memory ------------------------------------------------------------------------------------------------------------------------

    def _size(self) -> int:
        """Of the record when everybody is there, the most that there can be."""
        everyone = self.station.core.among(frozenset())
        state = everyone.begin(self.station.part.first)
        longest = max((letter.shape[0] for letter in everyone.letters.values()), default=0)
        said = len(everyone.ends) * everyone.width + len(everyone.part.neighbours) * longest
        numbers = sum(np.size(leaf) for leaf in jax.tree.leaves(state)) + 2 * said
        return 8 * (numbers + self.station.part.team.count + 1)

    def _save(self) -> None:
        if self._store is None or self._outbox is None:
            return
        leaves = [np.asarray(leaf, dtype=float).ravel() for leaf in jax.tree.leaves(self._state)]
        epochs = self.station.membership.of(self.station.part.team.ids)
        said = [box.ravel() for rows in self._outbox for box in rows]
        self._store.save(np.concatenate([[float(self._round)], epochs, *said, *leaves]).tobytes())

    def _recall(self) -> None:
        record = None if self._store is None else self._store.load()
        if record is None:
            return
        station = self.station
        numbers = np.frombuffer(record)
        ids = station.part.team.ids
        self._round = int(numbers[0])
        station.membership.restore(ids, numbers[1 : 1 + len(ids)])
        station.regroup(None, station.part.first)
        at = 1 + len(ids)

        def read(like: Any) -> Any:
            """Numbers of the same shapes, from where the last ended."""
            nonlocal at
            leaves, structure = jax.tree.flatten(like)
            restored = []
            for leaf in leaves:
                restored.append(numbers[at : at + np.size(leaf)].reshape(np.shape(leaf)))
                at += np.size(leaf)
            return jax.tree.unflatten(structure, restored)

        nothing, _ = station.empty()
        self._outbox = read(nothing), read(nothing)
        self._state = read(station.core.begin(station.among(station.part.first)))
        station.resume(self._outbox[0], self._state)
        station.log("resumed", round=self._round)
        self._speak(station.clock())
