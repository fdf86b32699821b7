"""Partition of a team among several processes, with few links between processes, and the data that crosses these links.

A process holds its own agents first. Behind them come the agents of other processes that send messages to its agents, or whose positions
its constraints read. Messages of such agents are computed in their own process, and replace the local entries before any agent receives.
"""

from __future__ import annotations

import copy
import dataclasses
from dataclasses import dataclass

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import reverse_cuthill_mckee

from consat.problem.team import Team
from consat.protocols.estimates import Estimates


def assign(team: Team, copies: Estimates, processes: int) -> np.ndarray:
    """(N,) the process of each agent: shares of about equal work, cut from an order in which linked agents are close together (reverse
    Cuthill–McKee).

    Args:
        team: the team.
        copies: its layout of estimates.
        processes: number of processes.
    """
    links, count = copies.links, team.count
    both = np.concatenate([links, links[:, ::-1]])
    graph = coo_array((np.ones(len(both), dtype=np.int8), (both[:, 0], both[:, 1])), shape=(count, count)).tocsr()
    order = reverse_cuthill_mckee(graph, symmetric_mode=True)
    work = np.cumsum(1.0 + np.bincount(copies.holder, minlength=count)[order])  # the cost of an agent is proportional to its copies
    part = np.empty(count, dtype=np.int32)
    part[order] = np.minimum((work - 1e-9) * processes / work[-1], processes - 1).astype(np.int32)
    if len(np.unique(part)) < processes:  # few agents with very unequal work left a process without agents
        part[order] = np.arange(count) * processes // count
    return part


@dataclass(frozen=True, eq=False)
class Halo:
    """Items that one process exchanges with each of P processes, padded to the largest exchange H of any two.

    Attributes:
        out: (P, H) local indices of the items sent to each process, padded with 0.
        into: (P, H) local indices where the items received from each process are stored, padded with an index past the end.
    """

    out: np.ndarray
    into: np.ndarray

    @classmethod
    def of(cls, place: np.ndarray, source: np.ndarray, target: np.ndarray, key: np.ndarray, me: int, processes: int, *,
           end: int) -> Halo:  # fmt: skip
        """From a list of K items, which is the same in every process.

        Args:
            place: (K,) local index of each item; arbitrary where this process is neither source nor target.
            source: (K,) sending process.
            target: (K,) receiving process, different from the source.
            key: (K,) sort key of the items of a pair of processes.
            me: this process.
            processes: P.
            end: an index past the end.
        """
        width = int(np.bincount(source * processes + target, minlength=1).max(initial=0))
        out, into = np.zeros((processes, width), dtype=np.int32), np.full((processes, width), end, dtype=np.int32)
        for other in range(processes):
            for table, chosen in ((out, (source == me) & (target == other)), (into, (source == other) & (target == me))):
                items = np.flatnonzero(chosen)
                items = items[np.argsort(key[items], kind="stable")]
                table[other, : len(items)] = place[items]
        return cls(out, into)


