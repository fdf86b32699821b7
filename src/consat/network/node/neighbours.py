"""The neighbours as an agent knows them from their messages: what is accepted, how long messages take, how many get lost."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from consat.network.node.part import Neighbour, Part
from consat.network.transports import Transport
from consat.network.wire import Checker, Expected, Kind, Message, encode

SMOOTH = 0.05
"""Weight of the newest message in the running means of loss and round trip."""


@dataclass
class Peer:
    """One neighbour.

    Attributes:
        known: what the part says of it.
        born: when this agent began, own clock; it has sent nothing before.
        sequence: of the last message sent to it.
        last: the last message accepted from it.
        heard: when that was, own clock; −∞ if never.
        said: when it was last spoken to.
        trip: round trip, running mean, s; NaN before it is known.
        lost: share of its messages that did not arrive (in order), running mean.
        restarts: how often it has begun anew since it was first heard.
    """

    known: Neighbour
    born: float = -np.inf
    sequence: int = 0
    last: Message | None = None
    heard: float = -np.inf
    said: float = -np.inf
    trip: float = np.nan
    lost: float = 0.0
    restarts: int = 0

    def take(self, message: Message, now: float) -> None:
        """Learn from an accepted message."""
        if self.last is not None and message.incarnation > self.last.incarnation:
            self.restarts += 1
        if self.last is not None and self.last.incarnation == message.incarnation and message.sequence > self.last.sequence:
            gap = message.sequence - self.last.sequence
            self.lost += (1.0 - (1.0 - SMOOTH) ** gap) * ((gap - 1) / gap - self.lost)
        # An echo of what was never sent is a mistake or a lie, and would spoil the mean for long.
        if self.born <= message.echo <= now:
            trip = now - message.echo
            self.trip = trip if np.isnan(self.trip) else self.trip + SMOOTH * (trip - self.trip)
        self.last, self.heard = message, now


class Peers:
    """All neighbours of an agent, over a transport.

    Args:
        part: the agent's own.
        problem: see `Part.problem`.
        expected: for each neighbour, what arrays each kind of message has.
        transport: over which they talk.
        clock: own, s.
        incarnation: larger after each restart.
    """

    def __init__(
        self,
        part: Part,
        problem: bytes,
        expected: Mapping[str, Expected],
        transport: Transport,
        clock: Callable[[], float],
        incarnation: int,
    ) -> None:
        self.all = {neighbour.id: Peer(neighbour, clock()) for neighbour in part.neighbours}
        self.sent = Counter[str]()
        self._part, self._problem, self._transport, self._clock, self._incarnation = part, problem, transport, clock, incarnation
        self._checker = Checker(part.me, expected, problem, clock=clock)

    @property
    def dropped(self) -> Mapping[str, int]:
        """How many messages were refused, by reason."""
        return {str(reason): count for reason, count in self._checker.counts.items()}

    def hear(self) -> list[Message]:
        """The messages that came and pass every check, in the order of their arrival."""
        accepted = []
        for payload in self._transport.receive():
            message = self._checker.accept(payload)
            if message is not None and message.source in self.all:
                self.all[message.source].take(message, self._clock())
                accepted.append(message)
        return accepted

    def say(self, neighbour: str, kind: Kind, arrays: Sequence[np.ndarray], single: tuple[int, ...] = ()) -> None:
        """Send a message; single: which arrays are written in 32 bits."""
        peer, now = self.all[neighbour], self._clock()
        peer.sequence += 1
        peer.said = now
        echo, ack = (np.nan, 0) if peer.last is None else (peer.last.sent + (now - peer.heard), peer.last.sequence)
        payload = encode(
            Message(
                kind,
                self._problem,
                self._part.me,
                neighbour,
                self._incarnation,
                peer.sequence,
                now,
                echo,
                ack,
                float(self._part.nu.beta),
                tuple(arrays),
            ),
            single,
        )
        self._transport.send(neighbour, payload)
        self.sent["messages"] += 1
        self.sent["floats"] += sum(array.size for array in arrays)
        self.sent["bytes"] += len(payload)

    def alive(self) -> frozenset[str]:
        """Whose liveliness shows."""
        return self._transport.alive()
