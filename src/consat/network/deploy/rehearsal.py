"""A whole team over the network in memory, agent by agent as each would run in its process, on a clock that only moves when all have done
what is due: exact, repeatable, and as fast as the agents compute.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Mapping
from typing import Any

import jax
import numpy as np

from consat.network.node.body import SimulatedBody
from consat.network.node.modes import Manner, Runner, runner_of
from consat.network.node.part import Part
from consat.network.transports.memory import Air

OPENING = 0.01
"""Between opening its transport and its first step an agent has so long to get messages, s."""
SHORTEST = 1e-6
"""Time passes by at least this between two steps of an agent, s."""


class Rehearsal:
    """The agents of some parts.

    Args:
        parts: by agent.
        manner: how they run.
        air: the network between them.
        speed: the most that a body moves, length/s.
        build: makes the runner of an agent; what a process would make if None.
        skew: how far the Unix time of each agent is ahead of that of the network, s.
    """

    def __init__(
        self,
        parts: Mapping[str, Part],
        manner: Manner,
        air: Air,
        *,
        speed: float = np.inf,
        build: Callable[..., Runner] = runner_of,
        skew: Mapping[str, float] | None = None,
    ) -> None:
        self.parts, self.manner, self.air = parts, manner, air
        self.events: list[dict[str, Any]] = []
        self.bodies = {agent: SimulatedBody(part.first[part.team.ids.index(agent)], speed) for agent, part in parts.items()}
        self.runners: dict[str, Runner] = {}
        self._skew = skew or {}
        self._build, self._incarnations = build, dict.fromkeys(parts, 0)
        self._due: dict[str, float] = {}

    def start(self, *agents: str, **changes: Any) -> None:
        """Start agents, all if none is named, or start them again after a `kill`: what they remember is what is on disk.

        Args:
            *agents: their ids.
            **changes: to their `Manner`.
        """
        for agent in agents or tuple(self.parts):
            part = self.parts[agent]
            self._incarnations[agent] += 1
            manner = Manner(**({field: getattr(self.manner, field) for field in self.manner.__dataclass_fields__} | changes))
            with jax.enable_x64(True):
                self.runners[agent] = self._build(
                    part, manner, self.air.endpoint(agent, [neighbour.id for neighbour in part.neighbours]),
                    clock=self.air.clock, incarnation=self._incarnations[agent], body=self.bodies[agent], log=self.events.append,
                    wall=functools.partial(self._wall, self._skew.get(agent, 0.0)),
                )  # fmt: skip
            self._due[agent] = self.air.now + OPENING

    def _wall(self, skew: float) -> float:
        return self.air.now + skew

    def kill(self, *agents: str) -> None:
        """As a crash does: without a word."""
        for agent in agents:
            self.air.close(agent)
            del self.runners[agent], self._due[agent]

    def run(self, seconds: float, until: Callable[[], bool] = lambda: False) -> bool:
        """Let time pass; whether `until`, looked at after every step, came true."""
        end = self.air.now + seconds
        with jax.enable_x64(True):
            while (now := min(self.air.next(), *self._due.values(), np.inf)) <= end:
                self.air.now = max(now, self.air.now)
                ready = self.air.deliver() & self.runners.keys()
                ready |= {agent for agent, due in self._due.items() if due <= self.air.now}
                for agent in sorted(ready):
                    self._step(agent)
                if until():
                    return True
        self.air.now = end
        return until()

    def _step(self, agent: str) -> None:
        runner = self.runners[agent]
        due = runner.step()
        if runner.done:
            self.kill(agent)
            return
        self._due[agent] = max(due, self.air.now + SHORTEST)

    def positions(self) -> dict[str, np.ndarray]:
        """Where the bodies are."""
        return {agent: body.position().copy() for agent, body in self.bodies.items()}
