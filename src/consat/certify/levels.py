"""Bounds on the distance between a formation and any better one. A certificate needs them to turn a remaining gradient into a bound.

A formation better than x̂ satisfies ψ_k ≥ L = β̄(x̂) for all k. Then constraints on one agent confine it to a region, and constraints on the
difference of two agents limit the change of that difference. The radius of an agent is the shortest path, along these limits, from an agent
with a region. Affine constraints and supporting planes of concave ones are collected into polytopes.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy import sparse
from scipy.sparse.csgraph import dijkstra

from consat.certify.quadratics import Block, Expansion, Floats, Ints, columns_of, tangents
from consat.problem.graphs import components
from consat.problem.team import Team

MOST_POLYTOPES = 2000
"""Largest number of polytopes with slanted planes that are measured, each by a few small non-negative least squares."""
MOST_DENSE = 600
"""Up to this many coordinates an ellipsoid around each cluster is tried, by dense eigenvalues."""
TANGENTS = (1.0, 10.0, 100.0)
"""Distances from x̂ at which tangent planes are computed, in lengths of the team."""
FLAT = 1e-12
"""A curvature or slope below this fraction of the largest of its constraint counts as 0."""


class _Planes(NamedTuple):
    """Half-spaces normal·v + height ≥ 0, relative to x̂: v is the position of an agent (pair (i, i)) or y_i − y_j (pair (i, j)).

    Attributes:
        pair: (P, 2) agents.
        normal: (P, d).
        height: (P,).
    """

    pair: Ints
    normal: Floats
    height: Floats


class _Reaches(NamedTuple):
    """Balls ‖v‖ ≤ reach, with v as in `_Planes`.

    Attributes:
        pair: (P, 2) agents.
        reach: (P,) length.
    """

    pair: Ints
    reach: Floats


def radii(model: Expansion, lower: Floats, cluster: Ints) -> Floats:
    """(N,) R with ‖x_i − x̂_i‖ ≤ R_i for each formation x whose constraints in `model` are all at least `lower`; ∞ if none is proven.

    Formations that differ by a translation of a whole cluster count as one if no constraint of the cluster depends on the translation.

    Args:
        model: concave quadratics about x̂ = `model.at`, and tangent planes of other concave constraints (`with_tangents`).
        lower: (M,) margin to exceed, of the cluster of each constraint.
        cluster: (N,) cluster of each agent.
    """
    count, dimension = model.at.shape
    reaches: list[_Reaches] = []
    planes = [_anchors(model, cluster)]
    for block in model.blocks:
        slack = np.maximum(model.value[block.number] - lower[block.number], 0.0)
        balanced = _of_differences(block, dimension)
        reaches += _balls(block, slack, balanced, dimension)
        planes += _planes(block, slack, balanced, dimension)
    walls = _joined(planes)
    reaches.append(_boxes(walls, reaches, count))
    pair, reach = (np.concatenate(parts) for parts in zip(*reaches, strict=True))
    paths = _paths(pair, reach, count)
    if np.isinf(paths).any():
        paths = _together(walls, pair, reach, paths)
    if np.isinf(paths).any() and model.size <= MOST_DENSE:
        paths = np.minimum(paths, _ellipsoid(model, lower, cluster))
    return paths


def _anchors(model: Expansion, cluster: Ints) -> _Planes:
    """Planes ±v·y_i ≥ 0 that fix one agent of each cluster in the directions v in which translating the cluster changes no ψ."""
    count, dimension = model.at.shape
    notice = np.zeros((int(cluster.max(initial=-1)) + 1, dimension, dimension))
    walled = np.zeros(count, dtype=bool)
    for block in model.blocks:
        n = block.columns.shape[1]
        together = np.tile(np.eye(dimension), (n // dimension, 1))
        rows = np.concatenate([block.gradient[:, None, :] @ together, block.hessian @ together], axis=1)
        size = np.concatenate(
            [np.abs(block.gradient).max(axis=1)[:, None], np.repeat(np.abs(block.hessian).max(axis=(1, 2))[:, None], n, 1)], 1
        )
        rows = rows / np.where(size > 0, size, 1.0)[:, :, None]
        np.add.at(notice, cluster[block.columns[:, 0] // dimension], np.swapaxes(rows, 1, 2) @ rows)
        if n == dimension:
            walled[block.columns[:, 0] // dimension] = True
    size, vectors = np.linalg.eigh(notice)
    first = np.lexsort((np.arange(count), ~walled, cluster))
    first = first[np.unique(cluster[first], return_index=True)[1]]
    c, k = np.nonzero(size <= FLAT**2 * np.maximum(size[:, -1:], 1.0))
    agents, normals = np.repeat(first[c], 2), np.repeat(vectors[c, :, k], 2, axis=0)
    normals[1::2] *= -1
    if len(c) == dimension * len(np.unique(c)):  # all directions: axis-parallel planes are cheaper to measure
        normals = np.tile(np.repeat(np.eye(dimension), 2, axis=0) * np.tile([[1.0], [-1.0]], (dimension, 1)), (len(np.unique(c)), 1))
    return _Planes(np.stack([agents, agents], axis=1), normals, np.zeros(len(agents)))


def with_tangents(team: Team, model: Expansion, lower: Floats, curved: NDArray[np.bool_], length: float) -> tuple[Expansion, Floats]:
    """Arguments for `radii`, with concave constraints that are not quadratic replaced by tangent planes around x̂.

    Args:
        team: the team.
        model: expansion about x̂.
        lower: (M,) margin to exceed, of the cluster of each constraint.
        curved: (M,) which constraints to replace.
        length: natural length of the team.

    Returns:
        the expansion and `lower` with one more entry for each plane.
    """
    dimension, blocks = model.at.shape[1], list(model.keep(~curved).blocks)
    values, lowers, size = [model.value], [lower], len(model.value)
    shifts = [sign * far * length * axis for far in TANGENTS for axis in np.eye(dimension) for sign in (1.0, -1.0)]
    for f, family in enumerate(team.families):
        members = curved[family.number]
        if not members.any() or family.arity > 2:
            continue
        columns = columns_of(team)[f][members]
        for shift in shifts:
            arguments = model.at[family.agents]
            arguments[:, 0] += shift
            value, gradient = (part[members] for part in tangents(team, f, arguments))
            usable = np.isfinite(value) & np.isfinite(gradient).all(axis=(1, 2))
            number = size + np.arange(usable.sum())
            flat = np.zeros((len(number), columns.shape[1], columns.shape[1]))
            blocks.append(Block(number, columns[usable], gradient[usable].reshape(len(number), columns.shape[1]), flat))
            values.append((value - gradient[:, 0] @ shift)[usable])
            lowers.append(lower[family.number[members]][usable])
            size += len(number)
    return Expansion(model.at, np.concatenate(values), tuple(blocks)), np.concatenate(lowers)


def _of_differences(block: Block, dimension: int) -> NDArray[np.bool_]:
    """(m,) whether a member depends only on the difference of the positions of two agents."""
    if block.columns.shape[1] != 2 * dimension:
        return np.zeros(len(block.number), dtype=bool)
    near, far = block.gradient[:, :dimension], block.gradient[:, dimension:]
    across = block.hessian[:, :, :dimension] + block.hessian[:, :, dimension:]
    flat = np.abs(across).max(axis=(1, 2)) <= FLAT * np.abs(block.hessian).max(axis=(1, 2))
    return flat & (np.abs(near + far).max(axis=1) <= FLAT * np.abs(near).max(axis=1))


def _balls(block: Block, slack: Floats, balanced: NDArray[np.bool_], dimension: int) -> list[_Reaches]:
    """Balls that contain the points where a strictly concave quadratic is at least L: ‖v − v₀‖ ≤ √(2 (top − L) / μ)."""
    parts = []
    for members, width in ((balanced, dimension), (~balanced, block.columns.shape[1])):
        if not members.any():
            continue
        eigenvalues, vectors = np.linalg.eigh(-block.hessian[members][:, :width, :width])
        curved = eigenvalues[:, 0] > FLAT * eigenvalues[:, -1]
        bend = np.where(curved[:, None], eigenvalues, 1.0)
        slope = np.einsum("mij,mi->mj", vectors, block.gradient[members][:, :width])
        top = slack[members] + 0.5 * np.sum(slope**2 / bend, axis=1)
        reach = np.linalg.norm(slope / bend, axis=1) + np.sqrt(2.0 * top / bend[:, 0])
        agents = block.columns[members][:, ::dimension] // dimension
        pairs = agents[:, None, :] if width < block.columns.shape[1] else np.repeat(agents[:, :, None], 2, axis=2)
        parts.append(_Reaches(pairs[curved].reshape(-1, 2), np.repeat(reach[curved], pairs.shape[1])))
    return parts


def _planes(block: Block, slack: Floats, balanced: NDArray[np.bool_], dimension: int) -> list[_Planes]:
    """Tangent planes at x̂ of the members that depend on one agent or one difference. A concave ψ lies below its tangent plane."""
    known = balanced if block.columns.shape[1] != dimension else np.ones(len(block.number), dtype=bool)
    if not known.any() or block.columns.shape[1] > 2 * dimension:
        return []
    agents = block.columns[known][:, ::dimension] // dimension
    return [_Planes(agents[:, [0, -1]], block.gradient[known][:, :dimension], slack[known])]


def _joined(planes: list[_Planes]) -> _Planes:
    pair, normal, height = (np.concatenate(parts) for parts in zip(*planes, strict=True))
    turned = pair[:, 0] > pair[:, 1]
    return _Planes(np.sort(pair, axis=1), np.where(turned[:, None], -normal, normal), height)


def _boxes(planes: _Planes, reaches: list[_Reaches], count: int) -> _Reaches:
    """Balls around the polytopes of one agent or one difference.

    Axis-parallel planes give a box. Otherwise, if there is no ball in `reaches` yet, `_farkas` measures the polytope.
    """
    key = planes.pair[:, 0] * count + planes.pair[:, 1]
    keys, place = np.unique(key, return_inverse=True)
    sizes = np.linalg.norm(planes.normal, axis=1)
    upright = (np.abs(planes.normal) > FLAT * sizes[:, None]).sum(axis=1) == 1
    axis = np.argmax(np.abs(planes.normal), axis=1)
    slope = planes.normal[np.arange(len(axis)), axis]
    extent = np.full((2, len(keys), planes.normal.shape[1]), np.inf)
    side = (slope > 0).astype(int)
    with np.errstate(divide="ignore"):
        np.minimum.at(extent, (side[upright], place[upright], axis[upright]), (planes.height / np.abs(slope))[upright])
    reach = np.linalg.norm(extent.max(axis=0), axis=1)
    held = np.concatenate([np.zeros(0, dtype=np.intp), *(np.sort(part.pair, axis=1) @ np.array([count, 1]) for part in reaches)])
    open_ = np.flatnonzero(np.isinf(reach) & ~np.isin(keys, held))
    enough = np.bincount(place, sizes > 0, minlength=len(keys))[open_] > planes.normal.shape[1]
    order, ends = np.argsort(place, kind="stable"), np.cumsum(np.bincount(place, minlength=len(keys)))
    for k in open_[enough][:MOST_POLYTOPES]:
        members = order[ends[k - 1] if k else 0 : ends[k]]
        reach[k] = _farkas(planes.normal[members], planes.height[members])
    finite = np.isfinite(reach)
    return _Reaches(np.stack([keys // max(count, 1), keys % max(count, 1)], axis=1)[finite], reach[finite])


def _together(walls: _Planes, pair: Ints, reach: Floats, paths: Floats) -> Floats:
    """Radii of agents that are connected by reaches and share their planes.

    A plane of one agent is a plane of a connected agent, farther away by the reach between them. Used where `paths` is infinite.
    """
    count = len(paths)
    tied = pair[:, 0] != pair[:, 1]
    graph = _graph(pair[tied], reach[tied], count)
    part = components(pair[tied], count)
    own = walls.pair[:, 0] == walls.pair[:, 1]
    where, normal, height = walls.pair[own, 0], walls.normal[own], walls.height[own]
    sizes = np.linalg.norm(normal, axis=1)
    order = np.argsort(part[where], kind="stable")
    ends = np.searchsorted(part[where][order], np.arange(part.max() + 2))
    lost = np.unique(part[np.isinf(paths)])
    enough = ends[lost + 1] - ends[lost] > normal.shape[1]
    for p in lost[enough][:MOST_POLYTOPES]:
        members = order[ends[p] : ends[p + 1]]
        away = dijkstra(graph, indices=where[members[0]])[:count]
        radius = _farkas(normal[members], height[members] + sizes[members] * away[where[members]])
        paths = np.minimum(paths, radius + away)
    return paths


def _farkas(normal: Floats, height: Floats) -> float:
    """A radius of {v: normal v + height ≥ 0} about 0, by Farkas' lemma: μ ≥ 0 with Σ μ normal = −e gives e·v ≤ μ·height."""
    from scipy.optimize import nnls  # the import takes a tenth of a second, and most teams do not need it

    sizes = np.linalg.norm(normal, axis=1)
    normal, height = normal[sizes > 0] / sizes[sizes > 0, None], height[sizes > 0] / sizes[sizes > 0]
    dimension, squares = normal.shape[1], 0.0
    for axis in np.eye(dimension):
        extents = []
        for direction in (axis, -axis):
            weights, residual = nnls(normal.T, -direction)
            if residual > 1e-9:
                return np.inf
            extents.append(weights @ height)
        squares += max(extents) ** 2
    return float(np.sqrt(squares)) * (1.0 + 1e-6)  # for the residuals: ‖v‖ ≤ r + √d · 1e-9 ‖v‖


