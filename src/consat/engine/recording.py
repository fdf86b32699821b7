"""Recording of a run: which agents, how often, and where (in memory, or in a file that grows during the run)."""

from __future__ import annotations

import math
import os
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO, Literal, NamedTuple, Protocol

import numpy as np

from consat.engine.violations import watched
from consat.errors import InvalidSettings, closest
from consat.problem.team import Team
from consat.protocols.estimates import Estimates

MOST_AGENTS = 10_000
"""Largest team of which all agents are recorded by default."""
SAMPLE = 1000
"""Number of agents that are recorded by default of a larger team."""
MOST_ESTIMATES = 1000
"""Largest number of floats for which estimates are recorded by default."""
MOST_KEPT = 20_000_000
"""Largest number of floats of a record in memory. When it is exceeded, every second step is dropped."""

BLOCK = 2**25
"""Approximate number of bytes of a `Log` that are read at a time."""

Who = Sequence[str] | Literal["all", "none"] | None
"""Agents whose positions and margins are recorded: a list of ids, all, none; None for the default, which depends on the team's size."""


class Rows(NamedTuple):
    """Record of K steps, of R agents and E copies.

    Attributes:
        step: (K,) times in s, or numbers of rounds.
        position: (K, R, d) positions.
        velocity: (K, R, d) velocities; None where they are differences between steps.
        margin: (K,) margin of the team.
        smooth_margin: (K,) smooth margin of the team.
        agent_margin: (K, R) margin of each agent.
        estimate: (K, E, d) estimates; None if not recorded.
        integral: (K, E, d) integral states; None if not recorded.
        bound: (K,) upper bound on the best margin that all agents have proven, NaN without one; None in continuous time.
        heading: (K, R) headings, rad; None for bodies without a heading.
    """

    step: Any
    position: Any
    velocity: Any
    margin: Any
    smooth_margin: Any
    agent_margin: Any
    estimate: Any
    integral: Any
    bound: Any = None
    heading: Any = None

    def where(self, chosen: np.ndarray) -> Rows:
        """The chosen steps; `chosen` is a mask or an array of indices."""
        return Rows(*(None if leaf is None else leaf[chosen] for leaf in self))

    def joined(self, more: Rows) -> Rows:
        """These steps followed by the steps of `more`."""
        return Rows(*(None if leaf is None else np.concatenate([leaf, other]) for leaf, other in zip(self, more, strict=True)))


@dataclass(frozen=True)
class Choice:
    """What is recorded.

    Attributes:
        agents: (R,) agents whose positions and margins are recorded, in increasing order.
        copies: (E,) recorded rows of the state; None if estimates are not recorded.
        every: record one step in `every`; the first and the last step are always recorded.
        everyone: whether `agents` is the whole team.
        watched: (W,) constraints whose violations are counted.
    """

    agents: np.ndarray
    copies: np.ndarray | None
    every: int
    everyone: bool
    watched: np.ndarray

    @classmethod
    def of(cls, team: Team, copies: Estimates, who: Who = None, estimates: bool | None = None, every: int = 1) -> Choice:
        """Resolve the request, with defaults that depend on the size of the team.

        Args:
            team: the team.
            copies: the layout of estimates.
            who: see `Who`.
            estimates: whether to record all estimates (and integral states) that recorded agents hold of recorded agents; if None, only
                while they are few.
            every: record one step in `every`.

        Raises:
            InvalidSettings: unknown agent, or `every` below 1.
        """
        if every < 1:
            raise InvalidSettings(f"every is {every}, but must be a whole number from 1: one step in so many is recorded")
        agents = _agents(team, who)
        everyone = len(agents) == team.count
        rows = np.arange(copies.count)
        if not everyone:
            rows = np.flatnonzero(np.isin(copies.holder, agents) & np.isin(copies.position, agents))
        keep = len(rows) * team.dimension <= MOST_ESTIMATES if estimates is None else estimates
        return cls(agents, rows if keep else None, every, everyone, watched(team))


def _agents(team: Team, who: Who) -> np.ndarray:
    if who is None:
        chosen = np.arange(team.count) if team.count <= MOST_AGENTS else np.linspace(0, team.count - 1, SAMPLE).round()
        return chosen.astype(np.int32)
    if isinstance(who, str):
        if who not in ("all", "none"):
            raise InvalidSettings(f"agents to record are {who!r}, but must be all, none or a list of ids")
        return np.arange(team.count if who == "all" else 0, dtype=np.int32)
    wanted = set(who)
    found = [i for i, name in enumerate(team.ids) if name in wanted]
    if len(found) < len(wanted):
        missing = sorted(wanted - {team.ids[i] for i in found})[0]
        raise InvalidSettings(f"there is no agent {missing!r} to record{closest(missing, team.ids)}")
    return np.array(found, dtype=np.int32)


class Sink(Protocol):
    """Destination of the record."""

    every: int
    """Record one step in `every`."""

    @property
    def path(self) -> Path | None:
        """The file; None for a record in memory."""
        ...

    def append(self, rows: Rows) -> None:
        """Append steps. Their numbers are multiples of `every`, except for the last step of the run."""
        ...

    def flush(self) -> None:
        """Write the appended steps to disk, so that they survive the process; does nothing for a record in memory."""
        ...

    def close(self) -> Rows:
        """Close the record. Returns the part that is in memory: at least the last step."""
        ...


