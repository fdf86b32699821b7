"""The centralised optimum: the best margin that any formation can have, and a formation with this margin.

    β̄* = max_x min_k ψ_k(x)

Clusters are independent. Each is maximised separately, and β̄* is the smallest of their margins.

* All ψ concave of degree ≤ 2: one cone program (`conic`), exact.
* Otherwise gradient ascent with increasing ν from many starts (`ascent`), then polishing of the best: ψ_k is replaced by its value, its
  gradient and the concave part of its Hessian, and the cone program is solved within a trust region, repeatedly. If ψ is a quadratic, the
  replacement is a lower bound, so each step increases the margin (convex–concave procedure: Lipp, Boyd 2016). If ψ is concave, the
  replacement is exact to second order, so the steps converge superlinearly.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass

import numpy as np
from scipy.sparse import eye_array
from scipy.sparse.linalg import splu

from consat.certify.ascent import climb, drawn
from consat.certify.conic import Solution, maximise, units
from consat.certify.quadratics import Bools, Expansion, Floats, Ints, expand, shape_of, values_and_gradients
from consat.problem.graphs import clusters
from consat.problem.team import Team
from consat.problem.units import scale

STARTS = 32
"""Number of starts for a team that is not concave."""
CONCAVE_STARTS = 4
"""And for a concave team that is not quadratic."""
POLISHED = 3
"""Number of the best starts of each cluster that are polished."""
MOST_VALUES = 4_000_000
"""Limit on (number of starts) × (number of constraints), for memory. Large teams get fewer starts."""
ROUNDS = 60
"""Largest number of cone programs for polishing one start."""
SETTLED = 1e-9
"""Polishing stops when the predicted gain of a step is below this, in units of ψ. The cone programs are not more accurate."""
AGAIN = 3
"""Largest number of steps of the exact solution."""
FAR = 1e3
"""After a step longer than this, in natural lengths, the program is solved again at the new point, because digits were lost."""


@dataclass(frozen=True)
class Optimum:
    """The best formation known.

    Attributes:
        positions: (N, d), length.
        margin: β̄ at `positions`; +∞ for a team without constraints.
        multipliers: (M,) multiplier of each constraint, large where it binds. They sum to 1 within each cluster that has constraints.
        method: how the formation was found, and whether it is exact, in words.
        exact: whether `margin` is the best possible, up to the tolerance of the solver.
        unbounded: whether the margin has no upper limit; `positions` is then one formation of many.
    """

    positions: Floats
    margin: float
    multipliers: Floats
    method: str
    exact: bool
    unbounded: bool = False


def max_min(team: Team, *, seed: int = 0) -> Optimum:
    """Maximise the margin of a team.

    Args:
        team: the team.
        seed: seed of the random starts.
    """
    shape, cluster = shape_of(team), clusters(team)
    first = middle(team)
    if not len(team.owner):
        return Optimum(first, np.inf, np.zeros(0), "no constraints", exact=True)
    if shape.quadratic.all() and shape.concave.all():
        return _quadratic(team, cluster, first)
    return _smooth(team, cluster, first, seed, concave=bool(shape.concave.all()))


def cluster_margins(team: Team, values: Floats, cluster: Ints) -> Floats:
    """(C,) smallest of the (M,) ψ in each cluster; +∞ for a cluster without constraints."""
    margins = np.full(int(cluster.max(initial=-1)) + 1, np.inf)
    np.minimum.at(margins, cluster[team.owner], values)
    return margins


def middle(team: Team) -> Floats:
    """(N, d) maximiser of a weighted sum of the concave quadratic ψ, length: an expansion point near the optimum.

    Agents that the sum does not determine are at their start or, without one, at the centre of the team.
    """
    shape, size = shape_of(team), scale(team)
    x = np.where(np.isnan(team.starts), size.center, team.starts)
    usable = shape.quadratic & shape.concave
    for _ in range(2):  # the second pass recovers digits lost if the first began far away
        model = expand(team, x).keep(usable)
        weights = model.inverse_bend()
        bend = -model.hessian(weights)
        damping = 1e-9 * np.maximum(bend.diagonal(), 1.0)
        curved = bend.diagonal() > 0
        step = splu((bend + eye_array(model.size) * damping.max()).tocsc()).solve(np.where(curved, model.gradient(weights).ravel(), 0.0))
        x = x + np.where(curved, step, 0.0).reshape(x.shape)
    return x


def _quadratic(team: Team, cluster: Ints, x: Floats) -> Optimum:
    group = cluster[team.owner]
    model = expand(team, x)
    solution = maximise(model, cluster, group)
    for _ in range(AGAIN):
        if solution.status != "solved":
            break
        x = x + solution.step
        far = (np.abs(solution.step).max(axis=1) > FAR * units(model, group, int(cluster.max()) + 1).length[cluster]).any()
        model = expand(team, x)
        if not far:
            break
        solution = maximise(model, cluster, group)
    if solution.status == "unbounded":
        return _limitless(team, cluster, model)
    if solution.status == "failed":
        return _smooth(team, cluster, x, 0, concave=True)
    margin = float(values_and_gradients(team, x)[0].min())
    return Optimum(x, margin, solution.multipliers, "concave quadratic constraints: exact, by one cone program (Clarabel)", exact=True)


def _limitless(team: Team, cluster: Ints, model: Expansion) -> Optimum:
    """The optimum if the margin of some clusters has no upper limit. These stop at a margin at least as large as that of the others."""
    group = cluster[team.owner]
    count = int(cluster.max()) + 1
    unit, has = units(model, group, count), np.bincount(group, minlength=count) > 0
    open_ = has.copy()
    ceiling = np.ones(count)
    ample = maximise(model, cluster, group, ceiling=ceiling)
    open_ &= cluster_margins(team, model.values(ample.step), cluster) > 0.99 * unit.psi
    for c in np.flatnonzero(open_):
        alone = maximise(model.keep(group == c), cluster, group)
        if alone.status == "solved":
            ample = _replaced(ample, alone, cluster == c, group == c)
            open_[c] = False
    worst = float(np.min(cluster_margins(team, model.values(ample.step), cluster), initial=np.inf, where=has & ~open_))
    if np.isfinite(worst):
        ceiling = np.maximum(1.0, 2.0 * worst / unit.psi)
        higher = maximise(model.keep(open_[group]), cluster, group, ceiling=ceiling)
        ample = _replaced(ample, higher, open_[cluster], open_[group])
    x = model.at + ample.step
    margin = float(values_and_gradients(team, x)[0].min())
    if np.isfinite(worst):
        method = "concave quadratic constraints: exact, by one cone program (Clarabel); some clusters could have any margin"
        return Optimum(x, margin, ample.multipliers, method, exact=True)
    return Optimum(x, margin, ample.multipliers, "the margin can be made as large as one likes", exact=False, unbounded=True)


def _replaced(solution: Solution, by: Solution, agents: Bools, constraints: Bools) -> Solution:
    step = np.where(agents[:, None], by.step, solution.step)
    return Solution(step, np.where(constraints, by.multipliers, solution.multipliers), solution.status)


def _smooth(team: Team, cluster: Ints, first: Floats, seed: int, *, concave: bool) -> Optimum:
    """The optimum of a team that is not concave quadratic: ascent from many starts, then polishing; arguments as in `max_min`."""
    size = scale(team)
    count = max(1, min(CONCAVE_STARTS if concave else STARTS, MOST_VALUES // max(len(team.owner), 1)))
    formations, margins = climb(team, np.concatenate([first[None], drawn(team, count - 1, seed, size)]), cluster, size)
    order = np.argsort(-margins, axis=0, kind="stable")
    x, multipliers = first, np.zeros(len(team.owner))
    best, converged = np.full(margins.shape[1], -np.inf), np.zeros(margins.shape[1], dtype=bool)
    for rank in range(min(1 if concave else POLISHED, count)):
        polished, weights, settled = _polish(team, cluster, formations[order[rank][cluster], np.arange(team.count)])
        reached = cluster_margins(team, values_and_gradients(team, polished)[0], cluster)
        gained = (reached > best) | (rank == 0)
        x, multipliers = np.where(gained[cluster][:, None], polished, x), np.where(gained[cluster[team.owner]], weights, multipliers)
        best, converged = np.where(gained, reached, best), np.where(gained, settled, converged)
    found = f"best of {count} starts, ν-continuation and sequential cone programs (Clarabel)"
    if not concave:
        return Optimum(x, float(best.min()), multipliers, found, exact=False)
    exact = bool(converged.all() and (best > -np.inf).all())
    note = "concave constraints: exact" if exact else "concave constraints, not converged"
    return Optimum(x, float(best.min()), multipliers, f"{note}, {found}", exact=exact)


def _polish(team: Team, cluster: Ints, x: Floats) -> tuple[Floats, Floats, Bools]:
    """A local max-min, starting from x: (N, d) positions, (M,) multipliers, and (C,) whether the iteration converged."""
    group = cluster[team.owner]
    model = concave_part(expand(team, x))
    unit = units(model, group, int(cluster.max()) + 1)
    trust, margins = unit.length.copy(), cluster_margins(team, model.value, cluster)
    multipliers, settled = np.zeros(len(group)), np.zeros(len(trust), dtype=bool)
    for _ in range(ROUNDS):
        solution = maximise(model, cluster, group, trust=trust[cluster])
        if solution.status != "solved":
            break
        multipliers = solution.multipliers
        after = cluster_margins(team, values_and_gradients(team, x + solution.step)[0], cluster)
        with np.errstate(invalid="ignore"):  # a cluster without constraints has margin ∞ before and after
            promised = np.where(margins == -np.inf, np.inf, cluster_margins(team, model.values(solution.step), cluster) - margins)
            settled = ~(promised > SETTLED * unit.psi)
            gain = after - margins
            accepted = gain > 0
            trust = np.where(gain > 0.5 * promised, 3.0, np.where(gain > 0.1 * promised, 1.0, 0.25)) * trust
        x = np.where(accepted[cluster][:, None], x + solution.step, x)
        margins = np.where(accepted, after, margins)
        settled |= trust < SETTLED * unit.length
        if settled.all():
            break
        model = concave_part(expand(team, x))
    return x, multipliers, settled


def concave_part(model: Expansion) -> Expansion:
    """The expansion with the positive eigenvalues of each Hessian set to 0."""
    blocks = []
    for block in model.blocks:
        eigenvalues, vectors = np.linalg.eigh(block.hessian)
        negative = np.minimum(eigenvalues, 0.0)[:, None, :] * vectors
        blocks.append(dataclasses.replace(block, hessian=np.matmul(negative, np.swapaxes(vectors, 1, 2))))
    return Expansion(model.at, model.value, tuple(blocks))
