"""Constraints of single agents: checks them, ψ included, before anything runs, and groups those that share a function into families."""

from __future__ import annotations

import functools
import types
from collections.abc import Callable, Container, Hashable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import jax
import numpy as np

from consat.errors import Fault, InvalidExpression, shown
from consat.numerics import float64
from consat.problem.constraints.record import OWNER, Constraint, Number, flatten
from consat.problem.family import Family
from consat.problem.index import SUGGESTIONS, Index, who_is
from consat.problem.parameters import Path, Spot, checked, is_printable, still
from consat.problem.schedule import Schedule, Track


@dataclass(slots=True)
class Entry:
    """One checked constraint that is not yet in a family.

    Attributes:
        constraint: the constraint as the user made it.
        owner: index of the agent that owns it.
        agents: indices of the agents whose positions ψ takes.
        name: what reports call it.
        path: its place in the input, for faults.
        where: the same in words, for faults.
        values: checked parameters; of a moving parameter, the value at time 0.
        weight: positive factor on ψ.
        moving: schedules of the parameters that move with time.
    """

    constraint: Constraint
    owner: int
    agents: tuple[int, ...]
    name: str
    path: Path
    where: str
    values: dict[str, np.ndarray] = field(default_factory=dict)
    weight: float = 1.0
    moving: dict[str, Schedule] = field(default_factory=dict)

    @property
    def family(self) -> tuple[Any, ...]:
        """Key of the family: the function, the number of positions, and the shapes of the parameters."""
        shapes = tuple((key, value.shape) for key, value in sorted(self.values.items()))
        return same(self.constraint.psi), len(self.agents), shapes


def same(psi: Callable[..., Any]) -> Hashable:
    """A key that is equal for functions with the same code and the same captured objects.

    A lambda written in a loop is a new object on each pass but the same function, so constraints that use it belong to one family. The key
    contains object ids: it is valid only while the functions exist.
    """
    if not isinstance(psi, types.FunctionType):
        return psi
    bound = [psi.__globals__, *(psi.__closure__ or ()), *(psi.__defaults__ or ()), *(psi.__kwdefaults__ or {}).values()]
    return psi.__code__, tuple(map(id, bound)), psi.__name__


@float64
def trace(entries: Iterable[Entry], dimension: int, faults: list[Fault]) -> None:
    """Trace ψ once per family, so that errors in a user's function are found before anything runs. Adds to `faults`."""
    seen: dict[tuple[Any, ...], Fault | None] = {}
    for entry in entries:
        family = entry.family
        if family not in seen:
            fault = seen[family] = _untraceable(entry, dimension)
        elif (fault := seen[family]) is not None:
            written = entry.constraint.source is not None and len(faults) < SUGGESTIONS
            # Expressions of one family may be written differently, so the column of the error differs.
            again = _untraceable(entry, dimension) if written else None
            fault = again or replace(fault, path=(*entry.path, *fault.path[len(entry.path) :]), where=entry.where, offset=0)
        if fault is not None:
            faults.append(fault)


def _untraceable(entry: Entry, dimension: int) -> Fault | None:
    message, offset = _mistake(entry, dimension)
    key: Path = ("psi",) if entry.constraint.source is not None else ()
    return Fault((*entry.path, *key), message, entry.where, offset) if message else None


def _mistake(entry: Entry, dimension: int) -> tuple[str, int]:
    """(message, column in the text of ψ) of an error in ψ. The message is empty if ψ is valid."""
    position = jax.ShapeDtypeStruct((dimension,), np.dtype(float))
    try:
        shape = jax.eval_shape(functools.partial(entry.constraint.psi, **entry.values), *(position,) * len(entry.agents))
    except InvalidExpression as error:
        return error.message, error.column
    except Exception as error:  # noqa: BLE001 - whatever the user's own function raises is a fault of the input
        reason = str(error).strip().split("\n")[0]
        return f"ψ cannot be traced by JAX in dimension {dimension}: {reason or type(error).__name__}", 0
    leaves = jax.tree.leaves(shape)
    if len(leaves) != 1 or leaves[0].shape != ():
        return f"ψ must return one number, but returns {', '.join(f'shape {leaf.shape}' for leaf in leaves) or 'nothing'}", 0
    if not np.issubdtype(leaves[0].dtype, np.floating):
        return f"ψ must return a real number, but returns {leaves[0].dtype}; constraints must be differentiable", 0
    return "", 0