class Memory:
    """Record in memory. It drops every second step whenever it exceeds `MOST_KEPT` floats."""

    path: Path | None = None

    def __init__(self, every: int = 1) -> None:
        self.every = every
        self._rows: list[Rows] = []
        self._kept = 0

    def append(self, rows: Rows) -> None:
        """Append steps; thins the record if it is too large, and then doubles `every`."""
        if not len(rows.step):
            return
        self._rows.append(rows)
        self._kept += sum(leaf.size for leaf in rows if leaf is not None)
        if self._kept > MOST_KEPT and sum(len(part.step) for part in self._rows) > 2:
            whole = self._whole()
            self._rows = [whole.where(np.arange(0, len(whole.step), 2))]
            self._kept = sum(leaf.size for leaf in self._rows[0] if leaf is not None)
            self.every *= 2

    def flush(self) -> None:
        """Does nothing: a record in memory is lost with the process."""

    def _whole(self) -> Rows:
        return Rows(*(None if parts[0] is None else np.concatenate(parts) for parts in zip(*self._rows, strict=True)))

    def close(self) -> Rows:
        """All recorded steps."""
        return self._whole()

    def renamed(self, before: Sequence[str], after: Sequence[str]) -> Memory:
        """Copy for other agents. Positions and margins of agents that were not in it are NaN.

        Args:
            before: ids of its agents.
            after: ids of the new agents.
        """
        rows, place = self._whole(), {agent: k for k, agent in enumerate(before)}
        where = np.array([place.get(agent, -1) for agent in after])
        there = where >= 0

        def arranged(values: np.ndarray) -> np.ndarray:
            found = np.full((len(values), len(after), *values.shape[2:]), np.nan)
            found[:, there] = values[:, where[there]]
            return found

        fresh = Memory(self.every)
        heading = None if rows.heading is None else arranged(rows.heading)
        fresh.append(rows._replace(position=arranged(rows.position), agent_margin=arranged(rows.agent_margin), heading=heading))
        return fresh


class Log:
    """Record in a file, so that memory use does not grow with the run; `steps` reads it back.

    The file holds float64 numbers, one row per step, and is only appended to. The written rows stay valid however the process ends. A
    resumed run cuts off the rows after its checkpoint.

    Args:
        path: path of the file.
        shapes: shape of each variable in one step; ``step`` first.
        every: record one step in `every`.
        count: number of steps to keep of an existing file; None for a new file.
    """

    def __init__(self, path: Path, shapes: Mapping[str, tuple[int, ...]], every: int = 1, count: int | None = None) -> None:
        self.every = every
        self.path: Path | None = path
        self._log, self._shapes = path, shapes
        self._last: Rows | None = None
        self._row = 8 * sum(math.prod(shape) for shape in shapes.values())
        self._begin = count
        self._file: BinaryIO | None = None

    def append(self, rows: Rows) -> None:
        """Append steps to the file."""
        if not len(rows.step):
            return
        flat = [np.asarray(getattr(rows, name), dtype=float).reshape(len(rows.step), -1) for name in self._shapes]
        self._opened().write(np.concatenate(flat, axis=1).tobytes())
        self._last = rows.where(np.array([-1]))

    def flush(self) -> None:
        """Write all appended steps to disk (fsync)."""
        self._opened().flush()
        os.fsync(self._opened().fileno())

    def close(self) -> Rows:
        """Close the file. Returns the last step."""
        self._opened().close()
        return Rows(**{**dict.fromkeys(Rows._fields), **_shaped(self._read(-1), self._shapes)}) if self._last is None else self._last

    def _opened(self) -> BinaryIO:
        """The file, opened at the first write: a checkpoint to resume from has been checked by then."""
        if self._file is None:
            self._log.parent.mkdir(parents=True, exist_ok=True)
            self._file = self._log.open("wb" if self._begin is None else "r+b")
            self._file.truncate((self._begin or 0) * self._row)
            self._file.seek(0, os.SEEK_END)
        return self._file

    def _read(self, row: int) -> np.ndarray:
        whole = np.fromfile(self._log, offset=self._log.stat().st_size + row * self._row)
        return whole.reshape(-1, self._row // 8)

    @property
    def count(self) -> int:
        """Number of steps in the file."""
        return self._log.stat().st_size // self._row

    def steps(self, period: float) -> Iterator[dict[str, np.ndarray]]:
        """Read the record, block by block. Velocities that were not recorded are computed as differences between steps.

        Args:
            period: duration of a step, s.
        """
        count, most = self.count, max(1, BLOCK // self._row)
        with self._log.open("rb") as file:
            for start in range(0, count, most):
                more = min(most, count - start)
                file.seek(start * self._row)
                block = np.frombuffer(file.read((more + 1) * self._row)).reshape(-1, self._row // 8)  # + 1 step for the velocity
                rows = _shaped(block, self._shapes)
                if "position" in rows and "velocity" not in rows:
                    rows["velocity"] = velocities(rows["step"], rows["position"], period)
                yield {name: values[:more] for name, values in rows.items()}


def _shaped(block: np.ndarray, shapes: Mapping[str, tuple[int, ...]]) -> dict[str, np.ndarray]:
    ends = np.cumsum([math.prod(shape) for shape in shapes.values()])[:-1]
    parts = np.split(block, ends, axis=1)
    return {name: part.reshape(len(block), *shape) for part, (name, shape) in zip(parts, shapes.items(), strict=True)}


def velocities(step: np.ndarray, position: np.ndarray, period: float) -> np.ndarray:
    """(K, R, d) mean velocities between each step and the next; 0 at the last step.

    Args:
        step: (K,) numbers of the steps.
        position: (K, R, d) positions.
        period: duration of a step, s.
    """
    gap = np.diff(step, append=step[-1:] + 1) * period
    return np.asarray(np.diff(position, axis=0, append=position[-1:]) / gap[:, None, None])
