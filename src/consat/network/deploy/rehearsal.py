"""Simulates a launch in one process: the runners of all agents over the network in memory, on a simulated clock.

The clock advances when all agents have done the steps that are due. So a run is deterministic, and as fast as the agents compute.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any

import jax
import numpy as np

from consat.network.node.body import SimulatedBody
from consat.network.node.build import core_of, runner_of
from consat.network.node.embodied import Embodied
from consat.network.node.modes import NodeSettings
from consat.network.node.part import Part
from consat.network.node.runner import Runner
from consat.network.node.station import Station
from consat.network.transports.memory import MemoryNetwork

OPENING = 0.01
"""Time between the start of an agent and its first step, s, in which messages can arrive."""
SHORTEST = 1e-6
"""Shortest time between two steps of an agent, s."""


class Rehearsal:
    """A simulated launch of the agents with the given parts.

    Args:
        parts: the part (local problem) of each agent, by id.
        settings: mode and rate of the agents.
        network: the simulated network.
        speed: largest speed of a body, length/s.
        core: makes the core of an agent; by default as a process does.
        skew: by how much the Unix time of an agent is ahead of the time of the network, s, by id; 0 for agents that are not listed.
    """

    def __init__(
        self,
        parts: Mapping[str, Part],
        settings: NodeSettings,
        network: MemoryNetwork,
        *,
        speed: float = np.inf,
        core: Callable[[Part, NodeSettings], Embodied] = core_of,
        skew: Mapping[str, float] | None = None,
    ) -> None:
        self.parts, self.settings, self.network = parts, settings, network
        self.events: list[dict[str, Any]] = []
        self.bodies = {agent: SimulatedBody(part.first[part.own], speed) for agent, part in parts.items()}
        self.runners: dict[str, Runner] = {}
        self._skew = skew or {}
        self._core, self._incarnations = core, dict.fromkeys(parts, 0)
        self._due: dict[str, float] = {}

    def start(self, *agents: str, **changes: Any) -> None:
        """Start agents, or restart them after a `kill`. A restarted agent has only its state on disk.

        Args:
            *agents: ids of the agents; all if none is given.
            **changes: fields of `NodeSettings` to change for these agents.
        """
        for agent in agents or tuple(self.parts):
            part, settings = self.parts[agent], replace(self.settings, **changes)
            self._incarnations[agent] += 1
            endpoint = self.network.endpoint(agent, [neighbour.id for neighbour in part.neighbours])
            with jax.enable_x64(True):
                station = Station(
                    part, self._core(part, settings), settings, endpoint, clock=self.network.clock, incarnation=self._incarnations[agent],
                    body=self.bodies[agent], log=self.events.append, wall=functools.partial(self._wall, agent),
                )  # fmt: skip
                self.runners[agent] = runner_of(station)
            self._due[agent] = self.network.now + OPENING

    def _wall(self, agent: str) -> float:
        return self.network.now + self._skew.get(agent, 0.0)

    def kill(self, *agents: str) -> None:
        """End agents without notice, as a crash does."""
        for agent in agents:
            self.network.close(agent)
            del self.runners[agent], self._due[agent]

    def run(self, seconds: float, until: Callable[[], bool] = lambda: False) -> bool:
        """Advance the simulated clock.

        Args:
            seconds: duration, s.
            until: condition for an earlier end, checked each time the clock advances.

        Returns:
            whether the condition became true.
        """
        end = self.network.now + seconds
        with jax.enable_x64(True):
            while (now := min(self.network.next(), *self._due.values(), np.inf)) <= end:
                self.network.now = max(now, self.network.now)
                ready = self.network.deliver() & self.runners.keys()
                ready |= {agent for agent, due in self._due.items() if due <= self.network.now}
                for agent in sorted(ready):
                    self._due[agent] = max(self.runners[agent].step(), self.network.now + SHORTEST)
                    if self.runners[agent].done:
                        self.kill(agent)
                if until():
                    return True
        self.network.now = end
        return until()

    def positions(self) -> dict[str, np.ndarray]:
        """The current position of each body, (d,), by id."""
        return {agent: body.position().copy() for agent, body in self.bodies.items()}
