"""The max-min of concave quadratic models, as a cone program solved by Clarabel.

    maximise Σ_c t_c   subject to   c_k + b_k·y + ½ yᵀH_k y ≥ t_c for each constraint k of cluster c,   ‖y_i‖ ≤ Δ_i

With −H = FᵀF a constraint is the second-order cone ‖(√2 F y, w − 1)‖ ≤ w + 1, w = c + b·y − t. Clusters share no variable, so one program
maximises all of them. Each cluster is scaled to its own units first, so that the unit of length does not matter.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy import sparse

from consat.certify.quadratics import Block, Expansion, Floats, Ints

FLAT = 1e-12
"""Eigenvalues below this fraction of the largest count as 0."""
STRAIGHT = 1e-6
"""Eigenvalues below this fraction of the largest are ignored when the scale of ψ is estimated."""
TOLERANCE = 1e-9
"""Clarabel's tolerance for gap and residuals, in the units of a cluster. Its default is 1e-8; 1e-10 is not always reached."""


@dataclass(frozen=True)
class Solution:
    """The result of the solver.

    Attributes:
        step: (N, d) y, length; 0 for agents that no constraint reads.
        multipliers: (M,) λ, which sum to 1 within each cluster that has constraints.
        status: "solved", "unbounded" (the margin has no upper limit) or "failed".
    """

    step: Floats
    multipliers: Floats
    status: str


@dataclass(frozen=True)
class Units:
    """(C,) units of length and of ψ for each cluster."""

    length: Floats
    psi: Floats


def units(model: Expansion, group: Ints, count: int) -> Units:
    """Typical sizes of length and ψ in each cluster.

    For a curved ψ: its value at the stationary point, and the corresponding radius. For an affine ψ: its slope times that length.

    Args:
        model: expansion with negative semidefinite Hessians.
        group: (M,) cluster of each constraint.
        count: C, the number of clusters.
    """
    top, bend, slope = (np.zeros(len(group)) for _ in range(3))
    for block in model.blocks:
        norm = np.linalg.norm(block.hessian, axis=(1, 2))
        slope[block.number] = np.linalg.norm(block.gradient, axis=1)
        lift = np.einsum("mi,mij,mj->m", block.gradient, np.linalg.pinv(block.hessian, STRAIGHT, hermitian=True), block.gradient)
        top[block.number], bend[block.number] = np.abs(model.value[block.number] - 0.5 * lift), norm
    curved = (bend > 0) & (top > 0)
    radius = np.sqrt(2 * top / np.where(curved, bend, 1.0))
    walls = (slope > 0) & (bend == 0)
    distance = np.abs(model.value) / np.where(walls, slope, 1.0)
    length = _typical(radius, curved, group, count, _typical(distance, walls & (distance > 0), group, count, np.ones(count)))
    flat = walls & ~curved
    size = np.where(flat, slope * length[group], top)
    return Units(length, _typical(size, (curved | flat) & (size > 0), group, count, np.ones(count)))


def _typical(sizes: Floats, counted: np.ndarray, group: Ints, count: int, default: Floats) -> Floats:
    """(C,) geometric mean, in each group, of the sizes that are `counted`; `default` where there are none."""
    number = np.bincount(group[counted], minlength=count)
    logs = np.bincount(group[counted], np.log(sizes[counted]), minlength=count)
    return np.where(number > 0, np.exp(logs / np.maximum(number, 1)), default)


def maximise(model: Expansion, cluster: Ints, group: Ints, trust: Floats | None = None, ceiling: Floats | None = None) -> Solution:
    """Maximise the smallest ψ of each cluster.

    Args:
        model: expansion with negative semidefinite Hessians.
        cluster: (N,) cluster of each agent.
        group: (M,) cluster of each constraint.
        trust: (N,) radius of the trust region of each agent, length; None: no limit.
        ceiling: (C,) upper limit of the margin of each cluster, in its units of ψ; None: no limit.
    """
    count, dimension = int(cluster.max(initial=-1)) + 1, model.at.shape[1]
    unit = units(model, group, count)
    read = np.zeros(model.at.shape, dtype=bool)
    for block in model.blocks:
        read.ravel()[block.columns] = True
    nothing = np.zeros(model.at.shape), np.zeros(len(group))
    if not read.any():
        return Solution(*nothing, "solved")
    place, length = np.cumsum(read) - 1, np.repeat(unit.length[cluster], dimension)
    active, which = np.unique(group, return_inverse=True)
    moves, levels = int(read.sum()), len(active)
    cones: list[Cones] = []
    if ceiling is not None:
        cones.append(Cones(_rows(np.ones((levels, 1)), moves + np.arange(levels)[:, None], moves + levels), ceiling[active], levels, 1))
    constraints: list[Ints] = []
    for block in model.blocks:
        for number, F, b, columns in _by_rank(block):
            psi = unit.psi[group[number]][:, None]
            entries = np.column_stack([-b * length[columns] / psi, np.ones(len(number))])  # t − w without its constant
            above = _rows(entries, np.column_stack([place[columns], moves + which[number]]), moves + levels)
            scaled = F * (np.sqrt(2.0) * length[columns] / np.sqrt(psi))[:, None, :]
            flat = _rows(-scaled.reshape(-1, F.shape[2]), np.repeat(place[columns], F.shape[1], axis=0), moves + levels)
            constraints.append(number)
            cones.append(_epigraph(above, model.value[number] / psi[:, 0], flat))
    first = len(cones) - len(constraints)
    if trust is not None:
        held = read.all(axis=1)
        cones.append(_balls((trust / unit.length[cluster])[held], place.reshape(-1, dimension)[held], moves + levels))
    found = _solve(np.repeat([0.0, -1.0], [moves, levels]), cones)
    if isinstance(found, str):
        return Solution(*nothing, found)
    solution, duals = found
    step, multipliers = nothing
    step[read] = solution[:moves] * length[read.ravel()]
    for number, dual in zip(constraints, duals[first:], strict=False):
        # in a cone w appears in the head (w + 1) and in the last row (w − 1)
        multipliers[number] = dual[:, 0] if dual.shape[1] == 1 else dual[:, 0] + dual[:, -1]
    return Solution(step, normalised(multipliers, group, count), "solved")


