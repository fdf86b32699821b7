"""Work beside the session's thread, of which only the newest is worth doing."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from typing import Generic, TypeVar

T = TypeVar("T")


class Background(Generic[T]):
    """A thread that does the newest of what it is asked for.

    Args:
        work: what to do.
        pause: seconds without another request before it begins.
        longest: seconds that requests can put it off.
        name: of the thread.
    """

    def __init__(self, work: Callable[[T], None], pause: float, longest: float, name: str) -> None:
        self._work, self._pause, self._longest = work, pause, longest
        self._asked: list[T] = []
        self._first = self._last = self._took = 0.0
        self._open, self._change = True, threading.Condition()
        self._thread = threading.Thread(target=self._run, name=name, daemon=True)
        self._thread.start()

    def ask(self, task: T) -> None:
        """Do this, instead of what has not begun."""
        with self._change:
            self._last = time.monotonic()
            if not self._asked:
                self._first = self._last
            self._asked = [task]
            self._change.notify()

    def close(self) -> None:
        """Begin nothing more, and wait for what has begun."""
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
        """Seconds until it is time."""
        if not self._asked:
            return 1.0
        patience = self._longest + 4.0 * self._took  # what takes long is done more rarely, so that it slows nobody
        return min(self._last + self._pause, self._first + patience) - time.monotonic()
