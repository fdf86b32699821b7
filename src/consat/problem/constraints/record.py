"""`Constraint`: the common record for library kinds, Python functions and text expressions."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Final, TypeAlias

OWNER: Final = "@owner"
"""Placeholder in `Constraint.reads` for the agent that owns the constraint."""


@dataclass(frozen=True)
class Number:
    """A scalar parameter; `consat.Team` checks its value.

    Attributes:
        value: the value as given.
        positive: whether it must be positive.
    """

    value: Any
    positive: bool = False


@dataclass(frozen=True)
class Vector:
    """A vector parameter in R^d; `consat.Team` checks its value.

    Attributes:
        value: the value as given.
        nonzero: whether it must differ from 0.
        above: if given, a vector that each entry must exceed: the parameter ``low`` of a box.
    """

    value: Any
    nonzero: bool = False
    above: Any = None


@dataclass(frozen=True)
class Fixed:
    """A parameter without restrictions, except that it must be numeric."""

    value: Any


Parameter = Number | Vector | Fixed


@dataclass(frozen=True, eq=False)
class Constraint:
    """A private constraint ψ > 0 of one agent (paper, eq. 4).

    Constraints with the same `psi` and the same number of positions form one family, which one `jax.vmap` evaluates. So `psi` should be a
    module-level function, and everything that varies between constraints should be a parameter.

    Attributes:
        kind: the name that errors and reports use, e.g. ``within``.
        psi: ``psi(*positions, **parameters) -> scalar``, JAX-traceable and continuously differentiable; each position is a (d,) array.
        reads: ids of the agents whose positions `psi` takes, in order. `OWNER` stands for the owner. In a group, an entry that is not a
            text is a relation; see `consat.problem.groups`.
        parameters: keyword arguments of `psi`.
        name: name given by the user. If None, the team derives one from the kind and the agents read.
        weight: positive factor on ψ.
        source: text of ψ, if it was written as a text expression.
    """

    kind: str
    psi: Callable[..., Any]
    reads: tuple[Any, ...]
    parameters: Mapping[str, Parameter] = field(default_factory=dict)
    name: str | None = None
    weight: float = 1.0
    source: str | None = None


Constraints: TypeAlias = "Sequence[Constraint | Sequence[Constraint]]"
"""Constraints of an agent. An item is a constraint, or a list of constraints such as `consat.box` returns."""


def flatten(item: Any) -> Iterator[Any]:
    """Yields the items of a list that may be nested, or the item itself if it is no list."""
    if isinstance(item, list | tuple):
        for part in item:
            yield from flatten(part)
    else:
        yield item
