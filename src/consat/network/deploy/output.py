"""Events of an agent as JSON lines on stdout, written by a thread of its own: a reader that is slow, or hangs, never delays the agent."""

from __future__ import annotations

import itertools
import json
import os
import sys
import threading
from collections.abc import Hashable
from typing import Any, Self

MOST = 1000
"""Largest number of events that wait to be written; beyond, the oldest is dropped."""
DRAIN = 1.0
"""How long the end of a process waits for the events that are left to be written, s."""
COMMAND = "command"
"""Of events of this name only the newest waits: an older command is of no use to a body."""


class Output:
    """Writes events to stdout in their order. A context manager: at the end it writes what is left, for at most `DRAIN`."""

    def __init__(self) -> None:
        self._waiting: dict[Hashable, dict[str, Any]] = {}
        self._order = itertools.count()
        self._changed = threading.Condition()
        self._busy = self._closed = self._broken = False
        self._thread = threading.Thread(target=self._run, name="consat output", daemon=True)

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        with self._changed:
            self._closed = True
            self._changed.notify_all()
            self._changed.wait_for(lambda: self._broken or not (self._waiting or self._busy), DRAIN)

    def write(self, event: dict[str, Any]) -> None:
        """Write an event, soon; does not wait. Raises: BrokenPipeError: nobody can read stdout any more."""
        key: Hashable = COMMAND if event["event"] == COMMAND else next(self._order)
        with self._changed:
            if self._broken:
                raise BrokenPipeError
            self._waiting.pop(key, None)
            self._waiting[key] = event
            if len(self._waiting) > MOST:
                del self._waiting[next(key for key in self._waiting if key != COMMAND)]
            self._changed.notify_all()

    def _run(self) -> None:
        while True:
            with self._changed:
                self._busy = False
                self._changed.notify_all()
                self._changed.wait_for(lambda: self._waiting or self._closed)
                if not self._waiting:
                    return
                event = self._waiting.pop(next(iter(self._waiting)))
                self._busy = True
            try:
                _write(json.dumps(event) + "\n")
            except OSError:
                with self._changed:
                    self._broken, self._busy = True, False
                    self._changed.notify_all()
                return


def _write(line: str) -> None:
    """Past the buffer of `sys.stdout`, whose lock a write that hangs would hold for ever."""
    try:
        where = sys.stdout.fileno()
    except (OSError, ValueError, AttributeError):  # not a file, as where it is captured
        sys.stdout.write(line)
        return
    data = memoryview(line.encode())
    while data:
        data = data[os.write(where, data) :]
