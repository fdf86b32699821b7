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

LOOPED = 16
"""Largest number of unknowns for elimination by a loop over the pivots; larger systems are split into halves recursively."""
SWEEPS = 30
"""Largest number of sweeps over all pairs in `eigen`; 5 to 10 are usual."""


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


def product(left: Array, right: Array) -> Array:
    """Matrix product in every lane: (i, k, A), (k, j, A) → (i, j, A)."""
    found = jnp.matmul(jnp.moveaxis(left, -1, 0), jnp.moveaxis(right, -1, 0))
    return jnp.moveaxis(found, 0, -1)


def solve(matrix: Array, right: Array) -> tuple[Array, Array]:
    """Solve a symmetric positive definite system in every lane.

    Args:
        matrix: (N, N, A) matrices.
        right: (N, r, A) right-hand sides.

    Returns:
        (N, r, A) the solutions, and (A,) whether the matrix is positive definite.
    """
    size = len(matrix)
    if size > LOOPED:  # block elimination with two halves
        half = size // 2
        corner = jnp.concatenate([matrix[:half, half:], right[:half]], axis=1)
        found, first = solve(matrix[:half, :half], corner)
        filled = product(matrix[half:, :half], found)
        rest = size - half
        below, second = solve(matrix[half:, half:] - filled[:, :rest], right[half:] - filled[:, rest:])
        above = found[:, rest:] - product(found[:, :rest], below)
        return jnp.concatenate([above, below]), first & second
    return eliminated(matrix, right)


def eigen(matrix: Array) -> tuple[Array, Array]:
    """Eigenvalues and eigenvectors of a symmetric matrix in every lane, by Jacobi rotations of disjoint pairs (Brent and Luk 1985, "The
    solution of singular-value and symmetric eigenvalue problems on multiprocessor arrays", round-robin order).

    LAPACK is not used in compiled programs: on a CPU, two calls at once wait for threads of the pool that they themselves occupy.

    Args:
        matrix: (N, N, A) symmetric, finite.

    Returns:
        (N, A) eigenvalues, unsorted, and (N, N, A) the eigenvectors, one in each column.
    """
    size = len(matrix)
    odd = size % 2
    scale = jnp.max(jnp.abs(matrix), axis=(0, 1), initial=0.0)
    whole = jnp.pad(matrix / jnp.where(scale > 0, scale, 1.0)[None, None], ((0, odd), (0, odd), (0, 0)))
    top, bottom = np.arange(0, size, 2), np.arange(1, size + odd, 2)
    order = np.arange(size + odd)
    if len(top) > 1:  # the first one stays, the others go around
        order = np.stack([[0, bottom[0], *top[1:-1]], [*bottom[1:], top[-1]]], axis=1).ravel()
    apart = ~np.eye(size + odd, dtype=bool)[:, :, None]
    small = 8.0 * jnp.finfo(matrix.dtype).eps

    def rotate(whole: Array, vectors: Array, done: Array) -> tuple[Array, Array]:
        diagonal, beside = jnp.diagonal(whole).T, jnp.stack([whole[k, k + 1] for k in range(0, size, 2)])
        tau = (diagonal[1::2] - diagonal[::2]) / (2.0 * jnp.where(beside == 0, 1.0, beside))
        tangent = jnp.where(tau < 0, -1.0, 1.0) / (jnp.abs(tau) + jnp.sqrt(1.0 + tau**2))
        tangent = jnp.where((beside == 0) | done[None], 0.0, tangent)
        cosine = 1.0 / jnp.sqrt(1.0 + tangent**2)
        sine = tangent * cosine

        def turned(rows: Array) -> Array:
            p, q = rows[::2], rows[1::2]
            c, s = cosine[:, None], sine[:, None]
            return jnp.stack([c * p - s * q, s * p + c * q], axis=1).reshape(rows.shape)[order]

        whole = jnp.swapaxes(turned(jnp.swapaxes(turned(whole), 0, 1)), 0, 1)
        return whole, turned(vectors)

    def settled(whole: Array) -> Array:
        return jnp.max(jnp.where(apart, jnp.abs(whole), 0.0), axis=(0, 1)) <= small

    def sweep(at: tuple[Array, Array, Array, Array]) -> tuple[Array, Array, Array, Array]:
        whole, vectors, done, number = at
        whole, vectors = jax.lax.fori_loop(0, size + odd - 1, lambda _, now: rotate(now[0], now[1], done), (whole, vectors))
        return whole, vectors, settled(whole), number + 1

    vectors = jnp.broadcast_to(jnp.eye(size + odd)[:, :, None], whole.shape)
    start = whole, vectors, settled(whole), jnp.zeros((), int)
    whole, vectors, *_ = jax.lax.while_loop(lambda at: ~jnp.all(at[2]) & (at[3] < SWEEPS), sweep, start)
    return jnp.diagonal(whole).T[:size] * scale[None], jnp.swapaxes(vectors, 0, 1)[:size, :size]


def bend_of(family: Family, dimension: int) -> np.ndarray | None:
    """(n, n) −∇²ψ for weight 1, n = arity·d; None unless it is constant and the same for all constraints of the family."""
    try:
        constant = once(hessians(family.psi, family.arity, dimension, family.lasting, family.size))
    except ValueError:  # not a polynomial of degree ≤ 2
        return None
    return -constant[0] if len(constant) == 1 and np.isfinite(constant).all() else None
