"""What an agent can ask of itself in rounds, `consat.protocols.Solver`: the same for all agents of a team at once, and for one alone."""

from __future__ import annotations

from dataclasses import dataclass, field

import jax.numpy as jnp
from jax import Array

from consat import prox
from consat.numerics import Groups, pick
from consat.objective import Nu, Objective
from consat.protocols.base import Links
from consat.scale import Region

EXACT = prox.Precision(tolerance=1e-9)
"""Of every local step of an agent alone, and of a small team."""


@dataclass(frozen=True)
class LocalSolver:
    """Some agents, over the copies that they hold; what is one number an agent has one row an agent.

    Attributes:
        links: their ends of their links.
        length: the team's unit of length.
        region: where the team's places are.
        plan: the agents by shape, for their local steps.
        precision: of these.
        nu: the smoothing.
        local: every agent's objective over its copies.
        holder: (rows,) who holds each copy.
        talkers: groups the ends by agent.
        hops: see `consat.graphs.hops`.
        convex: whether every ψ of the team is known to be concave.
    """

    links: Links
    length: Array
    region: Region
    plan: prox.Plan
    nu: Nu
    local: Objective
    holder: Array
    talkers: Groups
    hops: int = field(metadata={"static": True})
    convex: bool = field(metadata={"static": True})
    precision: prox.Precision = field(metadata={"static": True})

    def recall(self, x: Array, kappa: Array) -> prox.Memory:
        return prox.recall(self.plan, self.nu, x, kappa)

    def prox(
        self, v: Array, kappa: Array, x: Array, memory: prox.Memory, sharper: Array | float = 1.0, above: Array | float = 0.0
    ) -> tuple[Array, prox.Memory, Array]:
        nu = Nu(self.nu.alpha * sharper, self.nu.beta * sharper)
        return prox.step(self.plan, nu, v, kappa, x, memory, offset=nu.beta * above - jnp.log(sharper), precision=self.precision)

    def nearby(self, x: Array) -> Array:
        idle = (self.links.degree == 0) & jnp.isinf(self.to_rows(self.margin(x)))
        return jnp.where(idle[:, None], x, self.region.nearby(x, self.convex))

    def margin(self, x: Array) -> Array:
        return self.local.agent_margins(x)

    def to_rows(self, numbers: Array) -> Array:
        return pick(numbers, self.holder)

    def least(self, numbers: Array) -> Array:
        return -self.talkers.max(-numbers)
