"""The processes of a team on this machine: started, listened to, and ended by their handles."""

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
"""An agent told to stop has so long, s, before it is ended."""
LARGEST_READ: Final = 2**20

PORTS: Final = (10240, 32768)
"""Among which a team's are chosen."""

Event = Mapping[str, Any]


@dataclass
class _Child:
    """The process of one agent, and what it has written of a line so far."""

    process: subprocess.Popen[bytes]
    rest: bytes = b""


@dataclass(frozen=True)
class Fleet:
    """The processes of a team; leaving its `with` block ends those that still run.

    Args:
        parts: by agent.
        options: of ``consat agent``, the same for all.
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
        """The private file of an agent, or another of its own, in a folder that only this user can read."""
        return Path(self._folder.name) / f"{spelled(agent)}.{ending}"

    def write(self, agent: str, part: Part) -> None:
        """Write the private file of an agent; what it reads when it starts, or is told to read it again."""
        self.file(agent).write_text(write_part(part), encoding="utf-8")

    def start(self, agent: str, *options: str) -> None:
        """Start an agent, or start it again; `options` of its own come after the common ones."""
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
        self._selector.register(process.stdout, selectors.EVENT_READ, (agent, child))
        self._children[agent] = child

    def running(self, agent: str) -> bool:
        """Whether its process is."""
        return agent in self._children and self._children[agent].process.poll() is None

    def exit_code(self, agent: str) -> int | None:
        """With which its process ended; None while it runs, or if it never did."""
        return self._children[agent].process.poll() if agent in self._children else None

    def pid(self, agent: str) -> int:
        """Of its process."""
        return self._children[agent].process.pid

    def tell(self, agent: str, order: Mapping[str, Any]) -> None:
        """Write a line on its stdin; nothing if it is gone."""
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
        """End it without a word (SIGKILL)."""
        child = self._children[agent]
        child.process.kill()
        child.process.wait()

    def poll(self, timeout: float) -> list[Event]:
        """The events that have come; waits for the first one no longer than `timeout`, s."""
        events: list[Event] = []
        for key, _ in self._selector.select(timeout):
            _, child = key.data
            assert child.process.stdout is not None
            data = child.process.stdout.read1(LARGEST_READ)
            if not data:
                self._selector.unregister(child.process.stdout)
                continue
            *lines, child.rest = (child.rest + data).split(b"\n")
            events.extend(json.loads(line) for line in lines if line.startswith(b"{"))
        return events

    def stop(self) -> list[Event]:
        """Tell all to stop, wait for them, and end those that don't; their last events."""
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
        """Close what a process has left open."""
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
    """Ports of this machine that nobody listens at.

    They lie below those that systems give to connections going out: an agent that tries to reach a neighbour that is not there yet might
    get that neighbour's port.

    Raises:
        NetworkError: there are not so many.
    """
    found: list[int] = []
    candidates = list(range(*PORTS))
    random.shuffle(candidates)
    for port in candidates:
        if len(found) == count:
            return found
        with socket.socket() as probe:
            try:
                probe.bind(("127.0.0.1", port))
            except OSError:
                continue
            found.append(port)
    raise NetworkError(f"there are no {count} free ports on 127.0.0.1 between {PORTS[0]} and {PORTS[1]}")
