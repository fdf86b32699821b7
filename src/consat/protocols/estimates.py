"""Who holds a copy of whose position, and the consensus between copies.

State is one row per copy (holder, position), ordered by holder, so an agent's rows stand together. "full" is the paper's layout: every
agent holds every position of its cluster. "local" holds only what is needed: every convergence proof of the full scheme carries over,
since the null space of the block Laplacian is still "all copies of each x_j agree" (arXiv 2203.00681, 1805.08460).
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, Literal, get_args

import jax
import numpy as np
from jax import Array

from consat.errors import InvalidSettings
from consat.numerics import Groups, on_device, pick
from consat.problem.family import distinct
from consat.problem.graphs import clusters, holders, relays, require_connected
from consat.problem.team import Team

Layout = Literal["full", "local"]


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Exchange:
    """The messages between copies: one directed edge for each pair of linked agents that both hold a position.

    Attributes:
        sender: (E,) row whose value arrives; the edges are ordered by receiver.
        arrivals: groups the edges by receiving row.
        block: rows move in blocks of this many: the agents' whole estimates where all hold all, else single rows.
    """

    sender: Array
    arrivals: Groups
    block: int = field(metadata={"static": True})

    def disagreement(self, message: Any) -> Any:
        """Σ_j (m_i − m_j) over the neighbours j that share the copy: the Laplacian, applied to every (rows, …) array of `message`."""

        def laplacian(m: Array) -> Array:
            blocks = m.reshape(-1, self.block, *m.shape[1:])
            return self.arrivals.sum(self.arrivals.spread(blocks) - pick(blocks, self.sender)).reshape(m.shape)

        return jax.tree.map(laplacian, message)


@dataclass(frozen=True)
class Estimates:
    """The copies of a team under one layout.

    Attributes:
        layout: ``full`` or ``local``.
        holder: (C,) who holds each copy.
        position: (C,) whose position it is.
        own: (N,) the row of each agent's own position.
        edges: (E, 2) directed edges (receiver, sender) between copies of the same position on linked agents, by receiver.
        cluster: (N,) the cluster of each agent.
        links: (L, 2) the links that carry messages: those whose ends share a copy.
    """

    layout: Layout
    holder: np.ndarray
    position: np.ndarray
    own: np.ndarray
    edges: np.ndarray
    cluster: np.ndarray
    links: np.ndarray

    @classmethod
    def of(cls, team: Team, layout: Layout) -> Estimates:
        """Raises: InvalidTeam: where a cluster is not connected (Assumption 1). InvalidSettings: no such layout."""
        if layout not in get_args(Layout):
            raise InvalidSettings(f"estimates is {layout!r}, but must be one of {', '.join(get_args(Layout))}")
        require_connected(team)
        cluster = clusters(team)
        pairs = holders(team, cluster) if layout == "local" else _everyone(team, cluster)
        own = np.flatnonzero(pairs[:, 0] == pairs[:, 1]).astype(np.int32)
        edges = _shared(pairs, team.links, team.count)
        return cls(layout, pairs[:, 0], pairs[:, 1], own, edges, cluster, _used(pairs[edges, 0], team.count))

    @property
    def count(self) -> int:
        """C, the number of copies."""
        return len(self.holder)

    def rows(self, holder: np.ndarray, position: np.ndarray) -> np.ndarray:
        """The rows of the copies (holder, position), which must exist; any shape, int32."""
        count = len(self.own)
        keys = self.holder.astype(np.int64) * count + self.position
        return np.searchsorted(keys, holder.astype(np.int64) * count + position).astype(np.int32)

    def carried(self, before: Estimates, x: np.ndarray, place: np.ndarray) -> np.ndarray:
        """(C, d) first estimates of agents whose copies were laid out otherwise before: those that they held, and of what is new to them
        their own place.

        Args:
            before: the layout until now.
            x: (C', d) estimates until now.
            place: (N, d) where the agents are.
        """
        rows, found = before.found(self.holder, self.position)
        first = np.where(found[:, None], x[rows], place[self.holder])
        first[self.own] = place
        return first

    def found(self, holder: np.ndarray, position: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """(…,) the rows of the copies (holder, position), and (…,) whether they exist."""
        rows = np.minimum(self.rows(holder, position), self.count - 1)
        return rows, (self.holder[rows] == holder) & (self.position[rows] == position)

    def ends(self) -> tuple[np.ndarray, np.ndarray, int]:
        """Both ends of every link of every row: (B,) receivers, in order, (B,) senders, and how many rows make a block, in which both are
        counted: agents' whole estimates where everyone holds everything, which makes one Laplacian for all positions; else single rows."""
        agents = len(self.own)
        if self.count == agents**2 and self.count:
            return *_both_ways(self.links, agents), agents
        return self.edges[:, 0], self.edges[:, 1], 1

    def exchange(self) -> Exchange:
        """The edges as arrays for the device."""
        receiver, sender, block = self.ends()
        return Exchange(on_device(sender), Groups.of(receiver, self.count // block), block)


def _everyone(team: Team, cluster: np.ndarray) -> np.ndarray:
    """Pairs (holder, position): every agent holds every position of its cluster, and relays those of the clusters that they join."""
    order = np.argsort(cluster, kind="stable")
    members = np.split(order, np.flatnonzero(np.diff(cluster[order])) + 1)
    holding = [(group, group) for group in members]
    holding += [(np.array(sorted(joining)), members[c]) for c, joining in relays(team, cluster).items()]
    pairs = np.concatenate([np.stack([np.repeat(who, len(whom)), np.tile(whom, len(who))], axis=1) for who, whom in holding])
    return pairs[np.lexsort((pairs[:, 1], pairs[:, 0]))].astype(np.int32)


def _shared(pairs: np.ndarray, links: np.ndarray, count: int) -> np.ndarray:
    """Edges between rows: for each link and direction, the positions that both ends hold."""
    keys = pairs[:, 0].astype(np.int64) * count + pairs[:, 1]
    here, there = _both_ways(links, count)
    offsets = np.searchsorted(pairs[:, 0], np.arange(count + 1, dtype=pairs.dtype))
    sizes = (offsets[1:] - offsets[:-1])[here]
    starts = np.cumsum(sizes) - sizes
    receiver = np.repeat(offsets[here] - starts, sizes) + np.arange(sizes.sum())
    wanted = np.repeat(there.astype(np.int64) * count, sizes) + pairs[receiver, 1]
    sender = np.minimum(np.searchsorted(keys, wanted), len(keys) - 1)
    both = keys[sender] == wanted
    edges = np.sort(receiver[both] * len(keys) + sender[both])
    return np.stack(np.divmod(edges, max(len(keys), 1)), axis=1).astype(np.int32)


def _both_ways(links: np.ndarray, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Every link in both directions, (2L,) and (2L,), sorted by the first."""
    low, high = links.astype(np.int64).T
    keys = np.sort(np.concatenate([low * count + high, high * count + low]))
    here, there = np.divmod(keys, max(count, 1))
    return here.astype(np.int32), there.astype(np.int32)


def _used(talkers: np.ndarray, count: int) -> np.ndarray:
    """(L, 2) the links, i < j, each once, between the agents at both ends of (E, 2) edges."""
    keys = distinct(talkers[:, 0].astype(np.int64) * count + talkers[:, 1])
    links = np.stack([keys // count, keys % count], axis=1).astype(np.int32)
    return links[links[:, 0] < links[:, 1]]
