"""One agent as a process: steps in real time over a real network, orders and measurements from stdin, JSON lines to stdout.

A line on stdin is a measurement ``{"position": [x, y]}``, optionally with a ``"stamp"``, or an order such as ``{"command": "leave"}``; see
`consat.network.node.orders`. Other lines are reported and ignored. Each line on stdout is an event: ``start``, ``report``, ``command`` (a
velocity and the time for which it is valid), ``satisfied``, ``changed``, ``rejected`` …

If the agent ends for any reason, or loses its sensor, its last command is zero velocity.
"""

from __future__ import annotations

import math
import os
import time
from collections.abc import Callable, Iterator
from concurrent.futures import Executor, Future, ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Final, Literal, NamedTuple

import jax
import numpy as np

from consat.errors import InvalidInput, InvalidSettings, InvalidTeam
from consat.faults import Faults
from consat.network.deploy.output import Output
from consat.network.node.body import Body, MeasuredBody, SimulatedBody
from consat.network.node.build import core_of, runner_of
from consat.network.node.commander import Commander
from consat.network.node.core import Moment
from consat.network.node.embodied import Embodied
from consat.network.node.membership import Membership
from consat.network.node.modes import NodeSettings
from consat.network.node.orders import Order, Orders, heeding_signals
from consat.network.node.part import Part
from consat.network.node.pilot import RobotBody
from consat.network.node.runner import Runner
from consat.network.node.station import Station
from consat.network.transports import Transport
from consat.network.transports.faults import FaultyTransport
from consat.scenario.robots import asked

NAP: Final = 0.05
"""Longest wait, s, so that signals and orders are noticed soon."""
NO_FILE: Final = "the agent was started from a scenario; only a part of its own can be read again"
LINGER: Final = 2.0
"""Time that an agent continues after it knows the outcome, s, so that its neighbours learn it, too."""


@dataclass(frozen=True)
class ProcessOptions:
    """Options of an agent's process.

    Attributes:
        faults: faults of incoming messages, for experiments.
        speed: largest speed of the body, length/s.
        robot: kind of the robot that is commanded; None for that of the scenario, if any.
        sensor: ``simulated``, or ``stdin`` if measured positions are read from stdin.
        sensor_timeout: time without a measurement after which the body is commanded to stop, s.
        position: start position of a simulated body, (d,), length; None for the start in the part.
        until: duration, s; None for no limit.
        stop: ``satisfied`` to stop once it is known that all agents are satisfied, or that the team is infeasible and near its best margin.
        attached: whether to stop when stdin ends, as it does when the parent process dies.
        keys: folder of the keys of the team or the agent; None for a network without protection.
        epoch: Unix time of t = 0, s; None for the one in the part.
        standby: whether to wait for the order ``join``.
    """

    faults: Faults = field(default_factory=Faults)
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


class Restart(NamedTuple):
    """The state with which an agent starts, or continues after it has reloaded its part.

    Attributes:
        part: its local problem.
        core: the compiled protocol for this part.
        membership: which agents are present.
    """

    part: Part
    core: Embodied
    membership: Membership


def run_agent(part: Part, settings: NodeSettings, options: ProcessOptions, reread: Callable[[], Part] | None = None) -> None:
    """Run one agent until it is done or told to stop.

    Args:
        part: local problem of the agent.
        settings: its mode and rate.
        options: options of the process.
        reread: reads the part from its file again; None if the part has no file.

    Raises:
        NetworkError: its address is in use, or its keys are not usable.
        InvalidSettings: mode and protocol do not fit, or constraints move and the time t = 0 is not known.
    """
    part = part if options.epoch is None else replace(part, epoch=options.epoch)
    jax.config.update("jax_enable_x64", True)
    jax.config.update("jax_cpu_enable_async_dispatch", False)
    dimension = part.team.dimension
    measured = _measured(part, options) if options.sensor == "stdin" else None
    body = SimulatedBody(_start(part, options), options.speed) if measured is None else measured
    reading = options.attached or measured is not None or options.standby
    if part.team.moves and part.epoch is None and settings.mode != "lockstep" and not reading:
        raise InvalidSettings("constraints move with time, but nobody says when t = 0 is; say --epoch, to all agents the same")
    orders = Orders(None if measured is None else dimension, reading=reading)
    with Output() as output, heeding_signals(orders):
        commander = Commander(part.me, dimension, measured, options.sensor_timeout, output.write)
        core = core_of(part, settings)
        _compile(core)
        try:
            _Process(settings, options, body, orders, commander, reread, output.write).run(Restart(part, core, Membership(part)))
        except BaseException:
            commander.halt()
            raise


