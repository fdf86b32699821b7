"""The interior-point protocol's parts: linear algebra against dense matrices, a step against its formula, bounds that are never false."""

from __future__ import annotations

from collections.abc import Iterator
from types import SimpleNamespace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import consat as cs
from consat.certify.optimum import max_min as reference
from consat.numerics import float64
from consat.problem.graphs import clusters
from consat.problem.objective import Objective
from consat.problem.units import scale
from consat.protocols.interior_point import InteriorPoint
from consat.protocols.local.interior import Interior, Memory, route_of
from consat.protocols.local.interior.algebra import gram, reduced, spread
from consat.protocols.local.interior.prediction import observed, predicted
from consat.protocols.local.lanewise import LOOPED, eigen, solve
from tests.unit.teams import MARGINS, case


@pytest.fixture(autouse=True)
def _double() -> Iterator[None]:
    with jax.enable_x64(True):
        yield


def positive(random: np.random.Generator, size: int, lanes: int) -> np.ndarray:
    """(N, N, A) well-conditioned symmetric positive definite matrices."""
    root = random.normal(size=(lanes, size, size))
    return np.moveaxis(root @ np.swapaxes(root, 1, 2) + np.eye(size), 0, -1)


@pytest.mark.parametrize("size", [1, 5, LOOPED, LOOPED + 1, 2 * LOOPED + 3])
def test_systems_are_solved_as_numpy_does(size):
    random = np.random.default_rng(size)
    matrix, right = positive(random, size, 3), random.normal(size=(size, 2, 3))
    matrix[..., 1] *= -1.0
    found, fine = solve(jnp.asarray(matrix), jnp.asarray(right))
    assert fine.tolist() == [True, False, True]
    for lane in (0, 2):
        assert np.allclose(found[..., lane], np.linalg.solve(matrix[..., lane], right[..., lane]), rtol=1e-9, atol=1e-9)


def test_a_gram_matrix_is_the_same_however_large():
    random = np.random.default_rng(0)
    weight, vectors = random.uniform(size=(3, 2)), random.normal(size=(3, 4, 2))
    expected = np.einsum("ma,mia,mja->ija", weight, vectors, vectors)
    assert np.allclose(gram(jnp.asarray(weight), jnp.asarray(vectors)), expected)


@float64
@pytest.mark.parametrize("size", [1, 2, 3, 4, 7, 12, LOOPED + 5])
def test_eigenvectors_of_many_matrices_at_once(size: int) -> None:
    """Also zero, multiples of the identity, rank one, and entries of very different size."""
    random = np.random.default_rng(size)
    matrices = random.normal(size=(9, size, size))
    matrices = matrices + np.swapaxes(matrices, 1, 2)
    matrices[:5] = [
        np.zeros((size, size)),
        3 * np.eye(size),
        np.ones((size, size)),
        np.diag(10.0 ** np.linspace(-12, 12, size)),
        matrices[0] * 1e250,
    ]
    values, vectors = (np.asarray(each) for each in eigen(jnp.asarray(np.moveaxis(matrices, 0, -1))))
    for k, matrix in enumerate(matrices):
        scale = max(np.abs(matrix).max(), 1e-300)
        np.testing.assert_allclose(vectors[..., k].T @ vectors[..., k], np.eye(size), atol=1e-13)
        np.testing.assert_allclose((vectors[..., k] * values[:, k]) @ vectors[..., k].T / scale, matrix / scale, atol=1e-13)
        np.testing.assert_allclose(np.sort(values[:, k]) / scale, np.linalg.eigvalsh(matrix) / scale, atol=1e-13)
        alone = eigen(jnp.asarray(matrix[..., None]))
        assert np.array_equal(alone[0][:, 0], values[:, k]), "whatever else is in the batch"
        assert np.array_equal(alone[1][..., 0], vectors[..., k])


@pytest.mark.parametrize("size", [6, LOOPED + 4])
def test_what_is_left_of_a_quadratic_is_its_schur_complement(size):
    random = np.random.default_rng(size)
    matrix, vector = positive(random, size, 2), random.normal(size=(size, 2))
    none = size + 1  # padding
    shared = np.array([[[0, 2], [3, 5], [5, none]], [[1, none], [none, none], [none, none]]])  # (g, p, A)
    left, e, gain, fine = reduced(jnp.asarray(matrix), jnp.asarray(vector), jnp.asarray(shared, dtype=jnp.int32))
    assert fine.all()
    for g in range(2):
        for lane in range(2):
            keep = shared[g, :, lane][shared[g, :, lane] < size]
            out = np.setdiff1d(np.arange(size), keep)
            M, h = matrix[..., lane], vector[:, lane]
            K = np.linalg.solve(M[np.ix_(out, out)], np.column_stack([M[np.ix_(out, keep)], h[out]]))
            k = len(keep)
            assert np.allclose(left[g, :k, :k, lane], M[np.ix_(keep, keep)] - M[np.ix_(keep, out)] @ K[:, :-1])
            assert np.allclose(e[g, :k, lane], h[keep] - M[np.ix_(keep, out)] @ K[:, -1])
            assert np.isclose(gain[g, lane], 0.5 * h[out] @ K[:, -1])
            assert not np.any(left[g, k:, :, lane])
            assert not np.any(e[g, k:, lane])


