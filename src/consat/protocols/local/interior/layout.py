"""Variables of an agent in the interior-point protocol, and the variables that it shares with each neighbour.

An agent's variables are the positions of which it holds copies, and its level. Each position is exchanged along a tree that spans its
holders. The level is exchanged along a spanning tree of each cluster. So information about a single variable never returns to its sender
through other agents. Several variables together can still form a loop; where all used links form a tree, they cannot.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Literal, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from scipy.sparse import coo_array
from scipy.sparse.csgraph import breadth_first_order

from consat.numerics import distinct, laid_out, on_device
from consat.problem.constraints.curvature import read_curvatures
from consat.problem.family import Family
from consat.problem.graphs import middles
from consat.problem.team import Team
from consat.protocols.estimates import Estimates
from consat.protocols.local.lanewise import bend_of
from consat.settings import Layout

Route = Literal["tree", "links"]
"""How copies are exchanged: ``tree``, all along one spanning tree, or ``links``, over all links, each position along a tree of its own."""

Vectors = tuple[tuple[float, ...], ...]


@dataclass(frozen=True)
class Form:
    """Static properties of the constraints of one family.

    Attributes:
        psi: the function ψ.
        curvature: (R, arity·d) vectors v with Σ v vᵀ = the convex part of −∇²ψ for weight 1; None where it varies with the position.
        concave: whether ψ is proven concave.
        quadratic: whether it is a polynomial of degree ≤ 2.
        moves: whether any of its parameters moves with time.
    """

    psi: Callable[..., Any]
    curvature: Vectors | None
    concave: bool
    quadratic: bool
    moves: bool


class Kind(NamedTuple):
    """The constraints of one family in a batch, m for each agent with padding. The first axis is the chunk, the last the agent in it.

    Attributes:
        slots: (chunks, m, arity, A) which of the agent's copies each constraint reads.
        parameters: name to (chunks, m, …, A).
        weight: (chunks, m, A).
        used: (chunks, m, A) false where padded.
    """

    slots: Array
    parameters: dict[str, Array]
    weight: Array
    used: Array


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Batch:
    """Agents of similar size: up to n copies, m constraints, g neighbours and p variables shared with a neighbour.

    Attributes:
        agents: (chunks, A) indices of the agents; the last is repeated where a chunk is not full.
        rows: (chunks, n, A) rows of their copies, their own first; padded with the number of rows.
        members: (chunks, m, A) indices of their constraints among the multipliers; padded with the number of multipliers.
        pairs: (chunks, g, A) indices of their ends of links; padded with the number of ends.
        shared: (chunks, g, p, A) indices of the variables shared with each neighbour; the level is number n·d; padded with n·d + 1.
        kinds: their constraints, one entry per family.
        forms: static properties of these families.
        families: for each kind the index of its family in the team, and of its first multiplier.
    """

    agents: Array
    rows: Array
    members: Array
    pairs: Array
    shared: Array
    kinds: tuple[Kind, ...]
    forms: tuple[Form, ...] = field(metadata={"static": True})
    families: tuple[tuple[int, int], ...] = field(metadata={"static": True})

    def with_parameters(self, values: Sequence[Mapping[str, Array]]) -> Batch:
        """Copy with new constraint parameters. `values`: for each family the parameters to replace, (M_f, …)."""
        kinds, start = [], 0
        for kind, (family, offset) in zip(self.kinds, self.families, strict=True):
            m = kind.used.shape[1]
            own, members = values[family], self.members[:, start : start + m] - offset
            last = min((len(array) for array in own.values()), default=1) - 1
            kinds.append(kind._replace(parameters={**kind.parameters, **laid_out(own, jnp.clip(members, 0, last))}))
            start += m
        return replace(self, kinds=tuple(kinds))


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Plan:
    """All agents in batches. The index arrays locate each result in the concatenated results of all batches.

    Attributes:
        batches: the agents.
        row: (C,) index of the result for each copy.
        agent: (N,) index of the result for each agent.
        member: (M,) index of the result for each constraint, family after family.
        pair: (P,) index of the result for each end of a link.
        floats: (P,) number of floats in a message over each end of a link.
        singles: (P,) number of those floats that may be sent in 32 bits.
        width: largest number of scalar variables that two neighbours share.
        exact: whether the agents can prove a bound: all used links form a tree, so that no information returns to its sender through
            others, and no constraint moves.
    """

    batches: tuple[Batch, ...]
    row: Array
    agent: Array
    member: Array
    pair: Array
    floats: Array
    singles: Array
    width: int = field(metadata={"static": True})
    exact: bool = field(metadata={"static": True})

    def with_parameters(self, values: Sequence[Mapping[str, Array]]) -> Plan:
        """Copy with new constraint parameters. `values`: for each family the parameters to replace, (M_f, …)."""
        return replace(self, batches=tuple(batch.with_parameters(values) for batch in self.batches))


@dataclass(frozen=True)
class Shared:
    """The variables that neighbours share, S in all.

    Attributes:
        pairs: (P, 2) directed pairs (agent, neighbour), sorted.
        pair: (S,) index of the pair that shares each variable, sorted.
        row: (S,) the agent's row of the shared variable, sorted by position within a pair; −1 for the level, which comes last.
        exact: whether all used links form a tree; see `Plan.exact`.
    """

    pairs: np.ndarray
    pair: np.ndarray
    row: np.ndarray
    exact: bool

    @classmethod
    def of(cls, copies: Estimates) -> Shared:
        """Compute the shared variables of agents with these copies."""
        count = len(copies.own)
        here, there = _tree(copies.count, copies.edges, copies.own)
        talk = copies.holder[copies.edges].astype(np.int64)
        keys = copies.holder[here].astype(np.int64) * count + copies.holder[there]
        span = spanning_tree(count, copies.links)
        level = np.concatenate([span[:, 0].astype(np.int64) * count + span[:, 1], span[:, 1].astype(np.int64) * count + span[:, 0]])
        pairs = distinct(talk[:, 0] * count + talk[:, 1])
        pair = np.searchsorted(pairs, np.concatenate([keys, level]))
        position = np.concatenate([copies.position[here], np.full(len(level), count)])
        row = np.concatenate([here, np.full(len(level), -1)])
        order = np.lexsort((position, pair))
        directed = np.stack(np.divmod(pairs, max(count, 1)), axis=1).astype(np.int32)
        return cls(directed, pair[order], row[order], len(pairs) == 2 * _tree_links(copies))

    @property
    def level(self) -> np.ndarray:
        """(P,) which pairs share the level."""
        found = np.zeros(len(self.pairs), dtype=bool)
        found[self.pair[self.row < 0]] = True
        return found

    def sizes(self, dimension: int) -> np.ndarray:
        """(P,) number of scalar variables that each pair shares. `dimension`: d."""
        width = np.where(self.row < 0, 1, dimension)
        return np.bincount(self.pair, weights=width, minlength=len(self.pairs)).astype(np.int64)


def _tree(rows: int, edges: np.ndarray, own: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Edges of trees that span the copies of each position, in both directions, found by breadth-first search from the owner.

    Args:
        rows: number of copies.
        edges: (E, 2) edges between copies of the same position, in both directions.
        own: (N,) rows of own positions.
    """
    root = np.full(len(own), rows)
    here, there = np.concatenate([edges[:, 0], root, own]), np.concatenate([edges[:, 1], own, root])
    graph = coo_array((np.ones(len(here), dtype=np.int8), (here, there)), shape=(rows + 1, rows + 1)).tocsr()
    order, parent = breadth_first_order(graph, rows, directed=True)
    child = order[parent[order] >= 0]
    child = child[parent[child] < rows]
    up = parent[child]
    return np.concatenate([child, up]), np.concatenate([up, child])


