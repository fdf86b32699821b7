"""The max-min of concave quadratic models, as a cone program solved by Clarabel through cvxpy.

    maximise Σ_c t_c   subject to   c_k + b_k·y + ½ yᵀH_k y ≥ t_c for each constraint k of cluster c,   ‖y_i‖ ≤ Δ_i

With −H = FᵀF a constraint is the second-order cone ‖(√2 F y, w − 1)‖ ≤ w + 1, w = c + b·y − t. Clusters share no variable, so one program
maximises all of them. Each cluster is scaled to its own units first, so that the unit of length does not matter.
"""

from __future__ import annotations

import warnings
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
    import cvxpy as cp

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
    u, t = cp.Variable(int(read.sum())), cp.Variable(len(active))
    constraints: list[Any] = [] if ceiling is None else [t <= ceiling[active]]
    duals: list[tuple[Ints, Any]] = []
    for block in model.blocks:
        for number, F, b, columns in _by_rank(block):
            psi = unit.psi[group[number]][:, None]
            slack = _rows(b * length[columns] / psi, place[columns], u.size) @ u + model.value[number] / psi[:, 0] - t[which[number]]
            scaled = F * (np.sqrt(2.0) * length[columns] / np.sqrt(psi))[:, None, :]
            flat = _rows(scaled.reshape(-1, F.shape[2]), np.repeat(place[columns], F.shape[1], axis=0), u.size)
            constraints.append(_cone(slack, flat @ u if F.shape[1] else None, len(number)))
            duals.append((number, constraints[-1]))
    if trust is not None:
        held = read.all(axis=1)
        radius = (trust / unit.length[cluster])[held]
        constraints.append(cp.SOC(radius, cp.reshape(u, (dimension, len(radius)), order="F"), axis=0))
    status = _solve(cp.Problem(cp.Maximize(cp.sum(t)), constraints))
    if status != "solved":
        return Solution(*nothing, status)
    step, multipliers = nothing
    step[read] = u.value * length[read.ravel()]
    for number, constraint in duals:
        multipliers[number] = _multiplier(constraint)
    return Solution(step, normalised(multipliers, group, count), status)


def _cone(slack: Any, flat: Any, members: int) -> Any:
    """The constraint w ≥ ½ ‖F y‖² for each member.

    Args:
        slack: (members,) w.
        flat: √2 F y, concatenated over the members; None if they have no curvature.
        members: number of members.
    """
    import cvxpy as cp

    if flat is None:
        return slack >= 0
    tall = cp.vstack([cp.reshape(flat, (flat.size // members, members), order="F"), cp.reshape(slack - 1, (1, members), order="F")])
    return cp.SOC(slack + 1, tall, axis=0)


def _solve(problem: Any) -> str:
    import cvxpy as cp

    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # about inaccurate solutions: callers evaluate the result themselves
            problem.solve(solver=cp.CLARABEL, tol_gap_abs=TOLERANCE, tol_gap_rel=TOLERANCE, tol_feas=TOLERANCE)
    except cp.SolverError:
        return "failed"
    if problem.status in (cp.UNBOUNDED, cp.UNBOUNDED_INACCURATE):
        return "unbounded"
    return "solved" if problem.status in (cp.OPTIMAL, cp.OPTIMAL_INACCURATE) else "failed"


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


def _multiplier(constraint: Any) -> Floats:
    """(members,) dual of w ≥ …. In a cone, w appears in the head (w + 1) and in the last row (w − 1), so both duals are added."""
    dual = constraint.dual_value
    if isinstance(dual, list):
        head, tail = np.atleast_1d(dual[0]), np.atleast_2d(dual[1])
        return head + tail.reshape(-1, len(head))[-1]

    return np.atleast_1d(dual)


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
