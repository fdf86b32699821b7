"""Background work for the session's thread. Only the newest request is done."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from typing import Generic, TypeVar

T = TypeVar("T")


class Background(Generic[T]):
    """A thread that works on the newest request. A new request replaces one that has not begun.

    Args:
        work: function to call with a request.
        pause: time without a further request before the work begins, s.
        longest: longest time that further requests can delay the work, s. Four times the duration of the last work is added.
        name: name of the thread.
    """

    def __init__(self, work: Callable[[T], None], pause: float, longest: float, name: str) -> None:
        self._work, self._pause, self._longest = work, pause, longest
        self._asked: list[T] = []
        self._first = self._last = self._took = 0.0
        self._open, self._change = True, threading.Condition()
        self._thread = threading.Thread(target=self._run, name=name, daemon=True)
        self._thread.start()

    def ask(self, task: T) -> None:
        """Request work on `task`. It replaces a request that has not begun."""
        with self._change:
            self._last = time.monotonic()
            if not self._asked:
                self._first = self._last
            self._asked = [task]
            self._change.notify()

    def close(self) -> None:
        """Drop a request that has not begun, and wait, at most 60 s, for work that has."""
        with self._change:
            self._open = False
            self._change.notify()
        self._thread.join(timeout=60.0)

    def _run(self) -> None:
        while True:
            with self._change:
                while self._open and (wait := self._wait()) > 0:
                    self._change.wait(wait if self._asked else None)
                if not self._open:
                    return
                [task], self._asked = self._asked, []
            begun = time.monotonic()
            self._work(task)
            self._took = time.monotonic() - begun

    def _wait(self) -> float:
        """Time until the work should begin, s; 0 or less if now. Without a request, positive."""
        if not self._asked:
            return 1.0
        patience = self._longest + 4.0 * self._took  # long work is done less often, so that it does not slow the session
        return min(self._last + self._pause, self._first + patience) - time.monotonic()
