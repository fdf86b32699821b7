"""Agents, constraints and links: what the problem is. All validation of input lives here, and names every fault at once."""

from __future__ import annotations

import copy
import functools
import math
from collections import defaultdict
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any, TypeAlias, cast

import jax
import numpy as np
from numpy.typing import ArrayLike

from consat.constraints.record import OWNER, Constraint, Fixed, Number, Parameter
from consat.errors import Fault, InvalidExpression, InvalidTeam, closest, shown
from consat.numerics import float64

if TYPE_CHECKING:
    import networkx as nx

LARGEST = 1e100
"""Numbers beyond this are refused: their squares must stay finite in float64."""

SUGGESTIONS = 20
"""Beyond this many faults neither similar ids nor columns within expressions are looked for: in a large team that takes long."""

TOPOLOGIES = ("line", "ring", "star", "complete", "task")

Path = tuple[str | int, ...]
Links: TypeAlias = "str | nx.Graph | Iterable[tuple[str, str]]"


@dataclass(frozen=True)
class Agent:
    """One agent with its private constraints.

    Attributes:
        id: unique in the team.
        constraints: what `consat.within` and its like return; lists may nest.
        start: x_i(0), shape (d,); if None, drawn when the team is run.
    """

    id: str
    constraints: Sequence[Any] = ()
    start: ArrayLike | None = None


@dataclass(frozen=True, eq=False)
class Family:
    """M constraints that share one function ψ, with stacked parameters; evaluated by one `jax.vmap`.

    Attributes:
        kind: the name errors and reports use.
        psi: ``psi(*positions, **parameters) -> scalar``.
        agents: (M, arity) whose positions ψ takes.
        owner: (M,) whose constraint it is.
        number: (M,) place in the team's order of constraints, which is by owner.
        parameters: arrays with leading axis M.
        weight: (M,) positive factors on ψ.
        sources: (M,) the texts, if they were written as text expressions, else None.
    """

    kind: str
    psi: Callable[..., Any]
    agents: np.ndarray
    owner: np.ndarray
    number: np.ndarray
    parameters: Mapping[str, np.ndarray]
    weight: np.ndarray
    sources: Sequence[str] | None = None

    @property
    def size(self) -> int:
        return len(self.owner)

    @property
    def arity(self) -> int:
        return int(self.agents.shape[1])


class Team:
    """N agents in R^d, their constraints and who can talk to whom.

    Args:
        agents: the agents, at least one.
        links: who talks to whom: pairs of ids, a `networkx.Graph` over ids, or one of `TOPOLOGIES`
            (``task`` links agents along the task graph, the default).
        dimension: d ≥ 1.

    Raises:
        InvalidTeam: names every fault, its agent and constraint, and the cure.

    Attributes:
        ids: the N ids, in order.
        families: the constraints, grouped by function.
        owner: (M,) the owner of each constraint; the constraints are ordered by owner.
        names: (M,) their names.
        links: (L, 2) int32, i < j, each link once.
        starts: (N, d), NaN where an agent has no start of its own.
        dimension: d.
    """

    ids: Sequence[str]
    families: tuple[Family, ...]
    owner: np.ndarray
    names: Sequence[str]
    links: np.ndarray
    starts: np.ndarray
    dimension: int

    def __init__(self, agents: Iterable[Agent], links: Links = "task", dimension: int = 2) -> None:
        agents = list(agents)
        faults: list[Fault] = []
        if isinstance(dimension, bool) or not isinstance(dimension, int | np.integer) or not 1 <= dimension <= 64:
            faults.append(Fault(("dimension",), f"dimension is {dimension!r}, but must be a whole number from 1 to 64", "dimension"))
            dimension = 0
        if not agents:
            faults.append(Fault(("agents",), "a team needs at least one agent", "agents"))
        index = _index(agents, faults)
        self.ids = tuple(agent.id for agent in agents)
        self.dimension = int(dimension)
        self.starts = np.full((len(agents), self.dimension), np.nan)
        entries = list(_entries(agents, index, self.dimension, faults))
        if dimension:
            _trace(entries, self.dimension, faults)
            for i, agent in enumerate(agents):
                if agent.start is not None:
                    start = _vector(agent.start, self.dimension, ("agents", i, "start"), "start", _who(i, agent.id), faults)
                    self.starts[i] = np.nan if start is None else start
        pairs = _pairs(links, index, faults)
        if faults:
            distinct = {(fault.path, fault.message): fault for fault in reversed(faults)}
            raise InvalidTeam(sorted(distinct.values(), key=lambda fault: tuple(map(_sortable, fault.path))))
        self.owner = np.array([entry.owner for entry in entries], dtype=np.int32)
        self.names = tuple(entry.name for entry in entries)
        self.families = _families(entries)
        self.links = _unique(pairs) if pairs is not None else topology(cast(str, links), len(agents), self.families)

    def with_constraints(self, families: Iterable[Family], owner: np.ndarray, names: Sequence[str]) -> Team:
        """The same agents and links with other constraints, which are known to fit; see the attributes of `Team`."""
        team = copy.copy(self)
        team.__dict__.pop("constraints_per_agent", None)
        team.families, team.owner, team.names = tuple(families), owner, names
        return team

    @property
    def count(self) -> int:
        """N, the number of agents."""
        return len(self.ids)

    @functools.cached_property
    def constraints_per_agent(self) -> np.ndarray:
        """(N,) m_i."""
        return np.bincount(self.owner, minlength=self.count)

    def __repr__(self) -> str:
        return f"Team({self.count} agents, {len(self.owner)} constraints, {len(self.links)} links, dimension={self.dimension})"