def alike(entries: Iterable[Entry]) -> list[tuple[Family, Sequence[str]]]:
    """Groups entries by family. Returns: the families and the names of their constraints, whose `number` is the index of the entry."""
    members: dict[tuple[Any, ...], list[tuple[int, Entry]]] = {}
    for number, entry in enumerate(entries):
        members.setdefault(entry.family, []).append((number, entry))
    made: list[tuple[Family, Sequence[str]]] = []
    for numbers, group in (zip(*pairs, strict=True) for pairs in members.values()):
        first = group[0]
        texts = tuple(entry.constraint.source for entry in group)
        moving = {key: {row: entry.moving[key] for row, entry in enumerate(group) if key in entry.moving} for key in first.values}
        family = Family(
            kind=first.constraint.kind,
            psi=first.constraint.psi,
            agents=np.array([entry.agents for entry in group], dtype=np.int32),
            owner=np.array([entry.owner for entry in group], dtype=np.int32),
            number=np.array(numbers),
            parameters={key: np.stack([entry.values[key] for entry in group]) for key in first.values},
            weight=np.array([entry.weight for entry in group]),
            sources=None if None in texts else texts,
            tracks={key: Track.of(each) for key, each in moving.items() if each},
        )
        made.append((family, tuple(entry.name for entry in group)))
    return made


def entries_of(index: Index, dimension: int, faults: list[Fault]) -> Iterator[Entry]:
    """Check the constraints of the single agents, and yield those without faults.

    Args:
        index: the agents.
        dimension: d.
        faults: list to which faults are added.
    """
    for number, i, agent in index.singles:
        taken: dict[str, int] = {}
        who = who_is(number, agent.id)
        for k, item in enumerate(agent.constraints):
            path: Path = ("agents", number, "constraints", k)
            for constraint in flatten(item):
                if not isinstance(constraint, Constraint):
                    faults.append(Fault(path, f"{constraint!r} is no constraint; use consat.within and its like", who))
                    continue
                known = len(faults)
                name = _name(constraint, taken, path, agent.id, who, faults)
                where = f"{who}, constraint {name!r}"
                spot = Spot(path, "", where, faults)
                reads = _reads(constraint, agent.id, index, spot)
                values: dict[str, np.ndarray] = {}
                moving: dict[str, Schedule] = {}
                for key, parameter in constraint.parameters.items():
                    value = checked(parameter, dimension, spot.under(key))
                    if isinstance(value, Schedule):
                        moving[key], value = value, value.at(0.0)
                    if value is not None:
                        values[key] = value
                weight = still(Number(constraint.weight, positive=True), dimension, spot.under("weight"))
                if len(faults) == known and reads and weight is not None:
                    yield Entry(constraint, i, reads, name, path, where, values, float(weight), moving)


def _name(constraint: Constraint, taken: dict[str, int], path: Path, owner: str, who: str, faults: list[Fault]) -> str:
    """The name that the user gave, or one derived from the kind and the other agents, with a number if it would repeat."""
    if constraint.name is not None:
        message = wrong_name(constraint.name, taken, who)
        if message:
            faults.append(Fault((*path, "name"), message, who))
        else:
            taken[constraint.name] = 1
        return str(constraint.name)
    others = [str(agent) for agent in constraint.reads if not isinstance(agent, str) or agent not in (OWNER, owner)]
    base = f"{constraint.kind}({', '.join(others)})" if others else constraint.kind
    name = base
    while name in taken:
        taken[base] += 1
        name = f"{base} #{taken[base]}"
    taken[name] = 1
    return name


def wrong_name(name: Any, taken: Container[str], whose: str) -> str | None:
    """What is wrong with a name given to a constraint; None if it is valid and not among those `taken` by constraints of the same owner."""
    if not is_printable(name):
        return f"name is {shown(name)}, but must be a printable text"
    return f"name {name!r} is taken by another constraint of {whose}; choose another" if name in taken else None


def _reads(constraint: Constraint, owner: str, index: Index, spot: Spot) -> tuple[int, ...]:
    key = "psi" if constraint.source is not None else "agent"
    reads: list[str] = []
    for agent in constraint.reads:
        if isinstance(agent, str) and (agent == OWNER or agent in index):
            reads.append(owner if agent == OWNER else agent)
        else:
            spot.fault(index.unknown(agent, spot.faults), key)
    if not isinstance(owner, str) or owner not in index:
        return ()  # the owner's id has a fault, which `Index` reports
    if owner not in reads:
        spot.fault(f"it must read the position of its owner {owner!r}, but reads {', '.join(map(repr, reads)) or 'nothing'}", key)
    if repeated := next((agent for agent in reads if reads.count(agent) > 1), None):
        itself = "its own owner" if repeated == owner else "the same agent twice"
        spot.fault(f"it names {itself}, {repeated!r}; name another agent", key)
    return tuple(index[agent] for agent in reads)