def spanning_tree(count: int, links: np.ndarray) -> np.ndarray:
    """(L', 2) links of a breadth-first spanning tree of every component, rooted at a central agent.

    Args:
        count: number of agents N.
        links: (L, 2).
    """
    middle = middles(count, links)
    here = np.concatenate([links[:, 0], links[:, 1], np.full(len(middle), count)])
    there = np.concatenate([links[:, 1], links[:, 0], middle])
    graph = coo_array((np.ones(len(here), dtype=np.int8), (here, there)), shape=(count + 1, count + 1)).tocsr()
    order, parent = breadth_first_order(graph, count, directed=True)
    child = order[1:]
    child = child[parent[child] < count]
    found = np.sort(np.stack([child, parent[child]], axis=1), axis=1).astype(np.int32)
    return found[np.lexsort((found[:, 1], found[:, 0]))]


def _tree_links(copies: Estimates) -> int:
    """Number of links if every cluster is a tree."""
    return len(copies.own) - 1 - int(copies.cluster.max(initial=-1))


WIDE = 64
"""Largest number of shared scalars per pair for which a spanning tree is used. Measured on one core: a round with 57 scalars and 50 agents
takes 57 ms, with 65 scalars and 100 agents 95 ms; over the links 10 ms and 34 ms."""


