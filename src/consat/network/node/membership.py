"""Who is there. Every agent passes on, with each message, a number for each position that it shares with the neighbour: how often that
agent has come and gone. Even: it is there; odd: it left for good. The larger number is the newer, so all who hold a copy of its position
learn of it in whatever order messages arrive, as often as they are repeated, over the links among them alone.
"""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from consat.network.node.part import Part

MOST = 2.0**31
"""A number beyond is not believed. It is even: whoever is said to have left, and has not, can always answer with a larger number."""


class Membership:
    """What one agent knows of who is there.

    Args:
        part: the agent's own; those `absent` in it have left before the beginning, but the agent itself is there.
    """

    def __init__(self, part: Part) -> None:
        self._me = part.me
        self._epoch = {agent: 1 if agent in part.absent else 0 for agent in part.team.ids}
        if self._epoch[part.me] % 2:
            self._epoch[part.me] += 1

    @property
    def gone(self) -> frozenset[str]:
        """Who is not there."""
        return frozenset(agent for agent, epoch in self._epoch.items() if epoch % 2)

    def of(self, agents: Iterable[str]) -> np.ndarray:
        """Their numbers."""
        return np.array([self._epoch[agent] for agent in agents], dtype=float)

    def hear(self, agents: Iterable[str], epochs: np.ndarray) -> bool:
        """Take in what a neighbour says of some agents; whether anything is new.

        Whoever is told that it has left itself, and has not, says so with a larger number.
        """
        news = False
        for agent, told in zip(agents, epochs, strict=True):
            if not (0 <= told <= MOST and told == int(told)) or told <= self._epoch[agent]:
                continue
            if agent != self._me:
                self._epoch[agent] = int(told)
                news = True
            elif not self._epoch[agent] % 2:
                self._epoch[agent] = int(told) + int(told) % 2
        return news

    def drop(self, agent: str) -> None:
        """`agent` has left for good: the agent itself says so, or another that has waited long enough."""
        self._epoch[agent] += 1 - self._epoch[agent] % 2

    def adopt(self, other: Membership) -> None:
        """Take over what another one of the same agent knows, of those that both know."""
        for agent in self._epoch.keys() & other._epoch.keys():
            self._epoch[agent] = max(self._epoch[agent], other._epoch[agent])

    def restore(self, agents: Iterable[str], epochs: np.ndarray) -> None:
        """As it was written down before a restart."""
        self._epoch.update(zip(agents, map(int, epochs), strict=True))
