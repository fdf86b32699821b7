"""One view of the live page, independent of how its messages travel: its orders, its answers, and news."""

from __future__ import annotations

import json
import time
from collections import deque
from collections.abc import Callable, Iterator
from typing import Any, Final

from consat.errors import InvalidSettings
from consat.server.orders import number_of, parse
from consat.server.simulation import Simulation

MOST_CLIENTS: Final = 16
MOST_ANSWERS: Final = 64
RATE, BURST = 200.0, 400.0
"""Messages per second that a client may send, and largest burst."""


class Allowance:
    """Token bucket that limits the messages of a client.

    Args:
        rate: messages per second.
        burst: most messages at once.
    """

    def __init__(self, rate: float = RATE, burst: float = BURST) -> None:
        self._rate, self._burst = rate, burst
        self._left, self._at = burst, time.monotonic()

    def take(self) -> bool:
        """Take one message. Returns whether it is allowed."""
        now = time.monotonic()
        self._left = min(self._burst, self._left + self._rate * (now - self._at))
        self._at = now
        if self._left < 1.0:
            return False
        self._left -= 1.0
        return True


class Client:
    """One view. It receives the latest content; a slow view misses what was replaced meanwhile.

    Args:
        number: number of the client.
        simulation: the simulation that it watches.
        wake: called when there is an answer, from any thread.

    Attributes:
        answers: answers to its orders. If there are too many, the oldest are dropped.
    """

    def __init__(self, number: int, simulation: Simulation, wake: Callable[[], None]) -> None:
        self.number, self._simulation, self._wake = number, simulation, wake
        self.answers: deque[str] = deque(maxlen=MOST_ANSWERS)
        self.allowance = Allowance()
        self._seen: dict[str, int] = {}

    def answer(self, answer: dict[str, Any]) -> None:
        """Answer an order. May be called from any thread."""
        self.answers.append(json.dumps(answer, allow_nan=False))
        self._wake()

    def take(self, raw: str | bytes) -> None:
        """Take a message of the view: queue its order, or answer why it is refused."""
        if not self.allowance.take():
            self._refuse(raw, f"more than {RATE:g} messages a second; this one was ignored")
            return
        try:
            order = parse(raw)
        except InvalidSettings as error:
            self._refuse(raw, str(error))
            return
        self._simulation.ask(order, self.number, self.answer)

    def _refuse(self, raw: str | bytes, words: str) -> None:
        self.answer({"type": "answer", "id": number_of(raw), "ok": False, "words": words[:1000]})

    def news(self) -> Iterator[str | bytes]:
        """Yield the content and the answers that the view has not received yet."""
        ready = len(self.answers)  # the news that they refer to are sent first
        yield from self._simulation.board.news(self._seen)
        for _ in range(min(ready, len(self.answers))):
            yield self.answers.popleft()
