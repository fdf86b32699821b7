"""What is kept of a run: of whom, how often, and where: in memory, or in a result file that grows as the run goes on."""

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
"""Of larger teams a sample is recorded when nobody says of whom, …"""
SAMPLE = 1000
"""… of so many agents."""
MOST_ESTIMATES = 1000
"""Estimates are recorded by default while there are at most this many numbers."""
MOST_KEPT = 20_000_000
"""A record in memory that outgrows this many numbers loses every second step, again and again."""

BLOCK = 2**25
"""Bytes that are read of a `Log` at a time, about."""

Who = Sequence[str] | Literal["all", "none"] | None
"""Of whom positions and margins are recorded: ids, all, nobody, or, if None, all of a team that is not large."""


class Rows(NamedTuple):
    """The record of K steps; K is the leading axis.

    Attributes:
        step: (K,) times or rounds.
        position: (K, R, d).
        velocity: (K, R, d), or None where it is the difference between steps.
        margin: (K,).
        smooth_margin: (K,).
        agent_margin: (K, R).
        estimate: (K, E, d), or None.
        integral: (K, E, d), or None.
        bound: (K,) on the best margin, proven by all agents, NaN where none is; None in continuous time.
        heading: (K, R) rad; None where bodies have none.
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
        """Some of the steps."""
        return Rows(*(None if leaf is None else leaf[chosen] for leaf in self))

    def joined(self, more: Rows) -> Rows:
        """These steps, and more."""
        return Rows(*(None if leaf is None else np.concatenate([leaf, other]) for leaf, other in zip(self, more, strict=True)))


@dataclass(frozen=True)
class Choice:
    """What is recorded.

    Attributes:
        agents: (R,) whose positions and margins, in order.
        copies: (E,) which rows of the state, or None.
        every: each how manieth step; the first and the last are kept in any case.
        everyone: whether that is the whole team.
        watched: (W,) constraints of which it is counted how often they are violated.
    """

    agents: np.ndarray
    copies: np.ndarray | None
    every: int
    everyone: bool
    watched: np.ndarray

    @classmethod
    def of(cls, team: Team, copies: Estimates, who: Who = None, estimates: bool | None = None, every: int = 1) -> Choice:
        """What is asked for, or what the size of the team suggests.

        Args:
            team: the team.
            copies: the layout of estimates.
            who: see `Who`.
            estimates: whether to keep all estimates (and integral states) that recorded agents hold of recorded agents; if None, while
                they are few.
            every: each how manieth step.

        Raises:
            InvalidSettings: no such agent, or no such step.
        """
        if every < 1:
            raise InvalidSettings(f"every is {every}, but must be a whole number from 1: each how manieth step to record")
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
    """Where the record goes."""

    every: int
    """Each how manieth step is wanted."""

    @property
    def path(self) -> Path | None:
        """The file, if it is one."""
        ...

    def append(self, rows: Rows) -> None:
        """Add the record of further steps, all of them multiples of `every`, or the last of the run."""
        ...

    def flush(self) -> None:
        """See that what was added survives the process, if it can."""
        ...

    def close(self) -> Rows:
        """End the record, and give back what of it is in memory: at least its last step."""
        ...


class Memory:
    """A record in memory, thinned where it would grow too large."""

    path: Path | None = None

    def __init__(self, every: int = 1) -> None:
        self.every = every
        self._rows: list[Rows] = []
        self._kept = 0

    def append(self, rows: Rows) -> None:
        """Add the record of further steps."""
        self._rows.append(rows)
        self._kept += sum(leaf.size for leaf in rows if leaf is not None)
        if self._kept > MOST_KEPT and sum(len(part.step) for part in self._rows) > 2:
            whole = self._whole()
            self._rows = [whole.where(np.arange(0, len(whole.step), 2))]
            self._kept = sum(leaf.size for leaf in self._rows[0] if leaf is not None)
            self.every *= 2

    def flush(self) -> None:
        """Nothing in memory survives."""

    def _whole(self) -> Rows:
        return Rows(*(None if parts[0] is None else np.concatenate(parts) for parts in zip(*self._rows, strict=True)))

    def close(self) -> Rows:
        """Everything that was kept."""
        return self._whole()


class Log:
    """A record in a file, so that what is in memory stays small, however long the run; `steps` reads it back.

    Plain float64 numbers, a row a step, added at the end and nowhere else: whatever ends the process, the rows that were written stay, and
    a run that is taken up cuts off those that came after its checkpoint.

    Args:
        path: of the file.
        shapes: of the variables, a step; ``step`` first.
        every: each how manieth step.
        count: go on after so many steps; None for a new file.
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
        """Write further steps."""
        if not len(rows.step):
            return
        flat = [np.asarray(getattr(rows, name), dtype=float).reshape(len(rows.step), -1) for name in self._shapes]
        self._opened().write(np.concatenate(flat, axis=1).tobytes())
        self._last = rows.where(np.array([-1]))

    def flush(self) -> None:
        """See that what was added survives the process."""
        self._opened().flush()
        os.fsync(self._opened().fileno())

    def close(self) -> Rows:
        """The last step."""
        self._opened().close()
        return Rows(**{**dict.fromkeys(Rows._fields), **_shaped(self._read(-1), self._shapes)}) if self._last is None else self._last

    def _opened(self) -> BinaryIO:
        """The file, opened when it is first written to: by then whatever is taken up is known to fit."""
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
        """How many steps the file holds."""
        return self._log.stat().st_size // self._row

    def steps(self, period: float) -> Iterator[dict[str, np.ndarray]]:
        """What was recorded, some steps at a time, with the velocities where they are differences between steps.

        Args:
            period: of a step, s, for these.
        """
        count, most = self.count, max(1, BLOCK // self._row)
        with self._log.open("rb") as file:
            for start in range(0, count, most):
                more = min(most, count - start)
                file.seek(start * self._row)
                block = np.frombuffer(file.read((more + 1) * self._row)).reshape(-1, self._row // 8)  # one step of the next block
                rows = _shaped(block, self._shapes)
                if "position" in rows and "velocity" not in rows:
                    rows["velocity"] = velocities(rows["step"], rows["position"], period)
                yield {name: values[:more] for name, values in rows.items()}


def _shaped(block: np.ndarray, shapes: Mapping[str, tuple[int, ...]]) -> dict[str, np.ndarray]:
    ends = np.cumsum([math.prod(shape) for shape in shapes.values()])[:-1]
    parts = np.split(block, ends, axis=1)
    return {name: part.reshape(len(block), *shape) for part, (name, shape) in zip(parts, shapes.items(), strict=True)}


def velocities(step: np.ndarray, position: np.ndarray, period: float) -> np.ndarray:
    """(K, R, d) between each step and the next, 0 at the last.

    Args:
        step: (K,) numbers of the steps.
        position: (K, R, d).
        period: of a step, s.
    """
    gap = np.diff(step, append=step[-1:] + 1) * period
    return np.asarray(np.diff(position, axis=0, append=position[-1:]) / gap[:, None, None])
