"""What both local steps use: operations on arrays whose last axis is the agent (the lane), size A, and constant curvatures."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from consat.numerics import once
from consat.problem.constraints.curvature import hessians
from consat.problem.family import Family


def along(function: Callable[..., Any]) -> Callable[..., Any]:
    """Vectorise a function of one constraint of one agent over the constraints (first axis) and the agents (last axis)."""
    return jax.vmap(jax.vmap(function, in_axes=-1, out_axes=-1))


def arguments(y: Array, slots: Array) -> Array:
    """(m, arity, d, A) the positions that each constraint reads.

    Args:
        y: (n, d, A) positions of each agent.
        slots: (m, arity, A) which of the n positions each constraint reads.
    """
    m, arity, count = slots.shape
    return jnp.take_along_axis(y, slots.reshape(m * arity, 1, count), axis=0).reshape(m, arity, y.shape[1], count)


def eliminated(matrix: Array, right: Array) -> tuple[Array, Array]:
    """Solve a symmetric system in every lane by Gauss–Jordan elimination, one pivot an iteration of a loop: the program has the same size
    for any N. The rows are not exchanged, which a positive definite matrix does not need.

    Args:
        matrix: (N, N, A) symmetric.
        right: (N, r, A) right-hand sides.

    Returns:
        (N, r, A) the solutions, and (A,) whether the matrix is positive definite; where it is not, the solution is meaningless.
    """
    size = len(matrix)

    def eliminate(j: Array, at: tuple[Array, Array]) -> tuple[Array, Array]:
        whole, positive = at
        pivot = whole[j, j]
        row = whole[j] / pivot[None]
        factor = jnp.where(jnp.arange(size, dtype=j.dtype)[:, None] == j, 0.0, whole[:, j])
        return (whole - factor[:, None] * row[None]).at[j].set(row), positive & (pivot > 0)

    start = jnp.concatenate([matrix, right], axis=1), jnp.ones(matrix.shape[-1], bool)
    whole, positive = jax.lax.fori_loop(0, size, eliminate, start)
    return whole[:, size:], positive


def bend_of(family: Family, dimension: int) -> np.ndarray | None:
    """(n, n) −∇²ψ for weight 1, n = arity·d; None unless it is constant and the same for all constraints of the family."""
    try:
        constant = once(hessians(family.psi, family.arity, dimension, family.lasting, family.size))
    except ValueError:  # not a polynomial of degree ≤ 2
        return None
    return -constant[0] if len(constant) == 1 and np.isfinite(constant).all() else None