@dataclass
class _Process:
    """What an agent keeps when its part is reloaded, and the loop that runs it.

    Attributes:
        settings: mode and rate of the agent.
        options: options of the process.
        body: the body of the agent.
        orders: orders and measurements from stdin.
        commander: sends velocity commands to the body.
        reread: reads the part from its file; None if the part has no file.
        write: writes an event.
        end: time on the monotonic clock at which the process ends, s.
        reading: the reload order in progress, with its future result.
    """

    settings: NodeSettings
    options: ProcessOptions
    body: Body
    orders: Orders
    commander: Commander
    reread: Callable[[], Part] | None
    write: Callable[[dict[str, Any]], None]
    end: float = math.inf
    reading: tuple[Order, Future[tuple[Part, Embodied] | str]] | None = None

    def run(self, begin: Restart) -> None:
        """Run the agent, with one part after the other, until it ends."""
        outcome = self._wait_to_join(begin) if self.options.standby else begin
        if self.options.until is not None:
            self.end = time.monotonic() + self.options.until
        with ThreadPoolExecutor(1) as reader:
            while isinstance(outcome, Restart):
                outcome = self._run_part(outcome, reader)

    def _wait_to_join(self, begin: Restart) -> Restart | str:
        """Wait for the order ``join``. Returns the state to begin with, or the reason why the process must end."""
        part, core, orders = begin.part, begin.core, self.orders

        def write(event: str, **details: Any) -> None:
            self.write({"event": event, "id": part.me, "t": time.monotonic(), **details})

        write("standby", pid=os.getpid())
        while not orders.stopped and not orders.leaving:
            for line, why in orders.rejected():
                write("rejected", line=line, why=why)
            while (order := orders.next()) is not None:
                outcome: Any = "the agent has not joined yet"
                if order.command == "join":
                    return Restart(part, core, Membership(part))
                if order.command == "clock":
                    outcome, part = None, replace(part, epoch=float(order.given["epoch"]))
                elif order.command == "reload":
                    outcome = _reloaded(part, core, self.reread)
                if isinstance(outcome, tuple):
                    part, core = replace(outcome[0], epoch=outcome[0].epoch or part.epoch), outcome[1]
                elif outcome is not None:
                    write("rejected", line=order.line, why=outcome)
            time.sleep(NAP)
        why = orders.stopped or "told to leave"
        write("end", why=why, cpu=round(time.process_time(), 3))
        return why

    def _run_part(self, begin: Restart, reader: Executor) -> Restart | str:
        """Run with one part. Returns the state to continue with after a reload, or the reason of the end."""
        part, settings = begin.part, self.settings
        with _transport(part, settings, self.options) as transport:
            incarnation = time.time_ns() // 1_000_000
            station = Station(
                part, begin.core, settings, transport, clock=time.monotonic, incarnation=incarnation, body=self.body, log=self.write
            )
            station.membership.adopt(begin.membership)
            station.log("start", mode=settings.mode, run=part.run, pid=os.getpid(), rounds=settings.mode == "lockstep")
            try:
                outcome = self._loop(runner_of(station), transport, reader)
            except BaseException:
                self.commander.halt()  # before the transport is closed, which may take long
                raise
            if isinstance(outcome, str):
                self.commander.halt()
                station.send_goodbye()
            station.report()
            if isinstance(outcome, str):
                station.log("end", why=outcome, cpu=round(time.process_time(), 3))
            return outcome

    def _loop(self, runner: Runner, transport: Transport, reader: Executor) -> Restart | str:
        station, orders, commander = runner.station, self.orders, self.commander
        known_since = math.inf
        while True:
            commander.sense(orders)
            due = runner.step()
            now = time.monotonic()
            commander.sense(orders)  # measurements that arrived during the step
            commander.steer(station.target)
            if (restart := self._execute_orders(runner, reader)) is not None:
                return restart
            known_since = min(known_since, now) if station.settled else math.inf
            if runner.done:
                return "done"
            if orders.stopped:
                return orders.stopped
            if now >= self.end:
                return "out of time"
            if self.options.stop == "satisfied" and now - known_since >= LINGER:
                return str(station.known)
            transport.wait(min(max(due - now, 0.0), NAP))

    def _execute_orders(self, runner: Runner, reader: Executor) -> Restart | None:
        """Carry out the orders from stdin and log those that are rejected. Returns the state to continue with once a reload is done.

        A new part is read and compiled in a separate thread. Meanwhile the agent continues as before, and later orders wait.
        """
        station, orders = runner.station, self.orders
        for line, why in orders.rejected():
            station.log("rejected", line=line, why=why)
        while self.reading is None and (order := orders.next()) is not None:
            if order.command == "reload":
                self.reading = order, reader.submit(_reloaded, station.part, station.core, self.reread)
            elif (refusal := _execute(runner, order)) is not None:
                station.log("rejected", line=order.line, why=refusal)
        if orders.leaving:
            orders.leaving = False
            self.commander.halt()
            station.log("leaving")
            runner.leave()
        if self.reading is not None and self.reading[1].done():
            (order, found), self.reading = self.reading, None
            if isinstance(outcome := found.result(), tuple):
                return _restart(station, *outcome)
            station.log("rejected", line=order.line, why=outcome)
        return None


