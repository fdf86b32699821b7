"""An agent's own part of the interior-point protocol: its Newton step, what it tells each neighbour, and the bound that it proves.

`layout` says which variables an agent has and shares, and sorts agents into batches; `step` computes a round.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import Array

from consat.interior.layout import Batch, Plan, Route, Shared, plan_of, route_of
from consat.interior import step
from consat.interior.step import Gains, Lanes, Mail, Memory, Proof, Units
from consat.numerics import pick, taken

__all__ = ["Batch", "Gains", "Mail", "Memory", "Plan", "Route", "Shared", "Units", "begin", "plan_of", "route_of", "round_of", "silence"]


def silence(plan: Plan, pairs: int) -> Mail:
    """The mail before anything was said; leading axis P."""
    p = plan.width
    matrix, vector, number = jnp.zeros((pairs, p, p)), jnp.zeros((pairs, p)), jnp.zeros(pairs)
    return Mail(matrix, vector, number - 1.0, number, number + jnp.inf, Proof(matrix, vector, number, number, number))


def begin(plan: Plan, units: Units, x: Array, gains: Gains) -> Memory:
    """What all agents remember at the start, from first estimates (C, d)."""

    def start(batch: Batch) -> Memory:
        y = jnp.moveaxis(taken(_normal(x, units), batch.rows[0], 0.0), 1, -1)
        return _out(step.begin(_lanes(batch, units, gains), y))

    return _collected(plan, [start(batch) for batch in plan.batches], units)


def round_of(plan: Plan, units: Units, memory: Memory, inbox: Mail, gains: Gains) -> tuple[Memory, Mail]:
    """One round of all agents: what they remember, and what stands at each end of a link."""
    y, pairs = _normal(memory.y, units), len(plan.floats)

    def turn(batch: Batch) -> tuple[Memory, Mail]:
        agents, rows, ends, shared = batch.agents[0], batch.rows[0], batch.pairs[0], batch.shared[0]
        multiplier = taken(memory.multiplier, batch.members[0], 0.0)
        mine = Memory(jnp.moveaxis(taken(y, rows, 0.0), 1, -1), multiplier, *(leaf[agents] for leaf in memory[2:]))
        p = shared.shape[1]

        def at(values: Array, empty: float = 0.0) -> Array:
            found = jnp.moveaxis(taken(values, ends, empty), 1, -1) if pairs else jnp.zeros((0, *values.shape[1:], len(agents)))
            return found[(slice(None), *[slice(p)] * (values.ndim - 1))]

        heard = Mail(
            at(inbox.matrix), at(inbox.vector), at(inbox.barrier, -1.0), at(inbox.level), at(inbox.margin, jnp.inf),
            Proof(*map(at, inbox.proof)),
        )  # fmt: skip
        told, mail = step.act(_lanes(batch, units, gains), shared, rows < len(y), mine, heard, gains)
        return _out(told), jax.tree.map(lambda leaf: _widened(leaf, plan.width), mail)

    found = [turn(batch) for batch in plan.batches]
    mail = jax.tree.map(lambda *leaves: pick(jnp.concatenate(leaves), plan.pair), *[each[1] for each in found])
    return _collected(plan, [each[0] for each in found], units), mail


def _normal(x: Array, units: Units) -> Array:
    return (x - units.center[None]) / units.length


def _lanes(batch: Batch, units: Units, gains: Gains) -> Lanes:
    n, count = batch.rows.shape[1:]
    return Lanes(batch, jax.tree.map(lambda leaf: leaf[0], batch.kinds), units, gains.cap, (n, len(units.center), count))


def _out(memory: Memory) -> Memory:
    """The agents first: (n·A, d), (m·A,), (A,)."""
    y = jnp.moveaxis(memory.y, -1, 1)
    return memory._replace(y=y.reshape(-1, y.shape[-1]), multiplier=memory.multiplier.reshape(-1))


def _widened(leaf: Array, width: int) -> Array:
    """(g, p, …, A) → (g·A, width, …)."""
    leaf = jnp.moveaxis(leaf, -1, 1)
    leaf = leaf.reshape(-1, *leaf.shape[2:])
    return jnp.pad(leaf, [(0, 0), *[(0, width - size) for size in leaf.shape[1:]]])


def _collected(plan: Plan, found: list[Memory], units: Units) -> Memory:
    """The answers of all batches, each where it belongs."""
    whole = Memory(*(jnp.concatenate(leaves) for leaves in zip(*found, strict=True)))
    agents = {name: pick(getattr(whole, name), plan.agent) for name in Memory._fields if name not in ("y", "multiplier")}
    x = units.center[None] + units.length * pick(whole.y, plan.row)
    return Memory(y=x, multiplier=pick(whole.multiplier, plan.member), **agents)
