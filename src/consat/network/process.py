"""One agent as a process: its steps in real time over a real network, commands and measurements from stdin, JSON lines to stdout.

A line on stdin is ``{"position": [x, y]}``, a measurement, or ``{"command": "stop"}`` or ``{"command": "leave"}``; what is anything else
is reported and ignored. Each line on stdout is an event: ``start``, ``report``, ``command`` (a velocity), ``satisfied`` …
"""

from __future__ import annotations

import json
import math
import os
import signal
import sys
import threading
import time
from collections import deque
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from types import FrameType
from typing import Any, Final, Literal

import jax
import numpy as np

from consat.network.body import MeasuredBody, SimulatedBody
from consat.network.core import Core, Moment
from consat.network.modes import Manner, Runner, core_of, runner_of
from consat.network.part import Part
from consat.network.transports import Transport
from consat.network.transports.weather import Weathered

LONGEST_LINE: Final = 65536
"""Characters read of a line on stdin."""
NAP: Final = 0.05
"""No wait is longer, s, so that signals and commands are soon seen."""
LINGER: Final = 2.0
"""An agent that is done because all are satisfied goes on so long, s, so that its neighbours learn of it."""


@dataclass(frozen=True)
class Circumstances:
    """What surrounds an agent's process.

    Attributes:
        loss: probability that a message that arrives is dropped, for trials.
        delay: (low, high) for which each is held back, s, for trials.
        seed: of loss and delay.
        speed: the most that the body moves, length/s.
        sensor: ``simulated``, or ``stdin``: positions are measured by somebody else and read there.
        position: where a simulated body is; None for the start in the part.
        until: when to stop, s; None for never.
        stop: whether to stop once all are known to be satisfied.
        attached: stop when stdin ends, as it does when the process that started this one dies.
        keys: folder of the team's or the agent's keys; None for a network without protection.
    """

    loss: float = 0.0
    delay: tuple[float, float] = (0.0, 0.0)
    seed: int = 0
    speed: float = math.inf
    sensor: Literal["simulated", "stdin"] = "simulated"
    position: tuple[float, ...] | None = None
    until: float | None = None
    stop: Literal["satisfied", "never"] = "never"
    attached: bool = False
    keys: Path | None = None


def run_agent(part: Part, manner: Manner, around: Circumstances) -> None:
    """Run one agent until it is done, or told to stop.

    Raises:
        NetworkError: its address is taken, or its keys are unfit.
        InvalidSettings: mode and protocol do not fit.
    """
    jax.config.update("jax_enable_x64", True)
    jax.config.update("jax_cpu_enable_async_dispatch", False)
    core = core_of(part, manner)
    _warm(core)
    orders = _Orders(part.team.dimension, reading=around.attached or around.sensor == "stdin")
    body = MeasuredBody(around.speed) if around.sensor == "stdin" else SimulatedBody(_start(part, around), around.speed)
    with _orders_by_signal(orders), _transport(part, manner, around) as transport:
        runner = runner_of(
            part, manner, transport, clock=time.monotonic, incarnation=time.time_ns() // 1_000_000, body=body, log=_write, core=core
        )
        runner.station.log("start", mode=manner.mode, run=part.run, pid=os.getpid(), rounds=manner.mode == "lockstep")
        why = _loop(runner, transport, orders, body, around)
        runner.station.goodbye()
        runner.station.report()
        runner.station.log("end", why=why, cpu=round(time.process_time(), 3))


def _loop(runner: Runner, transport: Transport, orders: _Orders, body: SimulatedBody | MeasuredBody, around: Circumstances) -> str:
    began, known_since = time.monotonic(), math.inf
    told: np.ndarray | None = None
    while True:
        due = runner.step()
        now = time.monotonic()
        station = runner.station
        if isinstance(body, MeasuredBody):
            orders.measure(body)
            if station.velocity is not None and station.velocity is not told:
                told = station.velocity
                station.log("command", velocity=told.tolist())
        for line in orders.rejected():
            station.log("rejected", line=line)
        if orders.leaving:
            orders.leaving = False
            runner.leave()
        known_since = min(known_since, now) if station.satisfied else math.inf
        if runner.done:
            return "done"
        if orders.stopped:
            return orders.stopped
        if around.until is not None and now - began >= around.until:
            return "out of time"
        if around.stop == "satisfied" and now - known_since >= LINGER:
            return "satisfied"
        transport.wait(min(max(due - now, 0.0), NAP))


