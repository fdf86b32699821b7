"""∇²L of the agents of a chunk, and the linear systems of Newton's method: (diag κ + e^σ ∇²L) y = r. The last axis is the agent (lane)."""

from __future__ import annotations

import functools
import operator
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import Array

from consat.numerics import add_up
from consat.protocols.local.lanewise import eigen, solve

UNROLLED = 8
"""Largest number of unknowns for elimination with unrolled pivots."""


def dot(a: Array, b: Array) -> Array:
    """Inner product in every lane: (n, A), (n, A) → (A,)."""
    return add_up(a * b)


class Dense(NamedTuple):
    """∇²L as a dense matrix.

    Attributes:
        whole: (N, N, A) ∇²L.
        safe: (N, N, A) a positive semidefinite part of ∇²L; None where it is not available separately.
        convex: whether ∇²L is known to be positive semidefinite.
    """

    whole: Array
    safe: Array | None
    convex: bool

    def diagonal(self) -> Array:
        """(N, A) diagonal of ∇²L."""
        return jnp.stack([self.whole[i, i] for i in range(len(self.whole))])

    def absolute(self, numbers: Array) -> Array:
        """(N, A) Σ_j |∇²L|_ij r_j. `numbers`: (N, A) r."""
        return add_up(jnp.abs(jnp.moveaxis(self.whole, 1, 0)) * numbers[:, None])

    def solve(self, kappa: Array, multiplier: Array, right: Array) -> Array:
        """(N, r, A) solutions of (diag κ + e^σ ∇²L) y = r. A matrix that is not positive definite is replaced: with `safe` for ∇²L, or by
        the absolute values of its eigenvalues.

        Args:
            kappa: (N, A) κ.
            multiplier: (A,) e^σ.
            right: (N, r, A) right-hand sides.
        """
        diagonal = jnp.eye(len(kappa))[:, :, None] * kappa[None]
        matrix = diagonal + multiplier[None, None] * self.whole
        found, positive = solve_symmetric(matrix, right)
        if self.convex:
            return found

        def mended() -> Array:
            if self.safe is not None:
                return solve_symmetric(diagonal + multiplier[None, None] * self.safe, right)[0]
            values, vectors = eigen(jnp.where(jnp.isfinite(matrix), matrix, 0.0))
            values = jnp.maximum(jnp.abs(values), jnp.min(kappa, axis=0)[None])
            return jnp.einsum("ija,ja,kja,kra->ira", vectors, 1.0 / values, vectors, right)

        return jnp.where(positive[None, None], found, jax.lax.cond(jnp.all(positive), lambda: found, mended))


class Alike(NamedTuple):
    """∇²L = B ⊗ I + Σ_k w_k a_k a_kᵀ, for concave ψ with the same curvature along all axes, such as balls and half-spaces. Systems are
    solved with B, then corrected for one direction after the other (Sherman–Morrison). This takes a fraction of the operations of `Dense`.

    Attributes:
        block: (n, n, A) B.
        directions: pairs (w, a) of shapes (A,) and (N, A).
        d: number of coordinates of a row.
    """

    block: Array
    directions: list[tuple[Array, Array]]
    d: int

    def diagonal(self) -> Array:
        """(N, A) diagonal of ∇²L."""
        own = jnp.stack([self.block[i // self.d, i // self.d] for i in range(self.d * len(self.block))])
        return add_up([own, *(weight[None] * a**2 for weight, a in self.directions)])

    def absolute(self, numbers: Array) -> Array:
        """(N, A) an upper bound on Σ_j |∇²L|_ij r_j. `numbers`: (N, A) r."""
        rows = numbers.reshape(-1, self.d, numbers.shape[-1])
        own = add_up(jnp.abs(jnp.moveaxis(self.block, 1, 0))[:, :, None] * rows[:, None]).reshape(numbers.shape)
        return add_up([own, *((weight * dot(jnp.abs(a), numbers))[None] * jnp.abs(a) for weight, a in self.directions)])

    def solve(self, kappa: Array, multiplier: Array, right: Array) -> Array:
        """See `Dense.solve`; the matrix is always positive definite."""
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
    """Solve a symmetric system in every lane.

    Args:
        matrix: (N, N, A) symmetric.
        right: (N, r, A).

    Returns:
        (N, r, A) the solutions, and (A,) whether the matrix is positive definite.
    """
    size = len(matrix)
    return solve(matrix, right) if size > UNROLLED else _unrolled(jnp.concatenate([matrix, right], axis=1), size)


def _unrolled(whole: Array, size: int) -> tuple[Array, Array]:
    """LDLᵀ elimination with unrolled pivots. Each pivot updates the array, which keeps the compiler from recomputing earlier pivots."""
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
