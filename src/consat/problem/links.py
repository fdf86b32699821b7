"""Pairs of agents: the communication links of a team as given (pairs, a graph, or the name of a topology), and edges of the task graph."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import TYPE_CHECKING, TypeAlias

import numpy as np

from consat.errors import Fault, shown
from consat.numerics import distinct
from consat.problem.family import Family
from consat.problem.index import Index
from consat.problem.parameters import Path

if TYPE_CHECKING:
    import networkx as nx

TOPOLOGIES = ("line", "ring", "star", "complete", "task")
"""Names of link graphs: see `topology`."""

Links: TypeAlias = "str | nx.Graph | np.ndarray | Iterable[tuple[str, str]]"


def pairs_of(links: Links, index: Index, faults: list[Fault]) -> np.ndarray | None:
    """(L, 2) links as pairs of indices; None for a named topology, or after a fault in the topology or the array."""
    if isinstance(links, str):
        if links not in TOPOLOGIES:
            choices = ", ".join(TOPOLOGIES)
            faults.append(Fault(("communication", "graph"), f"there is no graph {links!r}; choose one of {choices}", "communication"))
        return None
    if isinstance(links, np.ndarray) and links.dtype.kind in "iu":
        if links.ndim == 2 and links.shape[1] == 2 and (not links.size or (links.min() >= 0 and links.max() < index.count)):
            return links
        message = f"an array of links must have shape (L, 2) and hold places from 0 to {index.count - 1}"
        faults.append(Fault(("communication", "links"), message, "communication"))
        return None
    pairs = []
    for k, link in enumerate(getattr(links, "edges", links)):
        path: Path = ("communication", "links", k)
        ends = tuple(link) if isinstance(link, list | tuple) else (link,)
        where = f"communication link {k + 1}"
        if len(ends) != 2:
            faults.append(Fault(path, f"a link joins two agents, such as [a1, a2], but is {shown(link)}", where))
        elif unknown := [end for end in ends if not isinstance(end, str) or end not in index]:
            faults.append(Fault(path, index.unknown(unknown[0], faults), where))
        elif ends[0] == ends[1]:
            faults.append(Fault(path, f"agent {ends[0]!r} is linked to itself; name another agent", where))
        else:
            pairs.append((index[ends[0]], index[ends[1]]))
    return np.array(pairs, dtype=np.int32).reshape(-1, 2)


def topology(kind: str, count: int, families: Sequence[Family]) -> np.ndarray:
    """The links of one of `TOPOLOGIES`: (L, 2) int32, i < j, sorted, each once.

    Args:
        kind: one of `TOPOLOGIES`.
        count: N, the number of agents.
        families: the constraints, which ``task`` needs.
    """
    return unique(_topology(kind, count, families), count)


def _topology(kind: str, count: int, families: Sequence[Family]) -> np.ndarray:
    i = np.arange(count, dtype=np.int32)
    if kind == "line":
        return np.stack([i[:-1], i[1:]], axis=1)
    if kind == "ring":
        return np.stack([i, np.roll(i, -1)], axis=1)
    if kind == "star":
        return np.stack([np.zeros(max(count - 1, 0), dtype=np.int32), i[1:]], axis=1)
    if kind == "complete":
        return np.stack(np.triu_indices(count, 1), axis=1).astype(np.int32)
    return task_pairs(families)


def unique(pairs: np.ndarray, count: int) -> np.ndarray:
    """(L, 2) links, i < j, sorted, each once, without links from an agent to itself. `count`: N."""
    ends = np.sort(pairs, axis=1)
    return unique_pairs(ends[ends[:, 0] < ends[:, 1]], count)


def task_pairs(families: Iterable[Family]) -> np.ndarray:
    """(E, 2) int32 pairs (owner, agent whose position it reads), one for each constraint and position, so pairs may repeat.

    The owner itself is among them only for a constraint that reads nobody else.
    """
    edges = [np.zeros((0, 2), dtype=np.int32)]
    for family in families:
        for slot in range(family.arity):
            pairs = np.stack([family.owner, family.agents[:, slot]], axis=1)
            edges.append(pairs if family.arity == 1 else pairs[pairs[:, 0] != pairs[:, 1]])
    return np.concatenate(edges)


def pair_keys(pairs: np.ndarray, count: int) -> np.ndarray:
    """(K,) distinct integers for distinct (K, 2) pairs of agents, in the order of the pairs. `count`: N, the number of agents."""
    return pairs[:, 0].astype(np.int64) * count + pairs[:, 1]


def unique_pairs(pairs: np.ndarray, count: int) -> np.ndarray:
    """(K', 2) int32 pairs of agents, sorted, each once. `count`: N, the number of agents."""
    keys = distinct(pair_keys(pairs, count))
    return np.stack([keys // max(count, 1), keys % max(count, 1)], axis=1).astype(np.int32)
