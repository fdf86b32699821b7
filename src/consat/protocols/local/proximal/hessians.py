"""∇²L of the agents of a chunk, the lanes, and the linear systems of Newton's method: (diag κ + e^σ ∇²L) y = r."""

from __future__ import annotations

import functools
import operator
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import Array

from consat.numerics import add_up

UNROLLED = 8
"""Systems of up to so many unknowns are eliminated by a program written out, …"""
LOOPED = 24
"""… of up to so many by a loop, and larger ones by LAPACK."""


def dot(a: Array, b: Array) -> Array:
    """(n, A), (n, A) → (A,)."""
    return add_up(a * b)


class Dense(NamedTuple):
    """∇²L as a matrix.

    Attributes:
        whole: (N, N, A).
        safe: the same without what is not convex; None where that is not known apart.
        convex: whether there is nothing that is not.
    """

    whole: Array
    safe: Array | None
    convex: bool

    def diagonal(self) -> Array:
        """(N, A)."""
        return jnp.stack([self.whole[i, i] for i in range(len(self.whole))])

    def absolute(self, numbers: Array) -> Array:
        """(N, A) Σ_j |∇²L|_ij r_j."""
        return add_up(jnp.abs(jnp.moveaxis(self.whole, 1, 0)) * numbers[:, None])

    def solve(self, kappa: Array, multiplier: Array, right: Array) -> Array:
        """(N, r, A) y; where the matrix is not positive definite, it is made so.

        Args:
            kappa: (N, A).
            multiplier: (A,) e^σ.
            right: (N, r, A).
        """
        diagonal = jnp.eye(len(kappa))[:, :, None] * kappa[None]
        matrix = diagonal + multiplier[None, None] * self.whole
        found, positive = solve_symmetric(matrix, right)
        if self.convex:
            return found

        def mended() -> Array:
            if self.safe is not None:
                return solve_symmetric(diagonal + multiplier[None, None] * self.safe, right)[0]
            values, vectors = jnp.linalg.eigh(jnp.moveaxis(matrix, -1, 0))
            values = jnp.maximum(jnp.abs(values), jnp.min(kappa, axis=0)[:, None])
            return jnp.einsum("aij,aj,akj,kra->ira", vectors, 1.0 / values, vectors, right)

        return jnp.where(positive[None, None], found, jax.lax.cond(jnp.all(positive), lambda: found, mended))


class Alike(NamedTuple):
    """∇²L where every ψ is concave and curves alike along all axes, as those of balls and walls do: B ⊗ I + Σ_k w_k a_k a_kᵀ. It is
    solved by blocks, and direction by direction (Sherman and Morrison), for a fraction of the arithmetic that the matrix takes.

    Attributes:
        block: (n, n, A) B.
        directions: (w, a), (A,) and (N, A) each.
        d: coordinates of a row.
    """

    block: Array
    directions: list[tuple[Array, Array]]
    d: int

    def diagonal(self) -> Array:
        """(N, A)."""
        own = jnp.stack([self.block[i // self.d, i // self.d] for i in range(self.d * len(self.block))])
        return add_up([own, *(weight[None] * a**2 for weight, a in self.directions)])

    def absolute(self, numbers: Array) -> Array:
        """(N, A) at least Σ_j |∇²L|_ij r_j."""
        rows = numbers.reshape(-1, self.d, numbers.shape[-1])
        own = add_up(jnp.abs(jnp.moveaxis(self.block, 1, 0))[:, :, None] * rows[:, None]).reshape(numbers.shape)
        return add_up([own, *((weight * dot(jnp.abs(a), numbers))[None] * jnp.abs(a) for weight, a in self.directions)])

    def solve(self, kappa: Array, multiplier: Array, right: Array) -> Array:
        """As `Dense.solve`."""
        n, wanted = len(self.block), right.shape[1]
        base = jnp.eye(n)[:, :, None] * kappa[:: self.d][None] + multiplier[None, None] * self.block
        sides = jnp.concatenate([right, *(a[:, None] for _, a in self.directions)], axis=1)
        found, _ = solve_symmetric(base, sides.reshape(n, -1, kappa.shape[-1]))
        found = found.reshape(sides.shape)
        columns = [found[:, k] for k in range(sides.shape[1])]
        for k, (weight, a) in enumerate(self.directions, wanted):
            stretch = multiplier * weight
            gain = stretch / (1.0 + stretch * dot(a, columns[k]))
            columns = [
                column - columns[k] * (gain * dot(a, column))[None] if j < wanted or j > k else column for j, column in enumerate(columns)
            ]
        return jnp.stack(columns[:wanted], axis=1)


def solve_symmetric(matrix: Array, right: Array) -> tuple[Array, Array]:
    """Solve a system in every lane.

    Args:
        matrix: (N, N, A) symmetric.
        right: (N, r, A).

    Returns:
        (N, r, A) the solutions, and (A,) whether the matrix is positive definite.
    """
    size = len(matrix)
    if size > LOOPED:
        first = jnp.moveaxis(matrix, -1, 0)
        found = jnp.moveaxis(jnp.linalg.solve(first, jnp.moveaxis(right, -1, 0)), 0, -1)
        return found, jnp.linalg.eigvalsh(first)[:, 0] > 0 if size <= 4 * LOOPED else jnp.ones(matrix.shape[-1], bool)
    whole = jnp.concatenate([matrix, right], axis=1)
    return _looped(whole, size) if size > UNROLLED else _unrolled(whole, size)


def _unrolled(whole: Array, size: int) -> tuple[Array, Array]:
    """LDLᵀ. Each step goes into the array as it stands, which keeps the compiler from computing earlier steps over and over."""
    put = jax.lax.dynamic_update_slice
    for j in range(size - 1):
        factor = whole[j + 1 :, j] / whole[j, j][None]
        whole = put(whole, whole[j + 1 :, j + 1 :] - factor[:, None] * whole[j, j + 1 :][None], (j + 1, j + 1, 0))
    positive = functools.reduce(operator.and_, [whole[j, j] > 0 for j in range(size)])
    matrix, right = whole[:, :size], whole[:, size:]
    for j in reversed(range(size)):
        right = put(right, (right[j] / matrix[j, j][None])[None], (j, 0, 0))
        if j:
            right = put(right, right[:j] - matrix[:j, j][:, None] * right[j][None], (0, 0, 0))
    return right, positive


def _looped(whole: Array, size: int) -> tuple[Array, Array]:
    """Gauss and Jordan, without exchanges, which a positive definite matrix does not need."""

    def eliminate(j: Array, at: tuple[Array, Array]) -> tuple[Array, Array]:
        whole, positive = at
        pivot = whole[j, j]
        row = whole[j] / pivot[None]
        factor = jnp.where(jnp.arange(size)[:, None] == j, 0.0, whole[:, j])
        return (whole - factor[:, None] * row[None]).at[j].set(row), positive & (pivot > 0)

    whole, positive = jax.lax.fori_loop(0, size, eliminate, (whole, jnp.ones(whole.shape[-1], bool)))
    return whole[:, size:], positive
