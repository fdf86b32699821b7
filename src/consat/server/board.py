"""Latest content of each topic for the web page. Slow readers miss replaced content; writers never wait for readers."""

from __future__ import annotations

import itertools
import threading
from collections.abc import Iterator
from typing import Final

TOPICS: Final = ("scene", "shapes", "outlines", "state", "verdict", "frame")
"""All topics, in the order in which a reader needs them."""


class Board:
    """Latest content of each topic. It is written by the session's thread and read by the server's threads."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._numbers = itertools.count(1)
        self._newest: dict[str, tuple[int, str | bytes]] = {}

    def put(self, topic: str, content: str | bytes) -> None:
        """Replace the content of a topic."""
        with self._lock:
            self._newest[topic] = next(self._numbers), content

    def drop(self, *topics: str) -> None:
        """Remove the content of topics."""
        with self._lock:
            for topic in topics:
                self._newest.pop(topic, None)

    def news(self, seen: dict[str, int]) -> Iterator[str | bytes]:
        """Yield the content that a reader has not seen yet.

        Args:
            seen: number of the last content seen of each topic. The reader keeps it; it is updated here.
        """
        for topic in TOPICS:
            with self._lock:
                number, content = self._newest.get(topic, (0, ""))
            if number > seen.get(topic, 0):
                seen[topic] = number
                yield content
