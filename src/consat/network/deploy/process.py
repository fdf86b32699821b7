"""One agent as a process: its steps in real time over a real network, commands and measurements from stdin, JSON lines to stdout.

A line on stdin is ``{"position": [x, y]}``, a measurement, which may have a ``"stamp"``, or ``{"command": "stop"}`` or
``{"command": "leave"}``; what is anything else is reported and ignored. Each line on stdout is an event: ``start``, ``report``,
``command`` (a velocity, and for how long it is valid), ``satisfied`` …

Whatever ends the agent, or takes its sensor from it, its last command is to stand.
"""

from __future__ import annotations

import json
import math
import os
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, Literal

import jax
import numpy as np

from consat.errors import InvalidSettings
from consat.network.node.body import MeasuredBody, SimulatedBody
from consat.network.node.core import Embodied, Moment
from consat.network.node.helm import Helm
from consat.network.node.modes import Manner, Runner, core_of, runner_of
from consat.network.node.orders import Orders, heeding_signals
from consat.network.node.part import Part
from consat.network.node.pilot import RobotBody
from consat.network.transports import Transport
from consat.network.transports.faults import Weathered
from consat.robots.description import asked

NAP: Final = 0.05
"""No wait is longer, s, so that signals and commands are soon seen."""
LINGER: Final = 2.0
"""An agent that is done because of what it knows goes on so long, s, so that its neighbours learn of it."""


@dataclass(frozen=True)
class Circumstances:
    """What surrounds an agent's process.

    Attributes:
        loss: probability that a message that arrives is dropped, for trials.
        delay: (low, high) for which each is held back, s, for trials.
        seed: of loss and delay.
        speed: the most that the body moves, length/s.
        robot: the kind of robot that is commanded; None for that of the scenario, if any.
        sensor: ``simulated``, or ``stdin``: positions are measured by somebody else and read there.
        sensor_timeout: after so long without a measurement, s, the body is commanded to stand.
        position: where a simulated body is; None for the start in the part.
        until: when to stop, s; None for never.
        stop: whether to stop once all are known to be satisfied, or to be near the best where they cannot be.
        attached: stop when stdin ends, as it does when the process that started this one dies.
        keys: folder of the team's or the agent's keys; None for a network without protection.
    """

    loss: float = 0.0
    delay: tuple[float, float] = (0.0, 0.0)
    seed: int = 0
    speed: float = math.inf
    robot: str | None = None
    sensor: Literal["simulated", "stdin"] = "simulated"
    sensor_timeout: float = 0.5
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
    dimension = part.team.dimension
    measured = _measured(part, around) if around.sensor == "stdin" else None
    body = SimulatedBody(_start(part, around), around.speed) if measured is None else measured
    orders = Orders(None if measured is None else dimension, reading=around.attached or measured is not None)
    with heeding_signals(orders):
        helm = Helm(part.me, dimension, measured, around.sensor_timeout, _write)
        core = core_of(part, manner)
        _warm(core)
        with _transport(part, manner, around) as transport:
            runner = runner_of(
                part, manner, transport, clock=time.monotonic, incarnation=time.time_ns() // 1_000_000, body=body, log=_write, core=core
            )
            runner.station.log("start", mode=manner.mode, run=part.run, pid=os.getpid(), rounds=manner.mode == "lockstep")
            try:
                why = _loop(runner, transport, orders, helm, around)
            finally:
                helm.stand()
            runner.station.goodbye()
            runner.station.report()
            runner.station.log("end", why=why, cpu=round(time.process_time(), 3))


def _loop(runner: Runner, transport: Transport, orders: Orders, helm: Helm, around: Circumstances) -> str:
    station, end = runner.station, math.inf if around.until is None else time.monotonic() + around.until
    known_since = math.inf
    while True:
        helm.sense(orders)
        due = runner.step()
        now = time.monotonic()
        helm.sense(orders)  # what came during the step
        helm.steer(station.target)
        for line, why in orders.rejected():
            station.log("rejected", line=line, why=why)
        if orders.leaving:
            orders.leaving = False
            helm.stand()
            runner.leave()
        known_since = min(known_since, now) if station.settled else math.inf
        if runner.done:
            return "done"
        if orders.stopped:
            return orders.stopped
        if now >= end:
            return "out of time"
        if around.stop == "satisfied" and now - known_since >= LINGER:
            return str(station.known)
        transport.wait(min(max(due - now, 0.0), NAP))


def _warm(core: Embodied) -> None:
    """Compile before the first neighbour can wait for it."""
    moment = Moment(0.0, 1.0, np.zeros(len(core.ends)), np.ones(len(core.ends), dtype=bool), np.zeros(core.part.team.dimension))
    _, _, look = core.turn(core.begin(core.part.first), *core.empty(), moment)
    core.margin(look.bodies)


def _measured(part: Part, around: Circumstances) -> MeasuredBody:
    """A body that somebody else moves: a robot, if the scenario or the command line names one."""
    robots = asked(around.robot, None, part.robots, part.team.ids)
    if robots is None:
        return MeasuredBody(around.speed, around.sensor_timeout)
    if math.isfinite(around.speed):
        raise InvalidSettings("--speed is of bodies that are points; robots have a speed of their own, robots: {speed: ..}")
    return RobotBody(robots, part.team.dimension, around.sensor_timeout)


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
