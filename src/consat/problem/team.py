"""The team: agents, their constraints and the links between them. Validates all input and reports all faults at once."""

from __future__ import annotations

import copy
import functools
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, TypeAlias, cast

import numpy as np
from numpy.typing import ArrayLike

from consat.errors import Fault, InvalidTeam, closest, shown
from consat.problem.constraints.record import OWNER, Constraint, Constraints, Fixed, Number, flatten
from consat.problem.entries import SUGGESTIONS, Entry, alike, trace
from consat.problem.family import Chosen, Counted, Family, FamilyPart, Joined, assemble, distinct
from consat.problem.groups import Expansion, Group, faults_of, stems_clash
from consat.problem.parameters import Path, checked, still, vector
from consat.problem.schedule import FOREVER

if TYPE_CHECKING:
    import networkx as nx

MOST_NAMED = 100_000
"""With at most this many constraints, all names are built at once; with more, each name is built on access."""

INSTANTS = 12
"""Approximate number of times at which moving constraints are sampled; see `Team.instants`."""
LONGEST_UNIT = 16
"""Largest length of the name of a unit, in characters."""

TOPOLOGIES = ("line", "ring", "star", "complete", "task")
"""Names of link graphs: see `topology`."""

Links: TypeAlias = "str | nx.Graph | np.ndarray | Iterable[tuple[str, str]]"


@dataclass(frozen=True)
class Agent:
    """One agent with its private constraints.

    Attributes:
        id: unique in the team.
        constraints: what `consat.within` and the other factories return; lists may nest.
        start: initial position x_i(0), shape (d,), length. If None, it is drawn at random when the team runs.
    """

    id: str
    constraints: Constraints = ()
    start: ArrayLike | None = None