@dataclass
class _Entry:
    """One constraint on its way into a family."""

    constraint: Constraint
    owner: int
    agents: tuple[int, ...]
    name: str
    path: Path
    where: str
    values: dict[str, np.ndarray] = field(default_factory=dict)
    weight: float = 1.0

    @property
    def family(self) -> tuple[Any, ...]:
        shapes = tuple((key, value.shape) for key, value in sorted(self.values.items()))
        return self.constraint.psi, len(self.agents), shapes


def _index(agents: Sequence[Agent], faults: list[Fault]) -> dict[str, int]:
    index: dict[str, int] = {}
    for i, agent in enumerate(agents):
        path: Path = ("agents", i, "id")
        if not isinstance(agent.id, str) or not agent.id.strip() or not agent.id.isprintable():
            faults.append(Fault(path, f"id is {agent.id!r}, but must be a printable text such as 'a1'", f"agents[{i}]"))
        elif agent.id in index:
            message = f"id {agent.id!r} is taken by agents[{index[agent.id]}]; every agent needs an id of its own"
            faults.append(Fault(path, message, f"agents[{i}]"))
        else:
            index[agent.id] = i
    return index


def _who(i: int, name: Any) -> str:
    return f"agent {name!r}" if isinstance(name, str) and name.strip() else f"agents[{i}]"


def _entries(agents: Sequence[Agent], index: Mapping[str, int], dimension: int, faults: list[Fault]) -> Iterator[_Entry]:
    for i, agent in enumerate(agents):
        taken: dict[str, int] = {}
        who = _who(i, agent.id)
        for k, item in enumerate(agent.constraints):
            path: Path = ("agents", i, "constraints", k)
            for constraint in _flatten(item):
                if not isinstance(constraint, Constraint):
                    faults.append(Fault(path, f"{constraint!r} is no constraint; use consat.within and its like", who))
                    continue
                named = len(faults)
                name = _name(constraint, taken, path, agent.id, who, faults)
                where = f"{who}, constraint {name!r}"
                reads = _reads(constraint, agent.id, index, path, where, faults)
                entry = _Entry(constraint, i, reads, name, path, where)
                for key, parameter in constraint.parameters.items():
                    value = _parameter(parameter, dimension, (*path, key), key, where, faults)
                    if value is not None:
                        entry.values[key] = value
                weight = _parameter(Number(constraint.weight, positive=True), dimension, (*path, "weight"), "weight", where, faults)
                entry.weight = 1.0 if weight is None else float(weight)
                if len(faults) == named and reads:
                    yield entry


def _flatten(item: Any) -> Iterator[Any]:
    if isinstance(item, list | tuple):
        for part in item:
            yield from _flatten(part)
    else:
        yield item


def _name(constraint: Constraint, taken: dict[str, int], path: Path, owner: str, who: str, faults: list[Fault]) -> str:
    """The user's name, or one derived from the kind and the other agents, numbered where it repeats."""
    if constraint.name is not None:
        if not isinstance(constraint.name, str) or not constraint.name.strip() or not constraint.name.isprintable():
            faults.append(Fault((*path, "name"), f"name is {constraint.name!r}, but must be a printable text", who))
        elif constraint.name in taken:
            message = f"name {constraint.name!r} is taken by another constraint of {who}; choose another"
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