def test_quadratics_of_neighbours_add_up_over_own_variables():
    random = np.random.default_rng(0)
    matrix, vector = random.normal(size=(2, 2, 2, 1)), random.normal(size=(2, 2, 1))
    shared = jnp.asarray([[[0], [2]], [[2], [4]]], dtype=jnp.int32)  # the last is padding
    whole, pull = spread(jnp.asarray(matrix), jnp.asarray(vector), shared, 3)
    expected = np.zeros((3, 3))
    expected[np.ix_([0, 2], [0, 2])] += matrix[0, ..., 0]
    expected[2, 2] += matrix[1, 0, 0, 0]
    assert np.allclose(whole[..., 0], expected)
    assert np.allclose(pull[:, 0], [vector[0, 0, 0], 0.0, vector[0, 1, 0] + vector[1, 0, 0]])


class Talk:
    """Rounds of a team outside the engine, with messages lost, late, out of order and twice."""

    def __init__(self, team: cs.Team, protocol: InteriorPoint | None = None, *, along: Any = None):
        self.team, size = team, scale(team)
        self.route, self.copies = along or route_of(team, "local")[:2]
        self.interior = Interior.of(team, self.copies, size)
        self.gains = (protocol or InteriorPoint(cap=None)).gains
        self.own, self.size = self.copies.own, size
        observer = Objective.at_positions(team)
        self.margins = jax.jit(observer.agent_margins)
        self.turn = jax.jit(
            lambda memory, inbox: self.interior.round(memory, inbox, observer.agent_margins(memory.y[self.own]), self.gains)
        )

    def begin(self, x: np.ndarray | None = None, seed: int = 0) -> None:
        random = np.random.default_rng(seed)
        if x is None:
            x = self.size.center + self.size.reach * random.uniform(-1, 1, (self.copies.count, self.team.dimension))
        self.memory, self.inbox = jax.jit(self.interior.begin, static_argnums=1)(jnp.asarray(x), self.gains), self.interior.silence()

    def run(self, rounds: int, *, loss: float = 0.0, late: int = 0, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
        """(rounds, N) margins and (rounds, N) bounds."""
        random, past, margins, bounds = np.random.default_rng(seed), [], [], []
        ends = np.arange(len(self.interior.other))
        for _ in range(rounds):
            self.memory, mail = self.turn(self.memory, self.inbox)
            past = [jax.tree.map(np.asarray, self.interior.across(mail)), *past[:late]]
            delay = random.integers(0, len(past), len(ends))
            came = random.uniform(size=len(ends)) >= loss
            sent = [jax.tree.leaves(each) for each in past]
            old, shape = jax.tree.flatten(self.inbox)
            new = [np.stack(leaves)[delay, ends] for leaves in zip(*sent, strict=True)]
            kept = [np.where(came.reshape(-1, *[1] * (one.ndim - 1)), one, before) for one, before in zip(new, old, strict=True)]
            self.inbox = jax.tree.unflatten(shape, kept)
            margins.append(self.margins(self.memory.y[self.own]))
            bounds.append(self.memory.bound * self.interior.units.psi)
        return np.array(margins), np.array(bounds)


def test_a_step_of_one_agent_is_the_newton_step_of_its_barrier():
    team = cs.Team([cs.Agent("a", [cs.within([0.0, 0.0], 1), cs.within([1.5, 0.5], 1.0)])])
    talk = Talk(team, InteriorPoint(cap=None, warm=0))
    talk.begin(np.array([[0.4, -0.2]]))
    unit = jax.tree.map(np.asarray, talk.interior.units)
    y, lam, t, mu = (np.asarray(each) for each in (talk.memory.y[0], talk.memory.multiplier, talk.memory.level[0], talk.memory.barrier[0]))
    y, center = (y - unit.center) / unit.length, (np.array([[0.0, 0.0], [1.5, 0.5]]) - unit.center) / unit.length
    talk.run(1)
    psi = unit.length**2 / unit.psi * (1 / unit.length**2 - np.sum((y - center) ** 2, axis=1))
    a = np.column_stack([-2 * unit.length**2 / unit.psi * (y - center), [-1, -1]])
    s = psi - t
    matrix = (a.T * (lam / s)) @ a
    matrix[[0, 1], [0, 1]] += 2 * unit.length**2 / unit.psi * lam.sum() + talk.gains.inertia
    step = -np.linalg.solve(matrix, -(mu / s) @ a - [0, 0, 1])
    moved = (np.asarray(talk.memory.y[0]) - unit.center) / unit.length - y
    part = moved[0] / step[0]
    assert 0 < part <= 1 + 1e-6
    assert np.allclose(moved, part * step[:2], rtol=1e-6)


def test_an_infeasible_case_ends_at_its_best_margin_and_is_proven_to():
    talk, best = Talk(case("d")), MARGINS["d"]
    talk.begin()
    margins, bounds = talk.run(25)
    assert margins[-1].min() == pytest.approx(best, abs=1e-3)
    assert (bounds >= best - 1e-5).all()
    assert (bounds[-1] <= best + 5e-3).all()


def tangle(random: np.random.Generator, count: int, prefix: str) -> tuple[list[cs.Agent], list[tuple[str, str]]]:
    """A team that can hardly be satisfied, over a tree that has nothing to do with its tasks; some agents only relay."""
    place = random.uniform(-4, 4, (count, 2))
    own: list[list[Any]] = [[] for _ in range(count)]
    for i in range(count):
        if random.random() < 0.5 or i == 0:
            own[i].append(cs.within(place[i] + random.normal(size=2), 0.5))
        elif random.random() < 0.5:
            normal = random.normal(size=2)
            own[i] += [cs.halfspace(normal, float(normal @ place[i] - random.uniform(0, 1))), cs.within([0, 0], 20)]
        if i:
            j = int(random.integers(i))
            whose, other = (i, j) if random.random() < 0.5 else (j, i)
            own[whose].append(cs.near(f"{prefix}{other}", float(np.linalg.norm(place[i] - place[j]) * random.uniform(0.4, 1.0))))
    order = random.permutation(count)
    links = [(f"{prefix}{order[int(random.integers(k))]}", f"{prefix}{order[k]}") for k in range(1, count)]
    return [cs.Agent(f"{prefix}{i}", constraints) for i, constraints in enumerate(own)], links


@pytest.fixture(scope="module")
@float64
def tangles() -> tuple[Talk, np.ndarray]:
    """A dozen teams, as the clusters of one; and (N,) the best margin of each agent's own."""
    random = np.random.default_rng(0)
    made = [tangle(random, int(random.integers(3, 8)), f"t{k}_") for k in range(12)]
    team = cs.Team([agent for agents, _ in made for agent in agents], [link for _, links in made for link in links])
    best, cluster = reference(team), clusters(team)
    margins = np.asarray(Objective.at_positions(team).agent_margins(jnp.asarray(best.positions)))
    least = np.full(cluster.max() + 1, np.inf)
    np.minimum.at(least, cluster, margins)
    return Talk(team), least[cluster]


@pytest.mark.parametrize(("loss", "late"), [(0.0, 0), (0.3, 0), (0.3, 5), (0.7, 0)])
def test_no_bound_is_ever_false_whatever_is_lost_or_late(tangles, loss, late):
    talk, best = tangles
    talk.begin(seed=late)
    margins, bounds = talk.run(60, loss=loss, late=late, seed=1)
    assert (bounds >= best - 1e-6 * np.maximum(1, np.abs(best))).all()
    assert np.isfinite(bounds[-1]).all()  # relays without constraints prove as others do
    assert (bounds[-1][best < -0.1] < 0).all()
    if not loss:
        worst = np.array([margins[-1][best == value].min() for value in best])
        assert np.allclose(worst, best, atol=2e-3 * np.maximum(1, np.abs(best)).max())


def ring(count: int) -> cs.Team:
    agents = [cs.Agent(f"a{i}", [cs.near(f"a{(i + 1) % count}", 1.0)]) for i in range(count)]
    agents[0] = cs.Agent("a0", [cs.near("a1", 1.0), cs.within([2, 0], 1)])
    return cs.Team(agents, "ring")


def test_loops_narrow_enough_are_cut_open_and_wide_ones_proven_by_nobody(monkeypatch):
    team = ring(6)
    route, copies, *_ = route_of(team, "local")
    assert route == "tree"
    assert route_of(team, "local", exact=False).route == "links"
    assert Interior.of(team, copies, scale(team)).plan.exact
    monkeypatch.setattr("consat.protocols.local.interior.routes.WIDE", 3)
    route, copies, why, _ = route_of(team, "local")
    assert route == "links"
    assert "more than 3" in why
    talk = Talk(team, along=(route, copies))
    assert not talk.interior.plan.exact
    talk.begin()
    margins, bounds = talk.run(30)
    assert margins[-1].min() > 0
    assert np.isinf(bounds).all()


def inverse(p, q):
    return 1.0 - 0.1 / jnp.sum((p - q) ** 2)


def rooted(p):
    return jnp.sqrt(4.0 - jnp.sum(p**2)) - 1.0


def test_nothing_that_is_no_number_enters_a_state():
    """Poles where bodies coincide, a domain that ends, and a start outside it."""
    agents = [cs.Agent("a", [cs.constraint(rooted, ["a"])]), cs.Agent("b", [cs.constraint(inverse, ["b", "a"]), cs.near("a", 2)])]
    agents.append(cs.Agent("c", [cs.near("b", 1)]))
    talk = Talk(cs.Team(agents, "line"), InteriorPoint())
    for x in (np.zeros((talk.copies.count, 2)), np.full((talk.copies.count, 2), 1.5)):
        talk.begin(x)
        margins, _ = talk.run(25)
        assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(talk.memory._replace(bound=jnp.zeros(3))))
        assert margins[-1].min() > 0


