"""Layout of the copies (which agent holds a copy of which position), and the consensus between copies.

The state has one row per copy (holder, position), sorted by holder, so that the rows of an agent are contiguous. In the layout "full", as
in the paper, every agent holds every position of its cluster. In the layout "local" an agent holds only the positions that it needs. Every
convergence proof of the full layout carries over: the null space of the block Laplacian is still the set where all copies of each x_j
agree (arXiv 2203.00681, 1805.08460).
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, get_args

import jax
import numpy as np
from jax import Array

from consat.errors import InvalidSettings
from consat.numerics import Groups, distinct, on_device, pick
from consat.problem.graphs import clusters, holders, relays, require_connected
from consat.problem.team import Team
from consat.settings import Layout


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Exchange:
    """Directed edges between copies: one for each direction of a link and each position that both ends hold.

    Attributes:
        sender: (E,) sending row, in units of blocks; the edges are sorted by receiver.
        arrivals: groups the edges by receiving row, in units of blocks.
        block: number of rows that are sent together: all rows of an agent where every agent holds every position, else 1.
    """

    sender: Array
    arrivals: Groups
    block: int = field(metadata={"static": True})

    def disagreement(self, message: Any) -> Any:
        """Σ_j (m_i − m_j) over the neighbours j that share the copy: the Laplacian applied to every (rows, …) array of `message`."""

        def laplacian(m: Array) -> Array:
            blocks = m.reshape(-1, self.block, *m.shape[1:])
            return self.arrivals.sum(self.arrivals.spread(blocks) - pick(blocks, self.sender)).reshape(m.shape)

        return jax.tree.map(laplacian, message)


@dataclass(frozen=True)
class Estimates:
    """The copies of a team under one layout.

    Attributes:
        layout: ``full`` or ``local``.
        holder: (C,) agent that holds each copy.
        position: (C,) agent whose position it is.
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
        """Lay out the copies of a team.

        Raises:
            InvalidTeam: a cluster is not connected (Assumption 1 of the paper).
            InvalidSettings: unknown layout.
        """
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
        """Rows of the copies (holder, position), which must exist; arrays of any shape, result int32."""
        count = len(self.own)
        keys = self.holder.astype(np.int64) * count + self.position
        return np.searchsorted(keys, holder.astype(np.int64) * count + position).astype(np.int32)

    def carried(self, before: Estimates, x: np.ndarray, place: np.ndarray) -> np.ndarray:
        """(C, d) initial estimates after a change of layout. Copies that existed before keep their value; new copies start at the holder's
        own position.

        Args:
            before: the previous layout.
            x: (C', d) estimates in the previous layout.
            place: (N, d) positions of the agents.
        """
        rows, found = before.found(self.holder, self.position)
        first = np.where(found[:, None], x[rows], place[self.holder])
        first[self.own] = place
        return first

    def found(self, holder: np.ndarray, position: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """(…,) rows of the copies (holder, position), and (…,) whether they exist; the row is arbitrary where the copy does not exist."""
        rows = np.minimum(self.rows(holder, position), self.count - 1)
        return rows, (self.holder[rows] == holder) & (self.position[rows] == position)

    def ends(self) -> tuple[np.ndarray, np.ndarray, int]:
        """(B,) receivers, sorted, (B,) senders, and the number of rows of a block. Receivers and senders are indices of blocks. Where every
        agent holds every position, a block is all rows of an agent, so that one Laplacian serves all positions; else a block is one row."""
        agents = len(self.own)
        if self.count == agents**2 and self.count:
            return *_both_ways(self.links, agents), agents
        return self.edges[:, 0], self.edges[:, 1], 1

    def exchange(self) -> Exchange:
        """The edges as arrays on the device."""
        receiver, sender, block = self.ends()
        return Exchange(on_device(sender), Groups.of(receiver, self.count // block), block)


def _everyone(team: Team, cluster: np.ndarray) -> np.ndarray:
    """Pairs (holder, position): agents hold every position of their cluster, relays also those of the clusters that they connect."""
    order = np.argsort(cluster, kind="stable")
    members = np.split(order, np.flatnonzero(np.diff(cluster[order])) + 1)
    holding = [(group, group) for group in members]
    holding += [(np.array(sorted(joining)), members[c]) for c, joining in relays(team, cluster).items()]
    pairs = np.concatenate([np.stack([np.repeat(who, len(whom)), np.tile(whom, len(who))], axis=1) for who, whom in holding])
    return pairs[np.lexsort((pairs[:, 1], pairs[:, 0]))].astype(np.int32)


def _shared(pairs: np.ndarray, links: np.ndarray, count: int) -> np.ndarray:
    """(E, 2) edges (receiver, sender) between rows: for each direction of a link, the positions that both ends hold."""
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
    """Every link in both directions, (2L,) and (2L,), sorted by the first array."""
    low, high = links.astype(np.int64).T
    keys = np.sort(np.concatenate([low * count + high, high * count + low]))
    here, there = np.divmod(keys, max(count, 1))
    return here.astype(np.int32), there.astype(np.int32)


def _used(talkers: np.ndarray, count: int) -> np.ndarray:
    """(L, 2) distinct links (i, j), i < j, between the agents at both ends of edges. `talkers`: (E, 2) the agents of each edge."""
    keys = distinct(talkers[:, 0].astype(np.int64) * count + talkers[:, 1])
    links = np.stack([keys // count, keys % count], axis=1).astype(np.int32)
    return links[links[:, 0] < links[:, 1]]
