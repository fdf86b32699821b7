"""Implementation of `consat.protocols.Solver`, for all agents of a team at once or for a single agent."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple, Self

import jax
import jax.numpy as jnp
from jax import Array

from consat.numerics import Groups, pick
from consat.problem.constraints.domain import HUGE
from consat.problem.objective import Nu, Objective
from consat.problem.units import Region
from consat.protocols.base import Links
from consat.protocols.local import proximal as prox
from consat.protocols.local.interior import Interior

EXACT = prox.Precision(tolerance=1e-9)
"""Precision of the local steps of a single agent and of small teams."""
FLAT = 1e-6
"""A ψ that changes by less than this over the team's unit of length, in units of 1/ν, counts as flat."""


class Tries(NamedTuple):
    """Sequence of K moves of the initial estimates, tried in order; arrays of shape (K,).

    Attributes:
        others: fraction of the way by which copies of other positions move towards the agent's own position.
        own: fraction of the way by which the own position moves towards the mean of these copies.
        home: fraction of the way by which all move towards the centre of the team's region.
        scale: standard deviation of an additional random step, in units of the region's reach.
    """

    others: Any
    own: Any
    home: Any
    scale: Any

    @classmethod
    def all(cls) -> Tries:
        """First moves towards each other by growing fractions, then random steps of growing scale around the estimates and the centre."""
        moves = [(part, 0.0, 0.0, 0.0) for part in PARTS] + [(0.0, part, 0.0, 0.0) for part in PARTS]
        draws = [(0.0, 0.0, home, scale) for scale in SCALES for home in (0.0, 1.0) for _ in range(DRAWS)]
        return cls(*(jnp.array(column) for column in zip(*moves, *draws, strict=True)))


PARTS = (0.5, 0.75, 0.9, 0.97, 0.99)
SCALES = tuple(2.0**k for k in range(-8, 1))
DRAWS = 4
"""Number of random tries per scale and starting point."""


class Place(NamedTuple):
    """State of the search for initial estimates: number of the next try, estimates, (rows, d), and which agents are lost there, (N,)."""

    number: Array
    x: Array
    lost: Array


@dataclass(frozen=True)
class Footing:
    """Moves initial estimates away from places where an agent's constraints have no usable gradient: where one of its ψ is −∞, or where a
    constraint is violated and all of them are flat (design, section 10). Such an agent is called lost.

    Attributes:
        local: the agents' objectives over the copies that they hold.
        nu: the smoothing.
        length: the team's unit of length.
        region: the team's region.
        holder: (rows,) the agent that holds each copy, sorted.
        own: (N,) rows of own positions.
        still: whether own positions stay fixed, as measured positions of bodies do.
    """

    local: Objective
    nu: Nu
    length: Array
    region: Region
    holder: Array
    own: Array
    still: bool = False

    def lost(self, x: Array) -> Array:
        """(N,) which agents are lost at the estimates `x`, (rows, d)."""
        margin = self.local.agent_margins(x)
        slope = jnp.max(jnp.abs(self.local.ascent(x, self.nu)), axis=1)
        steepest = jax.ops.segment_max(slope, self.holder, len(self.own), indices_are_sorted=True)
        return (margin < -HUGE) | ((margin <= 0.0) & (steepest * self.nu.alpha * self.length < FLAT))

    def find(self, x: Array) -> Array:
        """(rows, d) for each agent the first of the `Tries` at which it is not lost; `x` where none is needed or none helps."""
        if not any(batch.partial for batch in self.local.batches):
            return x
        tries, moved = Tries.all(), self.moves(x)

        def improve(at: Place) -> Place:  # number 0 tests x itself, so that ψ is compiled only once
            step = moved(at.number, jax.tree.map(lambda each: each[at.number - 1], tries))
            candidate = jnp.where(pick(at.lost, self.holder)[:, None] & (at.number > 0), x + step, at.x)
            return Place(at.number + 1, candidate, self.lost(candidate))

        def goes_on(at: Place) -> Array:
            return (at.number <= len(tries.own)) & jnp.any(at.lost)

        found = jax.lax.while_loop(goes_on, improve, Place(jnp.asarray(0), x, jnp.ones(len(self.own), bool)))
        return jnp.where(pick(found.lost, self.holder)[:, None], x, found.x)

    def moves(self, x: Array) -> Callable[[Array, Tries], Array]:
        """Function that returns the step, (rows, d), of a try with its number. The random step of a copy depends only on its rank among the
        copies of its holder, so that it is the same in a team and alone."""
        count, row = len(self.own), jnp.arange(len(x), dtype=self.own.dtype)
        is_own = (pick(self.own, self.holder) == row)[:, None]
        rank = row - jnp.searchsorted(self.holder, self.holder).astype(row.dtype)
        size, total = (jax.ops.segment_sum(each, self.holder, count, indices_are_sorted=True) for each in (jnp.ones(len(x)), x))
        mine, mean = (pick(each, self.holder) for each in (x[self.own], (total - x[self.own]) / jnp.maximum(size - 1.0, 1.0)[:, None]))

        def step(number: Array, how: Tries) -> Array:
            key = jax.random.fold_in(jax.random.key(0), number)
            noise = jax.vmap(lambda place: jax.random.normal(jax.random.fold_in(key, place), x.shape[1:]))(rank)
            together = jnp.where(is_own, how.own * (mean - x), how.others * (mine - x)) + how.home * (self.region.center[None, :] - x)
            whole = together + how.scale * self.region.reach * noise
            return jnp.where(is_own, 0.0, whole) if self.still else whole

        return step