def _warm(core: Core) -> None:
    """Compile before the first neighbour can wait for it."""
    count = len(core.ends)
    moment = Moment(0.0, 1.0, np.zeros(count), np.ones(count, dtype=bool))
    core.turn(core.begin(core.part.first), np.zeros((count, core.width)), np.zeros(count, dtype=bool), moment)


def _start(part: Part, around: Circumstances) -> np.ndarray:
    return part.first[part.team.ids.index(part.me)] if around.position is None else np.array(around.position, dtype=float)


@contextmanager
def _transport(part: Part, manner: Manner, around: Circumstances) -> Iterator[Transport]:
    from consat.network import keys
    from consat.network.transports.zenoh import connect

    credentials = None if around.keys is None else keys.load(around.keys, part.me)
    listen, *others = (_protected(address) if credentials else address for address in (part.listen, *(n.address for n in part.neighbours)))
    addresses = {neighbour.id: address for neighbour, address in zip(part.neighbours, others, strict=True)}
    transport = connect(part.run, part.me, listen, addresses, reliable=manner.reliable, credentials=credentials)
    try:
        if around.loss > 0 or around.delay[1] > 0:
            yield Weathered(transport, time.monotonic, loss=around.loss, delay=around.delay, seed=around.seed)
        else:
            yield transport
    finally:
        transport.close()


def _protected(address: str) -> str:
    """The address with encryption. One that has it keeps it also where there are no keys: then nobody listens rather than in the clear."""
    kind, _, rest = address.partition("/")
    return f"tls/{rest}" if kind == "tcp" else address


def _write(event: dict[str, Any]) -> None:
    sys.stdout.write(json.dumps(event) + "\n")
    sys.stdout.flush()


class _Orders:
    """What stdin and signals say."""

    def __init__(self, dimension: int, *, reading: bool) -> None:
        self.stopped = ""
        self.leaving = False
        self._dimension = dimension
        self._positions: deque[np.ndarray] = deque(maxlen=1)
        self._rejected: deque[str] = deque(maxlen=16)
        if reading:
            threading.Thread(target=self._read, name="stdin", daemon=True).start()

    def measure(self, body: MeasuredBody) -> None:
        """Hand on the newest measurement."""
        if self._positions:
            body.measure(self._positions.pop())

    def rejected(self) -> Iterator[str]:
        """The lines that mean nothing, each once."""
        while self._rejected:
            yield self._rejected.popleft()

    def _read(self) -> None:
        while line := sys.stdin.readline(LONGEST_LINE):
            if not self._take(line):
                self._rejected.append(line.strip()[:80])
        self.stopped = self.stopped or "stdin ended"

    def _take(self, line: str) -> bool:
        try:
            order = json.loads(line)
        except (ValueError, RecursionError):
            return False
        if not isinstance(order, dict):
            return False
        position, command = order.get("position"), order.get("command")
        if command == "stop":
            self.stopped = "told to stop"
        elif command == "leave":
            self.leaving = True
        elif isinstance(position, list) and len(position) == self._dimension and all(map(_is_coordinate, position)):
            self._positions.append(np.array(position, dtype=float))
        else:
            return False
        return True


def _is_coordinate(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and abs(value) <= 1e100


@contextmanager
def _orders_by_signal(orders: _Orders) -> Iterator[None]:
    """SIGTERM and Ctrl-C stop the agent after its step, so that it can say goodbye."""

    def stop(number: int, _: FrameType | None) -> None:
        orders.stopped = signal.Signals(number).name

    before = {number: signal.signal(number, stop) for number in (signal.SIGTERM, signal.SIGINT)}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