class Way(NamedTuple):
    """How the copies of a team are exchanged.

    Attributes:
        route: along one spanning tree, or over the links.
        copies: layout of the copies on this route.
        why: reason for this route.
        then: layout along a spanning tree, to which a team on route ``links`` switches if it is not satisfied in time; None without one.
    """

    route: Route
    copies: Estimates
    why: str
    then: Estimates | None = None


def route_of(team: Team, layout: Layout, *, exact: bool = True) -> Way:
    """Choose how the copies of a team are exchanged. Along a tree the steps are exact and the team proves its bound. Over links with loops
    a satisfying formation is found in fewer rounds, but the smallest violation is often not found and never proven.

    Args:
        team: team with connected clusters.
        layout: layout of the estimates.
        exact: whether to use a spanning tree from the start where the links form loops, if no pair shares more than `WIDE` scalars on it.
    """
    along_links = Estimates.of(team, layout)
    if len(along_links.links) == _tree_links(along_links):
        return Way("tree", along_links, "the links form a tree")
    tree = team.with_links(spanning_tree(team.count, along_links.links))
    along_tree = Estimates.of(tree, layout)
    width = int(Shared.of(along_tree).sizes(team.dimension).max(initial=0))
    if width > WIDE:
        why = f"the links form loops, and over a spanning tree neighbours would share {width} numbers, more than {WIDE}"
        return Way("links", along_links, why)
    if exact:
        return Way("tree", along_tree, f"a spanning tree is narrow enough: neighbours share at most {width} numbers")
    why = f"the links form loops; a team not satisfied in time goes over to a spanning tree, where neighbours share at most {width} numbers"
    return Way("links", along_links, why, along_tree)


ALIKE = 2**19
"""Largest number of matrix entries for which all agents are padded to one batch; beyond, there is one batch for each size class."""


class _Group(NamedTuple):
    """Agents of one batch, and the padded sizes n, g and p; see `Batch`."""

    agents: np.ndarray
    n: int
    g: int
    p: int