@dataclass(frozen=True)
class Cones:
    """Cones of one size, into which offset − matrix·v must fall. Cones of size 1 are half-lines, v ≥ 0.

    Attributes:
        matrix: (members·size, V).
        offset: (members·size,).
        members: number of cones.
        size: rows of each cone.
    """

    matrix: sparse.csr_array
    offset: Floats
    members: int
    size: int


def _epigraph(above: sparse.csr_array, value: Floats, flat: sparse.csr_array) -> Cones:
    """The constraint w ≥ ½ ‖F y‖² for each member, w = value − above·v.

    Args:
        above: (m, V).
        value: (m,).
        flat: (m·rank, V) matrix of −√2 F y, concatenated over the members.
    """
    members, rank = len(value), flat.shape[0] // len(value)
    if not rank:
        return Cones(above, value, members, 1)
    order = np.column_stack([
        np.arange(members), members + np.arange(members * rank).reshape(members, rank), members * (rank + 1) + np.arange(members)
    ]).ravel()  # fmt: skip
    offset = np.concatenate([value + 1, np.zeros(members * rank), value - 1])
    return Cones(sparse.vstack([above, flat, above], format="csr")[order], offset[order], members, rank + 2)


def _balls(radius: Floats, columns: Ints, width: int) -> Cones:
    """The constraint ‖y_i‖ ≤ r_i for each agent.

    Args:
        radius: (n,) r.
        columns: (n, d) columns of y.
        width: V, the number of columns of the matrix.
    """
    members, size = len(radius), columns.shape[1] + 1
    rows = (size * np.arange(members)[:, None] + np.arange(1, size)).ravel()
    matrix = sparse.csr_array((-np.ones(len(rows)), (rows, columns.ravel())), shape=(members * size, width))
    offset = np.zeros(members * size)
    offset[::size] = radius
    return Cones(matrix, offset, members, size)


def _solve(slope: Floats, cones: list[Cones]) -> tuple[Floats, list[Floats]] | str:
    """Minimise slope·v over the cones.

    Returns:
        v and, for each group of cones, the duals, shape (members, size); a status of `Solution` if there is no solution.
    """
    import clarabel

    settings = clarabel.DefaultSettings()
    settings.verbose = False
    settings.tol_gap_abs = settings.tol_gap_rel = settings.tol_feas = TOLERANCE
    shapes: list[Any] = []
    for each in cones:
        line = each.size == 1
        shapes += [clarabel.NonnegativeConeT(each.members)] if line else [clarabel.SecondOrderConeT(each.size) for _ in range(each.members)]
    matrix = sparse.csc_matrix(sparse.vstack([each.matrix for each in cones], format="csc"))
    nothing = sparse.csc_matrix((len(slope), len(slope)))
    found = clarabel.DefaultSolver(nothing, slope, matrix, np.concatenate([each.offset for each in cones]), shapes, settings).solve()
    status = clarabel.SolverStatus
    if found.status in (status.DualInfeasible, status.AlmostDualInfeasible):
        return "unbounded"
    if found.status not in (status.Solved, status.AlmostSolved):  # AlmostSolved may be inaccurate: callers evaluate the result themselves
        return "failed"
    ends = np.cumsum([each.members * each.size for each in cones])[:-1]
    duals = np.split(np.asarray(found.z), ends)
    return np.asarray(found.x), [dual.reshape(each.members, each.size) for dual, each in zip(duals, cones, strict=True)]


def normalised(weights: Floats, group: Ints, count: int) -> Floats:
    """Weights clipped at 0 and scaled to sum to 1 within each group. Groups without positive weights stay at 0.

    Args:
        weights: (M,).
        group: (M,) group of each weight.
        count: number of groups.
    """
    weights = np.maximum(weights, 0.0)
    total = np.bincount(group, weights, minlength=count)
    return weights / np.where(total > 0, total, 1.0)[group]


def _rows(entries: Floats, columns: Ints, size: int) -> sparse.csr_array:
    """A sparse matrix with the same number of entries in each row.

    Args:
        entries: (rows, width).
        columns: (rows, width) column of each entry.
        size: number of columns of the matrix.
    """
    rows, width = entries.shape
    return sparse.csr_array((entries.ravel(), columns.ravel(), np.arange(rows + 1) * width), shape=(rows, size))


def _by_rank(block: Block) -> list[tuple[Ints, Floats, Floats, Ints]]:
    """The members of a block, split by the rank of −H = FᵀF: for each rank their numbers, F (m, rank, n), b and columns."""
    eigenvalues, vectors = np.linalg.eigh(-block.hessian)
    curved = eigenvalues > FLAT * np.abs(eigenvalues).max(axis=1, keepdims=True)
    ranks, n = curved.sum(axis=1), block.columns.shape[1]
    roots = np.sqrt(np.where(curved, eigenvalues, 0.0))[:, :, None] * np.swapaxes(vectors, 1, 2)
    return [
        (block.number[members], roots[members, n - rank :], block.gradient[members], block.columns[members])
        for rank in np.unique(ranks)
        for members in [np.flatnonzero(ranks == rank)]
    ]
