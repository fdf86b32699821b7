"""The local proximal step: every agent's own small problem, exact, from any start (design, section 4).

    x⁺ = argmin_y  f_i(y) + Σ_r κ_r/2 ‖y_r − v_r‖²,      f_i = e^{L_i},  L_i = −ν_β α_i

over the rows r that the agent's constraints read (the others stay at v). f_i overflows far from satisfaction and its gradient underflows
near it, so e^{L} is replaced by its conjugate: with ln of the multiplier, σ, as one more unknown, the step is the saddle point

    κ (y − v) + e^σ ∇L(y) = 0,        L(y) − σ = 0.

For a fixed σ the first is the gradient of a strongly convex function of y, and L(y(σ)) − σ falls in σ: Newton on both together, with a line
search on the first and a bracket on the second, cannot miss. For ψ that are not concave the Hessian is made positive and the bracket still
finds a stationary point.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from consat.family import Family
from consat.objective import Nu
from consat.team import Team

MOST_ITERATIONS = 200
SMALL_TEAM = 2000
"""Up to so many agents are batched by size and padded, which compiles once; more by exact shape, which runs faster, …"""
MOST_SHAPES = 4
"""… while there are at most this many shapes."""
SHARPEN = 4.0
"""Factor by which the soft minimum is sharpened each time its blunter version is solved."""
LONGEST_STEP = 3.0
"""σ rises by at most this much at a time where y answers to it: beyond, the linear model of y says nothing."""
STRONGEST = 1e12
"""Where the multiplier outweighs κ by this much, an agent already does all it can for its own constraints, and σ stays."""


class Kind(NamedTuple):
    """The constraints of one family, for agents of like shape: leading axes (agents, most of this family an agent has).

    Attributes:
        slots: (A, m, arity) which of the agent's rows each constraint reads.
        parameters: (A, m, …).
        weight: (A, m).
        used: (A, m) false where padded.
    """

    slots: Array
    parameters: Mapping[str, Array]
    weight: Array
    used: Array


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Bucket:
    """Agents of like shape, solved as one batch.

    Attributes:
        agents: (A,) which.
        rows: (A, n) the rows of the state that their constraints read; the padding points past the last row.
        kinds: their constraints, a family each.
        psi: the families' functions.
        convex: whether every ψ is known to be concave.
    """

    agents: Array
    rows: Array
    kinds: tuple[Kind, ...]
    psi: tuple[Callable[..., Any], ...] = field(metadata={"static": True})
    convex: bool = field(metadata={"static": True})


def buckets(team: Team, row: Callable[[np.ndarray, np.ndarray], np.ndarray], count: int, convex: bool) -> tuple[Bucket, ...]:
    """Sort the agents that have constraints into batches.

    Args:
        team: the team.
        row: gives the row of the copy (holder, position).
        count: how many rows there are.
        convex: whether every ψ is known to be concave.
    """
    n_agents = team.count
    keys = [family.owner[:, None].astype(np.int64) * n_agents + family.agents for family in team.families]
    read = np.unique(np.concatenate([np.zeros(0, dtype=np.int64), *(key.ravel() for key in keys)]))
    holder, position = read // n_agents, read % n_agents
    first = np.searchsorted(holder, np.arange(n_agents + 1))
    sizes = np.stack([np.diff(first), *(np.bincount(family.owner, minlength=n_agents) for family in team.families)], axis=1)
    made = []
    for agents in _alike(sizes):
        place = np.full(n_agents, -1)
        place[agents] = np.arange(len(agents))
        width, *most = sizes[agents].max(axis=0)
        rows = np.full((len(agents), width), count, dtype=np.int32)
        chosen = place[holder] >= 0
        rows[place[holder[chosen]], np.flatnonzero(chosen) - first[holder[chosen]]] = row(holder[chosen], position[chosen])
        kinds, functions = [], []
        for family, key, m in zip(team.families, keys, most, strict=True):
            if m:
                slots = np.searchsorted(read, key) - first[family.owner][:, None]
                kinds.append(_kind(family, slots, place, len(agents), int(m)))
                functions.append(family.psi)
        made.append(Bucket(jnp.asarray(agents, dtype=jnp.int32), jnp.asarray(rows), tuple(kinds), tuple(functions), convex))
    return tuple(made)


def _alike(sizes: np.ndarray) -> list[np.ndarray]:
    """Batches of agents: equal sizes if these are few, else those whose number of rows is of the same power of two."""
    some = np.flatnonzero(sizes[:, 1:].sum(axis=1))
    if not len(some):
        return []
    shapes, which = np.unique(sizes[some], axis=0, return_inverse=True)
    if len(some) <= SMALL_TEAM or len(shapes) > MOST_SHAPES:
        which = np.ceil(np.log2(np.maximum(sizes[some, 0], 4))).astype(int)
    return [some[which == shape] for shape in np.unique(which)]


def _kind(family: Family, slots: np.ndarray, place: np.ndarray, agents: int, most: int) -> Kind:
    members = np.flatnonzero(place[family.owner] >= 0)
    owner = place[family.owner[members]]
    order = np.argsort(owner, kind="stable")
    members, owner = members[order], owner[order]
    rank = np.arange(len(owner)) - np.searchsorted(owner, owner)
    index = np.full((agents, most), members[0])
    index[owner, rank] = members
    used = np.zeros((agents, most), dtype=bool)
    used[owner, rank] = True
    return Kind(
        jnp.asarray(np.where(used[..., None], slots[index], 0), dtype=jnp.int32),
        {key: jnp.asarray(value[index]) for key, value in family.parameters.items()},
        jnp.asarray(family.weight[index]),
        jnp.asarray(used),
    )


def exponents(psi: Sequence[Callable[..., Any]], kinds: Sequence[Kind], y: Array) -> Array:
    """(m,) −ψ_k of ONE agent at its rows y, (n, d), −∞ where padded; the `kinds` without their leading agent axis."""
    found = []
    for function, kind in zip(psi, kinds, strict=True):
        values = jax.vmap(lambda x, p, w, f=function: w * f(*x, **p))(y[kind.slots], kind.parameters, kind.weight)
        found.append(jnp.where(kind.used, -values, -jnp.inf))
    return jnp.concatenate(found)


def log_objective(violations: Array, nu: Nu, offset: Array | float = 0.0, sharpness: Array | float = 1.0) -> Array:
    """L = ln f of ONE agent, plus an offset.

    Args:
        violations: (m,) −ψ_k, −∞ where padded.
        nu: the smoothing.
        offset: added; what max-min scales every f by.
        sharpness: in (0, 1]; below 1 the soft minimum is that much blunter, from the mean (0) to the true one (1).
    """
    count = jnp.log(jnp.sum(violations > -jnp.inf, dtype=violations.dtype))
    blunt = jax.nn.logsumexp(sharpness * nu.alpha * violations) - count
    return nu.beta / nu.alpha * (blunt / sharpness + count) + offset


class Guess(NamedTuple):
    """Where an agent's solver stands: its rows, ln of its multiplier, and the sharpness it has reached."""

    y: Array
    sigma: Array
    sharpness: Array


