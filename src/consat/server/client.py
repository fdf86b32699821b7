"""One view that watches, however its messages travel: what it asks for, and what it is told."""

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
"""Messages a second that a client may send, and how many at once."""


class Allowance:
    """How much a client may still send: a bucket that fills at a rate.

    Args:
        rate: messages a second.
        burst: what it holds.
    """

    def __init__(self, rate: float = RATE, burst: float = BURST) -> None:
        self._rate, self._burst = rate, burst
        self._left, self._at = burst, time.monotonic()

    def take(self) -> bool:
        """Whether one more is allowed."""
        now = time.monotonic()
        self._left = min(self._burst, self._left + self._rate * (now - self._at))
        self._at = now
        if self._left < 1.0:
            return False
        self._left -= 1.0
        return True


class Client:
    """One view that watches. It is told the newest; what it was too slow for is lost.

    Args:
        number: tells clients apart.
        simulation: what it watches.
        wake: called when it has an answer, from any thread.

    Attributes:
        answers: to its orders; of too many the oldest are lost.
    """

    def __init__(self, number: int, simulation: Simulation, wake: Callable[[], None]) -> None:
        self.number, self._simulation, self._wake = number, simulation, wake
        self.answers: deque[str] = deque(maxlen=MOST_ANSWERS)
        self.allowance = Allowance()
        self._seen: dict[str, int] = {}

    def answer(self, told: dict[str, Any]) -> None:
        """Answer an order; from any thread."""
        self.answers.append(json.dumps(told, allow_nan=False))
        self._wake()

    def take(self, raw: str | bytes) -> None:
        """Take what the view sent: an order, or a refusal of it in words."""
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
        """What it has not been told yet."""
        ready = len(self.answers)  # what they tell of is among the news by now, and is sent first
        yield from self._simulation.board.news(self._seen)
        for _ in range(min(ready, len(self.answers))):
            yield self.answers.popleft()
