"""Changes of a team's structure: agents, links and constraints that come and go. Each function returns a new team."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np

from consat.errors import Fault, InvalidTeam, shown
from consat.problem import graphs
from consat.problem.agent import Agent
from consat.problem.changes import named, place_of
from consat.problem.constraints.record import flatten
from consat.problem.parameters import Path
from consat.problem.team import Team


def with_agent(team: Team, agent: Agent, links: Iterable[str] | None = None) -> Team:
    """The team with one more agent, its last.

    Args:
        team: the team.
        agent: the new agent.
        links: ids of the agents to link it to; by default those whose positions its constraints read.

    Raises:
        InvalidTeam: the agent does not fit the team.
    """
    if not isinstance(agent, Agent):
        raise InvalidTeam([Fault((), f"{shown(agent)} is no agent; give a consat.Agent", "add")])
    given = None if links is None else [links] if isinstance(links, str) else list(links)
    joined = [*team.agents, agent]
    new = _like(team, joined, [(agent.id, other) for other in given or ()])
    if given is None:
        i = new.count - 1
        read = {int(j) for family in new.families for j in np.unique(family.agents[family.owner == i])} - {i}
        new = _like(team, joined, [(agent.id, new.ids[j]) for j in sorted(read)])
    return new


def without_agent(team: Team, agent: str) -> Team:
    """The team without an agent, its constraints, its links, and all constraints that read its position.

    Raises:
        InvalidTeam: there is no such agent, it is the last one, or the others would not be connected.
    """
    i = place_of(team, agent)
    if team.count == 1:
        raise InvalidTeam([Fault((), "it is the last agent; a team needs at least one", f"agent {agent!r}")])
    new, _ = team.part(np.delete(np.arange(team.count), i))
    require_connected(new, f"without agent {agent!r}")
    return new


def with_link(team: Team, one: str, other: str, path: Path = ()) -> Team:
    """The team with one more link. `path`: place of the change in the input, for faults.

    Raises:
        InvalidTeam: there are no such agents, or they are linked already.
    """
    pair, there = _link(team, one, other)
    if there.any():
        raise InvalidTeam([Fault(path, "they are linked already", f"link [{one}, {other}]")])
    links = np.concatenate([team.links, np.array([pair], dtype=np.int32)])
    return team.with_links(links[np.lexsort((links[:, 1], links[:, 0]))])


def without_link(team: Team, one: str, other: str, path: Path = ()) -> Team:
    """The team without a link; agents that depend on each other may not be connected in it. `path`: place of the change in the input.

    Raises:
        InvalidTeam: there are no such agents, or there is no such link.
    """
    _, there = _link(team, one, other)
    if not there.any():
        raise InvalidTeam([Fault(path, "there is no such link", f"link [{one}, {other}]")])
    return team.with_links(team.links[~there])


def with_constraint(team: Team, agent: str, constraint: Any) -> Team:
    """The team in which an agent has one more constraint. Raises: InvalidTeam: there is no such agent, or the constraint does not fit."""
    i, agents = place_of(team, agent), list(team.agents)
    agents[i] = dataclasses.replace(agents[i], constraints=[*flatten(agents[i].constraints), constraint])
    return _like(team, agents)


def without_constraint(team: Team, agent: str, constraint: str) -> Team:
    """The team in which an agent lacks a constraint, or all sides of a box. Raises: InvalidTeam: there is no such agent or constraint."""
    i, agents = place_of(team, agent), list(team.agents)
    gone = {team.names[number] for number in named(team, agent, constraint)}
    agents[i] = dataclasses.replace(agents[i], constraints=[each for each in flatten(agents[i].constraints) if each.name not in gone])
    return _like(team, agents)


def require_connected(team: Team, where: str, path: Path = ()) -> None:
    """Raises: InvalidTeam: agents that depend on each other are not connected by links.

    Args:
        team: the team.
        where: the change that led to it, for the message.
        path: place of the change in the input.
    """
    try:
        graphs.require_connected(team)
    except InvalidTeam as error:
        raise InvalidTeam([dataclasses.replace(fault, path=path, where=where) for fault in error.faults]) from None


def _link(team: Team, one: str, other: str) -> tuple[tuple[int, int], np.ndarray]:
    """The sorted indices of two agents, and (L,) which links are between them."""
    i, j = place_of(team, one), place_of(team, other)
    if i == j:
        raise InvalidTeam([Fault((), "an agent is not linked to itself; name another", f"agent {one!r}")])
    pair = min(i, j), max(i, j)
    return pair, (team.links == np.array(pair)).all(axis=1)


def _like(team: Team, agents: Sequence[Agent], links: Sequence[tuple[str, str]] = ()) -> Team:
    """Team with the agents `agents` and additional links, other properties as in `team`."""
    return Team(agents, [*team.linked, *links], team.dimension, unit=team.unit)
