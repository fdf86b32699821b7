"""Groups against the same teams built agent by agent, in Python and from scenario files."""

from __future__ import annotations

import re
from collections.abc import Sequence
from itertools import product
from typing import Any

import numpy as np
import pytest

import consat as cs
from consat.problem.groups import layout


def said(team: cs.Team) -> set[tuple[Any, ...]]:
    """Every constraint: owner, name, kind, who is read, parameters, weight."""
    found = set()
    for family in team.families:
        for k, number in enumerate(family.number):
            values = tuple((key, tuple(np.ravel(value[k]).round(9))) for key, value in sorted(family.parameters.items()))
            reads = tuple(team.ids[i] for i in family.agents[k])
            found.add((team.ids[team.owner[number]], team.names[number], family.kind, reads, values, float(family.weight[k])))
    return found


def same(a: cs.Team, b: cs.Team) -> None:
    assert tuple(a.ids) == tuple(b.ids)
    np.testing.assert_array_equal(a.owner, b.owner)
    assert tuple(a.names) == tuple(b.names)
    assert said(a) == said(b)
    np.testing.assert_array_equal(a.links, b.links)


def chain(count: int) -> cs.Team:
    rest = [cs.Agent(f"a{i}", [cs.near(f"a{i - 1}", 1)]) for i in range(2, count + 1)]
    return cs.Team([cs.Agent("a1", [cs.within([2, 0], 1, name="goal")]), *rest], links="line")


def test_convoy_is_the_chain_agent_by_agent() -> None:
    group = cs.Group("a", 12, [cs.each(cs.within([2, 0], 1, name="goal"), of="first"), cs.near(-1, 1)])
    same(cs.Team([group], links="line"), chain(12))
    same(cs.load("convoy", ["count=12"]).team, chain(12))


def test_ring_goes_round() -> None:
    one_by_one = [cs.Agent(f"r{i + 1}", [cs.near(f"r{(i + 2) % 5 + 1}", 1, weight=2)]) for i in range(5)]
    same(cs.Team([cs.Group("r", 5, [cs.near(2, 1, weight=2)], shape="ring")]), cs.Team(one_by_one))


def test_grid_with_a_short_last_row() -> None:
    count, side = 11, 4  # rows of 4, 4 and 3
    agents = []
    for i in range(count):
        row, column = divmod(i, side)
        own: list[Any] = [cs.within(np.array([row, column]) * 2.0 - 3.0, 0.5)] if row % 2 == 0 and column % 2 == 0 else []
        own += [cs.near(f"g{i + side + 1}", 3)] if i + side < count else []
        own += [cs.near(f"g{i + 2}", 3)] if column + 1 < side and i + 1 < count else []
        agents.append(cs.Agent(f"g{i + 1}", own))
    constraints = [cs.each(cs.within("place", 0.5), of={"every": 2}), cs.near([1, 0], 3), cs.near([0, 1], 3)]
    same(cs.Team([cs.Group("g", count, constraints, shape="grid", spacing=2.0)]), cs.Team(agents))


@pytest.mark.parametrize(("dimension", "count", "side"), [(1, 7, 7), (2, 9, 3), (2, 10, 4), (3, 27, 3), (3, 28, 4)])
def test_grid_is_square_and_centred(dimension: int, count: int, side: int) -> None:
    made = layout(cs.Group("g", count, shape="grid", spacing=0.5), dimension)
    assert made.sides == (side,) * dimension
    expected = np.array(list(product(range(side), repeat=dimension)))[:count]
    np.testing.assert_array_equal(made.steps, expected)
    np.testing.assert_allclose(made.places, 0.5 * (expected - (side - 1) / 2), atol=1e-15)


@pytest.mark.parametrize("shape", ["line", "ring", "grid"])
def test_neighbours_are_a_spacing_apart(shape: str) -> None:
    places = layout(cs.Group("g", 9, shape=shape, spacing=0.7), 2).places
    step = 3 if shape == "grid" else 1
    np.testing.assert_allclose(np.linalg.norm(places[step:] - places[:-step], axis=1), 0.7, rtol=1e-14)


def test_nearest_are_those_of_a_full_search() -> None:
    group = cs.Group("s", 60, [cs.apart({"nearest": 4}, 0.2)], shape="random")
    places = layout(group, 2).places
    away = np.linalg.norm(places[:, None] - places[None], axis=2) + np.diag(np.full(60, np.inf))
    expected = {(i, int(j)) for i in range(60) for j in np.argsort(away[i])[:4]}
    (family,) = cs.Team([group]).families
    assert set(map(tuple, family.agents.tolist())) == expected
    assert len(set(cs.Team([group]).names[:4])) == 4