def _paths(pair: Ints, reach: Floats, count: int) -> Floats:
    """(N,) shortest paths from a virtual source, which is linked to each agent that has a region."""
    own = pair[:, 0] == pair[:, 1]
    distances: Floats = dijkstra(_graph(np.stack([np.where(own, count, pair[:, 0]), pair[:, 1]], axis=1), reach, count + 1), indices=count)
    return distances[:count]


def _graph(pair: Ints, reach: Floats, count: int) -> sparse.csr_array:
    """Symmetric graph of the reaches: between two agents the shortest one."""
    tail, head = pair[:, 0], pair[:, 1]
    tail, head, reach = np.concatenate([tail, head]), np.concatenate([head, tail]), np.concatenate([reach, reach])
    order = np.lexsort((reach, head, tail))
    tail, head, reach = tail[order], head[order], np.maximum(reach[order], np.finfo(float).tiny)
    first = np.ones(len(tail), dtype=bool)
    first[1:] = (tail[1:] != tail[:-1]) | (head[1:] != head[:-1])
    return sparse.csr_array((reach[first], (tail[first], head[first])), shape=(count, count))


def _ellipsoid(model: Expansion, lower: Floats, cluster: Ints) -> Floats:
    """(N,) radii from a weighted sum of the constraints of each cluster; ∞ where this proves nothing.

    At a better formation each ψ_k is at least L, so the sum is at least L times the sum of the weights. If the sum is strictly concave,
    such formations lie in an ellipsoid.
    """
    weights, gap = model.inverse_bend(), np.maximum(model.value - lower, 0.0)
    reach = np.full(model.at.shape[0], np.inf)
    bend, slope = -model.hessian(weights).toarray(), model.gradient(weights).ravel()
    home = np.full(len(weights), -1)
    for block in model.blocks:
        home[block.number] = cluster[block.columns[:, 0] // model.at.shape[1]]
    for c in np.unique(home[home >= 0]):
        agents = cluster == c
        mine = np.repeat(agents, model.at.shape[1])
        eigenvalues, vectors = np.linalg.eigh(bend[np.ix_(mine, mine)])
        if eigenvalues[0] > 1e-9 * eigenvalues[-1]:
            turned = vectors.T @ slope[mine]
            top = weights[home == c] @ gap[home == c] + 0.5 * np.sum(turned**2 / eigenvalues)
            reach[agents] = np.linalg.norm(turned / eigenvalues) + np.sqrt(2.0 * top / eigenvalues[0])
    return reach
