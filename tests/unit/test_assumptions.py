import json

import jax.numpy as jnp
import numpy as np
import pytest
from scipy.optimize import linprog

import consat as cs
from consat.certify.assumptions import binding_auxiliaries, existence, report, with_auxiliary
from consat.certify.optimum import max_min
from consat.certify.quadratics import expand
from tests.unit.teams import case

A = cs.Agent
TRIANGLE = [cs.halfspace([1, 0.3], 1), cs.halfspace([-1, 0.3], 1), cs.halfspace([0.1, -1], 1)]


@pytest.mark.parametrize(
    ("agents", "bounded", "unique"),
    [
        # the gap in the paper's lemma: each agent has a ψ strictly concave in its own position, and yet both may drift off together
        ([A("a", [cs.near("b", 1)]), A("b", [cs.near("a", 2)])], False, False),
        ([A("a", [cs.near("b", 1), cs.within([0, 0], 1)]), A("b", [cs.near("a", 2)])], True, True),
        ([A("a", [cs.halfspace([1, 0], 1), cs.halfspace([-1, 0], 1)])], False, False),  # a slab: a line of optima
        ([A("a", [cs.halfspace([1, 0], 1), cs.halfspace([0, 1], 1)])], False, False),  # a quadrant: no optimum
        ([A("a", TRIANGLE)], True, True),
        ([A("a", TRIANGLE[:2])], False, False),
        ([A("a", [cs.box([0, 0], [1, 1])]), A("b", [cs.displacement("a", [1, 0], 1)])], True, True),
        ([A("a", [cs.expr("a.y - a.x**2"), cs.expr("1 - a.y")])], True, True),  # a parabola, closed by a wall
        ([A("a", [cs.expr("a.y - a.x**2")])], False, False),
        ([A("a", [cs.expr("1 - (a.x + b.x)**2"), cs.expr("1 - (a.x - b.x)**2")]), A("b", [cs.box([-9, -1], [9, 1])])], False, False),
        ([A("a", [cs.within([0, 0], 1)]), A("relay")], True, True),  # nobody reads the relay's position
        ([A("a", [cs.apart("b", 1)]), A("b")], False, False),  # not concave, but translation invariant
        ([A("a", [cs.apart("b", 1), cs.within([0, 0], 1)]), A("b", [cs.within([0, 0], 1)])], True, None),
        ([A("a", [cs.outside([0, 0], 1)])], None, None),
    ],
)
def test_bounded_and_unique(agents: list[cs.Agent], bounded: bool | None, unique: bool | None) -> None:
    assert existence(cs.Team(agents))[:2] == (bounded, unique)


def test_units_do_not_matter() -> None:
    for unit in (1e-6, 1.0, 1e6):
        assert existence(case("d", unit))[:2] == (True, True)
        team = cs.Team([A("a", [cs.near("b", unit), cs.halfspace([1, 0.3], unit)]), A("b", [cs.halfspace([-1, 0.3], unit)])])
        assert existence(team)[:2] == (False, False)


@pytest.mark.parametrize("count", [10, 2000])
def test_long_chains(count: int) -> None:
    """The smallest eigenvalue of 2000 links is 6e-7: a tolerance on eigenvalues would be a gamble, merging is not."""
    chain = [A(f"x{i}", [cs.near(f"x{i - 1}", 1)]) for i in range(1, count)]
    assert existence(cs.Team([A("x0", [cs.within([0, 0], 1)]), *chain]))[:2] == (True, True)
    bounded, unique, adrift = existence(cs.Team([A("x0"), *chain]))
    assert (bounded, unique, len(adrift)) == (False, False, count)


def test_long_affine_chains() -> None:
    """Nothing to merge here: rank and linear program."""

    def tied(x: jnp.ndarray, y: jnp.ndarray, normal: jnp.ndarray) -> jnp.ndarray:
        return 1 - jnp.dot(normal, x - y)

    count, axes = 600, np.array([[1.0, 0], [-1, 0], [0, 1], [0, -1]])

    def chain(normals: np.ndarray) -> cs.Team:
        links = [A(f"x{i}", [cs.constraint(tied, (f"x{i}", f"x{i - 1}"), normal=n) for n in normals]) for i in range(1, count)]
        return cs.Team([A("x0", [cs.box([0, 0], [1, 1])]), *links])

    assert existence(chain(axes))[:2] == (True, True)
    assert existence(chain(axes[:3]))[:2] == (False, False)