Level = Callable[[Array, Array | float], Array]


class _Search(NamedTuple):
    y: Array
    sigma: Array
    sharpness: Array
    low: Array
    high: Array
    stiffness: Array
    iterations: Array
    done: Array


def solve(level: Level, v: Array, kappa: Array, guess: Guess, tolerance: Array | float, convex: bool) -> tuple[Guess, Array, Array]:
    """The prox of ONE agent.

    Args:
        level: L as a function of y, (n, d), and the sharpness of its soft minimum.
        v: (n, d) the point to stay near.
        kappa: (n, 1) > 0 how near.
        guess: where to begin.
        tolerance: of both equations: relative to the terms of the first, and on ln f of the second.
        convex: whether every ψ is known to be concave.

    Returns:
        the solution, (n,) the mean diagonal of ∇²f there over the coordinates of each row, and the number of iterations.
    """
    n, d = v.shape
    eps = 8 * jnp.finfo(v.dtype).eps
    k = jnp.broadcast_to(kappa, v.shape).reshape(-1)
    anchor = v.reshape(-1)

    def step(at: _Search) -> _Search:
        def flat(y: Array) -> Array:
            return level(y.reshape(n, d), at.sharpness)

        bend, (height, slope) = jax.jacfwd(lambda y: _twice(flat, y), has_aux=True)(at.y)
        ceiling = jnp.log(STRONGEST * jnp.mean(k) / (jnp.mean(jnp.abs(jnp.diag(bend))) + jnp.finfo(v.dtype).tiny))
        sigma = jnp.minimum(at.sigma, ceiling)
        multiplier = jnp.exp(sigma)
        pull, push = k * (at.y - anchor), multiplier * slope
        residual, gap = pull + push, height - sigma
        matrix = jnp.diag(k) + multiplier * bend
        rounding = eps * (jnp.abs(at.y) + jnp.abs(anchor))
        blur = jnp.abs(matrix) @ rounding
        if not convex:
            values, vectors = jnp.linalg.eigh(matrix)
            matrix = (vectors * jnp.maximum(jnp.abs(values), jnp.min(k))[None, :]) @ vectors.T
        solved = jnp.linalg.solve(matrix, jnp.stack([-residual, -push], axis=1))
        descend, follow = solved[:, 0], solved[:, 1]

        # y alone, for this multiplier, until that much is settled to a fraction of the gap …
        near = -residual @ descend <= 0.2 * multiplier * jnp.maximum(1.0, 0.3 * jnp.abs(gap))
        scales = jnp.array([1.0, 0.5, 0.2, 0.05, 0.01, 0.002])
        worths = jax.vmap(lambda t: 0.5 * jnp.sum(k * (at.y + t * descend - anchor) ** 2) + multiplier * flat(at.y + t * descend))(scales)
        alone = at.y + scales[jnp.nanargmin(worths)] * descend
        # … then both at once, σ within a bracket that only certain signs may narrow
        certain = near & (jnp.abs(slope @ descend) <= 0.3 * jnp.abs(gap))
        low = jnp.where(certain & (gap > 0), jnp.maximum(at.low, sigma), at.low)
        high = jnp.where(certain & (gap < 0), jnp.minimum(at.high, sigma), at.high)
        left, reach = gap + slope @ descend, jnp.maximum(-slope @ follow, 0.0)
        most = jnp.maximum(LONGEST_STEP, jnp.minimum(left, jnp.log1p(jnp.maximum(left, 0.0) / (reach + jnp.finfo(v.dtype).tiny))))
        wanted = sigma + jnp.minimum(left / (1.0 + reach), most)
        bracketed = jnp.isfinite(low) & jnp.isfinite(high) & ((wanted < low) | (wanted > high))
        wanted = jnp.minimum(jnp.where(bracketed, 0.5 * (low + high), wanted), ceiling)
        change = wanted - sigma
        together = at.y + descend + follow * jnp.where(change < 0, jnp.expm1(change), change)

        settled = jnp.linalg.norm(residual) <= tolerance * (jnp.linalg.norm(pull) + jnp.linalg.norm(push)) + jnp.linalg.norm(blur)
        level_is_met = jnp.abs(gap) <= tolerance + eps * jnp.abs(sigma) + jnp.abs(slope) @ rounding
        level_is_met |= (sigma >= ceiling - 1e-6) & (gap > 0)
        sharp = at.sharpness >= 1.0
        done = settled & level_is_met & sharp
        sharpen = near & ((jnp.abs(gap) <= 3.0) | level_is_met) & ~sharp
        return _Search(
            y=jnp.where(done, at.y, jnp.where(near, together, alone)),
            sigma=jnp.where(near & ~done, wanted, sigma),
            sharpness=jnp.where(sharpen, jnp.minimum(SHARPEN * at.sharpness, 1.0), at.sharpness),
            low=jnp.where(sharpen, -jnp.inf, low),
            high=jnp.where(sharpen, jnp.inf, high),
            stiffness=multiplier * jnp.mean(jnp.abs(jnp.diag(bend) + slope**2).reshape(n, d), axis=1),
            iterations=at.iterations + 1,
            done=done,
        )

    infinity = jnp.asarray(jnp.inf, v.dtype)
    start = _Search(
        guess.y.reshape(-1), guess.sigma, guess.sharpness, -infinity, infinity, jnp.zeros(n), jnp.asarray(0), jnp.asarray(False)
    )
    end = jax.lax.while_loop(lambda at: ~at.done & (at.iterations < MOST_ITERATIONS), step, start)
    return Guess(end.y.reshape(n, d), end.sigma, end.sharpness), end.stiffness, end.iterations


