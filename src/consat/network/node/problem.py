"""`consat.protocols.Solver` and `Links` of one agent, built from its `Part` alone."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Self

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from consat.engine.live import Live
from consat.network.node.part import Part
from consat.numerics import Groups, on_device
from consat.problem.objective import Nu, Objective
from consat.problem.units import Region
from consat.protocols.estimates import Estimates
from consat.protocols.local import proximal as prox
from consat.protocols.local.interior import Interior, Shared, Units
from consat.protocols.solver import EXACT, LocalSolver


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class OwnLinks:
    """`consat.protocols.Links` of one agent.

    Attributes:
        row: (E,) row of the copy at each end.
        groups: groups the ends by copy.
        degree: (rows,) see `Links.degree`.
        metropolis: (E,) see `Links.metropolis`.
    """

    row: Array
    groups: Groups
    degree: Array
    metropolis: Array

    @classmethod
    def of(cls, part: Part) -> OwnLinks:
        """Build from a part; the ends are in the order of `ends`."""
        index = {agent: row for row, agent in enumerate(part.team.ids)}
        known = {neighbour.id: dict(zip(neighbour.shares, neighbour.degrees, strict=True)) for neighbour in part.neighbours}
        pairs = ends(part)
        row = np.array([index[agent] for _, agent in pairs], dtype=np.int32)
        degree = np.bincount(row, minlength=part.team.count)
        theirs = np.array([known[neighbour][agent] for neighbour, agent in pairs], dtype=float)
        return cls(
            on_device(row),
            Groups.of(row, part.team.count),
            jnp.asarray(degree, dtype=float),
            on_device(1.0 / (1.0 + np.maximum(degree[row], theirs))),
        )

    def at(self, rows: Array) -> Array:
        return rows[self.row]

    def sum(self, links: Array) -> Array:
        return self.groups.sum(links)

    def least(self, links: Array) -> Array:
        return -self.groups.max(-links)


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class OwnSolver(LocalSolver):
    """`LocalSolver` of one agent.

    Attributes:
        links: the ends of links at the agent.
        live: changeable parameters of its constraints.
    """

    links: OwnLinks
    live: Live

    @classmethod
    def of(cls, part: Part, speaks: str = "link") -> OwnSolver:
        """Build from a part. Rows are in the order of `part.team.ids`; the agent has index 0 of 1.

        Args:
            part: the agent's part.
            speaks: see `consat.protocols.Rounds.speaks`.
        """
        team = part.team
        return cls(
            links=OwnLinks.of(part),
            length=on_device(part.length),
            region=Region(on_device(part.center), on_device(part.reach)),
            interior=_interior(part) if speaks == "pair" else None,
            plan=_plan(part) if speaks == "link" else None,
            nu=Nu(on_device(part.nu.alpha), on_device(part.nu.beta)),
            local=replace(Objective.at_positions(team), owners=Groups.of(np.zeros_like(team.owner), 1)),
            holder=jnp.zeros(team.count, dtype=np.int32),
            own=jnp.array([part.own], dtype=np.int32),
            talkers=Groups.of(np.zeros(len(ends(part)), dtype=np.int32), 1),
            hops=part.hops,
            convex=part.convex,
            precision=EXACT,
            live=live_of(part),
        )

    def at(self, time: Array | float) -> Self:
        """Copy with the constraint parameters at a time, s since t = 0."""
        return self.with_parameters(self.live.at(jnp.asarray(time)))


def live_of(part: Part) -> Live:
    """Parameters of an agent's constraints. They are arguments of the compiled step, so that a change does not compile."""
    live = Live.of(part.team, 1.0, all_of_them=True)
    assert live is not None
    return live


def _plan(part: Part) -> prox.Plan:
    plan = prox.buckets(part.team, lambda _, position: position, part.team.count, part.convex, live=True)
    batches = tuple(replace(batch, agents=jnp.zeros_like(batch.agents)) for batch in plan.batches)
    return prox.Plan(batches, plan.row, plan.agent[part.own : part.own + 1], 1)


def _interior(part: Part) -> Interior:
    """Local interior-point step of the agent as a team of one. Its pairs are in the order of `part.neighbours`."""
    team, none = part.team, np.zeros((0, 2), dtype=np.int32)
    number = np.arange(team.count, dtype=np.int32)
    rows = [[*map(team.ids.index, neighbour.travels), *[-1] * neighbour.level] for neighbour in part.neighbours]
    pair = np.repeat(np.arange(len(rows)), [len(shares) for shares in rows])
    talks = np.stack([np.zeros(len(rows), dtype=np.int32), np.arange(len(rows), dtype=np.int32)], axis=1)
    me = np.array([part.own], dtype=np.int32)
    families = [replace(family, owner=np.zeros_like(family.owner)) for family in team.families]
    one = team.with_constraints(families, np.zeros_like(team.owner), team.names)
    one.ids = (part.me,)
    copies = Estimates("local", np.zeros_like(number), number, me, none, np.zeros(1, dtype=np.int32), none)
    units = Units(*(on_device(each) for each in (part.center, part.length, part.psi, part.reach / part.length, part.extent / part.length)))
    shared = Shared(talks, pair, np.array([row for shares in rows for row in shares], dtype=int), part.exact)
    return Interior.alone(one, copies, shared, units)


def ends(part: Part) -> list[tuple[str, str]]:
    """(neighbour, agent) for each end of a link: the neighbour at the other end, and the owner of the position. Sorted by agent, then by
    neighbour."""
    return [(neighbour.id, agent) for agent in part.team.ids for neighbour in part.neighbours if agent in neighbour.shares]
