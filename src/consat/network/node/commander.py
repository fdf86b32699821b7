"""Commands to an external body. The first and the last command are to stop, however the agent ends."""

from __future__ import annotations

import math
import sys
import time
from collections.abc import Callable
from typing import Any, Final

import numpy as np

from consat.network.node.body import MeasuredBody
from consat.network.node.orders import Orders

PERIOD: Final = 0.1
"""Largest time between two commands, s."""


class Commander:
    """Sends commands to a measured body while its position is known. A simulated body needs no commands.

    Args:
        me: id of the agent.
        dimension: number of entries of a command.
        body: the measured body; None for a simulated one.
        timeout: time without a measurement, s, after which the sensor counts as lost.
        write: function that takes events.
    """

    def __init__(self, me: str, dimension: int, body: MeasuredBody | None, timeout: float, write: Callable[[dict[str, Any]], None]) -> None:
        self._me, self._still, self._body, self._timeout, self._write = me, np.zeros(dimension), body, timeout, write
        self._began = math.inf
        self._target: np.ndarray | None = None
        self._due = -math.inf
        self._lost = self._over = False
        self._command(self._still)

    def sense(self, orders: Orders) -> None:
        """Pass the received measurements to the body, and log those that it rejects."""
        for line, new in orders.measurements():
            if self._body is not None and (why := self._body.measure(new)) is not None:
                self._log("rejected", line=line, why=why)

    def steer(self, target: np.ndarray | None) -> None:
        """Send a command towards `target`, (d,), when the target is new, and at least every `PERIOD`; to stop if the target is None."""
        if self._body is None:
            return
        now = time.monotonic()
        self._began = min(self._began, now)
        lost = not self._body.sensed(now) and now - self._began > self._timeout
        if lost == self._lost and target is self._target and now < self._due:
            return
        if lost != self._lost:
            self._lost = lost
            self._log("unmeasured" if lost else "measured")
            self._complain(f"has no measurement for {self._timeout:g} s, and stands" if lost else "is measured again")
        self._target, self._due = target, now + PERIOD
        self._command(self._still if target is None or self._over else self._body.command(target, now))

    def halt(self) -> None:
        """Command the body to stop; all later commands are to stop, too."""
        self._over = True
        self._command(self._still)

    def _command(self, command: np.ndarray) -> None:
        if self._body is not None:
            self._log("command", **self._body.named(command), valid_for=self._body.valid)

    def _log(self, event: str, **details: Any) -> None:
        self._write({"event": event, "id": self._me, "t": time.monotonic(), **details})

    def _complain(self, what: str) -> None:
        sys.stderr.write(f"consat: agent {self._me!r} {what}\n")
        sys.stderr.flush()
