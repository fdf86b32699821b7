"""The processes of a team on this machine: starts them, reads their events, and ends them."""

from __future__ import annotations

import json
import os
import random
import selectors
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from types import TracebackType
from typing import Any, Final, Self

from consat.errors import NetworkError
from consat.network.deploy.environment import prepare
from consat.network.names import spelled
from consat.network.node.part import Part, write_part

PATIENCE: Final = 3.0
"""Time that an agent has to stop by itself before it is terminated, s."""
LARGEST_READ: Final = 2**20
"""Largest number of bytes read from the output of an agent at once."""

PORTS: Final = (10240, 32768)
"""Range of the ports of a team; the upper end is excluded."""

Event = Mapping[str, Any]
"""An event that an agent has written to stdout; see `consat.network.deploy.process`."""


@dataclass
class _Child:
    """The process of one agent.

    Attributes:
        process: the process.
        rest: the last, incomplete line of its output.
    """

    process: subprocess.Popen[bytes]
    rest: bytes = b""


@dataclass(frozen=True)
class Fleet:
    """The processes of a team. A context manager; at the end of the block, processes that still run are killed.

    Args:
        parts: the part (local problem) of each agent, by id.
        options: command line options of ``consat agent`` for all agents.
        exact: see `consat.network.deploy.environment.prepare`.
    """

    parts: Mapping[str, Part]
    options: Sequence[str] = ()
    exact: bool = False
    _children: dict[str, _Child] = field(default_factory=dict)
    _selector: selectors.BaseSelector = field(default_factory=selectors.DefaultSelector)
    _folder: tempfile.TemporaryDirectory[str] = field(default_factory=lambda: tempfile.TemporaryDirectory(prefix="consat-"))

    def __enter__(self) -> Self:
        for agent, part in self.parts.items():
            self.write(agent, part)
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        for child in self._children.values():
            if child.process.poll() is None:
                child.process.kill()
        for child in self._children.values():
            self._bury(child)
        self._children.clear()
        self._selector.close()
        self._folder.cleanup()

    def file(self, agent: str, ending: str = "yaml") -> Path:
        """The path of a private file of an agent, in a folder that only this user can read.

        Args:
            agent: id of the agent.
            ending: ``yaml`` for its part; another ending for another file.
        """
        return Path(self._folder.name) / f"{spelled(agent)}.{ending}"

    def write(self, agent: str, part: Part) -> None:
        """Write the part of an agent to its private file. The agent reads it when it starts and on the order ``reload``."""
        self.file(agent).write_text(write_part(part), encoding="utf-8")

    def start(self, agent: str, *options: str) -> None:
        """Start the process of an agent, or restart it.

        Args:
            agent: id of the agent.
            *options: command line options of this agent, which follow the common ones.
        """
        environment = dict(os.environ)
        prepare(environment, exact=self.exact)
        if agent in self._children:
            self._bury(self._children.pop(agent))
        command = [
            sys.executable, "-c", "from consat.cli import main; main()", "agent", str(self.file(agent)), "--id", agent, "--attached",
            *self.options, *options,
        ]  # fmt: skip
        pipe = subprocess.PIPE
        process = subprocess.Popen(command, stdin=pipe, stdout=pipe, env=environment, start_new_session=True)  # noqa: S603 - our own
        child = _Child(process)
        assert process.stdout is not None
        os.set_blocking(process.stdout.fileno(), False)
        self._selector.register(process.stdout, selectors.EVENT_READ, child)
        self._children[agent] = child

    def running(self, agent: str) -> bool:
        """Whether the process of an agent runs."""
        return agent in self._children and self._children[agent].process.poll() is None

    def exit_code(self, agent: str) -> int | None:
        """The exit code of an agent's process. None if it was never started, and until it has ended and `poll` has read all its output."""
        child = self._children.get(agent)
        if child is None or any(key.data is child for key in self._selector.get_map().values()):
            return None
        return child.process.poll()

    def pid(self, agent: str) -> int:
        """The process id of an agent."""
        return self._children[agent].process.pid

    def tell(self, agent: str, order: Mapping[str, Any]) -> None:
        """Write an order as a JSON line to the stdin of an agent. Does nothing if its process has ended."""
        if agent not in self._children:
            return
        stdin = self._children[agent].process.stdin
        assert stdin is not None
        try:
            stdin.write((json.dumps(dict(order)) + "\n").encode())
            stdin.flush()
        except (BrokenPipeError, ValueError):
            return

    def kill(self, agent: str) -> None:
        """Kill the process of an agent (SIGKILL)."""
        child = self._children[agent]
        child.process.kill()
        child.process.wait()

    def poll(self, timeout: float) -> list[Event]:
        """The events that have arrived. Waits at most `timeout`, s, for the first one."""
        events: list[Event] = []
        for key, _ in self._selector.select(timeout):
            child = key.data
            assert child.process.stdout is not None
            data = child.process.stdout.read1(LARGEST_READ)
            if not data:
                self._selector.unregister(child.process.stdout)
                continue
            *lines, child.rest = (child.rest + data).split(b"\n")
            events.extend(json.loads(line) for line in lines if line.startswith(b"{"))
        return events

    def stop(self) -> list[Event]:
        """Tell all agents to stop, wait up to `PATIENCE`, and terminate those that still run. Returns their last events."""
        for agent in self._children:
            self.tell(agent, {"command": "stop"})
        events, end = [], time.monotonic() + PATIENCE
        while self._selector.get_map() and time.monotonic() < end:
            events += self.poll(0.05)
        for child in self._children.values():
            if child.process.poll() is None:
                child.process.terminate()
        return events

    def _bury(self, child: _Child) -> None:
        """Wait for the end of a process and close its pipes."""
        child.process.wait()
        for stream in (child.process.stdin, child.process.stdout):
            assert stream is not None
            if stream in [key.fileobj for key in self._selector.get_map().values()]:
                self._selector.unregister(stream)
            try:
                stream.close()
            except BrokenPipeError:
                continue


def free_ports(count: int) -> list[int]:
    """Free TCP ports of this machine.

    They lie below the range that systems use for outgoing connections. Otherwise an agent that connects to a neighbour that is not up yet
    could be given the port of this neighbour.

    Args:
        count: number of ports.

    Raises:
        NetworkError: there are not enough free ports.
    """
    found: list[int] = []
    for port in random.sample(range(*PORTS), PORTS[1] - PORTS[0]):
        if len(found) == count:
            return found
        with socket.socket() as probe:
            try:
                probe.bind(("127.0.0.1", port))
            except OSError:
                continue
            found.append(port)
    raise NetworkError(f"there are no {count} free ports on 127.0.0.1 between {PORTS[0]} and {PORTS[1]}")
