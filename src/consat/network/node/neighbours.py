"""State of the neighbours, from their messages: acceptance of messages, round-trip times, loss rates."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Container, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from consat.network.node.part import Neighbour, Part
from consat.network.transports import Transport
from consat.network.wire import Checker, Expected, Kind, Message, encode

SMOOTH = 0.05
"""Weight of the newest message in the running means of loss and round-trip time."""


@dataclass
class Peer:
    """State of one neighbour. Times are in s of the agent's own clock.

    Attributes:
        known: entry of the neighbour in the part.
        born: start time of this agent, before which it has sent nothing.
        sequence: sequence number of the last message sent to the neighbour.
        last: the last message accepted from the neighbour.
        heard: time of that message; −∞ before the first.
        trip: running mean of the round-trip time, s; NaN before the first measurement.
        lost: running mean of the fraction of its messages that did not arrive, or arrived out of order.
        restarts: number of restarts of the neighbour since its first message.
    """

    known: Neighbour
    born: float = -np.inf
    sequence: int = 0
    last: Message | None = None
    heard: float = -np.inf
    trip: float = np.nan
    lost: float = 0.0
    restarts: int = 0

    def take(self, message: Message, now: float) -> None:
        """Update the state with an accepted message, received at time `now`."""
        if self.last is not None and message.incarnation > self.last.incarnation:
            self.restarts += 1
        if self.last is not None and self.last.incarnation == message.incarnation and message.sequence > self.last.sequence:
            gap = message.sequence - self.last.sequence
            self.lost += (1.0 - (1.0 - SMOOTH) ** gap) * ((gap - 1) / gap - self.lost)
        # an echo of a time at which nothing was sent is wrong or forged, and would distort the mean for long
        if self.born <= message.echo <= now:
            trip = now - message.echo
            self.trip = trip if np.isnan(self.trip) else self.trip + SMOOTH * (trip - self.trip)
        self.last, self.heard = message, now


class Peers:
    """All neighbours of an agent, over a transport.

    Args:
        part: the agent's part.
        problem: see `Part.problem`.
        expected: for each neighbour the expected arrays of each kind of message.
        transport: the transport of the messages.
        clock: the agent's clock, s.
        incarnation: a number that is larger after each restart of this agent.
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
        """Number of refused messages, by reason."""
        return {str(reason): count for reason, count in self._checker.counts.items()}

    def receive(self) -> list[Message]:
        """The received messages that pass every check, in the order of their arrival."""
        accepted = []
        for payload in self._transport.receive():
            message = self._checker.accept(payload)
            if message is not None and message.source in self.all:
                self.all[message.source].take(message, self._clock())
                accepted.append(message)
        return accepted

    def send(self, neighbour: str, kind: Kind, arrays: Sequence[np.ndarray], single: Container[int] = ()) -> None:
        """Send a message to a neighbour. `single`: indices of the arrays that are written in 32 bits."""
        peer, now = self.all[neighbour], self._clock()
        peer.sequence += 1
        echo, ack = (np.nan, 0) if peer.last is None else (peer.last.sent + (now - peer.heard), peer.last.sequence)
        message = Message(
            kind, self._problem, self._part.me, neighbour, self._incarnation, peer.sequence, now, echo, ack, float(self._part.nu.beta),
            tuple(arrays),
        )  # fmt: skip
        payload = encode(message, single)
        self._transport.send(neighbour, payload)
        self.sent["messages"] += 1
        self.sent["floats"] += sum(array.size for array in arrays)
        self.sent["bytes"] += len(payload)
