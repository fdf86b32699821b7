"""Margins, smooth margins and gradients against the paper's formulas, finite differences and each other."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import consat as cs
from consat.engine.flows import Everyone, Problem
from consat.numerics import Groups, float64
from consat.problem.objective import Nu, Objective, SmoothingSchedule, margin_bounds
from consat.protocols import GradientFlow
from consat.protocols.estimates import Estimates
from consat.settings import Ramp, Smoothing
from tests import paper

NU = Nu(5.0, 3.0)


def team(case: str) -> cs.Team:
    return cs.load(case).team


@pytest.fixture(params=paper.CASES)
def case(request: pytest.FixtureRequest) -> str:
    return request.param


def positions(seed: int) -> np.ndarray:
    return np.random.default_rng(seed).uniform(-1.5, 1.5, (3, 2))


@float64
def gradient(team: cs.Team, x: np.ndarray, nu: Nu) -> np.ndarray:
    """∇f_i of every agent at one formation, (3, 3, 2), through the code that simulations use."""
    copies = Estimates.of(team, "full")
    schedule = SmoothingSchedule.of(Smoothing(nu_alpha=float(nu.alpha), nu_beta=float(nu.beta)))
    everyone = Everyone(Problem.of(team, copies, schedule), nu)
    return np.asarray(everyone.gradient(jnp.asarray(x)[copies.position])).reshape(3, 3, 2)


def test_gradient_is_the_closed_form(case: str) -> None:
    x = positions(1)
    expected = np.stack([paper.gradient(constraints, x, NU.beta) for constraints in paper.CASES[case]])
    np.testing.assert_allclose(gradient(team(case), x, NU), expected, rtol=1e-11, atol=1e-12)


@float64
def test_gradient_is_the_finite_difference(case: str) -> None:
    x, observer, step = positions(2), Objective.at_positions(team(case)), 1e-6

    def f(x: np.ndarray) -> np.ndarray:
        return np.exp(observer.log_objective(jnp.asarray(x), NU))

    found = gradient(team(case), x, NU)
    for j, k in np.ndindex(3, 2):
        shift = np.zeros((3, 2))
        shift[j, k] = step
        # central differences: error step² f''' ≈ 1e-9 of f, and rounding 1e-10 of f
        np.testing.assert_allclose(found[:, j, k], (f(x + shift) - f(x - shift)) / (2 * step), rtol=1e-6, atol=1e-6 * f(x).max())


@float64
def test_gradient_is_what_jax_finds(case: str) -> None:
    x, observer = jnp.asarray(positions(3)), Objective.at_positions(team(case))
    whole = jax.grad(lambda x: jnp.exp(observer.log_objective(x, NU)).sum())(x)
    np.testing.assert_allclose(gradient(team(case), np.asarray(x), NU).sum(axis=0), whole, rtol=1e-11, atol=1e-12)


@float64
def test_margins_keep_the_papers_order(case: str) -> None:
    observer = Objective.at_positions(team(case))
    for seed in range(20):
        x = jnp.asarray(positions(seed))
        margin, smooth = float(observer.agent_margins(x).min()), float(observer.smooth_margin(x, NU))
        low, high = margin_bounds(team(case), smooth, NU)
        assert low <= margin <= high
        np.testing.assert_allclose(
            observer.log_objective(x, NU), [paper.log_objective(c, np.asarray(x), NU.beta) for c in paper.CASES[case]], rtol=1e-12
        )


@float64
def test_multipliers_lie_in_the_simplex_and_point_at_the_worst() -> None:
    observer = Objective.at_positions(team("case-c"))
    x = jnp.array([[9.0, 0.0], [-0.5, 0.0], [-1.1, 0.0]])
    multipliers = observer.multipliers(x, NU)
    assert float(multipliers.sum()) == pytest.approx(1.0, abs=1e-12)
    assert int(jnp.argmax(multipliers)) == int(jnp.argmin(observer.psi(x)))


@float64
def test_log_domain_survives_what_the_objective_cannot() -> None:
    observer = Objective.at_positions(team("case-b"))
    x = jnp.full((3, 2), 1e6)
    assert np.isfinite(observer.smooth_margin(x, Nu(1e3, 1e3)))
    assert np.isfinite(observer.multipliers(x, Nu(1e3, 1e3))).all()
    assert np.isfinite(observer.ascent(x, Nu(1e3, 1e3))).all()


@float64
def test_weight_multiplies_psi() -> None:
    agents = [cs.Agent("a", [cs.within([0, 0], 1), cs.within([0, 0], 1, weight=2.5)])]
    x = jnp.array([[0.3, 0.4]])
    np.testing.assert_allclose(Objective.at_positions(cs.Team(agents)).psi(x), [0.75, 2.5 * 0.75])


@float64
def test_agent_without_constraints_has_no_objective() -> None:
    lone = cs.Team([cs.Agent("a", [cs.within([0, 0], 1)]), cs.Agent("b")])
    observer, x = Objective.at_positions(lone), jnp.zeros((2, 2))
    assert observer.agent_margins(x).tolist() == [1.0, np.inf]
    assert observer.log_objective(x, NU).tolist()[1] == -np.inf
    assert np.isfinite(observer.ascent(x, NU)).all()
    assert float(observer.smooth_margin(x, NU)) == pytest.approx(1.0)


@float64
def test_families_in_any_order_give_the_constraints_in_the_teams_order() -> None:
    agents = [
        cs.Agent("a", [cs.within([0, 0], 3), cs.near("b", 2), cs.within([1, 0], 4)]),
        cs.Agent("b", [cs.near("a", 5), cs.outside([4, 0], 1), cs.expr("9 - norm2(b)")]),
    ]
    x = jnp.array([[1.0, 0.0], [0.0, 2.0]])
    observer = Objective.at_positions(cs.Team(agents))
    np.testing.assert_allclose(observer.psi(x), [9 - 1, 4 - 5, 16, 25 - 5, 20 - 1, 9 - 4])
    assert [len(batch.weight) for batch in observer.batches] == [2, 2, 1, 1]
    ascent = observer.ascent(x, NU)
    expected = -jax.grad(lambda x: (observer.log_objective(x, NU) / NU.beta).sum())(x)
    np.testing.assert_allclose(ascent, expected, rtol=1e-12)


def test_ramp_ends_where_the_paper_says() -> None:
    with jax.enable_x64(True):
        schedule = SmoothingSchedule.of(Smoothing(nu_alpha=5, nu_beta=Ramp(start=0.01, to=5, rate=0.022)))
        assert [float(schedule.at(t).beta) for t in (0.0, 100.0, 300.0)] == pytest.approx([0.01, 2.21, 5.0])
        assert schedule.duration == pytest.approx(4.99 / 0.022)


@pytest.mark.parametrize("sizes", [[2, 2, 2], [1, 1, 1], [3, 0, 2], [0, 0, 1], [40, 1, 1, 1, 1, 1, 1, 1, 1, 1, 1, 1], []])
@pytest.mark.parametrize("shuffled", [False, True])
@float64
def test_groups_sum_and_reduce_like_a_loop(sizes: list[int], shuffled: bool) -> None:
    group = np.repeat(np.arange(len(sizes)), sizes)
    random = np.random.default_rng(0)
    if shuffled:
        random.shuffle(group)
    values = random.normal(size=len(group))
    groups = Groups.of(group, len(sizes))
    members = [values[group == g] for g in range(len(sizes))]
    np.testing.assert_allclose(groups.sum(jnp.asarray(values)), [m.sum() for m in members])
    np.testing.assert_allclose(groups.max(jnp.asarray(values)), [m.max(initial=-np.inf) for m in members])
    totals, weights = groups.logsumexp(jnp.asarray(values))
    np.testing.assert_allclose(totals, [np.log(np.exp(m).sum()) if len(m) else -np.inf for m in members], rtol=1e-12)
    np.testing.assert_allclose(groups.sum(weights), [1.0 if len(m) else 0.0 for m in members], rtol=1e-12)
    np.testing.assert_allclose(groups.spread(jnp.arange(float(len(sizes)))), group)


def test_gains_are_the_papers() -> None:
    assert (GradientFlow().k1, GradientFlow().k2) == (1.0, 1.0)