@dataclass(frozen=True, eq=False)
class Share:
    """The part of a team that one process holds: n agents, c copies, e ends of links.

    Attributes:
        team: this process's agents with their constraints, and the other needed agents without constraints.
        copies: layout of their estimates; agents have local indices.
        agents: (n,) indices in the whole team; this process's agents come first.
        mine: number of this process's agents.
        rows: (c,) rows of the local copies in the layout of the whole team.
        ours: (c,) whether a copy is held by an agent of this process.
        degree: (e,) for each end the larger number of links of the copies at both ends, in the whole team.
        messages: exchange of messages at ends of links.
        positions: exchange of positions that constraints of other processes read.
        pair: indices in the whole team of the local (sender, receiver) pairs, sorted as in the local layout.
        pairs: number of such pairs in the whole team.
    """

    team: Team
    copies: Estimates
    agents: np.ndarray
    mine: int
    rows: np.ndarray
    ours: np.ndarray
    degree: np.ndarray
    messages: Halo
    positions: Halo
    pair: np.ndarray
    pairs: int

    @classmethod
    def of(cls, team: Team, copies: Estimates, part: np.ndarray, me: int, processes: int) -> Share:
        """Compute the share of process `me`. Every process computes its own share from the whole team.

        Args:
            team: the whole team.
            copies: its layout of estimates.
            part: (N,) the process of each agent.
            me: this process.
            processes: number of processes.
        """
        count, holder, position = team.count, copies.holder, copies.position
        receiver, sender = copies.edges.astype(np.int64).T
        from_, to = part[holder[sender]], part[holder[receiver]]
        mine = np.flatnonzero(part == me)
        kept = np.flatnonzero(part[holder] == me)
        foreign = np.unique(sender[(to == me) & (from_ != me)])
        reads = [(family.owner, family.agents[:, slot]) for family in team.families for slot in range(family.arity)]
        owner, read = (np.concatenate([np.zeros(0, dtype=np.int64), *parts]) for parts in (zip(*reads, strict=True) if reads else ((), ())))
        seen = np.unique(np.concatenate([holder[foreign], position[kept], position[foreign], read[part[owner] == me]]))
        agents = np.concatenate([mine, seen[part[seen] != me]])
        local = np.full(count, -1, dtype=np.int64)
        local[agents] = np.arange(len(agents))

        rows = np.concatenate([kept, foreign])
        rows = rows[np.lexsort((local[position[rows]], local[holder[rows]]))]
        row = np.full(copies.count, -1, dtype=np.int64)
        row[rows] = np.arange(len(rows))
        here = np.flatnonzero((to == me) | (from_ == me))  # both ends of every link of this process's agents
        here = here[np.lexsort((row[sender[here]], row[receiver[here]]))]
        end = np.full(len(receiver), -1, dtype=np.int64)
        end[here] = np.arange(len(here))
        own = np.zeros(len(agents), dtype=np.int32)
        own[: len(mine)] = row[copies.own[mine]]
        layout = Estimates(
            copies.layout, local[holder[rows]].astype(np.int32), local[position[rows]].astype(np.int32), own,
            np.stack([row[receiver[here]], row[sender[here]]], axis=1).astype(np.int32), copies.cluster[agents], np.zeros((0, 2), np.int32),
        )  # fmt: skip

        cut = np.flatnonzero(from_ != to)
        # the message at an end is sent to the process of the other end
        messages = Halo.of(end[cut], to[cut], from_[cut], receiver[cut] * copies.count + sender[cut], me, processes, end=len(here))
        across = part[owner] != part[read]
        wanted = np.unique(part[owner[across]].astype(np.int64) * count + read[across])
        asks, asked = wanted // count, wanted % count
        positions = Halo.of(local[asked], part[asked].astype(np.int64), asks, asked, me, processes, end=len(agents))

        degree = np.bincount(receiver, minlength=copies.count)
        whole = np.unique(holder[receiver].astype(np.int64) * count + holder[sender])
        talker, listener = layout.holder[layout.edges].astype(np.int64).T.reshape(2, -1)
        speaks = np.unique(talker * len(agents) + listener)
        pair = np.searchsorted(whole, agents[speaks // len(agents)] * count + agents[speaks % len(agents)])
        return cls(
            _members(team, local, part, me, len(agents)), layout, agents, len(mine), rows, part[holder[rows]] == me,
            np.maximum(degree[receiver[here]], degree[sender[here]]), messages, positions, pair, len(whole),
        )  # fmt: skip


def _members(team: Team, local: np.ndarray, part: np.ndarray, me: int, count: int) -> Team:
    """The local agents with the constraints of process `me`. `local`: (N,) local index of each agent; `count`: number of local agents."""
    families, owners = [], []
    for family in team.families:
        chosen = np.flatnonzero(part[family.owner] == me)
        if len(chosen):
            families.append((family, chosen))
            owners.append(local[family.owner[chosen]])
    owner = np.concatenate([np.zeros(0, dtype=np.int64), *owners])
    rank = np.empty(len(owner), dtype=np.int64)
    # keep the order of the whole team
    numbers = np.concatenate([np.zeros(0, dtype=np.int64), *(family.number[chosen] for family, chosen in families)])
    rank[np.lexsort((numbers, owner))] = np.arange(len(owner))
    made, start = [], 0
    for family, chosen in families:
        stop = start + len(chosen)
        made.append(
            dataclasses.replace(
                family.members(chosen), agents=local[family.agents[chosen]].astype(np.int32), owner=owner[start:stop].astype(np.int32),
                number=rank[start:stop].astype(np.int32), sources=None,
            )
        )  # fmt: skip
        start = stop
    share = copy.copy(team).with_constraints(made, np.sort(owner).astype(np.int32), [""] * len(owner))
    share.ids = [""] * count
    return share