def test_agents_alone_and_without_constraints_stay_where_they_are():
    talk = Talk(cs.Team([cs.Agent("a", [cs.within([0, 0], 1)]), cs.Agent("b")], links=[]))
    talk.begin(np.array([[3.0, 0.0], [5.0, 5.0]]))
    margins, bounds = talk.run(15)
    assert margins[-1][0] == pytest.approx(1.0, abs=1e-3)
    assert bounds[-1][0] == pytest.approx(1.0, abs=1e-2)
    assert np.allclose(talk.memory.y[1], [5.0, 5.0])


def test_a_team_in_millimetres_and_the_same_in_kilometres_take_the_same_rounds():
    found = []
    for unit in (1e-3, 1e3):
        talk = Talk(case("c", unit=unit))
        talk.begin()
        found.append(talk.run(25)[0].min(axis=1) / unit**2)
    assert np.allclose(*found, rtol=1e-5, atol=1e-7)
    assert found[0][-1] == pytest.approx(MARGINS["c"], abs=1e-3)


def test_a_proof_speaks_of_wherever_constraints_lead() -> None:
    """A chain of displacements leads far beyond the team's places, and a changed goal does: no bound is below what can be had there."""
    agents = [
        cs.Agent(f"a{k}", [cs.displacement(f"a{k - 1}", [1, 0], 0.3)] if k else [cs.within([0, 0], 1)], start=[k, 0]) for k in range(30)
    ]
    result = cs.run(cs.Team(agents, links="line"), protocol="max-min", rounds=120)
    bound = result.data["bound"].values
    assert np.isfinite(bound).any()
    assert np.nanmin(bound) >= 0.09
    session = cs.Session(cs.Team([cs.Agent("a", [cs.within([0, 0], 1, name="goal")]), cs.Agent("b", [cs.near("a", 1)])]))
    session.step(10).change("a", "goal", center=[3000, 0])
    for _ in range(60):
        assert session.step().known != "infeasible"
    assert session.satisfied


