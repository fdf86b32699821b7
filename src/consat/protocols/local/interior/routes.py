"""Along which links the variables of the interior-point protocol are exchanged.

An agent's variables are the positions of which it holds copies, and its level. Each position is exchanged along a tree that spans its
holders. The level is exchanged along a spanning tree of each cluster. So information about a single variable never returns to its sender
through other agents. Several variables together can still form a loop; where all used links form a tree, they cannot.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, NamedTuple

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import breadth_first_order

from consat.numerics import distinct
from consat.problem.graphs import middles
from consat.problem.links import pair_keys
from consat.problem.team import Team
from consat.protocols.estimates import Estimates
from consat.settings import Layout

Route = Literal["tree", "links"]
"""How copies are exchanged: ``tree``, all along one spanning tree, or ``links``, over all links, each position along a tree of its own."""


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
        keys = pair_keys(copies.holder[np.stack([here, there], axis=1)], count)
        span = spanning_tree(count, copies.links)
        level = pair_keys(np.concatenate([span, span[:, ::-1]]), count)
        pairs = distinct(pair_keys(copies.holder[copies.edges], count))
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