def _reads(constraint: Constraint, owner: str, index: Mapping[str, int], path: Path, where: str, faults: list[Fault]) -> tuple[int, ...]:
    key: Path = ("psi",) if constraint.source is not None else ("agent",)
    reads: list[str] = []
    for agent in constraint.reads:
        if isinstance(agent, str) and (agent == OWNER or agent in index):
            reads.append(owner if agent == OWNER else agent)
        else:
            faults.append(Fault((*path, *key), _unknown(agent, index, faults), where))
    if not isinstance(owner, str) or owner not in index:
        return ()  # a fault of the owner's id
    if owner not in reads:
        faults.append(Fault((*path, *key), f"it must read the position of its owner {owner!r}, but reads {_listed(reads)}", where))
    if repeated := next((agent for agent in reads if reads.count(agent) > 1), None):
        itself = "its own owner" if repeated == owner else "the same agent twice"
        faults.append(Fault((*path, *key), f"it names {itself}, {repeated!r}; name another agent", where))
    return tuple(index[agent] for agent in reads)


def _parameter(parameter: Parameter, dimension: int, path: Path, key: str, where: str, faults: list[Fault]) -> np.ndarray | None:
    if isinstance(parameter, Fixed):
        try:
            return np.asarray(parameter.value, dtype=float)
        except (TypeError, ValueError):
            faults.append(Fault(path, f"{key} must be a number or an array of numbers, but is {parameter.value!r}", where))
            return None
    if isinstance(parameter, Number):
        return _number(parameter, path, key, where, faults)
    value = _vector(parameter.value, dimension, path, key, where, faults)
    if value is not None and parameter.nonzero and not np.any(value):
        faults.append(Fault(path, f"{key} is zero, but must point somewhere", where))
    if value is not None and parameter.above is not None:
        low = _vector(parameter.above, dimension, (*path[:-1], "low"), "low", where, faults)
        if low is not None and not np.all(value > low):
            faults.append(Fault(path, f"{key} is {value.tolist()}, but must be above low {low.tolist()} on every axis", where))
    return value


def _limit(value: Any) -> str:
    return f" of size at most {LARGEST:g}" if _is_number(value) and abs(value) > LARGEST else ""


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float | np.integer | np.floating) and not isinstance(value, bool)


def _number(parameter: Number, path: Path, key: str, where: str, faults: list[Fault]) -> np.ndarray | None:
    value = parameter.value
    want = "a positive number" if parameter.positive else "a number"
    if isinstance(value, np.ndarray | jax.Array) and value.ndim == 0:
        value = value.item()
    if not _is_number(value) or not math.isfinite(value) or abs(value) > LARGEST:
        faults.append(Fault(path, f"{key} is {shown(value)}, but must be {want}{_limit(value)}", where))
        return None
    if parameter.positive and value < 1 / LARGEST:
        faults.append(Fault(path, f"{key} is {value!r}, but must be {want}", where))
        return None
    return np.asarray(float(value))


def _vector(value: Any, dimension: int, path: Path, key: str, where: str, faults: list[Fault]) -> np.ndarray | None:
    entries = value.tolist() if isinstance(value, np.ndarray | jax.Array) else value
    numbers = f"{dimension} number" + ("s" if dimension > 1 else "")
    if not isinstance(entries, list | tuple):
        faults.append(Fault(path, f"{key} is {shown(value)}, but must be a list of {numbers}", where))
    elif dimension and len(entries) != dimension:
        message = f"{key} has {len(entries)} entries, but must have {dimension}, one for each dimension of the team"
        faults.append(Fault(path, message, where))
    elif bad := [entry for entry in entries if not _is_number(entry) or not math.isfinite(entry) or abs(entry) > LARGEST]:
        faults.append(Fault(path, f"{key} holds {shown(bad[0])}, but must be a list of {numbers}{_limit(bad[0])}", where))
    else:
        return np.array(entries, dtype=float)
    return None


@float64
def _trace(entries: Iterable[_Entry], dimension: int, faults: list[Fault]) -> None:
    """Trace ψ once a family: whatever a user's function does wrong shows here, before anything runs."""
    seen: dict[tuple[Any, ...], Fault | None] = {}
    for entry in entries:
        first = entry.family not in seen
        fault = seen.setdefault(entry.family, _untraceable(entry, dimension) if first else None)
        if fault is not None and not first:
            written = entry.constraint.source is not None and len(faults) < SUGGESTIONS
            # Equal expressions may be written differently: each has its own columns.
            again = _untraceable(entry, dimension) if written else None
            fault = again or replace(fault, path=(*entry.path, *fault.path[len(entry.path) :]), where=entry.where, offset=0)
        if fault is not None:
            faults.append(fault)


