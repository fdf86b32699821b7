"""A team that is advanced by rounds: the state that an engine computes, its counters, and what is recorded.

A run advances it until a rule ends it, see `consat.engine.rounds`. A session advances it when it is asked to, see `consat.Session`.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from jax import Array

from consat.engine.chunks import Chunk, Engine, Kept
from consat.engine.recording import Choice, Rows, velocities
from consat.engine.round import Now
from consat.engine.tally import Tally
from consat.engine.violations import shares
from consat.engine.world import World
from consat.numerics import quickly_compiled
from consat.problem.team import Team

if TYPE_CHECKING:
    from consat.robots.drive import Drive, Report


class RoundsSimulation:
    """A team in rounds.

    Args:
        team: the team.
        engine: computes the rounds.
        choice: what is recorded.
        period: duration of a round, s; None if rounds take no time.

    Attributes:
        state: state after the last round; None before `start`.
        tally: counters of the rounds so far.
    """

    def __init__(self, team: Team, engine: Engine, choice: Choice, period: float | None) -> None:
        self.team, self.engine, self.choice, self.period = team, engine, choice, period
        self.tally = Tally(every=choice.every)
        self.state: Any = None

    def start(self) -> Rows:
        """Begin. Returns the record of the start, round 0."""
        self.state, chunk = self.engine.start()
        return self._count(chunk, 1)

    def go(self, count: int, every: int, *, streak: tuple[int, int] | None = None) -> Rows:
        """Advance by up to `count` rounds.

        Args:
            count: number of rounds, at most `consat.engine.chunks.CHUNK`.
            every: record one round in `every`.
            streak: see `Engine.advance`; the rounds do not end early if None.

        Returns:
            The record of these rounds.
        """
        self.state, chunk = self.engine.advance(self.state, self.tally.done, count, streak, every)
        return self._count(chunk, every)

    def look(self) -> Rows:
        """Record of the present state."""
        tally = self.tally
        margins = [np.array([number]) for number in (tally.margin, tally.smooth_margin, tally.bound)]
        return self._rows(np.array([tally.done]), margins, Kept(*(leaf[None] for leaf in self.engine.look(self.state, tally.done))))

    def agree(self, stop: bool) -> bool:
        """Whether any of the processes wants to stop. `stop`: whether this one does."""
        return self.engine.agree(stop)

    def positions(self) -> np.ndarray:
        """(N, d) positions of all agents."""
        return self.engine.positions(self.state)

    def _count(self, chunk: Chunk, every: int) -> Rows:
        numbers = self.tally.add(chunk)
        chosen = np.flatnonzero(numbers % every == 0)
        kept = Kept(*(np.asarray(leaf)[: len(chosen)] for leaf in chunk.kept))
        margins = [np.asarray(leaf)[chosen] for leaf in (chunk.margin, chunk.smooth_margin, chunk.bound)]
        return self._rows(numbers[chosen], margins, kept)

    def _rows(self, step: np.ndarray, margins: Sequence[np.ndarray], kept: Kept) -> Rows:
        margin, smooth_margin, bound = margins
        estimate = None if self.choice.copies is None else kept.estimate
        heading = kept.heading if self.engine.world.drive is not None else None
        return Rows(step, kept.position, None, margin, smooth_margin, kept.agent_margin, estimate, None, bound, heading)

    def account(self, rows: Rows) -> Mapping[str, Any]:
        """See `consat.engine.loop.Traceable`."""
        tally, period = self.tally, self.period
        return {
            "clock": "round",
            "velocity": velocities(rows.step, rows.position, 1.0 if period is None else period),
            "satisfied_from": float(tally.last_bad + 1) if tally.last_bad < tally.done else None,
            "messages": tally.messages,
            "floats_sent": tally.floats,
            "bytes": tally.bytes,
            **tally.knowledge,
            "turned": tally.turned,
            "period": period,
            "heading": rows.heading,
            "motion": None if period is None else tally.motion(period) | driven(self.team, self.engine.world, self.state),
            "violated": None if tally.violated is None else shares(self.team, tally.violated, tally.done + 1),
        }


def driven(team: Team, world: World, now: Now) -> dict[str, Any]:
    """Fields of the summary for robots: smallest distances, m, contacts, stuck robots, and conditions of the collision guarantee that did
    not hold."""
    if world.drive is None or now.robots is None:
        none = {"smallest_distance": None, "clearance": None, "simulator": None}
        return none | {"contacts": 0, "collisions": 0, "stuck": [], "unproven": []}
    from consat.robots.conditions import conditions
    from consat.robots.simulated import Simulated

    drive, robots = world.drive, now.robots
    report, stuck = _ended(drive, robots.state, robots.memory, now.state.x[world.own])
    noise, wind = (0.0 if leaf is None else float(np.linalg.norm(leaf)) for leaf in (world.noise, world.wind))
    gap, clear = float(report.smallest_distance), float(report.clearance)
    return {
        "smallest_distance": gap if np.isfinite(gap) else None,
        "clearance": clear if np.isfinite(clear) else None,
        "contacts": int(report.contacts),
        "collisions": int(report.collisions),
        "stuck": [team.ids[i] for i in np.flatnonzero(stuck).tolist()],
        "unproven": list(conditions(drive, noise=noise, wind=wind, report=report)),
        "simulator": drive.model.name if isinstance(drive.model, Simulated) else None,
    }


@quickly_compiled("drive")
def _ended(drive: Drive, state: Any, memory: Any, targets: Array) -> tuple[Report, Array]:
    return drive.ended(state, memory, targets)