@dataclass(frozen=True)
class LocalSolver:
    """`consat.protocols.Solver` for a subset of agents. Per-agent scalars have shape (N,).

    Attributes:
        links: the ends of links at these agents.
        length: () the team's unit of length.
        region: the team's region.
        plan: the agents in batches, for proximal steps; None for protocols without proximal steps.
        precision: stopping rule of the proximal steps.
        interior: local step of `consat.protocols.interior_point`; None for other protocols.
        nu: the smoothing.
        local: every agent's objective over its copies.
        holder: (rows,) the agent that holds each copy, sorted.
        own: (N,) rows of own positions.
        talkers: groups the ends of links by agent.
        hops: see `consat.problem.graphs.hops`.
        convex: whether every ψ of the team is known to be concave.
    """

    links: Links
    length: Array
    region: Region
    plan: prox.Plan | None
    interior: Interior | None
    nu: Nu
    local: Objective
    holder: Array
    own: Array
    talkers: Groups
    hops: int = field(metadata={"static": True})
    convex: bool = field(metadata={"static": True})
    precision: prox.Precision = field(metadata={"static": True})

    def with_parameters(self, values: Sequence[Mapping[str, Array]]) -> Self:
        """Copy with new constraint parameters. `values`: for each family the parameters to replace, (M_f, …)."""
        interior = self.interior and replace(self.interior, plan=self.interior.plan.with_parameters(values))
        plan = self.plan and self.plan.with_parameters(values)
        return replace(self, local=self.local.with_parameters(values), interior=interior, plan=plan)

    def recall(self, x: Array, kappa: Array) -> prox.Memory:
        assert self.plan is not None, "only for protocols that take proximal steps"
        return prox.recall(self.plan, self.nu, x, kappa)

    def prox(self, v: Array, kappa: Array, x: Array, memory: prox.Memory) -> tuple[Array, prox.Memory, Array]:
        assert self.plan is not None, "only for protocols that take proximal steps"
        return prox.step(self.plan, self.nu, v, kappa, x, memory, offset=0.0, precision=self.precision)

    def nearby(self, x: Array) -> Array:
        idle = (self.links.degree == 0) & jnp.isinf(self.to_rows(self.margin(x)))
        near = jnp.where(idle[:, None], x, self.region.nearby(x, self.convex))
        return Footing(self.local, self.nu, self.length, self.region, self.holder, self.own).find(near)

    def gradient(self, x: Array) -> Array:
        return self.local.gradient(x, self.nu)

    def margin(self, x: Array) -> Array:
        return self.local.agent_margins(x)

    def to_rows(self, numbers: Array) -> Array:
        return pick(numbers, self.holder)

    def least(self, numbers: Array) -> Array:
        return -self.talkers.max(-numbers)
