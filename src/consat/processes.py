"""Several processes that run one team together: on this machine, started here, or on several, each started by hand or by a scheduler."""

from __future__ import annotations

import contextlib
import os
import socket
import subprocess
import sys
import time
from collections.abc import Mapping, Sequence

from consat.errors import InvalidSettings

COORDINATOR, PROCESS, OF = "CONSAT_COORDINATOR", "CONSAT_PROCESS", "CONSAT_OF"
"""What tells a process, if its command line doesn't: HOST:PORT of process 0, its own number from 0, and how many there are."""
PATIENCE = 120
"""How long processes wait for one another at the start, s."""
GRACE = 10.0
"""How long the others may take to end once one has failed, s."""


def join(coordinator: str, process: int, of: int, patience: int = PATIENCE) -> None:
    """Become one of several processes; before anything else is computed.

    Args:
        coordinator: HOST:PORT where process 0 listens, which it opens.
        process: number of this one, from 0.
        of: how many there are.
        patience: how long to wait for the others, s.

    Raises:
        InvalidSettings: they do not find together.
    """
    import jax

    if not 0 <= process < of:
        raise InvalidSettings(f"this is process {process} of {of}, but processes are numbered from 0 to {of - 1}")
    if ":" not in coordinator:
        raise InvalidSettings(f"the coordinator is {coordinator!r}, but must be HOST:PORT, where process 0 listens")
    _hush()
    jax.config.update("jax_cpu_collectives_implementation", "gloo")
    try:
        jax.distributed.initialize(coordinator, of, process, initialization_timeout=patience)
    except RuntimeError as error:
        raise InvalidSettings(f"process {process} of {of} found no others at {coordinator} within {patience} s ({error})") from error


def _hush() -> None:
    """Gloo writes to file descriptor 1, where the JSON goes: let that lead nowhere, and `sys.stdout` to where it led."""
    sys.stdout.flush()
    kept = os.dup(1)
    nowhere = os.open(os.devnull, os.O_WRONLY)
    os.dup2(nowhere, 1)
    os.close(nowhere)
    sys.stdout = os.fdopen(kept, "w", encoding=sys.stdout.encoding, errors="replace")


def asked(coordinator: str | None, process: int | None, of: int | None, environment: Mapping[str, str]) -> tuple[str, int, int] | None:
    """Where to join, from the command line and else the environment; None if nobody asks.

    Raises:
        InvalidSettings: only a part of it is given.
    """
    found = (coordinator or environment.get(COORDINATOR), _number(process, environment, PROCESS), _number(of, environment, OF))
    if all(value is None for value in found):
        return None
    where, number, count = found
    if where is None or number is None or count is None:
        raise InvalidSettings("a process needs --coordinator HOST:PORT, --process I and --of K, all three (or "
                              f"{COORDINATOR}, {PROCESS} and {OF} in its environment)")  # fmt: skip
    return where, number, count


def _number(given: int | None, environment: Mapping[str, str], name: str) -> int | None:
    if given is not None or name not in environment:
        return given
    try:
        return int(environment[name])
    except ValueError:
        raise InvalidSettings(f"{name} is {environment[name]!r}, but must be a whole number") from None


def launch(arguments: Sequence[str], count: int) -> int:
    """Run ``consat`` with these arguments in several processes on this machine.

    Process 0 speaks for all; of the others only what goes wrong is shown. When one fails, all end.

    Args:
        arguments: of the command line.
        count: how many processes.

    Returns:
        the exit code of process 0, or of the first that failed.
    """
    command = [sys.executable, "-m", "consat", *arguments]
    meet = {COORDINATOR: f"127.0.0.1:{_free_port()}", OF: str(count)}
    with contextlib.ExitStack() as stack:
        started = []
        for number in range(count):
            silent = None if number == 0 else subprocess.DEVNULL
            process = subprocess.Popen(command, env=os.environ | meet | {PROCESS: str(number)}, stdout=silent)  # noqa: S603 (ourselves)
            stack.callback(_end, process)
            started.append(process)
        while any(process.poll() is None for process in started):
            if failed := [process.returncode for process in started if process.returncode not in (None, 0, 4)]:
                deadline = time.monotonic() + GRACE
                while time.monotonic() < deadline and any(process.poll() is None for process in started):
                    time.sleep(0.05)
                return failed[0]
            try:
                time.sleep(0.02)
            except KeyboardInterrupt:  # the terminal tells all of them; they end at the same round
                continue
        return started[0].returncode


def _end(process: subprocess.Popen[bytes]) -> None:
    if process.poll() is None:
        process.terminate()
        try:
            process.wait(GRACE)
        except subprocess.TimeoutExpired:
            process.kill()
    process.wait()


def _free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])
