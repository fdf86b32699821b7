"""Task graph, clusters, holders and the Laplacian over copies."""

from __future__ import annotations

import jax.numpy as jnp
import networkx as nx
import numpy as np
import pytest

import consat as cs
from consat.certify.assumptions import report
from consat.network.node.part import split
from consat.numerics import float64
from consat.problem import graphs
from consat.protocols.estimates import Estimates
from consat.settings import Layout
from consat.views import tables


def example() -> cs.Team:
    return cs.load("example-1").team


def test_example_1_has_the_papers_task_graph() -> None:
    edges = {(int(i) + 1, int(j) + 1) for i, j in graphs.task_edges(example())}
    expected = {(1, 1), (1, 2), (2, 2), (2, 1), (3, 1), (4, 1), (4, 2), (4, 3), (5, 5), (5, 3), (5, 4), (6, 6), (6, 7), (7, 7)}
    assert edges == expected


def test_example_1_has_the_papers_clusters() -> None:
    assert graphs.clusters(example()).tolist() == [0, 0, 0, 0, 0, 1, 1]


def test_agents_without_constraints_are_clusters_of_their_own() -> None:
    team = cs.Team([cs.Agent("a"), cs.Agent("b", [cs.near("c", 1)]), cs.Agent("c")])
    assert graphs.clusters(team).tolist() == [0, 1, 1]


def test_disconnected_cluster_is_named_with_a_cure() -> None:
    team = cs.Team([cs.Agent("a", [cs.near("b", 1)]), cs.Agent("b"), cs.Agent("c", [cs.near("b", 1)])], links=[("a", "b")])
    assert graphs.disconnected(team) == [[["a", "b"], ["c"]]]
    with pytest.raises(cs.InvalidTeam, match=r"add a link such as \[a, c\]"):
        graphs.require_connected(team)


def test_links_through_another_cluster_do_not_count() -> None:
    tied = [cs.Agent("a", [cs.near("b", 1)]), cs.Agent("b")]
    links = [("a", "c"), ("c", "b")]
    assert graphs.disconnected(cs.Team([*tied, cs.Agent("c", [cs.within([0, 0], 1)])], links=links)) == [[["a"], ["b"]]]
    # nor through one that another cluster reads
    read = [cs.Agent("c"), cs.Agent("d", [cs.near("c", 1)])]
    assert graphs.disconnected(cs.Team([*tied, *read], links=[*links, ("c", "d")])) == [[["a"], ["b"]]]


def two_pairs() -> cs.Team:
    """Two clusters, {a, b} and {c, d}, whose messages pass m; n and o join a and b, too, but over more links; p hangs on loosely."""
    agents = [
        cs.Agent("a", [cs.within([0, 0], 1)]), cs.Agent("b", [cs.near("a", 1)]), cs.Agent("m"), cs.Agent("n"), cs.Agent("o"),
        cs.Agent("c", [cs.within([3, 0], 1)]), cs.Agent("d", [cs.near("c", 1)]), cs.Agent("p"),
    ]  # fmt: skip
    return cs.Team(agents, links=[tuple(link) for link in ("am", "mb", "an", "no", "ob", "cm", "md", "pa")])


def test_agents_without_constraints_relay_for_clusters_that_their_own_links_leave_in_pieces() -> None:
    team = two_pairs()
    cluster = graphs.clusters(team)
    assert graphs.relays(team, cluster) == {0: {2}, 4: {2}}
    assert graphs.disconnected(team) == []
    # who reads whom, and m for both clusters: b reads a, d reads c
    held = {(team.ids[i], team.ids[j]) for i, j in graphs.holders(team, cluster)}
    assert held == {(i, i) for i in team.ids} | {("b", "a"), ("m", "a"), ("d", "c"), ("m", "c")}
    full = Estimates.of(team, "full")
    held = {(team.ids[i], team.ids[j]) for i, j in zip(full.holder, full.position, strict=True)}
    assert held == {(i, j) for pair in ("ab", "cd") for i in (*pair, "m") for j in pair} | {(i, i) for i in "mnop"}
    # a cluster that its own links join asks nobody else
    joined = cs.Team([cs.Agent("a", [cs.near("b", 1)]), cs.Agent("b"), cs.Agent("m")], links=[("a", "b"), ("a", "m"), ("m", "b")])
    assert graphs.relays(joined, graphs.clusters(joined)) == {}
    # nobody joins those that are out of reach
    apart = cs.Team([cs.Agent("a", [cs.near("b", 1)]), cs.Agent("b"), cs.Agent("m")], links=[("a", "m")])
    assert graphs.disconnected(apart) == [[["a"], ["b"]]]
    with pytest.raises(cs.InvalidTeam, match=r"nor one over agents without constraints; add a link such as \[a, b\]"):
        graphs.require_connected(apart)


def test_check_says_who_relays_for_whom() -> None:
    findings = report(two_pairs())
    assert findings["communication_connected"]
    assert findings["relays"] == [{"agent": "m", "for": ["a", "b"]}, {"agent": "m", "for": ["c", "d"]}]
    text = "\n".join(part for part in tables.check("pairs", findings) if isinstance(part, str))
    assert "m relays for {a, b}. m relays for {c, d}." in text
    assert report(example())["relays"] == []


