"""The team: agents, their constraints and the links between them. Validates all input and reports all faults at once."""

from __future__ import annotations

import copy
import dataclasses
import functools
from collections.abc import Iterable, Mapping, Sequence
from typing import cast

import numpy as np

from consat.errors import Fault, InvalidTeam, shown
from consat.problem.agent import Agent
from consat.problem.constraints.record import OWNER, Constraint, Fixed
from consat.problem.entries import alike, entries_of, trace
from consat.problem.expansion import Expansion
from consat.problem.family import Family, assemble
from consat.problem.groups import Group
from consat.problem.index import Index, who_is
from consat.problem.links import Links, pairs_of, topology, unique
from consat.problem.names import Chosen
from consat.problem.parameters import Path, Spot, is_printable, is_whole, vector
from consat.problem.schedule import FOREVER

MOST_NAMED = 100_000
"""With at most this many constraints, all names are built at once; with more, each name is built on access."""

INSTANTS = 12
"""Approximate number of times at which moving constraints are sampled; see `Team.instants`."""
LONGEST_UNIT = 16
"""Largest length of the name of a unit, in characters."""


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
        if not is_whole(dimension, 1, 64):
            faults.append(Fault(("dimension",), f"dimension is {dimension!r}, but must be a whole number from 1 to 64", "dimension"))
            dimension = 0
        if not self.members:
            faults.append(Fault(("agents",), "a team needs at least one agent", "agents"))
        if unit is not None and not (is_printable(unit) and len(unit) <= LONGEST_UNIT):
            what = f"unit is {shown(unit)}, but must be a printable text of at most {LONGEST_UNIT} letters, such as m"
            faults.append(Fault(("unit",), what, "unit"))
        self.unit = unit
        self.dimension = int(dimension)
        index = Index(self.members, self.dimension, faults)
        self.ids = index.ids
        self.starts = np.full((index.count, self.dimension), np.nan)
        self.around = None
        entries = list(entries_of(index, self.dimension, faults))
        parts = alike(entries)
        if dimension:
            trace(entries, self.dimension, faults)
            for k, i, agent in index.singles:
                if agent.start is not None:
                    start = vector(agent.start, self.dimension, Spot(("agents", k, "start"), "start", who_is(k, agent.id), faults))
                    self.starts[i] = np.nan if start is None else start
            for k, i, group in index.groups:
                parts += self._expand(group, i, index, ("agents", k), faults)
        pairs = pairs_of(links, index, faults)
        if faults:
            distinct = {(fault.path, fault.message): fault for fault in reversed(faults)}
            raise InvalidTeam(sorted(distinct.values(), key=lambda fault: tuple(map(_sortable, fault.path))))
        self.families, self.owner, self.names = assemble(parts)
        if len(self.names) <= MOST_NAMED:
            self.names = tuple(self.names)
        self.links = unique(pairs, self.count) if pairs is not None else topology(cast(str, links), self.count, self.families)

    def _expand(self, group: Group, first: int, index: Index, path: Path, faults: list[Fault]) -> list[tuple[Family, Sequence[str]]]:
        expansion = Expansion(group, first, index, self.dimension, path, faults)
        mine = slice(first, first + group.count)
        if group.start is not None:
            self.starts[mine] = group.start
        if group.scatter is not None:
            if self.around is None:
                self.around = np.full_like(self.starts, np.nan), np.full(len(self.starts), np.nan)
            self.around[0][mine], self.around[1][mine] = expansion.layout.places, group.scatter
        return expansion.parts()

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
        kept = [family.members((place[family.agents] >= 0).all(axis=1)) for family in self.families]
        parts = [
            (dataclasses.replace(each, agents=place[each.agents], owner=place[each.owner]), Chosen(self.names, each.number))
            for each in kept
            if each.size
        ]
        team = self._copied()
        team.ids, team.starts, team.members, team.around = Chosen(self.ids, agents), self.starts[agents], None, None
        team.families, team.owner, team.names = assemble(parts)
        links = place[self.links]
        team.links = links[(links >= 0).all(axis=1)]
        return team, np.sort(np.concatenate([np.zeros(0, dtype=np.int32), *(each.number for each in kept)]))

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


def _sortable(part: str | int) -> tuple[int, int, str]:
    return (0, part, "") if isinstance(part, int) else (1, 0, part)
