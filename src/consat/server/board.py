"""The newest of everything that a page is shown. A reader who is late misses what has been replaced; nothing waits for it."""

from __future__ import annotations

import itertools
import threading
from collections.abc import Iterator
from typing import Final

TOPICS: Final = ("scene", "shapes", "outlines", "state", "verdict", "frame")
"""In the order in which they make sense to a reader."""


class Board:
    """What a session has to show; written by its thread, read by those of the server."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._numbers = itertools.count(1)
        self._newest: dict[str, tuple[int, str | bytes]] = {}

    def put(self, topic: str, content: str | bytes) -> None:
        """Replace what is shown of a topic."""
        with self._lock:
            self._newest[topic] = next(self._numbers), content

    def drop(self, *topics: str) -> None:
        """Show nothing of some topics any more."""
        with self._lock:
            for topic in topics:
                self._newest.pop(topic, None)

    def news(self, seen: dict[str, int]) -> Iterator[str | bytes]:
        """What a reader has not seen yet; `seen` is kept by the reader and brought up to date."""
        for topic in TOPICS:
            with self._lock:
                number, content = self._newest.get(topic, (0, ""))
            if number > seen.get(topic, 0):
                seen[topic] = number
                yield content