def _restart(station: Station, part: Part, core: Embodied) -> Restart:
    """The state after a reload, starting from the current estimates. New copies start at the agent's estimate of its own position, as in
    `consat.protocols.estimates.Estimates.carried`."""
    known = station.estimates
    own = known.get(part.me)
    first = [known.get(agent, row if own is None else own) for agent, row in zip(part.team.ids, part.first, strict=True)]
    return Restart(
        replace(part, first=np.array(first), epoch=station.epoch if part.epoch is None else part.epoch), core, station.membership
    )


def _reloaded(before: Part, core: Embodied, reread: Callable[[], Part] | None) -> tuple[Part, Embodied] | str:
    """The part read again from its file, with a compiled core; or the reason why it cannot be used."""
    if reread is None:
        return NO_FILE
    try:
        part = _fitting(reread(), before)
        fresh = core.without(frozenset(), part)
    except (InvalidInput, InvalidSettings, OSError) as error:
        return "; ".join(str(error).splitlines())
    _compile(fresh)
    return part, fresh


def _fitting(part: Part, before: Part) -> Part:
    """The part unchanged. Raises: InvalidSettings: its agent, run, address or dimension differs from `before`."""
    same = {
        "agent": (before.me, part.me), "run": (before.run, part.run), "address": (before.listen, part.listen),
        "dimension": (before.team.dimension, part.team.dimension),
    }  # fmt: skip
    for what, (old, new) in same.items():
        if old != new:
            raise InvalidSettings(f"{what} is {new!r}, but must stay {old!r}")
    return part


def _execute(runner: Runner, order: Order) -> str | None:
    """Carry out an order. Returns None, or one line that says why it was rejected."""
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


def _compile(core: Embodied) -> None:
    """Compile the core by running one turn, so that no neighbour waits for the compilation later."""
    moment = Moment(0.0, 1.0, np.zeros(len(core.ends)), np.ones(len(core.ends), dtype=bool), np.zeros(core.part.team.dimension))
    _, _, view = core.turn(core.begin(core.part.first), *core.empty(), moment)
    core.margin(view.bodies)


def _measured(part: Part, options: ProcessOptions) -> MeasuredBody:
    """A body with an external sensor: a robot if the scenario or the command line names one, else a point."""
    robots = asked(options.robot, None, part.robots, part.team.ids)
    if robots is None:
        return MeasuredBody(options.speed, options.sensor_timeout)
    if math.isfinite(options.speed):
        raise InvalidSettings("--speed is of bodies that are points; robots have a speed of their own, robots: {speed: ..}")
    return RobotBody(robots, part.team.dimension, options.sensor_timeout)


def _start(part: Part, options: ProcessOptions) -> np.ndarray:
    return part.first[part.own] if options.position is None else np.array(options.position, dtype=float)


@contextmanager
def _transport(part: Part, settings: NodeSettings, options: ProcessOptions) -> Iterator[Transport]:
    from consat.network.transports.zenoh import connect

    credentials = None
    if options.keys is not None:
        from consat.network.keys import load

        credentials = load(options.keys, part.me)
    listen, *others = (_protected(address) if credentials else address for address in (part.listen, *(n.address for n in part.neighbours)))
    addresses = {neighbour.id: address for neighbour, address in zip(part.neighbours, others, strict=True)}
    transport = connect(part.run, part.me, listen, addresses, reliable=settings.reliable, credentials=credentials)
    try:
        if options.faults.on_messages:
            yield FaultyTransport(transport, time.monotonic, options.faults)
        else:
            yield transport
    finally:
        transport.close()


def _protected(address: str) -> str:
    """The address with TLS instead of TCP. A TLS address stays as it is."""
    kind, _, rest = address.partition("/")
    return f"tls/{rest}" if kind == "tcp" else address
