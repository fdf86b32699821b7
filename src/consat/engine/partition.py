"""Who computes which agents, where several processes share a team: few links cut, and what crosses them.

A process holds its own agents, then those of other processes that it hears from or whose positions its constraints are judged by. The
latter's messages are computed where they live, and put in place of what would stand at their ends here before anybody hears.
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
    """(N,) the process of each agent: equal shares, in an order in which linked agents stand close together (reverse Cuthill–McKee).

    Args:
        team: the team.
        copies: its layout of estimates.
        processes: how many.
    """
    links, count = copies.links, team.count
    both = np.concatenate([links, links[:, ::-1]])
    graph = coo_array((np.ones(len(both), dtype=np.int8), (both[:, 0], both[:, 1])), shape=(count, count)).tocsr()
    order = reverse_cuthill_mckee(graph, symmetric_mode=True)
    work = np.cumsum(1.0 + np.bincount(copies.holder, minlength=count)[order])  # an agent's copies are what costs
    part = np.empty(count, dtype=np.int32)
    part[order] = np.minimum((work - 1e-9) * processes / work[-1], processes - 1).astype(np.int32)
    if len(np.unique(part)) < processes:  # few agents, of which some have much to do
        part[order] = np.arange(count) * processes // count
    return part


@dataclass(frozen=True, eq=False)
class Halo:
    """What one process exchanges with each of the others, in arrays padded to the largest exchange of any two.

    Attributes:
        out: (P, H) what goes to each process, padded with any.
        into: (P, H) where what comes from each process is put, padded with a place past the end.
    """

    out: np.ndarray
    into: np.ndarray

    @classmethod
    def of(cls, place: np.ndarray, source: np.ndarray, target: np.ndarray, key: np.ndarray, me: int, processes: int, *,
           end: int) -> Halo:  # fmt: skip
        """From a list of what goes from whom to whom, in the same order everywhere.

        Args:
            place: (K,) where it stands in this process, if it is its source or its target.
            source: (K,) process.
            target: (K,) process, another.
            key: (K,) what the items of a pair of processes are sorted by.
            me: this process.
            processes: P.
            end: a place past the end.
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
    """What one process holds of a team.

    Attributes:
        team: its agents with their constraints, and the others it needs without any.
        copies: the layout of their estimates, in which these agents are numbered anew.
        agents: (n,) their numbers in the whole team; this process's come first.
        mine: how many are this process's.
        rows: (c,) of its copies, where they stand in the whole layout.
        ours: (c,) whether a copy is held by an agent of this process.
        degree: (e,) of each end the larger number of links of its own and the other's copy, in the whole team.
        messages: what stands at ends of links that other processes need.
        positions: of agents that other processes need.
        pair: numbers in the whole team of the pairs that speak here, in the order in which the kernel counts them.
        pairs: how many there are in the whole team.
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
        """The share of process `me`; every process works it out for itself from the whole team."""
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
        # the message at an end goes to where the link's other end is
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
    """The agents of a process, numbered anew, with their constraints."""
    families, owners = [], []
    for family in team.families:
        chosen = np.flatnonzero(part[family.owner] == me)
        if len(chosen):
            families.append((family, chosen))
            owners.append(local[family.owner[chosen]])
    owner = np.concatenate([np.zeros(0, dtype=np.int64), *owners])
    rank = np.empty(len(owner), dtype=np.int64)
    # in the order in which the whole team has them
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
