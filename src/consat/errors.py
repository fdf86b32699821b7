"""One tree of errors. They are for wrong input only: divergence, time-out and infeasibility are outcomes, see `consat.result`."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass


class ConsatError(Exception):
    """Base of every error that consat raises on purpose."""


@dataclass(frozen=True, order=True)
class Fault:
    """One mistake in the input.

    Attributes:
        path: where it stands, as keys and indices into the scenario, e.g. ``("agents", 1, "constraints", 0, "radius")``.
        message: what is wrong and what would be right.
        where: the same place in words a person uses, e.g. ``agent 'a2', constraint 'tether'``; may be empty.
    """

    path: tuple[str | int, ...]
    message: str
    where: str = ""

    def __str__(self) -> str:
        return f"{self.where or dotted(self.path) or 'scenario'}: {self.message}"


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


def dotted(path: Iterable[str | int]) -> str:
    """``("agents", 1, "radius")`` as ``agents[1].radius``."""
    text = ""
    for part in path:
        text += f"[{part}]" if isinstance(part, int) else f".{part}" if text else part
    return text