def _twice(function: Callable[[Array], Array], y: Array) -> tuple[Array, tuple[Array, Array]]:
    value, slope = jax.value_and_grad(function)(y)
    return slope, (value, slope)


def cold(violations: Callable[[Array], Array], level: Level, nu: Nu, v: Array, kappa: Array) -> Guess:
    """Where to begin without a last solution: at v, with the multiplier that one step of Newton would want there, and with a soft minimum
    so blunt that it sees no kink between the constraints at v."""
    tiny = jnp.finfo(v.dtype).tiny
    there = violations(v)
    used = there > -jnp.inf
    spread = jnp.max(there) - jnp.sum(jnp.where(used, there, 0.0)) / jnp.sum(used, dtype=v.dtype)
    sharpness = 1.0 / jnp.maximum(nu.alpha * spread, 1.0)
    height, slope = jax.value_and_grad(level)(v, sharpness)
    reach = jnp.sum(slope**2 / kappa)
    sigma = jnp.minimum(height, jnp.log1p(jnp.maximum(height, 0.0)) - jnp.log(jnp.maximum(reach, tiny)))
    return Guess(v, sigma, sharpness)


class Memory(NamedTuple):
    """What the solver of each agent keeps for its next step, (N,): ln of the multiplier, and the sharpness reached."""

    sigma: Array
    sharpness: Array