@pytest.mark.parametrize("layout", ["full", "local"])
def test_a_team_that_needs_a_relay_is_satisfied(layout: Layout) -> None:
    team = two_pairs()
    summary = cs.run(team, estimates=layout, seed=1, loss=0.3).summary
    assert summary["status"] == "satisfied"
    assert summary["clusters"] == [["a", "b"], ["m"], ["n"], ["o"], ["c", "d"], ["p"]]
    assert summary["agents"]["m"] == {"margin": None, "constraints": []}
    # on the network m gets copies, too, and constraints of nobody
    part = split(cs.loads(cs.dump(team)), run="pairs")["m"]
    assert set(part.team.ids) == {"m", "a", "c"}
    assert not len(part.team.owner)


@pytest.mark.parametrize("kind", ["line", "ring", "star", "complete"])
def test_topologies_are_those_of_networkx(kind: str) -> None:
    agents = [cs.Agent(f"a{i}", [cs.near(f"a{(i + 1) % 6}", 1)]) for i in range(6)]
    made = {"line": nx.path_graph, "ring": nx.cycle_graph, "star": lambda n: nx.star_graph(n - 1), "complete": nx.complete_graph}[kind](6)
    assert {tuple(sorted(edge)) for edge in made.edges} == {tuple(link) for link in cs.Team(agents, links=kind).links.tolist()}


def random_team(seed: int, count: int = 14) -> cs.Team:
    """Tasks and links that have nothing to do with each other, so that relays are needed."""
    random = np.random.default_rng(seed)
    tree = nx.random_labeled_tree(count, seed=seed)
    agents = [cs.Agent("a0", [cs.within([0, 0], 1)])]
    agents += [cs.Agent(f"a{i}", [cs.near(f"a{random.integers(i)}", 1.0)]) for i in range(1, count)]
    return cs.Team(agents, links=nx.relabel_nodes(tree, {i: f"a{i}" for i in range(count)}))


@pytest.mark.parametrize("seed", range(10))
def test_holders_are_connected_and_contain_the_readers(seed: int) -> None:
    team = random_team(seed)
    pairs = graphs.holders(team, graphs.clusters(team))
    talk = nx.Graph(team.linked)
    talk.add_nodes_from(team.ids)
    for j, agent in enumerate(team.ids):
        held = {team.ids[i] for i, k in pairs if k == j}
        readers = {team.ids[i] for i, k in graphs.task_edges(team) if k == j}
        assert {agent} | readers <= held
        assert nx.is_connected(talk.subgraph(held))


def test_no_relay_where_readers_are_linked_to_the_owner() -> None:
    team = cs.load("case-b").team
    assert graphs.holders(team, graphs.clusters(team)).tolist() == [[0, 0], [1, 0], [1, 1], [1, 2], [2, 2]]


@pytest.mark.parametrize("layout", ["full", "local"])
@pytest.mark.parametrize("make", [lambda: random_team(4), example, lambda: cs.load("case-b").team])
@float64
def test_disagreement_is_the_laplacian(layout: str, make) -> None:
    team = make()
    copies = Estimates.of(team, layout)
    x = np.random.default_rng(0).normal(size=(copies.count, 2))
    expected = np.zeros_like(x)
    row = {(int(i), int(j)): r for r, (i, j) in enumerate(zip(copies.holder, copies.position, strict=True))}
    for i, j in team.linked:
        a, b = team.ids.index(i), team.ids.index(j)
        for held in range(team.count):
            if (a, held) in row and (b, held) in row and copies.cluster[a] == copies.cluster[b]:
                apart = x[row[a, held]] - x[row[b, held]]
                expected[row[a, held]] += apart
                expected[row[b, held]] -= apart
    np.testing.assert_allclose(copies.exchange().disagreement(jnp.asarray(x)), expected, atol=1e-12)


@float64
def test_disagreement_vanishes_only_in_consensus() -> None:
    team = random_team(1)
    copies = Estimates.of(team, "local")
    exchange = copies.exchange()
    matrix = np.stack([np.asarray(exchange.disagreement(jnp.asarray(column)[:, None]))[:, 0] for column in np.eye(copies.count)], axis=1)
    np.testing.assert_allclose(matrix, matrix.T, atol=1e-12)
    values = np.linalg.eigvalsh(matrix)
    assert np.sum(values < 1e-9) == team.count  # one dimension a position: all its copies agree


def test_full_layout_holds_only_the_own_cluster() -> None:
    copies = Estimates.of(example(), "full")
    assert copies.count == 5 * 5 + 2 * 2


def test_unknown_layout_is_refused() -> None:
    with pytest.raises(cs.InvalidSettings, match="must be one of local, full"):
        Estimates.of(example(), "half")  # type: ignore[arg-type]


def links_of(graph: nx.Graph) -> np.ndarray:
    return np.array([sorted(edge) for edge in nx.convert_node_labels_to_integers(graph).edges])


def test_length_of_loops() -> None:
    assert graphs.loop_length(8, links_of(nx.path_graph(8))) == 0.0
    assert graphs.loop_length(100, links_of(nx.cycle_graph(100))) == 100.0
    assert graphs.loop_length(400, links_of(nx.grid_2d_graph(20, 20))) == pytest.approx(4.0, abs=0.3)
    with_tail = nx.disjoint_union(nx.cycle_graph(30), nx.path_graph(50))
    with_tail.add_edge(0, 30)
    assert graphs.loop_length(80, links_of(with_tail)) == 30.0