def _untraceable(entry: _Entry, dimension: int) -> Fault | None:
    message, offset = _mistake(entry, dimension)
    key: Path = ("psi",) if entry.constraint.source is not None else ()
    return Fault((*entry.path, *key), message, entry.where, offset) if message else None


def _mistake(entry: _Entry, dimension: int) -> tuple[str, int]:
    """What is wrong with ψ, and where in its text; an empty message if nothing is."""
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


def _families(entries: Sequence[_Entry]) -> tuple[Family, ...]:
    members: dict[tuple[Any, ...], list[int]] = defaultdict(list)
    for number, entry in enumerate(entries):
        members[entry.family].append(number)
    families = []
    for numbers in members.values():
        group = [entries[number] for number in numbers]
        families.append(
            Family(
                kind=group[0].constraint.kind,
                psi=group[0].constraint.psi,
                agents=np.array([entry.agents for entry in group], dtype=np.int32),
                owner=np.array([entry.owner for entry in group], dtype=np.int32),
                number=np.array(numbers, dtype=np.int32),
                parameters={key: np.stack([entry.values[key] for entry in group]) for key in group[0].values},
                weight=np.array([entry.weight for entry in group]),
                sources=_sources(group),
            )
        )
    return tuple(families)


def _sources(entries: Sequence[_Entry]) -> tuple[str, ...] | None:
    texts = tuple(entry.constraint.source for entry in entries if entry.constraint.source is not None)
    return texts if len(texts) == len(entries) else None


def _pairs(links: Links, index: Mapping[str, int], faults: list[Fault]) -> np.ndarray | None:
    """Links as pairs of indices, or None for a named topology."""
    if isinstance(links, str):
        if links not in TOPOLOGIES:
            choices = ", ".join(TOPOLOGIES)
            faults.append(Fault(("communication", "graph"), f"there is no graph {links!r}; choose one of {choices}", "communication"))
        return None
    pairs = []
    for k, link in enumerate(getattr(links, "edges", links)):
        path: Path = ("communication", "links", k)
        ends = tuple(link) if isinstance(link, list | tuple) else (link,)
        where = f"communication link {k + 1}"
        if len(ends) != 2:
            faults.append(Fault(path, f"a link joins two agents, such as [a1, a2], but is {shown(link)}", where))
        elif unknown := [end for end in ends if not isinstance(end, str) or end not in index]:
            faults.append(Fault(path, _unknown(unknown[0], index, faults), where))
        elif ends[0] == ends[1]:
            faults.append(Fault(path, f"agent {ends[0]!r} is linked to itself; name another agent", where))
        else:
            pairs.append((index[ends[0]], index[ends[1]]))
    return np.array(pairs, dtype=np.int32).reshape(-1, 2)


def topology(kind: str, count: int, families: Sequence[Family]) -> np.ndarray:
    """The links of one of `TOPOLOGIES`, (L, 2) int32, i < j, each once."""
    return _unique(_topology(kind, count, families))


def _topology(kind: str, count: int, families: Sequence[Family]) -> np.ndarray:
    i = np.arange(count, dtype=np.int32)
    if kind == "line":
        return np.stack([i[:-1], i[1:]], axis=1)
    if kind == "ring":
        return np.stack([i, np.roll(i, -1)], axis=1)
    if kind == "star":
        return np.stack([np.zeros(max(count - 1, 0), dtype=np.int32), i[1:]], axis=1)
    if kind == "complete":
        return np.stack(np.triu_indices(count, 1), axis=1).astype(np.int32)
    pairs = [np.stack([family.owner, family.agents[:, k]], axis=1) for family in families for k in range(family.arity)]
    return np.concatenate([np.zeros((0, 2), dtype=np.int32), *pairs])


def _unique(pairs: np.ndarray) -> np.ndarray:
    pairs = np.sort(pairs, axis=1)
    return np.unique(pairs[pairs[:, 0] < pairs[:, 1]], axis=0)


def _unknown(agent: Any, index: Mapping[str, int], faults: Sequence[Fault]) -> str:
    hint = closest(agent, index) if len(faults) < SUGGESTIONS else ""
    return f"there is no agent {shown(agent)}{hint}"


def _listed(names: Sequence[str]) -> str:
    return ", ".join(map(repr, names)) or "nothing"


def _sortable(part: str | int) -> tuple[int, int, str]:
    return (0, part, "") if isinstance(part, int) else (1, 0, part)
