"""One tree of errors. They are for wrong input only: divergence, time-out and infeasibility are outcomes, see `consat.results.result`."""

from __future__ import annotations

import difflib
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any, Final, NamedTuple

AT_KEY: Final = -1
"""As `Fault.offset`: the fault is the key that `Fault.path` ends with, not the value that belongs to it."""


class ConsatError(Exception):
    """Base of every error that consat raises on purpose."""


class Place(NamedTuple):
    """A place in a file; line and column count from 1, and are 0 where the file as a whole is meant."""

    line: int = 0
    column: int = 0
    file: str = ""

    def __str__(self) -> str:
        return f"{self.file}:{self.line}:{self.column}" if self.line else self.file


NOWHERE: Final = Place()


@dataclass(frozen=True, order=True)
class Fault:
    """One mistake in the input.

    Attributes:
        path: where it stands, as keys and indices into the scenario, e.g. ``("agents", 1, "constraints", 0, "radius")``.
        message: what is wrong and what would be right.
        where: the same place in words a person uses, e.g. ``agent 'a2', constraint 'tether'``; may be empty.
        offset: 0-based, into the text that stands at `path`, where only a part of it is wrong; or `AT_KEY`.
        place: the same place in a file, once that is known.
    """

    path: tuple[str | int, ...]
    message: str
    where: str = ""
    offset: int = 0
    place: Place = NOWHERE

    def __str__(self) -> str:
        file = f"{self.place}: " if self.place.file else ""
        return f"{file}{self.where or dotted(self.path) or 'scenario'}: {self.message}"


class InvalidInput(ConsatError, ValueError):
    """Input that cannot be used; carries every fault found, not only the first."""

    def __init__(self, faults: Iterable[Fault]) -> None:
        self.faults = tuple(faults)
        super().__init__("\n".join(map(str, self.faults)))


class InvalidTeam(InvalidInput):
    """A team whose agents, constraints or links do not fit together."""


class InvalidScenario(InvalidInput):
    """A scenario file that cannot be read as a team and its settings; the message has one ``FILE:LINE:COLUMN:`` line a fault."""


class InvalidExpression(ConsatError, ValueError):
    """A text expression outside the allowed language.

    Attributes:
        message: what is wrong and what would be right.
        column: 0-based offset into the expression text.
    """

    def __init__(self, message: str, column: int = 0) -> None:
        self.message = message
        self.column = column
        super().__init__(message)


class InvalidResult(ConsatError, ValueError):
    """A file that is not a result written by consat."""


class InvalidSettings(ConsatError, ValueError):
    """Settings of a run that do not fit together, e.g. a protocol that does not exist."""


class NetworkError(ConsatError):
    """Agents cannot be put on the network as asked: a library, a port or keys are missing or unfit, or a message cannot be written."""


def closest(name: Any, known: Iterable[str]) -> str:
    """``; did you mean 'within'?`` if one of the `known` names is close to `name`, else nothing."""
    by_lower = {each.lower(): each for each in known}
    close = difflib.get_close_matches(str(name)[:100].lower(), by_lower, n=1)
    return f"; did you mean {by_lower[close[0]]!r}?" if close else ""


def shown(value: Any) -> str:
    """The value as errors quote it, cut where it is long."""
    text = repr(value)
    return text if len(text) <= 60 else text[:57] + "…"


def counted(count: int, one: str, many: str = "") -> str:
    """``1 cluster``, ``2,000 clusters``; `many` is given where it is not `one` with an s."""
    return f"{count:,} {one if count == 1 else many or one + 's'}"


def dotted(path: Iterable[str | int]) -> str:
    """``("agents", 1, "radius")`` as ``agents[1].radius``."""
    text = ""
    for part in path:
        text += f"[{part}]" if isinstance(part, int) else f".{part}" if text else part
    return text
