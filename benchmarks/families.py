"""Seeded families of teams to measure protocols on.

A `Problem` holds several instances, one a seed, as the clusters of ONE team: clusters are independent problems, so all seeds run in one
compiled program, and each is judged for itself.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import networkx as nx
import numpy as np

import consat as cs
from consat.settings import Smoothing

Instance = tuple[list[cs.Agent], list[tuple[str, str]]]
"""Agents and links, all ids with the instance's prefix."""
Builder = Callable[[str, int, np.random.Generator], Instance]
"""From a prefix of ids, N and a generator of random numbers."""


@dataclass(frozen=True)
class Problem:
    """Instances of one family at one size.

    Attributes:
        family: its name.
        count: N, of the largest instance.
        team: all instances, one cluster each.
        diameters: (S,) links between the two agents farthest apart, of each instance.
        convex: whether every ψ is concave.
        feasible: whether every constraint can hold at once.
        smoothing: ν; None for ``auto``.
    """

    family: str
    count: int
    team: cs.Team
    diameters: np.ndarray
    convex: bool
    feasible: bool
    smoothing: Smoothing | None

    @property
    def name(self) -> str:
        return f"{self.family} N={self.count}"

    @property
    def seeds(self) -> int:
        return len(self.diameters)


@dataclass(frozen=True)
class Family:
    """A family, before its size is chosen; attributes as in `Problem`."""

    name: str
    build: Builder
    sizes: tuple[int, ...]
    dimension: int = 2
    convex: bool = True
    feasible: bool = True
    paper: bool = False

    def at(self, count: int, seeds: int) -> Problem:
        """The problem of `count` agents, in `seeds` instances."""
        agents: list[cs.Agent] = []
        links: list[tuple[str, str]] = []
        diameters = []
        for seed in range(seeds):
            some, pairs = self.build(f"s{seed}_", count, np.random.default_rng([seed, count]))
            agents += some
            links += pairs
            diameters.append(_diameter(pairs))
        smoothing = Smoothing(nu_alpha=5.0, nu_beta=5.0) if self.paper else None
        team = cs.Team(agents, links, self.dimension)
        return Problem(self.name, count, team, np.array(diameters), self.convex, self.feasible, smoothing)


def _diameter(pairs: Sequence[tuple[str, str]]) -> int:
    graph = nx.Graph(pairs)
    far = max(nx.single_source_shortest_path_length(graph, pairs[0][0]).items(), key=lambda item: item[1])[0]
    return max(nx.single_source_shortest_path_length(graph, far).values())  # exact on trees, close elsewhere


def _line(ids: Sequence[str]) -> list[tuple[str, str]]:
    return list(itertools.pairwise(ids))


def _ids(prefix: str, count: int) -> list[str]:
    return [f"{prefix}a{i}" for i in range(count)]


def _case(letter: str) -> Builder:
    """The paper's cases."""

    def build(prefix: str, count: int, random: np.random.Generator) -> Instance:
        a, b, c = ids = _ids(prefix, count)
        goal = cs.within([2, 0], 1)
        if letter == "A":
            constraints = [[goal], [cs.near(a, 1)], [cs.near(b, 1)]]
        elif letter == "E":
            separate = 0.2
            third = [cs.near(b, 1), cs.near(a, 1), cs.apart(a, separate), cs.apart(b, separate)]
            constraints = [[goal], [cs.near(a, 1), cs.apart(a, separate)], third]
        else:
            near, nearer = {"B": (3, 2), "C": (1.7, 0.7), "D": (1.4, 0.4)}[letter]
            constraints = [[goal], [cs.near(a, near), cs.near(c, nearer)], [cs.within([-2, 0], 1)]]
        return [cs.Agent(i, own) for i, own in zip(ids, constraints, strict=True)], _line(ids)

    return build


def _chain(prefix: str, count: int, random: np.random.Generator) -> Instance:
    """A leader in a disc, each follower near the one ahead; links follow the tasks."""
    ids = _ids(prefix, count)
    followers = [cs.Agent(i, [cs.near(ahead, 1)]) for ahead, i in itertools.pairwise(ids)]
    return [cs.Agent(ids[0], [cs.within([2, 0], 1)]), *followers], _line(ids)


def _anchored(margin: float) -> Builder:
    """A chain between two discs so far apart that the best margin, by symmetry, is `margin`."""

    def build(prefix: str, count: int, random: np.random.Generator) -> Instance:
        ids = _ids(prefix, count)
        half = 0.5 * (count + 1) * math.sqrt(1 - margin)  # N − 1 tethers and two discs of radius 1, all stretched to √(1 − margin)
        agents = [cs.Agent(i, [cs.near(ahead, 1)]) for ahead, i in itertools.pairwise(ids)]
        agents[-1] = cs.Agent(ids[-1], [cs.near(ids[-2], 1), cs.within([half, 0], 1)])
        return [cs.Agent(ids[0], [cs.within([-half, 0], 1)]), *agents], _line(ids)

    return build