def test_agrees_with_a_linear_program_over_everything() -> None:
    """16 random teams, with a constraint or two left out, against 2n programs without any merging."""
    random, seen = np.random.default_rng(0), set()
    for _ in range(16):
        agents: list[cs.Agent] = [A(f"a{i}", []) for i in range(3)]
        kinds = [
            lambda i, j: cs.near(f"a{j}", 1),
            lambda i, j: cs.halfspace(random.normal(size=2).round(1) + 0.05, 1),
            lambda i, j: cs.within([0, 0], 1),
            lambda i, j: cs.expr(f"1 - (a{i}.x - 2*a{j}.y)**2"),
        ]
        for _ in range(int(random.integers(3, 7))):
            i, j = random.permutation(3)[:2]
            agents[i].constraints.append(kinds[random.choice(4, p=[0.4, 0.4, 0.05, 0.15])](i, j))
        team = cs.Team(agents)
        model, read = expand(team, np.zeros((3, 2))), np.zeros((3, 2), dtype=bool)
        for family in team.families:
            read[family.agents] = True
        slopes, curved = model.jacobian().toarray(), [model.hessian(np.eye(len(model.value))[k]).toarray() for k in range(len(model.value))]
        limits = [(-1, 1) if r else (0, 0) for r in read.ravel()]
        flat = np.vstack(curved)
        farthest = max(
            -linprog(sign * axis, A_ub=-slopes, b_ub=np.zeros(len(slopes)), A_eq=flat, b_eq=np.zeros(len(flat)), bounds=limits).fun
            for axis in np.eye(6)
            for sign in (1, -1)
        )
        expected = bool(farthest < 1e-6)  # 0 or 1, but for the solver's tolerance
        assert existence(team)[:2] == (expected, expected)
        seen.add(expected)
    assert seen == {True, False}


def test_report_is_json_with_the_fields_of_the_contract() -> None:
    found = json.loads(json.dumps(report(case("c"))))
    assert found["schema"] == "consat.check/1"
    assert found["count"] == 3
    assert found["clusters"] == [["a1", "a2", "a3"]]
    assert found["communication_connected"] is True
    assert (found["convex"], found["unique_optimum"], found["bounded"]) == (True, True, True)
    assert found["constraints"][1] == {
        "agent": "a2",
        "name": "near(a1)",
        "reads": ["a2", "a1"],
        "curvature": "concave",
        "strict_in_own": True,
    }
    assert [a["holds"] for a in found["assumptions"]] == [True, True, True]


def test_report_of_a_team_that_is_not_convex() -> None:
    found = report(case("e"))
    assert found["convex"] is False
    assert found["unique_optimum"] is None
    assert {c["curvature"] for c in found["constraints"]} >= {"not-concave"}


def test_broken_assumptions_are_named_with_their_cure() -> None:
    team = cs.Team([A("a", [cs.near("b", 1)]), A("b"), A("c", [cs.near("d", 1)]), A("d")], links=[("c", "d")])
    one, two, three = report(team)["assumptions"]
    assert one["holds"] is False
    assert "{a} and {b}" in one["what"]
    assert "[a, b]" in one["cure"]
    assert two["holds"] is False
    assert "2 clusters" in two["what"]
    assert three["holds"] is False
    assert "a, b, c, d can move off" in three["what"]
    assert "--auxiliary" in three["cure"]


def test_the_auxiliary_constraint_restores_what_was_missing() -> None:
    loose = cs.Team([A("a", [cs.near("b", 1)]), A("b", [cs.near("a", 2)])])
    team = with_auxiliary(loose, 50.0)
    assert existence(team)[:2] == (True, True)
    assert list(team.names) == ["near(b)", "auxiliary", "near(a)", "auxiliary"]
    assert team.owner.tolist() == [0, 0, 1, 1]
    assert sorted(np.concatenate([family.number for family in team.families])) == [0, 1, 2, 3]
    assert all((team.owner[family.number] == family.owner).all() for family in team.families)
    optimum = max_min(team)
    assert optimum.margin == pytest.approx(1, abs=1e-6)
    assert binding_auxiliaries(team, optimum.multipliers) == []


def test_an_auxiliary_constraint_that_binds_is_noticed() -> None:
    team = with_auxiliary(case("d"), 0.2)
    assert binding_auxiliaries(team, max_min(team).multipliers) == ["a1", "a3"]
