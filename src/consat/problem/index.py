"""Ids of the agents of a team: their indices, and the faults of ids and groups."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

from consat.errors import Fault, closest, shown
from consat.problem.agent import Agent
from consat.problem.groups import Group, faults_of, label
from consat.problem.names import Counted, Joined
from consat.problem.parameters import Path, is_printable

SUGGESTIONS = 20
"""With this many faults, errors stop suggesting similar ids and locating columns within expressions: in a large team that takes long."""


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
            if not is_printable(member.id):
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
        clashes = [] if found else [clash for _, other in self.ranges if (clash := _clash(other, counted)) is not None]
        if clashes:
            message = f"its member {clashes[0]!r} has the id of another group's; choose another name"
            found = [Fault(("agents", k, "group"), message, label(group))]
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

    def unknown(self, agent: Any, faults: Sequence[Fault]) -> str:
        """Message for an id that no agent has."""
        hint = closest(agent, self.known()) if len(faults) < SUGGESTIONS else ""
        return f"there is no agent {shown(agent)}{hint}"


def who_is(i: int, name: Any) -> str:
    """What messages call the agent number `i` of the input."""
    return f"agent {name!r}" if isinstance(name, str) and name.strip() else f"agents[{i}]"


def _clash(a: Counted, b: Counted) -> str | None:
    """An id that belongs to both of two groups, or None if there is none."""
    short, long = sorted((a, b), key=lambda ids: len(ids.stem))
    tail = long.stem[len(short.stem) :]
    if not long.stem.startswith(short.stem) or not (tail == "" or (tail.isascii() and tail.isdigit() and tail[0] != "0")):
        return None
    for digits in range(1, len(str(len(long))) + 1):  # 10^(digits - 1), the smallest number with so many digits, is the first to clash
        number = 10 ** (digits - 1)
        if number <= len(long) and short.find(text := f"{long.stem}{number}") is not None:
            return text
    return None
