"""An agent that was killed, and the teams without it and with it again."""

from __future__ import annotations

import dataclasses
from typing import NamedTuple

import numpy as np

from consat.problem.agent import Agent
from consat.problem.changes import place_of
from consat.problem.constraints.record import OWNER, Constraint, flatten
from consat.problem.team import Team


class Silent(NamedTuple):
    """An agent that was killed.

    Attributes:
        place: its index in the team.
        agent: the agent with its constraints; its start is its last position.
        readers: ids of other agents, each with a constraint that read its position.
        links: ids of its neighbours.
    """

    place: int
    agent: Agent
    readers: list[tuple[str, Constraint]]
    links: list[str]

    @classmethod
    def of(cls, team: Team, name: str, x: np.ndarray) -> Silent:
        """What is needed to bring an agent back, with the team at x (N, d). Raises: InvalidTeam: there is no such agent."""
        place, agents = place_of(team, name), list(team.agents)
        readers = [
            (each.id, constraint)
            for each in agents
            if each.id != name
            for constraint in flatten(each.constraints)
            if name in constraint.reads
        ]
        links = [next(end for end in pair if end != name) for pair in team.linked if name in pair]
        return cls(place, dataclasses.replace(agents[place], start=x[place]), readers, links)

    def back_in(self, team: Team) -> Team:
        """The team with the agent again, with those constraints and links whose agents are still there."""
        name = self.agent.id
        there = {*team.ids, name}

        def fits(constraint: Constraint) -> bool:
            return all(read == OWNER or read in there for read in constraint.reads)

        agents = []
        for each in team.agents:
            back = [constraint for other, constraint in self.readers if other == each.id and fits(constraint)]
            agents.append(dataclasses.replace(each, constraints=[*flatten(each.constraints), *back]) if back else each)
        own = [constraint for constraint in flatten(self.agent.constraints) if fits(constraint)]
        agents.insert(self.place, dataclasses.replace(self.agent, constraints=own))
        links = [*team.linked, *((name, other) for other in self.links if other in there)]
        return Team(agents, links, team.dimension, unit=team.unit)