def test_copies_that_move_steadily_are_predicted_and_others_are_not():
    end = 1.98
    lanes = SimpleNamespace(
        any_moves=True,
        moves=jnp.array([True, True, False, True]),
        used=jnp.ones((1, 4), bool),
        psi=lambda y: jnp.where(y[:1, 0] < jnp.array([[jnp.inf, jnp.inf, jnp.inf, end]]), 1.0, -jnp.inf),
    )
    zero = jnp.zeros(4)
    memory = Memory(jnp.zeros((1, 2, 4)), jnp.zeros((1, 2, 4)), jnp.zeros((0, 4)), *[zero] * (len(Memory._fields) - 3))
    steps = np.array([[[0.04, 0.04, 0.04, 0.04], [0.03, 0.03, 0.03, 0.03]]])
    for k in range(49):  # the second lane goes to and fro; the fourth has come to where its ψ ends
        assert k > 10 or (predicted(lanes, memory) == memory.y).all()
        there = memory.y + steps * np.array([1.0, (-1.0) ** k, 1.0, 1.0])
        memory = memory._replace(y=there, age=memory.age + 1, **observed(lanes, memory, there))
    moved = np.asarray(predicted(lanes, memory) - memory.y)[0]
    np.testing.assert_allclose(moved[:, 0], [0.04, 0.03], rtol=0.05)
    np.testing.assert_allclose(moved[:, 1], 0.0, atol=1e-3)
    np.testing.assert_array_equal(moved[:, 2:], 0.0)
