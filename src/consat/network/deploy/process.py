"""One agent as a process: its steps in real time over a real network, commands and measurements from stdin, JSON lines to stdout.

A line on stdin is ``{"position": [x, y]}``, a measurement, which may have a ``"stamp"``, or an order such as ``{"command": "leave"}``, see
`consat.network.node.orders`; what is anything else is reported and ignored. Each line on stdout is an event: ``start``, ``report``,
``command`` (a velocity, and for how long it is valid), ``satisfied``, ``changed``, ``rejected`` …

Whatever ends the agent, or takes its sensor from it, its last command is to stand.
"""

from __future__ import annotations

import json
import math
import os
import sys
import time
from collections import deque
from collections.abc import Callable, Iterator
from concurrent.futures import Executor, Future, ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Final, Literal, NamedTuple

import jax
import numpy as np

from consat.errors import InvalidInput, InvalidSettings, InvalidTeam
from consat.network.node.body import Body, MeasuredBody, SimulatedBody
from consat.network.node.core import Embodied, Moment
from consat.network.node.helm import Helm
from consat.network.node.membership import Membership
from consat.network.node.modes import Manner, Runner, core_of, runner_of
from consat.network.node.orders import Order, Orders, heeding_signals
from consat.network.node.part import Part
from consat.network.node.pilot import RobotBody
from consat.network.node.station import Station
from consat.network.transports import Transport
from consat.network.transports.faults import Weathered
from consat.robots.description import asked

NAP: Final = 0.05
"""No wait is longer, s, so that signals and commands are soon seen."""
NO_FILE: Final = "the agent was started from a scenario; only a part of its own can be read again"
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
        epoch: when t = 0 is, s of Unix time; None for what the part says.
        standby: wait for the order to join.
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
    epoch: float | None = None
    standby: bool = False


class Anew(NamedTuple):
    """With what an agent goes on after it has read its part again: the part, the core for it, and who is there."""

    part: Part
    core: Embodied
    membership: Membership


def run_agent(part: Part, manner: Manner, around: Circumstances, again: Callable[[], Part] | None = None) -> None:
    """Run one agent until it is done, or told to stop.

    Args:
        part: the agent's own.
        manner: how it runs.
        around: what surrounds it.
        again: reads the part again; None where it is of no file of its own.

    Raises:
        NetworkError: its address is taken, or its keys are unfit.
        InvalidSettings: mode and protocol do not fit, or constraints move and nobody can say when t = 0 is.
    """
    part = part if around.epoch is None else replace(part, epoch=around.epoch)
    jax.config.update("jax_enable_x64", True)
    jax.config.update("jax_cpu_enable_async_dispatch", False)
    dimension = part.team.dimension
    measured = _measured(part, around) if around.sensor == "stdin" else None
    body = SimulatedBody(_start(part, around), around.speed) if measured is None else measured
    reading = around.attached or measured is not None or around.standby
    if part.team.moves and part.epoch is None and manner.mode != "lockstep" and not reading:
        raise InvalidSettings("constraints move with time, but nobody says when t = 0 is; say --epoch, to all agents the same")
    orders = Orders(None if measured is None else dimension, reading=reading)
    with heeding_signals(orders):
        helm = Helm(part.me, dimension, measured, around.sensor_timeout, _write)
        core = core_of(part, manner)
        _warm(core)
        begin = Anew(part, core, Membership(part))
        told = _wait_to_join(begin, orders, again) if around.standby else begin
        end = math.inf if around.until is None else time.monotonic() + around.until
        try:
            with ThreadPoolExecutor(1) as reader:
                own = _Own(body, orders, helm, again, reader, deque(), end)
                while isinstance(told, Anew):
                    told = _live(told, manner, around, own)
        except BaseException:
            helm.stand()
            raise


class _Own(NamedTuple):
    """What stays when the part is read again: the body, what the process is told, who reads the part and in which thread, what is being
    read, and when the process is to end."""

    body: Body
    orders: Orders
    helm: Helm
    again: Callable[[], Part] | None
    reader: Executor
    reading: deque[tuple[Order, Future[tuple[Part, Embodied] | str]]]
    end: float


def _live(begin: Anew, manner: Manner, around: Circumstances, own: _Own) -> Anew | str:
    """From one part until it is read again, or until the end: why."""
    part = begin.part
    with _transport(part, manner, around) as transport:
        runner = runner_of(
            part, manner, transport, clock=time.monotonic, incarnation=time.time_ns() // 1_000_000, body=own.body, log=_write,
            core=begin.core,
        )  # fmt: skip
        station = runner.station
        station.membership.adopt(begin.membership)
        station.log("start", mode=manner.mode, run=part.run, pid=os.getpid(), rounds=manner.mode == "lockstep")
        try:
            told = _loop(runner, transport, own, around)
        except BaseException:
            own.helm.stand()  # before the transport is closed, which may take its time
            raise
        if isinstance(told, str):
            own.helm.stand()
            station.goodbye()
        station.report()
        if isinstance(told, str):
            station.log("end", why=told, cpu=round(time.process_time(), 3))
        return told


