"""Directions of recession: directions in which a team can move to infinity while no ψ gets worse.

This is the exact test for bounded level sets and a unique optimum. For ψ_k = c_k + b_k·y + ½ yᵀH_k y, the directions are the set

    {d : H_k d = 0 and b_k·d ≥ 0 for all k}.

H d = 0 is first used to merge coordinates. An agent with a ψ that is curved in all directions of its position cannot move. Two agents with
a ψ that is curved in all directions of their difference move together. The remaining problem is usually small. Merging also makes a chain
of ten thousand agents as well-posed as one of two; its smallest eigenvalue would be lost in rounding errors. What remains is a rank test
and a linear program.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy import sparse
from scipy.sparse.linalg import splu

from consat.certify.quadratics import Bools, Expansion, Floats, Ints
from consat.problem.graphs import components

FLAT = 1e-10
"""Relative changes of ψ below this count as 0. Two walls that are parallel to ten digits are therefore treated as parallel."""
NULL = 1e-13
"""An eigenvalue of a sum of squares below this fraction of the largest counts as 0. A chain of a million links still has 2e-12."""
MOST_DENSE = 500
"""Up to this many merged coordinates the null space is found by eigenvalues, above by inverse iteration."""
MOST_PROGRAMMED = 200_000
"""Up to this many merged coordinates the linear program is solved. Above, the result is unknown."""


class Recession(NamedTuple):
    """Result of the test for directions of recession.

    Attributes:
        bounded: whether there is no such direction, so that level sets are bounded; None if unknown.
        invariant: whether there is a direction that changes no ψ at all; None if unknown.
        adrift: (N,) whether the direction found moves the agent.
    """

    bounded: bool | None
    invariant: bool | None
    adrift: Bools


def recession(model: Expansion, read: Bools) -> Recession:
    """Test for directions of recession.

    Args:
        model: expansion of constraints of degree ≤ 2.
        read: (N,) whether the position of an agent matters. It may be true for an agent that no constraint of `model` reads.
    """
    agents, dimension = model.at.shape
    group, curved = _merged(model)
    count = int(group.max(initial=-1)) + 1
    onto = _onto(group, dimension)
    slopes = (_unit_slopes(model) @ onto).tocsr()
    slopes.data[np.abs(slopes.data) < FLAT] = 0.0
    slopes.eliminate_zeros()
    flat = sparse.vstack([(part @ onto).tocsr() for part in curved] or [sparse.csr_array((0, count * dimension))]).tocsr()
    alive = np.zeros(count, dtype=bool)
    alive[group[read & (group >= 0)]] = True
    keep = np.repeat(alive, dimension)
    slopes, flat = slopes[:, keep], flat[:, keep]
    slopes = slopes[np.diff(slopes.indptr) > 0]
    direction = _null(sparse.vstack([flat, slopes]).tocsr())
    invariant = direction is not None
    if direction is None:
        if slopes.shape[1] > MOST_PROGRAMMED:
            return Recession(None, False, np.zeros(agents, dtype=bool))
        direction = _improving(slopes, flat)
    if direction is None:
        return Recession(True, False, np.zeros(agents, dtype=bool))
    moved = np.zeros((count, dimension))
    moved[alive] = direction.reshape(-1, dimension)
    moves = np.abs(moved).max(axis=1, initial=0.0) > 1e-6
    return Recession(False, invariant, np.where(group >= 0, moves[group], False) if count else np.zeros(agents, dtype=bool))


def _merged(model: Expansion) -> tuple[Ints, list[sparse.csr_array]]:
    """Merges agents by H d = 0.

    Returns:
        (N,) group of agents that can only move together, −1 for agents that cannot move; and the remaining rows of H as sparse matrices.
    """
    agents, dimension = model.at.shape
    held, pairs, left = np.zeros(agents, dtype=bool), [np.zeros((0, 2), dtype=np.intp)], []
    for block in model.blocks:
        who, n = block.columns[:, ::dimension] // dimension, block.columns.shape[1]
        sizes = np.abs(block.hessian).max(axis=(1, 2))
        whole = _nonsingular(block.hessian)
        held[who[whole]] = True
        rest = ~whole & (sizes > 0)
        if n == 2 * dimension:
            across = np.abs(block.hessian[:, :, :dimension] + block.hessian[:, :, dimension:]).max(axis=(1, 2))
            tied = rest & (across <= FLAT * sizes) & _nonsingular(block.hessian[:, :dimension, :dimension])
            pairs.append(who[tied])
            rest &= ~tied
        if rest.any():
            rows = (block.hessian[rest] / sizes[rest, None, None]).reshape(-1, n)
            columns = np.repeat(block.columns[rest], n, axis=0)
            start = np.arange(len(rows) + 1) * n
            left.append(sparse.csr_array((rows.ravel(), columns.ravel(), start), shape=(len(rows), model.size)))
    label = components(np.concatenate(pairs), agents)
    free = np.ones(int(label.max(initial=-1)) + 1, dtype=bool)
    free[label[held]] = False
    number = np.where(free, np.cumsum(free) - 1, -1)
    return number[label], left


def _nonsingular(hessian: Floats) -> Bools:
    eigenvalues = np.abs(np.linalg.eigvalsh(hessian))
    return (eigenvalues.min(axis=1) > FLAT * eigenvalues.max(axis=1)) & (eigenvalues.max(axis=1) > 0)


def _onto(group: Ints, dimension: int) -> sparse.csr_array:
    """(N·d, G·d) sparse matrix from the coordinates of the groups to those of their agents."""
    agents = np.flatnonzero(group >= 0)
    axes = np.arange(dimension)
    rows, columns = (np.add.outer(part * dimension, axes).ravel() for part in (agents, group[agents]))
    shape = (len(group) * dimension, (int(group.max(initial=-1)) + 1) * dimension)
    return sparse.csr_array((np.ones(len(rows)), (rows, columns)), shape=shape)


def _unit_slopes(model: Expansion) -> sparse.csr_array:
    """(M, N·d) rows b_k, each divided by the larger of ‖b_k‖ and ‖H_k‖ times the spread of the formation.

    After this scaling, small entries are rounding errors.
    """
    slopes, size = model.jacobian(), np.zeros(len(model.value))
    spread = float(np.abs(model.at - model.at.mean(axis=0)).max(initial=0.0))
    for block in model.blocks:
        bend = np.abs(block.hessian).max(axis=(1, 2), initial=0.0) * max(spread, np.finfo(float).tiny)
        size[block.number] = np.maximum(np.abs(block.gradient).max(axis=1), bend)
    scaled: sparse.csr_array = (sparse.diags_array(1.0 / np.where(size > 0, size, 1.0)) @ slopes).tocsr()
    return scaled


def _null(matrix: sparse.csr_array) -> Floats | None:
    """A vector with largest entry 1 that the matrix maps to 0; None if there is none."""
    columns = matrix.shape[1]
    if not columns:
        return None
    if columns <= MOST_DENSE:
        square = (matrix.T @ matrix).toarray()
        size, vectors = np.linalg.eigh(square)
        smallest, largest = size[0], size[-1]
        space = vectors[:, size <= NULL * max(largest, 1.0)]
        direction = space @ np.random.default_rng(0).normal(size=space.shape[1])  # a random combination moves every agent that can move
    else:
        square = (matrix.T @ matrix).tocsc()
        largest = float(sparse.linalg.norm(square, np.inf)) or 1.0
        factor = splu((square + 1e-14 * largest * sparse.eye_array(columns)).tocsc(), permc_spec="MMD_AT_PLUS_A")
        direction = np.random.default_rng(0).normal(size=columns)
        for _ in range(8):
            direction = factor.solve(direction)
            direction /= np.linalg.norm(direction)
        smallest = float(direction @ (square @ direction))
    if smallest > NULL * max(largest, 1.0):
        return None
    return np.asarray(direction / np.abs(direction).max(), dtype=float)


def _improving(slopes: sparse.csr_array, flat: sparse.csr_array) -> Floats | None:
    """A vector d with slopes d ≥ 0, not all 0, and flat d = 0, by a linear program over the unit box; None if there is none."""
    columns = slopes.shape[1]
    if not columns:
        return None
    from scipy.optimize import linprog  # the import takes as long as the check of a small team

    gain = np.asarray(slopes.sum(axis=0)).ravel()
    answer = linprog(
        -gain, A_ub=-slopes, b_ub=np.zeros(slopes.shape[0]), A_eq=flat if flat.shape[0] else None,
        b_eq=np.zeros(flat.shape[0]) if flat.shape[0] else None, bounds=(-1.0, 1.0), method="highs",
    )  # fmt: skip
    if answer.status != 0 or -answer.fun < 1e-6:
        return None
    direction: Floats = answer.x
    return direction