@dataclass(frozen=True)
class _One:
    """One agent of a batch."""

    psi: tuple[Callable[..., Any], ...]
    kinds: tuple[Kind, ...]
    nu: Nu
    offset: Array | float

    def violations(self, y: Array) -> Array:
        return exponents(self.psi, self.kinds, y)

    def level(self, y: Array, sharpness: Array | float) -> Array:
        return log_objective(self.violations(y), self.nu, self.offset, sharpness)


def _padded(rows: Array) -> Array:
    return jnp.concatenate([rows, jnp.ones_like(rows[:1])])


def recall(batches: Sequence[Bucket], agents: int, nu: Nu, x: Array, kappa: Array) -> Memory:
    """What to remember before the first step from x, (rows, d), at weights κ, (rows,)."""
    memory = Memory(jnp.zeros(agents), jnp.ones(agents))
    x, kappa = _padded(x), _padded(kappa)
    for batch in batches:

        def begin(kinds: tuple[Kind, ...], rows: Array, batch: Bucket = batch) -> Guess:
            one = _One(batch.psi, kinds, nu, 0.0)
            return cold(one.violations, one.level, nu, x[rows], kappa[rows][:, None])

        guess = jax.vmap(begin)(batch.kinds, batch.rows)
        memory = Memory(memory.sigma.at[batch.agents].set(guess.sigma), memory.sharpness.at[batch.agents].set(guess.sharpness))
    return memory


def step(
    batches: Sequence[Bucket], nu: Nu, v: Array, kappa: Array, x: Array, memory: Memory, *, offset: Array | float, tolerance: float
) -> tuple[Array, Memory, Array]:
    """Every agent's prox, over the rows of a state.

    Args:
        batches: the agents that have constraints; the rows of the others stay at v.
        nu: the smoothing.
        offset: added to ln f_i; one number, or one an agent.
        v: (rows, d) the point to stay near.
        kappa: (rows,) how near.
        x: (rows, d) where the last step ended.
        memory: of the last step.
        tolerance: see `solve`.

    Returns:
        (rows, d) the solution, the memory, and (rows,) the stiffness, NaN for rows that no constraint reads.
    """
    near, last, weight = _padded(v), _padded(x), _padded(kappa)
    offset = jnp.broadcast_to(offset, memory.sigma.shape)
    stiff = jnp.full(len(kappa), jnp.nan)
    for batch in batches:

        def solve_one(kinds: tuple[Kind, ...], rows: Array, remembered: Memory, above: Array, batch: Bucket = batch) -> tuple[Guess, Array]:
            one = _One(batch.psi, kinds, nu, above)
            found, bend, _ = solve(one.level, near[rows], weight[rows][:, None], Guess(last[rows], *remembered), tolerance, batch.convex)
            return found, bend

        remembered = Memory(memory.sigma[batch.agents], memory.sharpness[batch.agents])
        found, bend = jax.vmap(solve_one)(batch.kinds, batch.rows, remembered, offset[batch.agents])
        flat = batch.rows.reshape(-1)
        v = v.at[flat].set(found.y.reshape(-1, v.shape[1]), mode="drop")
        stiff = stiff.at[flat].set(bend.reshape(-1), mode="drop")
        memory = Memory(memory.sigma.at[batch.agents].set(found.sigma), memory.sharpness.at[batch.agents].set(found.sharpness))
    return v, memory, stiff
