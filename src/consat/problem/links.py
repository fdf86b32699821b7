"""Communication links of a team, as given: pairs of agents, a graph, or the name of a topology."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import TYPE_CHECKING, TypeAlias

import numpy as np

from consat.errors import Fault, shown
from consat.problem.family import Family, distinct
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
    pairs = [np.stack([family.owner, family.agents[:, k]], axis=1) for family in families for k in range(family.arity)]
    return np.concatenate([np.zeros((0, 2), dtype=np.int32), *pairs])


def unique(pairs: np.ndarray, count: int) -> np.ndarray:
    """(L, 2) links, i < j, sorted, each once, without links from an agent to itself. `count`: N."""
    low, high = pairs.min(axis=1), pairs.max(axis=1)
    keys = distinct((low.astype(np.int64) * count + high)[low < high])
    return np.stack([keys // max(count, 1), keys % max(count, 1)], axis=1).astype(np.int32)