def test_random_places_are_one_to_each_cell_and_come_along_a_curve() -> None:
    places = layout(cs.Group("s", 4096, shape="random", spacing=0.5), 2).places
    assert np.abs(places).max() <= 16.0
    # 64 × 64 cells of side 1/2; a curve through them takes steps of about that, a random order of a third of the whole, 32/3
    assert np.median(np.linalg.norm(np.diff(places, axis=0), axis=1)) < 1.0


def test_displacements_to_places_hold_at_the_places() -> None:
    group = cs.Group("d", 9, [cs.displacement([1, 0], "place", 0.1), cs.displacement(-1, "place", 0.1)], shape="grid")
    team, places = cs.Team([group]), layout(group, 2).places
    (family,) = team.families
    np.testing.assert_allclose(family.parameters["vector"], places[family.agents[:, 0]] - places[family.agents[:, 1]])


def test_arrays_give_each_its_own() -> None:
    random = np.random.default_rng(0)
    owner, other = np.array([3, 0, 0, 2]), np.array([1, 2, 1, 0])
    radius, centers = random.uniform(1, 2, 4), random.normal(size=(5, 2))
    group = cs.Group("a", 5, [cs.within(centers, 1.0), cs.each(cs.near(other, radius), of=owner)])  # type: ignore[arg-type]
    agents = [cs.Agent(f"a{i + 1}", [cs.within(centers[i], 1.0)]) for i in range(5)]
    for i, j, r in zip(owner, other, radius, strict=True):
        agents[i] = cs.Agent(agents[i].id, [*agents[i].constraints, cs.near(f"a{j + 1}", r)])
    links = np.array([[1, 3], [2, 0], [1, 0]])
    named = [(f"a{i + 1}", f"a{j + 1}") for i, j in links]
    same(cs.Team([group], links=links), cs.Team(agents, links=named))


def test_groups_and_single_agents_read_one_another() -> None:
    group = cs.Group("a", 3, [cs.near("base", 2), cs.each(cs.expr("1 - norm2(self - other - [1, 0])", name="wing"), agent=1)])
    team = cs.Team([cs.Agent("base", [cs.within([0, 0], 1), cs.near("a2", 1)]), group])
    wing = [[cs.expr(f"1 - norm2(a{i} - a{i + 1} - [1, 0])", name="wing")] if i < 3 else [] for i in (1, 2, 3)]
    rest = [cs.Agent(f"a{i}", [cs.near("base", 2), *wing[i - 1]]) for i in (1, 2, 3)]
    same(team, cs.Team([cs.Agent("base", [cs.within([0, 0], 1), cs.near("a2", 1)]), *rest]))


def test_names_that_repeat_are_numbered() -> None:
    constraints = [cs.within([0, 0], 1), cs.each(cs.within([1, 0], 1), of="last"), cs.near(1, 1), cs.near(1, 2), cs.near(2, 1)]
    team = cs.Team([cs.Group("a", 3, constraints)])
    agents = [
        cs.Agent("a1", [cs.within([0, 0], 1), cs.near("a2", 1), cs.near("a2", 2), cs.near("a3", 1)]),
        cs.Agent("a2", [cs.within([0, 0], 1), cs.near("a3", 1), cs.near("a3", 2)]),
        cs.Agent("a3", [cs.within([0, 0], 1), cs.within([1, 0], 1)]),
    ]
    same(team, cs.Team(agents))
    named = cs.Team([cs.Group("s", 8, [cs.apart({"nearest": 2}, 0.1, name="gap")], shape="random")])
    assert tuple(named.names[:2]) == ("gap", "gap #2")


def test_names_and_ids_are_made_when_asked_for() -> None:
    team = cs.load("convoy", ["count=200000"]).team
    assert not isinstance(team.ids, tuple)
    assert not isinstance(team.names, tuple)
    assert (team.ids[0], team.ids[-1], len(team.ids)) == ("a1", "a200000", 200000)
    assert (team.names[0], team.names[199_999]) == ("goal", "near(a199999)")
    assert team.ids[1:3] == ("a2", "a3")
    with pytest.raises(IndexError, match="there are 200000 texts, but number 200000"):
        team.ids[200_000]


def test_members_start_around_their_places() -> None:
    scenario = cs.load("lattice", ["agents.0.scatter=0.25", "count=16"])
    result = cs.run(scenario, rounds=0, record=True)
    group = scenario.team.members[0]  # type: ignore[index]
    places = layout(group, 2).places  # type: ignore[arg-type]
    trace = result._trace
    assert trace is not None
    assert trace.estimate is not None
    for where, whose in ((trace.position[0], np.arange(16)), (trace.estimate[0], trace.held)):
        away = np.abs(where - places[whose]).max(axis=0)
        assert (away <= 0.25).all()
        assert (away > 0.125).all()


