"""Input of an agent's process: orders and measurements as lines on stdin, and signals.

An order is a JSON object with the key ``command``, whose value is a key of `KEYS`. Required keys are checked here; names and values of
constraint parameters are checked by `Station.change`.
"""

from __future__ import annotations

import json
import os
import signal
import sys
import threading
import time
from collections import deque
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType
from typing import Any, Final, NamedTuple

import numpy as np

from consat.errors import closest, shown
from consat.network.node.body import Measurement
from consat.network.node.core import LARGEST

LONGEST_LINE: Final = 65536
"""Largest number of bytes of a line on stdin; the rest is cut off."""
SHOWN: Final = 80
"""Largest number of characters of a line in a report."""
HELD: Final = 256
"""Size of each queue while the agent is busy. Of measurements and of rejected lines the newest are kept; further orders are rejected."""


KEYS: Final[dict[str, tuple[str, ...]]] = {
    "stop": (), "leave": (), "join": (), "clock": ("epoch",), "reload": (), "change": ("constraint",),
}  # fmt: skip
"""Commands and the required keys of each. ``change`` has parameters as additional keys; the other commands have no additional keys."""
EXAMPLE: Final = '{"position": [...]}, {"command": "stop"}, {"command": "leave"} or {"command": "change", "constraint": ..., ...}'


class Order(NamedTuple):
    """A well-formed order.

    Attributes:
        command: a key of `KEYS`.
        given: the other keys and values of the order.
        line: the line on stdin, cut to `SHOWN` characters.
    """

    command: str
    given: dict[str, Any]
    line: str


def order_of(value: Any, line: str) -> Order | str:
    """Parse a JSON value as an order. Returns the order, or the reason why it is not one.

    Args:
        value: the JSON value.
        line: its line on stdin.
    """
    command = value.get("command") if isinstance(value, dict) else None
    if not isinstance(command, str):
        return f"it must be {EXAMPLE}"
    if command not in KEYS:
        return f"there is no command {shown(command)}{closest(command, KEYS)}; the commands are {', '.join(KEYS)}"
    given = {key: each for key, each in value.items() if key != "command"}
    for key in KEYS[command]:
        if key not in given:
            return f"{command} lacks {key}"
    if command != "change" and (unknown := [key for key in given if key not in KEYS[command]]):
        return f"{command} has no key {shown(unknown[0])}"
    if command == "change" and not isinstance(given["constraint"], str):
        return f"the name of a constraint must be a text, but is {shown(given['constraint'])}"
    if command == "change" and len(given) == 1:
        return 'change names no parameter, such as "radius": 2'
    if command == "clock" and not _is_coordinate(given["epoch"]):
        return f"epoch is {shown(given['epoch'])}, but must be a Unix time, s"
    return Order(command, given, line)


class Orders:
    """Queues of orders and measurements from stdin, read in a thread, and flags set by signals.

    Args:
        dimension: d of measured positions; None for an agent with a simulated body.
        reading: whether to read stdin.
    """

    def __init__(self, dimension: int | None, *, reading: bool) -> None:
        self.stopped = ""
        self.leaving = False
        self._dimension = dimension
        self._measurements: deque[tuple[str, Measurement]] = deque(maxlen=HELD)
        self._rejected: deque[tuple[str, str]] = deque(maxlen=HELD)
        self._others: deque[Order] = deque()
        if reading:
            threading.Thread(target=self._read, name="stdin", daemon=True).start()

    def measurements(self) -> Iterator[tuple[str, Measurement]]:
        """The received measurements with their lines, each once."""
        while self._measurements:
            yield self._measurements.popleft()

    def next(self) -> Order | None:
        """The next order other than ``stop`` and ``leave``, each once; None without one."""
        return self._others.popleft() if self._others else None

    def rejected(self) -> Iterator[tuple[str, str]]:
        """The rejected lines with the reasons, each once."""
        while self._rejected:
            yield self._rejected.popleft()

    def _read(self) -> None:
        for line in _lines(sys.stdin.fileno()):
            if (why := self._take(line)) is not None:
                self._rejected.append((line[:SHOWN], why))
        self.stopped = self.stopped or "stdin ended"

    def _take(self, line: str) -> str | None:
        """Process a line. Returns the reason if it is rejected, else None."""
        try:
            value = json.loads(line)
        except (ValueError, RecursionError):
            return "it is no JSON"
        if isinstance(value, dict) and "position" in value and "command" not in value:
            return self._measure(line, value)
        order = order_of(value, line[:SHOWN])
        if isinstance(order, str):
            return order
        if order.command == "stop":
            self.stopped = "told to stop"
        elif order.command == "leave":
            self.leaving = True
        elif len(self._others) < HELD:
            self._others.append(order)
        else:
            return f"{HELD} orders wait already; tell it again later"
        return None

    def _measure(self, line: str, given: dict[str, Any]) -> str | None:
        position, stamp, heading, others = map(given.get, ("position", "stamp", "heading", "neighbours"))
        if self._dimension is None:
            return "the position of this agent is simulated; start it with --sensor stdin to measure it"
        if not _is_place(position, self._dimension):
            return f"position must be a list of {self._dimension} finite numbers"
        if not (stamp is None or _is_coordinate(stamp)):
            return "stamp must be a finite number"
        if not (heading is None or _is_coordinate(heading)):
            return "heading must be a finite number, rad"
        if not (others is None or (isinstance(others, list) and all(_is_place(each, self._dimension) for each in others))):
            return f"neighbours must be a list of lists of {self._dimension} finite numbers"
        new = Measurement(
            np.array(position, dtype=float), time.monotonic(), None if stamp is None else float(stamp),
            None if heading is None else float(heading),
            None if others is None else np.array(others, dtype=float).reshape(-1, self._dimension),
        )  # fmt: skip
        self._measurements.append((line[:SHOWN], new))
        return None


def _lines(descriptor: int) -> Iterator[str]:
    """The lines of a file descriptor. Lines are cut to `LONGEST_LINE` bytes; invalid UTF-8 is replaced.

    `sys.stdin` is not used: a thread that waits in it holds its lock, which would abort the process at exit.
    """
    rest = b""
    while data := os.read(descriptor, LONGEST_LINE):
        *lines, rest = (rest + data).split(b"\n")
        rest = rest[:LONGEST_LINE]
        yield from (line[:LONGEST_LINE].decode(errors="replace").strip() for line in lines)
    if rest:
        yield rest.decode(errors="replace").strip()


def _is_place(value: Any, dimension: int) -> bool:
    return isinstance(value, list) and len(value) == dimension and all(map(_is_coordinate, value))


def _is_coordinate(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and abs(value) <= LARGEST


@contextmanager
def heeding_signals(orders: Orders) -> Iterator[None]:
    """Handle SIGTERM, SIGHUP and Ctrl-C inside the context: they stop the agent after its step, so that it can command its body to stop and
    send a goodbye."""

    def stop(number: int, _: FrameType | None) -> None:
        orders.stopped = signal.Signals(number).name

    heeded = [number for number in (signal.SIGTERM, signal.SIGINT, signal.SIGHUP) if signal.getsignal(number) is not signal.SIG_IGN]
    before = {number: signal.signal(number, stop) for number in heeded}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