def plan_of(team: Team, copies: Estimates, shared: Shared) -> Plan:
    """Sort the agents of a team into batches of similar size.

    Args:
        team: the team.
        copies: the layout of estimates.
        shared: the variables that neighbours share.
    """
    count, d = team.count, team.dimension
    first = np.searchsorted(copies.holder, np.arange(count + 1))
    held = np.diff(first)
    degree = np.bincount(shared.pairs[:, 0], minlength=count)
    size = shared.sizes(d)
    widest = np.ones(count, dtype=np.int64)
    np.maximum.at(widest, shared.pairs[:, 0], size)
    power = np.ceil(np.log2(np.maximum(np.maximum(held, degree), 8) / 8) / 2).astype(int)  # size classes up to 8, 32, 128, …
    if count * max(degree.max(initial=0), 1) * (held.max(initial=0) * d + 1) ** 2 <= ALIKE:
        power[:] = 0
    forms = [form_of(family, d) for family in team.families]
    start = np.cumsum([0, *(family.size for family in team.families)])
    slot = np.arange(copies.count) - first[copies.holder]  # the own copy first, the others sorted by position
    mine = slot[copies.own]
    slot = np.where(slot == mine[copies.holder], 0, slot + (slot < mine[copies.holder]))
    made = [
        _made(team, copies, shared, forms, start, slot, group=_Group(np.flatnonzero(power == one), *(
            int(values[power == one].max(initial=0)) for values in (held, degree, widest)
        )))
        for one in np.unique(power)
    ]  # fmt: skip
    where = {}
    for name, total in (("rows", copies.count), ("agents", count), ("members", int(start[-1])), ("pairs", len(shared.pairs))):
        place, offset = np.zeros(total, dtype=np.int32), 0
        for batch in made:
            flat = np.asarray(getattr(batch, name)).ravel()
            inside = np.flatnonzero(flat < total)
            place[flat[inside]] = offset + inside
            offset += flat.size
        where[name] = on_device(place)
    places = size - np.bincount(shared.pair, weights=shared.row < 0, minlength=len(shared.pairs)).astype(np.int64)
    # quadratic + (barrier, level, margin, changes), and proof quadratic + (constant, weight, error)
    floats = size * (size + 3) // 2 + 4 + places * (places + 3) // 2 + 3
    return Plan(
        tuple(made), where["rows"], where["agents"], where["members"], where["pairs"],
        on_device(floats), on_device(size * (size + 3) // 2 + 3), int(size.max(initial=1)), shared.exact and not team.moves,
    )  # fmt: skip


def _made(team: Team, copies: Estimates, shared: Shared, forms: list[Form], start: np.ndarray, slot: np.ndarray, *, group: _Group) -> Batch:
    agents, d = group.agents, team.dimension
    place = np.full(team.count, -1)
    place[agents] = np.arange(len(agents))
    A, n = len(agents), group.n

    rows = np.full((n, A), copies.count, dtype=np.int32)
    chosen = np.flatnonzero(place[copies.holder] >= 0)
    rows[slot[chosen], place[copies.holder[chosen]]] = chosen

    pairs = np.full((group.g, A), len(shared.pairs), dtype=np.int32)
    talker = shared.pairs[:, 0]
    nth = np.arange(len(talker)) - np.searchsorted(talker, talker)
    ours = np.flatnonzero(place[talker] >= 0)
    pairs[nth[ours], place[talker[ours]]] = ours

    variables = np.full((group.g, group.p, A), n * d + 1, dtype=np.int32)
    width = np.where(shared.row < 0, 1, d)
    before = np.cumsum(width) - width
    within = before - before[np.searchsorted(shared.pair, shared.pair)]
    who = place[talker[shared.pair]]
    for axis in range(d):
        take = np.flatnonzero((who >= 0) & (axis < width))
        value = np.where(shared.row[take] < 0, n * d, slot[shared.row[take]] * d + axis)
        variables[nth[shared.pair[take]], within[take] + axis, who[take]] = value

    kinds, kept, members, families = [], [], [], []
    for number, (family, form, offset) in enumerate(zip(team.families, forms, start[:-1].tolist(), strict=True)):
        mine = np.flatnonzero(place[family.owner] >= 0)
        if not len(mine):
            continue
        mine = mine[np.argsort(family.owner[mine], kind="stable")]
        owner = place[family.owner[mine]]
        order = np.arange(len(mine)) - np.searchsorted(family.owner[mine], family.owner[mine])
        m = int(order.max()) + 1
        index = np.full((m, A), -1, dtype=np.int64)
        index[order, owner] = mine
        used = index >= 0
        filled = np.where(used, index, mine[0])
        held = slot[copies.rows(family.owner[:, None], family.agents)]  # (M_f, arity)
        slots = np.where(used[:, None, :], np.moveaxis(held[filled], -1, 1), 0)
        kinds.append(Kind(
            on_device(slots.astype(np.int32)[None]),
            {key: on_device(np.moveaxis(np.asarray(value)[filled], 1, -1)[None]) for key, value in family.parameters.items()},
            on_device(np.asarray(family.weight)[filled][None]),
            on_device(used[None]),
        ))  # fmt: skip
        kept.append(form)
        families.append((number, offset))
        members.append(np.where(used, offset + index, start[-1]).astype(np.int32))
    stacked = np.concatenate([np.zeros((0, A), dtype=np.int32), *members])
    arrays = [on_device(each[None]) for each in (agents.astype(np.int32), rows, stacked, pairs, variables)]
    return Batch(arrays[0], arrays[1], arrays[2], arrays[3], arrays[4], tuple(kinds), tuple(kept), tuple(families))


def form_of(family: Family, dimension: int) -> Form:
    """Static properties of the constraints of a family. `dimension`: d."""
    readings = read_curvatures(family.psi, family.arity, dimension, family.lasting, family.size)
    concave, quadratic, moves = bool(readings.concave.all()), readings.degree is not None, bool(family.tracks)
    bend = bend_of(family, dimension)
    if bend is None:
        return Form(family.psi, None, concave, quadratic, moves)
    values, vectors = np.linalg.eigh(bend)
    rows = (vectors * np.sqrt(np.maximum(values, 0.0)))[:, values > 1e-12 * max(1e-300, np.abs(values).max(initial=0.0))].T
    return Form(family.psi, tuple(tuple(map(float, row)) for row in rows), concave, quadratic, moves)
