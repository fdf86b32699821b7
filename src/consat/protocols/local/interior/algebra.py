"""Linear algebra for many small symmetric systems at once. The last axis of every array is the index of the system (the lane)."""

from __future__ import annotations

import jax.numpy as jnp
from jax import Array

from consat.protocols.local.lanewise import LOOPED, product, solve


def times(matrix: Array, vector: Array) -> Array:
    """Matrix-vector product in every lane: (N, N, A), (N, A) → (N, A)."""
    return jnp.sum(matrix * vector[None], axis=1)


def gram(weight: Array, vectors: Array) -> Array:
    """(N, N, A) Σ_k w_k v_k v_kᵀ. `weight`: (m, A) w_k; `vectors`: (m, N, A) v_k."""
    weighted = weight[:, None] * vectors
    if vectors.size * vectors.shape[1] <= 2**22:
        return jnp.sum(weighted[:, :, None] * vectors[:, None], axis=0)
    first = jnp.moveaxis(vectors, -1, 0)
    return jnp.moveaxis(jnp.einsum("aki,akj->aij", jnp.moveaxis(weighted, -1, 0), first), 0, -1)


def spread(matrix: Array, vector: Array, shared: Array, size: int) -> tuple[Array, Array]:
    """Sum of the neighbours' quadratics over an agent's own variables.

    Args:
        matrix: (g, p, p, A) matrices of the g neighbours.
        vector: (g, p, A) vectors of the neighbours.
        shared: (g, p, A) index of each shared variable among the agent's own; N and more mark padding.
        size: N, the number of own variables.

    Returns:
        (N, N, A) and (N, A).
    """
    lane = jnp.arange(shared.shape[-1], dtype=shared.dtype)
    whole = jnp.zeros((size, size, len(lane))).at[shared[:, :, None], shared[:, None], lane].add(matrix, mode="drop")
    return whole, jnp.zeros((size, len(lane))).at[shared, lane].add(vector, mode="drop")


def reduced(matrix: Array, vector: Array, shared: Array) -> tuple[Array, Array, Array, Array]:
    """Minimise ½ yᵀMy − hᵀy over all variables that are not shared with a neighbour, for each neighbour (a Schur complement).

    Args:
        matrix: (N, N, A) M.
        vector: (N, A) h.
        shared: (g, p, A) indices of the shared variables, which are kept; N and more mark padding.

    Returns:
        (g, p, p, A) and (g, p, A) the remaining quadratic, (g, A) minus the minimum over the eliminated variables where the shared ones
        are 0, and (g, A) whether M is positive definite on the eliminated variables.
    """
    size, count = vector.shape
    g, p, _ = shared.shape
    if not g * p:
        none = jnp.zeros((g, count))
        return jnp.zeros((g, p, p, count)), jnp.zeros((g, p, count)), none, none == 0.0
    shared = jnp.moveaxis(shared, 1, 0)  # (p, g, A)
    stays = (jnp.arange(size, dtype=shared.dtype)[:, None, None, None] == shared[None]).any(axis=1)  # (N, g, A)
    inner = jnp.where(stays[:, None] | stays[None], jnp.eye(size)[:, :, None, None], matrix[:, :, None])
    there, inside = shared < size, jnp.minimum(shared, size - 1)
    whole = jnp.broadcast_to(matrix[:, :, None], (size, size, g, count))
    columns = jnp.where(there[None], jnp.take_along_axis(whole, inside[None], axis=1), 0.0)  # (N, p, g, A)
    sides = jnp.concatenate([columns, jnp.broadcast_to(vector[:, None, None], (size, 1, g, count))], axis=1)
    out = jnp.where(stays[:, None], 0.0, sides)
    found, positive = solve(inner.reshape(size, size, g * count), out.reshape(size, p + 1, g * count))
    found = found.reshape(size, p + 1, g, count)
    if size > LOOPED:
        filled = product(jnp.swapaxes(out, 0, 1).reshape(p + 1, size, -1), found.reshape(size, p + 1, -1)).reshape(p + 1, p + 1, g, count)
    else:
        filled = jnp.sum(out[:, :, None] * found[:, None], axis=0)
    kept = jnp.where(there[:, None], jnp.take_along_axis(sides, inside[:, None], axis=0), 0.0)  # (p, p + 1, g, A)
    left = kept - filled[:p]
    square = 0.5 * (left[:, :p] + jnp.swapaxes(left[:, :p], 0, 1))
    return jnp.moveaxis(square, 2, 0), jnp.moveaxis(left[:, p], 1, 0), 0.5 * filled[p, p], positive.reshape(g, count)
