"""The exceptions of consat. They mean wrong input: divergence, time-out and infeasibility are results; see `consat.results.result`."""

from __future__ import annotations

import difflib
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any, Final, NamedTuple

AT_KEY: Final = -1
"""Value of `Fault.offset`: the key at the end of `Fault.path` is wrong, not its value."""


class ConsatError(Exception):
    """Base class of all errors that consat raises on purpose."""


class Place(NamedTuple):
    """A place in a file. Line and column count from 1; both are 0 for the file as a whole."""

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
        path: place in the scenario as keys and indices, e.g. ``("agents", 1, "constraints", 0, "radius")``.
        message: what is wrong and what would be right.
        where: the same place in words, e.g. ``agent 'a2', constraint 'tether'``; may be empty.
        offset: offset, from 0, of the wrong part within the text at `path`; or `AT_KEY`.
        place: the same place as line and column of a file, if known.
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
    """Input that cannot be used. `faults` holds all faults that were found, not only the first."""

    def __init__(self, faults: Iterable[Fault]) -> None:
        self.faults = tuple(faults)
        super().__init__("\n".join(map(str, self.faults)))


class InvalidTeam(InvalidInput):
    """A team whose agents, constraints or links do not fit together."""


class InvalidScenario(InvalidInput):
    """A scenario file that cannot be read as a team and its settings. The message has one line ``FILE:LINE:COLUMN: …`` per fault."""


class InvalidExpression(ConsatError, ValueError):
    """A text expression outside the allowed language.

    Attributes:
        message: what is wrong and what would be right.
        column: offset into the text of the expression, from 0.
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
    """Agents cannot run on the network as requested: a library, port or key is missing or not usable, or a message cannot be sent."""


def closest(name: Any, known: Iterable[str]) -> str:
    """``; did you mean 'within'?`` if one of the `known` names is similar to `name`; else an empty text."""
    by_lower = {each.lower(): each for each in known}
    close = difflib.get_close_matches(str(name)[:100].lower(), by_lower, n=1)
    return f"; did you mean {by_lower[close[0]]!r}?" if close else ""


def shown(value: Any) -> str:
    """The value as error messages quote it, shortened to about 60 characters."""
    text = repr(value)
    return text if len(text) <= 60 else text[:57] + "…"


def counted(count: int, one: str, many: str = "") -> str:
    """A count with its noun: ``1 cluster``, ``2,000 clusters``.

    Args:
        count: the number.
        one: the singular.
        many: the plural; by default `one` with an s.
    """
    return f"{count:,} {one if count == 1 else many or one + 's'}"


def dotted(path: Iterable[str | int]) -> str:
    """A path as text: ``("agents", 1, "radius")`` becomes ``agents[1].radius``."""
    text = ""
    for part in path:
        text += f"[{part}]" if isinstance(part, int) else f".{part}" if text else part
    return text