@pytest.mark.parametrize("name", ["convoy", "lattice", "swarm"])
def test_packaged_groups_are_satisfied_and_written_back(name: str) -> None:
    scenario = cs.load(name)
    assert cs.run(scenario).summary["status"] == "satisfied"
    again = cs.loads(cs.dump(scenario.team, scenario.settings, name))
    same(again.team, scenario.team)
    assert again.team.around is None or np.array_equal(again.team.around[0], scenario.team.around[0])  # type: ignore[index]


def test_large_teams_without_groups_are_not_written() -> None:
    agents: Sequence[cs.Agent] = [cs.Agent(f"a{i}") for i in range(10_001)]
    with pytest.raises(cs.InvalidTeam, match="at most 10000 are written one by one"):
        cs.dump(cs.Team(agents, links="line"))


BASE = """consat: 1
name: g
count: 4
agents:
  - group: a
    shape: grid
    constraints:
      - {kind: within, center: place, radius: 1, of: first}
      - {kind: near, agent: [0, 1], radius: 1}
"""


@pytest.mark.parametrize(
    ("old", "new", "line"),
    [
        ("group: a", "group: ''", r"5:12: group '': group is '', but must be a printable text"),
        ("count: 4", "count: 0", r"3:8: count: count is 0, but must be a whole number from 1"),
        ("count: 4\n", "", r"4:5: group 'a': count is missing"),
        ("shape: grid", "shape: gird", r"6:12: group 'a': there is no shape 'gird'; .* did you mean 'grid'\?"),
        ("shape: grid", "spacing: 0", r"6:14: group 'a': spacing is 0, but must be a positive number"),
        ("shape: grid", "scatter: -1", r"6:14: group 'a': scatter is -1, but must be a number ≥ 0"),
        ("shape: grid", "sape: grid", r"6:5: group 'a': there is no key 'sape'; .* did you mean 'shape'\?"),
        ("of: first", "of: b7", r"8:54: group 'a', constraint 'within': of is 'b7', but must be one of first, last"),
        ("of: first", "of: {every: 0}", r"8:54: group 'a', constraint 'within': of is \{'every': 0\}"),
        ("of: first", "off: first", r"8:50: group 'a', constraint 'within': there is no key 'off'; .* did you mean 'of'\?"),
        ("center: place", "center: plaice", r"8:32: group 'a', constraint 'within': center is 'plaice', but must be a list of 2 numbers"),
        ("radius: 1, of", "radius: -1, of", r"8:47: group 'a', constraint 'within': radius is -1, but must be a positive number"),
        ("[0, 1]", "0", r"9:29: group 'a', constraint 'near': agent is 0, but must be an id, a whole number other than 0"),
        ("[0, 1]", "[1, 2, 3]", r"9:29: group 'a', constraint 'near': agent is \[1, 2, 3\], .* or a list of 2 of them"),
        ("[0, 1]", "b1", r"9:29: group 'a', constraint 'near': there is no agent 'b1'"),
        ("[0, 1]", "{nearest: 4}", r"9:29: group 'a', constraint 'near': agent is \{'nearest': 4\}, .* k from 1 to 3"),
        ("kind: near, agent: [0, 1]", 'kind: expr, psi: "norm2(self - other)"', r"9:9: .*: agent is missing: it tells who `other` is"),
        ("kind: near, agent: [0, 1], radius: 1", 'kind: expr, psi: "norm2(b9)"', r"9:27: .*: there is no agent 'b9'; in a group, self"),
        ("  - group: a", "  - id: a2\n  - group: a", r"5:9: agents\[0\]: id 'a2' is taken by a member of a group"),
        ("  - group: a", "  - {group: a, count: 12}\n  - group: a1", r"6:12: group 'a1': its member 'a11' has the id of another"),
    ],
)  # fmt: skip
def test_faults_are_placed_and_explained(old: str, new: str, line: str) -> None:
    with pytest.raises(cs.InvalidScenario) as error:
        cs.loads(BASE.replace(old, new, 1), "g.yaml")
    first = str(error.value).split("\n")[0]
    assert re.match(f"g.yaml:{line}", first), first


def test_a_group_reaches_nobody_beyond_itself() -> None:
    with pytest.raises(cs.InvalidTeam, match=r"of holds places beyond 0 to 2"):
        cs.Team([cs.Group("a", 3, [cs.each(cs.within([0, 0], 1), of=np.array([3]))])])
    with pytest.raises(cs.InvalidTeam, match=r"agent must be an array of 3 places from 0 to 2"):
        cs.Team([cs.Group("a", 3, [cs.near(np.array([1, 2, 3]), 1)])])
    with pytest.raises(cs.InvalidTeam, match=r"radius must be positive throughout"):
        cs.Team([cs.Group("a", 3, [cs.within([0, 0], np.array([1.0, -1.0, 1.0]))])])  # type: ignore[arg-type]
