"""Membership: which agents are present.

Every message contains a number for each position that both ends share: how often its owner has left and joined. An even number means that
the agent is present, an odd number that it has left for good. The larger number is the newer one. So every holder of a copy learns about a
change, over the links between the holders alone, in whatever order messages arrive and however often they are repeated.
"""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from consat.network.node.part import Part

MOST = 2.0**31
"""Largest accepted number. It is even, so that an agent that is falsely reported as absent can always answer with a larger number."""


class Membership:
    """Membership as one agent knows it.

    Args:
        part: the agent's part. Agents in `part.absent` start as absent, except the agent itself.
    """

    def __init__(self, part: Part) -> None:
        self._me = part.me
        self._epoch = {agent: int(agent in part.absent) for agent in part.team.ids}
        if part.me in part.absent:
            self._epoch[part.me] = 2

    @property
    def gone(self) -> frozenset[str]:
        """The absent agents."""
        return frozenset(agent for agent, epoch in self._epoch.items() if epoch % 2)

    def of(self, agents: Iterable[str]) -> np.ndarray:
        """The membership numbers of some agents."""
        return np.array([self._epoch[agent] for agent in agents], dtype=float)

    def update(self, agents: Iterable[str], epochs: np.ndarray) -> None:
        """Update the numbers with those of a neighbour. Absurd ones are ignored.

        If the neighbour reports this agent as absent, it raises its own number, which contradicts the report.

        Args:
            agents: ids.
            epochs: their numbers, as received.
        """
        for agent, epoch in zip(agents, epochs, strict=True):
            if not (0 <= epoch <= MOST and epoch == int(epoch)) or epoch <= self._epoch[agent]:
                continue
            if agent != self._me:
                self._epoch[agent] = int(epoch)
            elif not self._epoch[agent] % 2:
                self._epoch[agent] = int(epoch) + int(epoch) % 2

    def drop(self, agent: str) -> None:
        """Mark an agent as absent for good: it is this agent that leaves, or a neighbour that was silent for too long."""
        self._epoch[agent] += 1 - self._epoch[agent] % 2

    def adopt(self, other: Membership) -> None:
        """Take over the larger numbers of another `Membership` of the same agent, for agents that both contain."""
        for agent in self._epoch.keys() & other._epoch.keys():
            self._epoch[agent] = max(self._epoch[agent], other._epoch[agent])

    def restore(self, agents: Iterable[str], epochs: np.ndarray) -> None:
        """Restore the numbers that were stored before a restart."""
        self._epoch.update(zip(agents, map(int, epochs), strict=True))