class Team:
    """N agents in R^d, their constraints and their communication links.

    Args:
        agents: at least one agent; a `Group` stands for many.
        links: pairs of agents that communicate: pairs of ids, a `networkx.Graph` over ids, an (L, 2) array of indices into `ids`, or one of
            `TOPOLOGIES`. The default ``task`` links the owner of each constraint to the agents that the constraint reads.
        dimension: d, from 1 to 64.
        unit: unit of lengths in figures and exports, such as ``m``. If None, none is shown.

    Raises:
        InvalidTeam: the input has faults. The message names every fault, its agent and constraint, and the cure.

    Attributes:
        ids: the N ids, in order.
        families: the constraints, grouped by function.
        owner: (M,) index of the agent that owns each constraint; constraints are sorted by owner.
        names: (M,) names of the constraints.
        links: (L, 2) int32, i < j, each link once, sorted.
        starts: (N, d) initial positions, length; NaN for an agent without a given start.
        around: (N, d) places and (N,) largest distances on each axis: the region in which a group with ``scatter`` starts its members and
            in which others first estimate them. NaN for other agents. None if no group has ``scatter``.
        members: the agents and groups as given; None if the constraints have been changed since.
        dimension: d.
        unit: unit of lengths, or None.
    """

    ids: Sequence[str]
    families: tuple[Family, ...]
    owner: np.ndarray
    names: Sequence[str]
    links: np.ndarray
    starts: np.ndarray
    around: tuple[np.ndarray, np.ndarray] | None
    members: tuple[Agent | Group, ...] | None
    dimension: int
    unit: str | None

    def __init__(self, agents: Iterable[Agent | Group], links: Links = "task", dimension: int = 2, *, unit: str | None = None) -> None:
        self.members = tuple(agents)
        faults: list[Fault] = []
        if isinstance(dimension, bool) or not isinstance(dimension, int | np.integer) or not 1 <= dimension <= 64:
            faults.append(Fault(("dimension",), f"dimension is {dimension!r}, but must be a whole number from 1 to 64", "dimension"))
            dimension = 0
        if not self.members:
            faults.append(Fault(("agents",), "a team needs at least one agent", "agents"))
        if unit is not None and not (isinstance(unit, str) and unit.strip() and unit.isprintable() and len(unit) <= LONGEST_UNIT):
            what = f"unit is {shown(unit)}, but must be a printable text of at most {LONGEST_UNIT} letters, such as m"
            faults.append(Fault(("unit",), what, "unit"))
        self.unit = unit
        self.dimension = int(dimension)
        index = Index(self.members, self.dimension, faults)
        self.ids = index.ids
        self.starts = np.full((index.count, self.dimension), np.nan)
        self.around = None
        entries = list(_entries(index, self.dimension, faults))
        parts = alike(entries)
        if dimension:
            trace(entries, self.dimension, faults)
            for k, i, agent in index.singles:
                if agent.start is not None:
                    start = vector(agent.start, self.dimension, ("agents", k, "start"), "start", _who(k, agent.id), faults)
                    self.starts[i] = np.nan if start is None else start
            for k, i, group in index.groups:
                parts += self._expand(group, i, index, ("agents", k), faults)
        pairs = _pairs(links, index, faults)
        if faults:
            distinct = {(fault.path, fault.message): fault for fault in reversed(faults)}
            raise InvalidTeam(sorted(distinct.values(), key=lambda fault: tuple(map(_sortable, fault.path))))
        self.families, self.owner, self.names = assemble(parts)
        if len(self.names) <= MOST_NAMED:
            self.names = tuple(self.names)
        self.links = _unique(pairs, self.count) if pairs is not None else topology(cast(str, links), self.count, self.families)

    def _expand(self, group: Group, first: int, index: Index, path: Path, faults: list[Fault]) -> list[FamilyPart]:
        expansion = Expansion(group, first, index.ids, index.get, self.dimension, path, faults)
        mine = slice(first, first + group.count)
        if group.start is not None:
            self.starts[mine] = group.start
        if group.scatter is not None:
            if self.around is None:
                self.around = np.full_like(self.starts, np.nan), np.full(len(self.starts), np.nan)
            self.around[0][mine], self.around[1][mine] = expansion.layout.places, group.scatter
        made = expansion.parts()
        entries = [
            Entry(constraint, first, tuple(range(part.agents.shape[1])), "", at, where, {k: v[0] for k, v in part.parameters.items()})
            for part, constraint, at, where in made
            if len(part.owner)
        ]
        trace(entries, self.dimension, faults)
        return [part for part, *_ in made if len(part.owner)]

    def _copied(self) -> Team:
        """A copy without what was computed of the constraints and agents, which are to be replaced."""
        team = copy.copy(self)
        for name in ("constraints_per_agent", "place", "slots"):
            team.__dict__.pop(name, None)
        return team

    def with_constraints(self, families: Iterable[Family], owner: np.ndarray, names: Sequence[str]) -> Team:
        """The same agents and links with other constraints. They are not checked; arguments as the attributes of `Team`."""
        team = self._copied()
        team.families, team.owner, team.names, team.members = tuple(families), owner, names, None
        return team

    @property
    def agents(self) -> tuple[Agent, ...]:
        """All agents with their constraints, members of groups included. An equal team can be built from them."""
        own: list[list[tuple[int, Constraint]]] = [[] for _ in range(self.count)]
        for family in self.families:
            for k in range(family.size):
                i, number = int(family.owner[k]), int(family.number[k])
                own[i].append((number, self._constraint(family, k, i, number)))
        return tuple(
            Agent(agent, [each for _, each in sorted(constraints, key=lambda pair: pair[0])], None if np.isnan(start).any() else start)
            for agent, constraints, start in zip(self.ids, own, self.starts, strict=True)
        )

    def _constraint(self, family: Family, k: int, owner: int, number: int) -> Constraint:
        moving = {key: track.schedule(k) for key, track in family.tracks.items()}
        values = {key: moving.get(key) or value[k] for key, value in family.parameters.items()}
        reads = tuple(OWNER if i == owner else self.ids[i] for i in family.agents[k].tolist())
        source = None if family.sources is None else family.sources[k]
        parameters = {key: Fixed(value) for key, value in values.items()}
        return Constraint(family.kind, family.psi, reads, parameters, self.names[number], float(family.weight[k]), source)

    @property
    def linked(self) -> list[tuple[str, str]]:
        """The links as pairs of ids."""
        return [(self.ids[i], self.ids[j]) for i, j in self.links.tolist()]

    @property
    def moves(self) -> bool:
        """Whether any constraint has a parameter that moves with time."""
        return any(family.tracks for family in self.families)

    def at(self, time: float) -> Team:
        """The team with all parameters frozen at `time`, s."""
        return self.with_constraints([family.at(time) for family in self.families], self.owner, self.names) if self.moves else self

    @property
    def knots(self) -> np.ndarray:
        """The distinct times of all schedules, s, increasing, and 0. The end of the clock is left out."""
        found = [track.knots for family in self.families for track in family.tracks.values()]
        return np.unique(np.concatenate([np.zeros(0), *found]))

    @property
    def instants(self) -> list[Team]:
        """The team frozen at sample times; a list with the team itself if nothing moves.

        The times are about `INSTANTS` of its `knots` and, if a constraint reads the time, `INSTANTS` times in the first minute.
        """
        if not self.moves:
            return [self]
        knots = self.knots
        reads_time = any((track.times[:, -1] >= FOREVER).any() for family in self.families for track in family.tracks.values())
        times = np.concatenate([[0.0], knots[:: max(1, len(knots) // INSTANTS)], np.linspace(0.0, 60.0, INSTANTS) if reads_time else []])
        return [self.at(time) for time in np.unique(times[times >= 0]).tolist()]

    def with_links(self, links: np.ndarray) -> Team:
        """The same agents and constraints with other links, (L, 2), i < j, sorted. They are not checked."""
        team = copy.copy(self)
        team.links = links
        return team

    def part(self, agents: np.ndarray) -> tuple[Team, np.ndarray]:
        """A team of a subset of the agents, with the constraints and links that involve only these.

        Args:
            agents: (N',) ascending indices of the agents to keep.

        Returns:
            the team, and the (M',) indices that its constraints have in this team.
        """
        place = np.full(self.count, -1, dtype=np.int32)
        place[agents] = np.arange(len(agents), dtype=np.int32)
        parts, numbers = [], [np.zeros(0, dtype=np.int32)]
        for family in self.families:
            kept = family.members((place[family.agents] >= 0).all(axis=1))
            numbers.append(kept.number)
            parts.append(
                FamilyPart(
                    kind=family.kind,
                    psi=family.psi,
                    agents=place[kept.agents],
                    owner=place[kept.owner],
                    parameters=kept.parameters,
                    weight=kept.weight,
                    names=Chosen(self.names, kept.number),
                    sources=kept.sources,
                    turn=kept.number,
                    tracks=kept.tracks,
                )
            )
        team = self._copied()
        team.ids, team.starts, team.members, team.around = Chosen(self.ids, agents), self.starts[agents], None, None
        team.families, team.owner, team.names = assemble([part for part in parts if len(part.owner)])
        links = place[self.links]
        team.links = links[(links >= 0).all(axis=1)]
        return team, np.sort(np.concatenate(numbers))

    @property
    def count(self) -> int:
        """N, the number of agents."""
        return len(self.ids)

    @functools.cached_property
    def place(self) -> Mapping[str, int]:
        """The index of each agent in `ids`, by id."""
        return {agent: i for i, agent in enumerate(self.ids)}

    @functools.cached_property
    def slots(self) -> np.ndarray:
        """(M, 2) int32: for each constraint the index of its family, and its index within the family."""
        slots = np.zeros((len(self.owner), 2), dtype=np.int32)
        for f, family in enumerate(self.families):
            slots[family.number, 0], slots[family.number, 1] = f, np.arange(len(family.number))
        return slots

    @functools.cached_property
    def constraints_per_agent(self) -> np.ndarray:
        """(N,) number of constraints m_i of each agent."""
        return np.bincount(self.owner, minlength=self.count)

    def _repr_html_(self) -> str:
        from consat.views import notebook

        return notebook.team(self)

    def __repr__(self) -> str:
        return f"Team({self.count} agents, {len(self.owner)} constraints, {len(self.links)} links, dimension={self.dimension})"


class Index:
    """Mapping from ids to indices of agents, without a dictionary entry for each member of a group.

    Args:
        members: agents and groups.
        dimension: d of the team; 0 if it is not valid.
        faults: list to which the faults of ids and groups are added.

    Attributes:
        ids: ids of all agents.
        singles: for each single agent: its index among the members, its index in the team, the agent.
        groups: the same for each group without faults; the index in the team is that of its first member.
    """

    def __init__(self, members: Sequence[Agent | Group], dimension: int, faults: list[Fault]) -> None:
        self.singles: list[tuple[int, int, Agent]] = []
        self.groups: list[tuple[int, int, Group]] = []
        self.places: dict[str, int] = {}
        self.ranges: list[tuple[int, Counted]] = []
        ids: list[Sequence[str]] = []
        numbers: dict[str, int] = {}
        self.count = 0
        for k, member in enumerate(members):
            if isinstance(member, Group):
                self._take(member, k, dimension, faults, ids)
                continue
            self.singles.append((k, self.count, member))
            path: Path = ("agents", k, "id")
            if not isinstance(member.id, str) or not member.id.strip() or not member.id.isprintable():
                faults.append(Fault(path, f"id is {member.id!r}, but must be a printable text such as 'a1'", f"agents[{k}]"))
            elif member.id in numbers:
                message = f"id {member.id!r} is taken by agents[{numbers[member.id]}]; every agent needs an id of its own"
                faults.append(Fault(path, message, f"agents[{k}]"))
            else:
                self.places[member.id], numbers[member.id] = self.count, k
            ids.append((member.id,))
            self.count += 1
        for k, _, agent in self.singles:
            if any(counted.find(agent.id) is not None for _, counted in self.ranges):
                message = f"id {agent.id!r} is taken by a member of a group; every agent needs an id of its own"
                faults.append(Fault(("agents", k, "id"), message, f"agents[{k}]"))
        self.ids: Sequence[str] = Joined(ids) if self.groups else tuple(agent.id for _, _, agent in self.singles)

    def _take(self, group: Group, k: int, dimension: int, faults: list[Fault], ids: list[Sequence[str]]) -> None:
        found = faults_of(group, ("agents", k), dimension) if dimension else []
        counted = Counted(group.name, 0 if found else group.count)
        clashes = [] if found else [clash for _, other in self.ranges if (clash := stems_clash(other, counted)) is not None]
        if clashes:
            message = f"its member {clashes[0]!r} has the id of another group's; choose another name"
            found = [Fault(("agents", k, "group"), message, f"group {group.name!r}")]
        faults += found
        if not found and dimension:
            self.groups.append((k, self.count, group))
            self.ranges.append((self.count, counted))
            ids.append(counted)
            self.count += group.count

    def get(self, agent: object) -> int | None:
        """The index in the team of the agent with this id, or None."""
        if not isinstance(agent, str):
            return None
        if agent in self.places:
            return self.places[agent]
        return next((first + place for first, ids in self.ranges if (place := ids.find(agent)) is not None), None)

    def __contains__(self, agent: object) -> bool:
        return self.get(agent) is not None

    def __getitem__(self, agent: str) -> int:
        place = self.get(agent)
        if place is None:
            raise KeyError(agent)
        return place

    def known(self) -> Iterator[str]:
        """Ids to suggest in messages: of each group only the first `SUGGESTIONS`."""
        yield from self.places
        for _, ids in self.ranges:
            yield from ids[:SUGGESTIONS]


def _who(i: int, name: Any) -> str:
    return f"agent {name!r}" if isinstance(name, str) and name.strip() else f"agents[{i}]"


def _entries(index: Index, dimension: int, faults: list[Fault]) -> Iterator[Entry]:
    for number, i, agent in index.singles:
        taken: dict[str, int] = {}
        who = _who(number, agent.id)
        for k, item in enumerate(agent.constraints):
            path: Path = ("agents", number, "constraints", k)
            for constraint in flatten(item):
                if not isinstance(constraint, Constraint):
                    faults.append(Fault(path, f"{constraint!r} is no constraint; use consat.within and its like", who))
                    continue
                named = len(faults)
                name = _name(constraint, taken, path, agent.id, who, faults)
                where = f"{who}, constraint {name!r}"
                reads = _reads(constraint, agent.id, index, path, where, faults)
                entry = Entry(constraint, i, reads, name, path, where)
                for key, parameter in constraint.parameters.items():
                    value = checked(parameter, dimension, (*path, key), key, where, faults)
                    if value is not None:
                        entry.take(key, value)
                weight = still(Number(constraint.weight, positive=True), dimension, (*path, "weight"), "weight", where, faults)
                entry.weight = 1.0 if weight is None else float(weight)
                if len(faults) == named and reads:
                    yield entry


def _name(constraint: Constraint, taken: dict[str, int], path: Path, owner: str, who: str, faults: list[Fault]) -> str:
    """The name that the user gave, or one derived from the kind and the other agents, with a number if it would repeat."""
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


def _reads(constraint: Constraint, owner: str, index: Index, path: Path, where: str, faults: list[Fault]) -> tuple[int, ...]:
    key: Path = ("psi",) if constraint.source is not None else ("agent",)
    reads: list[str] = []
    for agent in constraint.reads:
        if isinstance(agent, str) and (agent == OWNER or agent in index):
            reads.append(owner if agent == OWNER else agent)
        else:
            faults.append(Fault((*path, *key), _unknown(agent, index, faults), where))
    if not isinstance(owner, str) or owner not in index:
        return ()  # the owner's id has a fault, which `Index` reports
    if owner not in reads:
        faults.append(Fault((*path, *key), f"it must read the position of its owner {owner!r}, but reads {_listed(reads)}", where))
    if repeated := next((agent for agent in reads if reads.count(agent) > 1), None):
        itself = "its own owner" if repeated == owner else "the same agent twice"
        faults.append(Fault((*path, *key), f"it names {itself}, {repeated!r}; name another agent", where))
    return tuple(index[agent] for agent in reads)


def _pairs(links: Links, index: Index, faults: list[Fault]) -> np.ndarray | None:
    """(L, 2) links as pairs of indices; None for a named topology, or after a fault in the topology or the array."""
    if isinstance(links, str):
        if links not in TOPOLOGIES:
            choices = ", ".join(TOPOLOGIES)
            faults.append(Fault(("communication", "graph"), f"there is no graph {links!r}; choose one of {choices}", "communication"))
        return None
    if isinstance(links, np.ndarray) and links.dtype.kind in "iu":
        if links.ndim == 2 and links.shape[1] == 2 and (not links.size or (links.min() >= 0 and links.max() < index.count)):
            return links
        message = f"an array of links must have shape (L, 2) and hold places from 0 to {index.count - 1}"
        faults.append(Fault(("communication", "links"), message, "communication"))
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
    """The links of one of `TOPOLOGIES`: (L, 2) int32, i < j, sorted, each once.

    Args:
        kind: one of `TOPOLOGIES`.
        count: N, the number of agents.
        families: the constraints, which ``task`` needs.
    """
    return _unique(_topology(kind, count, families), count)


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


def _unique(pairs: np.ndarray, count: int) -> np.ndarray:
    low, high = pairs.min(axis=1), pairs.max(axis=1)
    keys = distinct((low.astype(np.int64) * count + high)[low < high])
    return np.stack([keys // max(count, 1), keys % max(count, 1)], axis=1).astype(np.int32)


def _unknown(agent: Any, index: Index, faults: Sequence[Fault]) -> str:
    hint = closest(agent, index.known()) if len(faults) < SUGGESTIONS else ""
    return f"there is no agent {shown(agent)}{hint}"


def _listed(names: Sequence[str]) -> str:
    return ", ".join(map(repr, names)) or "nothing"


def _sortable(part: str | int) -> tuple[int, int, str]:
    return (0, part, "") if isinstance(part, int) else (1, 0, part)