def _neighbours(count: int) -> list[tuple[int, int, list[int]]]:
    """(i, j, step) for every agent i of a grid and its left and lower neighbours j, as nearly square as N allows."""
    height = max(h for h in range(1, math.isqrt(count) + 1) if count % h == 0)
    width = count // height
    beside = [(i, i - 1, [1, 0]) for i in range(count) if i % width]
    return sorted([*beside, *((i, i - width, [0, 1]) for i in range(width, count))])


def _meshed(tie: Callable[[str, list[int]], cs.Constraint]) -> Builder:
    """A grid whose agents are tied to their left and lower neighbours; one corner in a disc; links follow the tasks."""

    def build(prefix: str, count: int, random: np.random.Generator) -> Instance:
        ids = _ids(prefix, count)
        own: list[list[cs.Constraint]] = [[cs.within([2, 0], 1)], *([] for _ in ids[1:])]
        for i, j, step in _neighbours(count):
            own[i].append(tie(ids[j], step))
        return [cs.Agent(i, tied) for i, tied in zip(ids, own, strict=True)], [(ids[j], ids[i]) for i, j, _ in _neighbours(count)]

    return build


def _tree(prefix: str, count: int, random: np.random.Generator) -> Instance:
    """Tethers along one random tree, links along another: relays are needed."""
    ids = _ids(prefix, count)
    agents = [cs.Agent(ids[0], [cs.within([2, 0], 1)])]
    agents += [cs.Agent(ids[i], [cs.near(ids[int(random.integers(i))], 1)]) for i in range(1, count)]
    order = random.permutation(count)
    links = [(ids[order[int(random.integers(i))]], ids[order[i]]) for i in range(1, count)]
    return agents, links


def _ring(prefix: str, count: int, random: np.random.Generator) -> Instance:
    """Each near the next and apart from the next two; one in a disc. Links join everyone to the next two."""
    ids = _ids(prefix, count)
    agents, links = [], []
    for i in range(count):
        one, two = ids[(i + 1) % count], ids[(i + 2) % count]
        own = [cs.near(one, 1), cs.apart(one, 0.4), cs.apart(two, 0.4)]
        agents.append(cs.Agent(ids[i], own + ([] if i else [cs.within([2, 0], 1)])))
        links += [(ids[i], one), (ids[i], two)]
    return agents, links


def _crowd(prefix: str, count: int, random: np.random.Generator) -> Instance:
    """All in one disc, every two apart: they fill about a third of it."""
    ids = _ids(prefix, count)
    radius = 0.5 * math.sqrt(count / 3) + 0.25
    agents = [cs.Agent(ids[i], [cs.within([0, 0], radius), *(cs.apart(other, 0.5) for other in ids[:i])]) for i in range(count)]
    return agents, [(ids[j], ids[i]) for i in range(count) for j in range(i)]


def _swarm(separate: bool) -> Builder:
    """3-D: everyone in a ball, and near two random teammates; if asked, also apart from these."""

    def build(prefix: str, count: int, random: np.random.Generator) -> Instance:
        ids = _ids(prefix, count)
        agents, links = [], []
        for i in range(count):
            own = [cs.within([0, 0, 0], 3)]
            for j in random.choice(i, size=min(i, 2), replace=False):
                own.append(cs.near(ids[j], 2))
                own += [cs.apart(ids[j], 0.5)] if separate else []
                links.append((ids[j], ids[i]))
            agents.append(cs.Agent(ids[i], own))
        return agents, links

    return build


FAMILIES: tuple[Family, ...] = (
    *(Family(f"case {x}", _case(x), (3,), convex=x != "E", feasible=x != "D", paper=True) for x in "ABCDE"),
    Family("chain", _chain, (3, 10, 30, 100, 300, 1000)),
    Family("grid", _meshed(lambda other, _: cs.near(other, 1)), (4, 10, 30, 100, 300, 1000)),
    Family("formation", _meshed(lambda other, step: cs.displacement(other, step, 0.5)), (4, 10, 30, 100)),
    Family("tree", _tree, (10, 20, 30)),
    Family("tight chain", _anchored(0.05), (10, 30)),
    Family("infeasible chain", _anchored(-0.1), (10, 30), feasible=False),
    Family("3-D swarm", _swarm(separate=False), (30,), dimension=3),
    Family("ring, apart", _ring, (6, 12, 24), convex=False),
    Family("crowd, apart", _crowd, (6,), convex=False),
    Family("3-D swarm, apart", _swarm(separate=True), (30,), dimension=3, convex=False),
)
