"""Task graph, clusters and communication graph (paper, section IV-A), and which agent holds an estimate of which position.

All functions work on arrays of edges.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator, Sequence

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import breadth_first_order, connected_components

from consat.errors import Fault, InvalidTeam
from consat.problem.links import pair_keys, task_pairs, unique_pairs
from consat.problem.team import Team


def task_edges(team: Team) -> np.ndarray:
    """Edges of the task graph: (i, j) if some ψ of i reads x_j; (i, i) if some ψ of i reads x_i alone.

    Returns:
        (E, 2) int32, sorted, each edge once.
    """
    return unique_pairs(task_pairs(team.families), team.count)


def clusters(team: Team) -> np.ndarray:
    """The maximal dependency cluster of each agent: the weakly connected components of the task graph.

    Returns:
        (N,) int32 labels from 0; clusters are numbered by their first agent.
    """
    return components(task_pairs(team.families), team.count)


def members(team: Team, cluster: np.ndarray) -> list[list[str]]:
    """The ids of the agents of each cluster. `cluster`: (N,) as `clusters` returns."""
    found: list[list[str]] = [[] for _ in range(int(cluster.max(initial=-1)) + 1)]
    for agent, label in zip(team.ids, cluster.tolist(), strict=True):
        found[label].append(agent)
    return found


def cluster_links(team: Team, cluster: np.ndarray) -> np.ndarray:
    """(L', 2) int32 links whose two ends are in the same cluster."""
    return team.links[cluster[team.links[:, 0]] == cluster[team.links[:, 1]]]


def disconnected(team: Team) -> list[list[list[str]]]:
    """The clusters that violate Assumption 1: they are connected neither by the links inside them nor through `relays`.

    Returns:
        for each such cluster a list of its connected parts; each part is a list of ids.
    """
    cluster = clusters(team)
    part, broken = _broken(team, cluster)
    joined = relays(team, cluster)
    parts = [
        [np.flatnonzero((cluster == c) & (part == p)) for p in np.unique(part[cluster == c])] for c in broken.tolist() if c not in joined
    ]
    return [[[team.ids[int(i)] for i in members] for members in of_cluster] for of_cluster in parts]


def _broken(team: Team, cluster: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(N,) label of the connected part of each agent, over links inside clusters only; and the labels of clusters with several parts."""
    part = components(cluster_links(team, cluster), team.count)
    first = np.full(cluster.max() + 1, -1)
    first[cluster[::-1]] = part[::-1]
    return part, np.unique(cluster[part != first[cluster]])


def relays(team: Team, cluster: np.ndarray) -> dict[int, set[int]]:
    """Relay agents that connect the parts of a cluster which its own links leave disconnected.

    Only agents without any role in a constraint (neither owner nor read) can be relays. A relay holds estimates of the positions of the
    cluster and adds no constraint to it.

    Args:
        team: the team.
        cluster: (N,) as `clusters` returns.

    Returns:
        relay agents by cluster, for each cluster that relays connect. The set is small, but not always minimal (Steiner heuristic).
    """
    _, broken = _broken(team, cluster)
    free = (np.bincount(cluster)[cluster] == 1) & (team.constraints_per_agent == 0)
    if not len(broken) or not free.any():
        return {}
    found = {}
    for c in broken.tolist():
        allowed = (cluster == c) | free
        links = team.links[allowed[team.links].all(axis=1)]
        members = np.flatnonzero(cluster == c)
        if len(np.unique(components(links, team.count)[members])) == 1:
            found[c] = _steiner(int(members[0]), set(members[1:].tolist()), _adjacency(links, team.count))
    return found


def require_connected(team: Team) -> None:
    """Check Assumption 1: every cluster is connected by links, if need be through `relays`.

    Raises:
        InvalidTeam: a cluster is not connected. The message names its parts and a link that would join them.
    """
    faults = []
    for parts in disconnected(team):
        shown = " and ".join("{" + ", ".join(part[:5]) + (", …" if len(part) > 5 else "") + "}" for part in parts[:4])
        cure = f"add a link such as [{parts[0][0]}, {parts[1][0]}]"
        message = f"the constraints tie {shown} together, but no path of links inside their cluster joins them (Assumption 1), "
        message += f"nor one over agents without constraints; {cure}"
        faults.append(Fault(("communication",), message, "communication"))
    if faults:
        raise InvalidTeam(faults)


def hops(count: int, links: np.ndarray) -> int:
    """Diameter of the graph in links: the largest over its components.

    Two breadth-first searches: one from any agent, one from the agent farthest from it. Exact on trees, a lower bound on other graphs.

    Args:
        count: N, the number of agents.
        links: (L, 2) pairs of agents.
    """
    return max((int(depth.max(initial=0)) for depth, _ in _sweeps(links, count, components(links, count), 2)), default=0)


def loop_length(count: int, links: np.ndarray) -> float:
    """Mean length of the loops that links form, in links; 0 where they form none.

    What hangs on the loops as a tree is left out. The rest has E links, each in two of its faces, one more than independent loops (Euler's
    formula). It is exact for a graph that can be drawn without crossings, such as a ring (N) or a square lattice (about 4).

    Args:
        count: N, number of agents.
        links: (L, 2) undirected links, each once.
    """
    loops = len(links) - count + int(components(links, count).max(initial=-1)) + 1
    if not loops:
        return 0.0
    kept = np.zeros(len(links), dtype=bool)
    while not kept.all():
        degree = np.bincount(links.ravel(), minlength=count)
        kept = (degree[links] > 1).all(axis=1)
        links = links[kept]
    return 2.0 * len(links) / (loops + 1)


def _sweeps(links: np.ndarray, count: int, component: np.ndarray, times: int) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Breadth-first searches over all components, each from the agents farthest from the starts of the one before; as `_depths` returns."""
    starts = np.unique(component, return_index=True)[1]
    for _ in range(times):
        depth, order = _depths(links, count, starts)
        yield depth, order
        starts = np.zeros(len(starts), dtype=np.intp)
        starts[component[order]] = order  # the last write wins: the deepest agent of each component


def _depths(links: np.ndarray, count: int, starts: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Breadth-first search from one start per component.

    Returns:
        (N,) distances in links, in the order of the search, and (N,) the agents in that order.
    """
    # one search for all components: a virtual agent, number `count`, is linked to every start
    here = np.concatenate([links[:, 0], links[:, 1], np.full(len(starts), count, dtype=links.dtype)])
    there = np.concatenate([links[:, 1], links[:, 0], starts.astype(links.dtype)])
    graph = coo_array((np.ones(len(here), dtype=np.int8), (here, there)), shape=(count + 1, count + 1)).tocsr()
    order, parent = breadth_first_order(graph, count, directed=True)
    place = np.empty(count + 1, dtype=np.int32)
    place[order] = np.arange(len(order), dtype=np.int32)
    above = place[np.maximum(parent[order], 0)]
    above[0] = 0
    depth = np.ones(len(order), dtype=np.int32)
    depth[0] = 0
    while above.any():  # pointer doubling: a chain of a million agents takes twenty passes
        depth += depth[above]
        above = above[above]
    return depth[1:] - 1, order[1:]


def middles(count: int, links: np.ndarray) -> np.ndarray:
    """(K,) a central agent of each component: the middle of a longest path. Exact on trees, approximate on other graphs.

    Args:
        count: N, the number of agents.
        links: (L, 2) pairs of agents.
    """
    labels, far = components(links, count), np.zeros(count, dtype=np.int64)
    for turn, (depth, order) in enumerate(_sweeps(links, count, labels, 3)):
        if turn:
            far[order] = np.maximum(far[order], depth)
    order = np.lexsort((np.arange(count), far, labels))
    return order[np.unique(labels[order], return_index=True)[1]]


def holders(team: Team, cluster: np.ndarray) -> np.ndarray:
    """Which agent holds an estimate of which position, under local estimates.

    Agent i holds x_j if some ψ of i reads x_j; agent j holds its own. If the links among the holders of a position do not connect them,
    further agents hold it too: agents of the same cluster or, where these cannot connect them, `relays`.

    Args:
        team: a team whose clusters are connected; see `require_connected`.
        cluster: (N,) as `clusters` returns.

    Returns:
        (C, 2) int32 pairs (holder, position), sorted, each once.
    """
    own = np.arange(team.count, dtype=np.int32)
    pairs = unique_pairs(np.concatenate([task_pairs(team.families), np.stack([own, own], axis=1)]), team.count)
    further = list(_further(team, cluster, pairs))
    return unique_pairs(np.concatenate([pairs, *further]), team.count) if further else pairs


def _further(team: Team, cluster: np.ndarray, pairs: np.ndarray) -> Iterator[np.ndarray]:
    """Additional (holder, position) pairs that connect the holders of a position.

    Positions whose readers are all linked to their owner need none; the loop skips them.
    """
    count, links = team.count, cluster_links(team, cluster)
    foreign = pairs[pairs[:, 0] != pairs[:, 1]]
    known = pair_keys(links, count)  # sorted, as links are
    wanted = pair_keys(np.stack([foreign.min(axis=1), foreign.max(axis=1)], axis=1), count)
    linked = np.append(known, -1)[np.searchsorted(known, wanted)] == wanted
    remote = np.unique(foreign[~linked, 1])
    if not len(remote):
        return
    inside, outside = _adjacency(links, count), relays(team, cluster)
    around = {c: _adjacency(_among(team, cluster, c, joining), count) for c, joining in outside.items()}
    by_position = foreign[np.argsort(foreign[:, 1], kind="stable")]
    starts = np.searchsorted(by_position[:, 1], remote), np.searchsorted(by_position[:, 1], remote, side="right")
    for position, begin, end in zip(remote, *starts, strict=True):
        neighbours = around.get(int(cluster[position]), inside)
        path_holders = _steiner(int(position), set(map(int, by_position[begin:end, 0])), neighbours)
        yield np.array([(holder, position) for holder in path_holders], dtype=np.int32).reshape(-1, 2)


def _among(team: Team, cluster: np.ndarray, c: int, joining: set[int]) -> np.ndarray:
    """(L', 2) links among the agents of cluster `c` and the relays `joining` it."""
    allowed = cluster == c
    allowed[list(joining)] = True
    return team.links[allowed[team.links].all(axis=1)]


def _steiner(root: int, wanted: set[int], neighbours: Sequence[np.ndarray]) -> set[int]:
    """Agents to add so that `root` and `wanted` are connected: an approximate Steiner tree (Takahashi, Matsuyama 1980).

    Repeatedly adds the shortest path from the tree to the nearest wanted agent. The tree is at most twice as long as the shortest.
    """
    joined, added, missing = {root}, set[int](), set(wanted)
    while missing:
        parent: dict[int, int] = dict.fromkeys(joined, -1)
        queue = deque(sorted(joined))
        while queue:
            agent = queue.popleft()
            if agent in missing:
                break
            for other in map(int, neighbours[agent]):
                if other not in parent:
                    parent[other] = agent
                    queue.append(other)
        while agent not in joined:
            joined.add(agent)
            missing.discard(agent)
            if agent not in wanted:
                added.add(agent)
            agent = parent[agent]
    return added


def components(edges: np.ndarray, count: int) -> np.ndarray:
    """(N,) int32 label of the connected component of each agent, from 0; components are numbered by their first agent.

    Args:
        edges: (E, 2) pairs of agents, in any order.
        count: N, the number of agents.
    """
    graph = coo_array((np.ones(len(edges), dtype=np.int8), (edges[:, 0], edges[:, 1])), shape=(count, count))
    labels: np.ndarray = connected_components(graph, directed=False)[1]
    return labels.astype(np.int32)


def _adjacency(links: np.ndarray, count: int) -> list[np.ndarray]:
    both = np.concatenate([links, links[:, ::-1]])
    both = both[np.lexsort((both[:, 1], both[:, 0]))]
    return np.split(both[:, 1], np.searchsorted(both[:, 0], np.arange(1, count)))