def _loop(runner: Runner, transport: Transport, own: _Own, around: Circumstances) -> Anew | str:
    station, orders, helm = runner.station, own.orders, own.helm
    known_since = math.inf
    while True:
        helm.sense(orders)
        due = runner.step()
        now = time.monotonic()
        helm.sense(orders)  # what came during the step
        helm.steer(station.target)
        if (anew := _obey(runner, own)) is not None:
            return anew
        known_since = min(known_since, now) if station.settled else math.inf
        if runner.done:
            return "done"
        if orders.stopped:
            return orders.stopped
        if now >= own.end:
            return "out of time"
        if around.stop == "satisfied" and now - known_since >= LINGER:
            return str(station.known)
        transport.wait(min(max(due - now, 0.0), NAP))


def _obey(runner: Runner, own: _Own) -> Anew | None:
    """Carry out what the process was told, and say what it does not do; with what it goes on, once it has read its part again.

    While a part is read and compiled, in a thread of its own, the agent goes on as before; the orders that came after wait.
    """
    station, orders = runner.station, own.orders
    for line, why in orders.rejected():
        station.log("rejected", line=line, why=why)
    while not own.reading:
        if (order := orders.next()) is None:
            break
        if order.command == "reload":
            own.reading.append((order, own.reader.submit(_renewed, station.part, station.core, own.again)))
        elif (refusal := _heed(runner, order)) is not None:
            station.log("rejected", line=order.line, why=refusal)
    if orders.leaving:
        orders.leaving = False
        own.helm.stand()
        station.log("leaving")
        runner.leave()
    if own.reading and own.reading[0][1].done():
        order, found = own.reading.popleft()
        if isinstance(told := found.result(), tuple):
            return _carried(station, *told)
        station.log("rejected", line=order.line, why=told)
    return None


def _carried(station: Station, part: Part, core: Embodied) -> Anew:
    """With what an agent goes on, from the estimates that it has."""
    known = station.estimates
    first = [known.get(agent, row) for agent, row in zip(part.team.ids, part.first, strict=True)]
    return Anew(replace(part, first=np.array(first), epoch=station.epoch if part.epoch is None else part.epoch), core, station.membership)


def _renewed(before: Part, core: Embodied, again: Callable[[], Part] | None) -> tuple[Part, Embodied] | str:
    """The part as it is in its file now, and a core for it, compiled; or why it cannot be used."""
    if again is None:
        return NO_FILE
    try:
        part = _fitting(again(), before)
        fresh = core.among(frozenset(), part)
    except (InvalidInput, InvalidSettings, OSError) as error:
        return "; ".join(str(error).splitlines())
    _warm(fresh)
    return part, fresh


def _fitting(part: Part, before: Part) -> Part:
    """The part, if it is one of the same agent in the same run. Raises: InvalidSettings."""
    same = {
        "agent": (before.me, part.me), "run": (before.run, part.run), "address": (before.listen, part.listen),
        "dimension": (before.team.dimension, part.team.dimension),
    }  # fmt: skip
    for what, (old, new) in same.items():
        if old != new:
            raise InvalidSettings(f"{what} is {new!r}, but must stay {old!r}")
    return part


def _heed(runner: Runner, order: Order) -> str | None:
    """Carry out an order; or why not, in one line."""
    if order.command == "join":
        return "the agent is in the team already"
    if order.command == "clock":
        runner.station.epoch = float(order.given["epoch"])
        runner.station.log("clock", epoch=runner.station.epoch)
        return None
    try:
        runner.change(order.given["constraint"], {key: value for key, value in order.given.items() if key != "constraint"})
    except (InvalidTeam, InvalidSettings) as error:
        return "; ".join(str(error).splitlines())
    return None


def _wait_to_join(begin: Anew, orders: Orders, again: Callable[[], Part] | None) -> Anew | str:
    """Until the order to join comes: with what the agent begins; or why the process is to end before."""
    part, core = begin.part, begin.core

    def write(event: str, **details: Any) -> None:
        _write({"event": event, "id": part.me, "t": time.monotonic(), **details})

    write("standby", pid=os.getpid())
    while not orders.stopped and not orders.leaving:
        for line, why in orders.rejected():
            write("rejected", line=line, why=why)
        while (order := orders.next()) is not None:
            told: Any = "the agent has not joined yet"
            if order.command == "join":
                return Anew(part, core, Membership(part))
            if order.command == "clock":
                told, part = None, replace(part, epoch=float(order.given["epoch"]))
            elif order.command == "reload":
                told = _renewed(part, core, again)
            if isinstance(told, tuple):
                part, core = replace(told[0], epoch=told[0].epoch or part.epoch), told[1]
            elif told is not None:
                write("rejected", line=order.line, why=told)
        time.sleep(NAP)
    why = orders.stopped or "told to leave"
    write("end", why=why, cpu=round(time.process_time(), 3))
    return why


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
