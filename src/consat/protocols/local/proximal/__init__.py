"""The proximal step of every agent, from any start (design, section 4):

    x⁺ = argmin_y  f_i(y) + Σ_r κ_r/2 ‖y_r − v_r‖²,      f_i = e^{L_i},  L_i = −ν_β α_i

over the rows r that the agent's constraints read; the other rows are set to v. f_i overflows where constraints are strongly violated, and
its gradient underflows where they are well satisfied. So e^{L} is replaced by its conjugate, with one more unknown σ, the logarithm of the
multiplier. The step is the saddle point

    κ (y − v) + e^σ ∇L(y) = 0,        L(y) − σ = 0.

Modules: `batches` sorts agents into batches, `lanes` computes L and its derivatives, `hessians` solves the linear systems, and `newton`
solves the saddle-point equations.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import Array

from consat.numerics import pick, taken
from consat.problem.objective import Nu
from consat.protocols.local.proximal.batches import MANY, PAIR, SMALL_TEAM, Batch, Kind, Plan, buckets
from consat.protocols.local.proximal.lanes import Lanes
from consat.protocols.local.proximal.newton import MOST_ITERATIONS, STRONGEST, Found, Guess, Precision, cold, solve, solve_most

__all__ = ["MOST_ITERATIONS", "SMALL_TEAM", "STRONGEST", "Guess", "Memory", "Plan", "Precision", "buckets", "recall", "step"]


class Memory(NamedTuple):
    """Warm start of each agent's solver.

    Attributes:
        sigma: (N,) σ, logarithm of the multiplier.
        sharpness: (N,) sharpness of the soft minimum that was reached, in (0, 1].
    """

    sigma: Array
    sharpness: Array


def recall(plan: Plan, nu: Nu, x: Array, kappa: Array) -> Memory:
    """Initial warm start for the first step from `x`, (rows, d), with weights κ, (rows,)."""

    def begin(batch: Batch, part: Part) -> tuple[Array, Array]:
        lanes = Lanes(batch, part.kinds, nu, jnp.zeros(part.rows.shape[-1]))
        guess = cold(lanes, _gathered(x, part.rows), _gathered(kappa, part.rows))
        return guess.sigma, guess.sharpness

    found = [_by_chunk(batch, begin) for batch in plan.batches]
    return Memory(*(_put_back(plan.agent, [each[k] for each in found], jnp.full(plan.agents, float(k))) for k in range(2)))


def step(
    plan: Plan, nu: Nu, v: Array, kappa: Array, x: Array, memory: Memory, *, offset: Array | float, precision: Precision
) -> tuple[Array, Memory, Array]:
    """Proximal step of every agent.

    Args:
        plan: the agents that have constraints; the rows of the others are set to v.
        nu: the smoothing.
        v: (rows, d) centre of the quadratic term.
        kappa: (rows,) weights κ.
        x: (rows, d) solution of the last step, where the solver starts.
        memory: warm start from the last step.
        offset: () or (N,) added to ln f_i.
        precision: stopping rule.

    Returns:
        (rows, d) the solution, the new warm start, and (rows,) the mean diagonal of ∇²f_i, NaN for rows that no constraint reads.
    """
    offset = jnp.broadcast_to(offset, memory.sigma.shape)

    def answers(solver: Callable[..., Found], batch: Batch, part: Part, guess: Guess | None = None, *rest: Array) -> tuple[Array, ...]:
        lanes = Lanes(batch, part.kinds, nu, offset[part.agents])
        guess = guess or Guess(_gathered(x, part.rows), memory.sigma[part.agents], memory.sharpness[part.agents])
        found = solver(lanes, _gathered(v, part.rows), _gathered(kappa, part.rows), guess, precision, *rest)
        return jnp.moveaxis(found.guess.y, 1, -1), found.stiffness, found.guess.sigma, found.guess.sharpness, found.done

    found = []
    for batch in plan.batches:
        if precision.tolerance is None and len(batch.rows) > 1 and not batch.partial:  # a partial ψ needs a line search
            first = _by_chunk(batch, functools.partial(answers, solve_most))
            found.append(_finish(batch, first, functools.partial(answers, solve)))
        else:
            found.append(_by_chunk(batch, functools.partial(answers, solve)))
    y, stiffness, sigma, sharpness = ([each[k] for each in found] for k in range(4))
    return (
        _put_back(plan.row, y, v),
        Memory(_put_back(plan.agent, sigma, memory.sigma), _put_back(plan.agent, sharpness, memory.sharpness)),
        _put_back(plan.row, stiffness, jnp.full(len(kappa), jnp.nan)),
    )


def _gathered(state: Array, rows: Array) -> Array:
    """(rows, …) indexed by (n, A) → (n, …, A); 1 where padded."""
    return jnp.moveaxis(taken(state, rows, 1.0), 1, -1)


class Part(NamedTuple):
    """One chunk of a batch, or a stack of chunks: agents, (A,), their rows, (n, A), and their constraints."""

    agents: Array
    rows: Array
    kinds: tuple[Kind, ...]


def _by_chunk(batch: Batch, function: Callable[[Batch, Part], tuple[Array, ...]]) -> tuple[Array, ...]:
    """Apply a function to every chunk and stack the results. Where there are at least `MANY` chunks, `PAIR` of them are computed in one
    iteration: their computations are independent, so that they can run on different cores."""
    parts, chunks = Part(batch.agents, batch.rows, batch.kinds), len(batch.rows)
    together = PAIR if chunks >= MANY else 1

    def some(parts: Part) -> tuple[Array, ...]:
        found = [function(batch, _one(parts, k)) for k in range(together)]
        return tuple(jnp.stack(leaves) for leaves in zip(*found, strict=True))

    if chunks == 1:
        return some(parts)
    found = jax.lax.map(some, jax.tree.map(lambda leaf: leaf.reshape(-1, together, *leaf.shape[1:]), parts))
    return tuple(leaf.reshape(chunks, *leaf.shape[2:]) for leaf in found)


def _one(parts: Part, k: int) -> Part:
    return jax.tree.map(lambda leaf: leaf[k], parts)


def _finish(batch: Batch, first: tuple[Array, ...], solver: Callable[..., tuple[Array, ...]]) -> tuple[Array, ...]:
    """Continue the agents that are not done, gathered into new chunks, so that converged agents are not iterated with them.

    Args:
        batch: the batch.
        first: results so far: y, stiffness, sigma, sharpness and whether the agent is done, each with a leading axis of chunks.
        solver: function of the batch, a chunk, a starting point and a mask of agents to skip.
    """
    chunks, width = batch.agents.shape
    missing = ~first[-1].reshape(-1)
    place = jnp.cumsum(missing.astype(jnp.int32))
    total = place[-1]
    order = jnp.zeros(chunks * width, jnp.int32)
    order = order.at[jnp.where(missing, place - 1, chunks * width)].set(jnp.arange(chunks * width, dtype=jnp.int32), mode="drop")

    def more(at: tuple[Array, tuple[Array, ...]]) -> tuple[Array, tuple[Array, ...]]:
        start, (y, stiffness, *numbers) = at
        mine = jax.lax.dynamic_slice(order, (start,), (width,))
        # dynamic_slice moves the last slice back so that it ends at the end of `order`; `spare` masks what was done already
        spare = jnp.minimum(start, chunks * width - width) + jnp.arange(width, dtype=jnp.int32) >= total
        chunk, lane = mine // width, mine % width
        part = jax.tree.map(lambda leaf: jnp.moveaxis(leaf[chunk, ..., lane], 0, -1), Part(batch.agents, batch.rows, batch.kinds))
        guess = Guess(jnp.moveaxis(y[chunk, :, lane], 0, -1), numbers[0][chunk, lane], numbers[1][chunk, lane])
        found = solver(batch, part, guess, spare)
        chunk = jnp.where(spare, chunks, chunk)
        # indexing with two index arrays puts the agent axis first
        y = y.at[chunk, :, lane].set(jnp.moveaxis(found[0], 1, 0), mode="drop")
        stiffness = stiffness.at[chunk, :, lane].set(jnp.moveaxis(found[1], 1, 0), mode="drop")
        put = [old.at[chunk, lane].set(new, mode="drop") for old, new in zip(numbers, found[2:], strict=True)]
        return start + width, (y, stiffness, *put)

    return jax.lax.while_loop(lambda at: at[0] < total, more, (jnp.asarray(0, jnp.int32), first))[1]


def _put_back(where: Array, found: list[Array], others: Array) -> Array:
    """Gather the results of all batches in the order of `where`; `others` where there is no result."""
    if not found:
        return others
    flat = jnp.concatenate([each.reshape(-1, *others.shape[1:]) for each in found])
    answered = where < len(flat)
    return jnp.where(answered.reshape(-1, *[1] * (others.ndim - 1)), pick(flat, jnp.minimum(where, len(flat) - 1)), others)
