"""Multi-start gradient ascent on the smooth margin with increasing ν. It finds candidates for the max-min of teams that are not quadratic.

    β_c(x) = −(1/ν) ln Σ_{k in cluster c} e^{−ν ψ_k(x)},    ν increasing

Each start and each cluster has its own step length (Barzilai, Borwein 1988). Gradients are exact. A step that lowers β_c is rejected.
"""

from __future__ import annotations

import functools

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from consat.certify.quadratics import Floats, Ints
from consat.numerics import Groups, float64, on_device
from consat.problem.objective import Objective
from consat.problem.team import Team
from consat.problem.units import SHARPNESS, Scale, start_box

LADDER = (0.2, 1.0, 5.0, 25.0)
"""Values of ν, in units of the automatic ν. The first smooths strongly; with the last, β_c is close to the minimum of ψ."""
STEPS = 150
"""Number of steps at each ν. The result is refined later; see `consat.certify.optimum`."""
REACH = 0.5
"""Longest step of an agent, in natural lengths of the team; see `consat.problem.units`."""


@float64
def climb(team: Team, first: Floats, cluster: Ints, size: Scale) -> tuple[Floats, Floats]:
    """Gradient ascent from many starts.

    Args:
        team: the team.
        first: (S, N, d) starts, length.
        cluster: (N,) cluster of each agent.
        size: natural scales of the team.

    Returns:
        (S, N, d) formations, length, and (S, C) margins of their clusters; −∞ where a ψ is not defined.
    """
    count = int(cluster.max(initial=-1)) + 1
    objective, groups, agents = Objective.at_positions(team), Groups.of(cluster[team.owner], count), Groups.of(cluster, count)
    x = on_device(first)
    for rung in LADDER:
        x = _climb(objective, groups, agents, x, on_device(rung * SHARPNESS / size.psi), on_device(REACH * size.length))
    return np.asarray(x), np.asarray(_margins(objective, groups, x))


def drawn(team: Team, count: int, seed: int, size: Scale) -> Floats:
    """(count, N, d) random starts, uniform in the default start box, length."""
    low, high = start_box(size)
    return np.random.default_rng(seed).uniform(low, high, (count, team.count, team.dimension))


@jax.jit
def _margins(objective: Objective, groups: Groups, x: Array) -> Array:
    margins = jax.vmap(lambda one: -groups.max(-objective.psi(one)))(x)
    return jnp.where(jnp.isnan(margins), -jnp.inf, margins)


@jax.jit
@functools.partial(jax.vmap, in_axes=(None, None, None, 0, None, None))
def _climb(objective: Objective, groups: Groups, agents: Groups, x: Array, nu: Array, reach: Array) -> Array:
    """`STEPS` steps of gradient ascent on β_c at one ν, for each start and cluster. `reach` limits the step of an agent, length."""

    def smooth(x: Array) -> tuple[Array, Array]:
        each = -groups.logsumexp(-nu * objective.psi(x))[0] / nu
        return jnp.sum(jnp.where(jnp.isfinite(each), each, 0.0)), each

    ascent = jax.value_and_grad(smooth, has_aux=True)

    def dot(a: Array, b: Array) -> Array:
        return agents.sum(jnp.sum(a * b, axis=1))

    def step(_: int, state: tuple[Array, Array, Array, Array]) -> tuple[Array, Array, Array, Array]:
        x, value, gradient, length = state
        move = agents.spread(length)[:, None] * gradient
        size = jnp.linalg.norm(move, axis=1, keepdims=True)
        move = move * jnp.minimum(1.0, reach / jnp.where(size > 0, size, 1.0))
        (_, after), slope = ascent(x + move)
        better = after >= value
        curved = jnp.abs(dot(move, slope - gradient))
        bold = jnp.where(curved > 0, dot(move, move) / jnp.where(curved > 0, curved, 1.0), 2.0 * length)
        accepted = agents.spread(better)[:, None]
        length = jnp.where(better, jnp.clip(bold, 0.1 * length, 10.0 * length), 0.25 * length)
        return jnp.where(accepted, x + move, x), jnp.where(better, after, value), jnp.where(accepted, slope, gradient), length

    (_, value), gradient = ascent(x)
    steep = jnp.sqrt(dot(gradient, gradient))
    length = reach / jnp.where(steep > 0, steep, 1.0)
    return jax.lax.fori_loop(0, STEPS, step, (x, value, gradient, length))[0]
