"""The one form that every constraint takes, whoever wrote it: library kind, Python callable or text expression."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Final, TypeAlias

OWNER: Final = "@owner"
"""Stands in `Constraint.reads` for the agent that will own the constraint."""


@dataclass(frozen=True)
class Number:
    """A real parameter of a constraint and the values it may take; `consat.Team` checks it."""

    value: Any
    positive: bool = False


@dataclass(frozen=True)
class Vector:
    """A parameter in R^d; `consat.Team` checks it against its dimension.

    Attributes:
        above: if given, every entry must exceed the entry of this vector, which is the parameter ``low``.
    """

    value: Any
    nonzero: bool = False
    above: Any = None


@dataclass(frozen=True)
class Fixed:
    """A parameter that its factory made and vouches for."""

    value: Any


Parameter = Number | Vector | Fixed


@dataclass(frozen=True, eq=False)
class Constraint:
    """A private constraint ψ > 0 of one agent (paper, eq. 4).

    Constraints that share `psi` and the number of positions it reads form one family and are evaluated by one `jax.vmap`,
    so `psi` should be a module-level function and everything that varies between constraints a parameter.

    Attributes:
        kind: the name that errors and reports use, e.g. ``within``.
        psi: ``psi(*positions, **parameters) -> scalar``, JAX-traceable and continuously differentiable; each position is a (d,) array.
        reads: the agents whose positions `psi` takes, in that order; `OWNER` stands for the owner, and in a group
            what is no text for whom a relation leads to (`consat.problem.groups`).
        parameters: the keyword arguments of `psi`.
        name: what the user calls it; if None, the team derives one from the kind and the agents read.
        weight: positive factor on ψ.
        source: the text it was written as, for text expressions.
    """

    kind: str
    psi: Callable[..., Any]
    reads: tuple[Any, ...]
    parameters: Mapping[str, Parameter] = field(default_factory=dict)
    name: str | None = None
    weight: float = 1.0
    source: str | None = None


Constraints: TypeAlias = "Sequence[Constraint | Sequence[Constraint]]"
"""Constraints of an agent: what `consat.within` and its like return, a list of them where that is a list (`consat.box`)."""


def flatten(item: Any) -> Iterator[Any]:
    """The constraints of a list that may nest."""
    if isinstance(item, list | tuple):
        for part in item:
            yield from flatten(part)
    else:
        yield item
