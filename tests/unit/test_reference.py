import jax.numpy as jnp
import numpy as np
import pytest
from scipy.optimize import minimize

import consat as cs
from consat.certify.optimum import cluster_margins, concave_part, max_min
from consat.certify.quadratics import expand, values_and_gradients
from consat.problem.graphs import clusters
from tests.unit.teams import MARGINS, case, grid, many

SOLVER = 1e-7
"""Relative to the scale of ψ: Clarabel stops at 1e-9, its multipliers and the recentring cost two digits at most."""


@pytest.mark.parametrize("letter", "abcd")
def test_cases_of_the_paper(letter: str) -> None:
    optimum = max_min(case(letter))
    assert optimum.exact
    assert optimum.margin == pytest.approx(MARGINS[letter], abs=6e-6)  # printed to five digits
    assert optimum.multipliers.sum() == pytest.approx(1, abs=1e-12)  # normalised by us


def test_case_e_is_the_triangle_of_equal_sides() -> None:
    """1 − s² = s² − 0.2² at the best side s; agent 1's disc does not bind."""
    optimum = max_min(case("e"))
    assert not optimum.exact
    assert "exact" not in optimum.method
    assert optimum.margin == pytest.approx((1 - 0.04) / 2, abs=1e-6)  # polishing stops at 1e-9 of ψ; 1e-6 leaves room for a flat optimum


def test_two_discs_meet_in_the_middle() -> None:
    team = cs.Team([cs.Agent("a", [cs.within([0, 0, 0], 1), cs.within([0, 3, 0], 1)])], dimension=3)
    optimum = max_min(team)
    assert optimum.margin == pytest.approx(1 - 1.5**2, abs=SOLVER)
    np.testing.assert_allclose(optimum.positions, [[0, 1.5, 0]], atol=1e-6)
    np.testing.assert_allclose(optimum.multipliers, [0.5, 0.5], atol=1e-6)


def test_weights_shift_the_balance() -> None:
    """w (1 − x²) = 1 − (3 − x)² at the optimum between the discs."""
    team = cs.Team([cs.Agent("a", [cs.within([0, 0], 1, weight=4.0), cs.within([3, 0], 1)])])
    x = np.roots([3.0, 6.0, -12.0]).max()  # 4 (1 − x²) = 1 − 9 + 6x − x²
    optimum = max_min(team)
    assert optimum.positions[0, 0] == pytest.approx(x, abs=1e-6)
    assert optimum.margin == pytest.approx(4 * (1 - x**2), abs=1e-6)


@pytest.mark.parametrize("unit", [1e-3, 1.0, 1e3, 1e6])
def test_units_do_not_matter(unit: float) -> None:
    one, scaled = max_min(case("d")), max_min(case("d", unit))
    assert scaled.margin == pytest.approx(unit**2 * one.margin, rel=1e-6)
    np.testing.assert_allclose(scaled.multipliers, one.multipliers, atol=1e-6)


def test_far_from_the_origin() -> None:
    """At 1e6 a ψ of size 1 is only known to 1e6 · ε · slope ≈ 1e-9."""
    assert max_min(case("d", offset=1e6)).margin == pytest.approx(max_min(case("d")).margin, abs=1e-7)


def test_every_cluster_is_maximised_for_itself() -> None:
    team = cs.Team([cs.Agent("bad", [cs.within([0, 0], 1), cs.within([4, 0], 1)]), cs.Agent("good", [cs.within([9, 9], 2e3)])])
    optimum = max_min(team)
    assert optimum.margin == pytest.approx(-3, abs=SOLVER)
    np.testing.assert_allclose(optimum.positions[1], [9, 9], atol=1e-3)  # of a disc of 2e3: its top is flat
    np.testing.assert_allclose(optimum.multipliers, [0.5, 0.5, 1], atol=1e-6)


def test_multipliers_are_those_of_the_optimum() -> None:
    """Σ λ ∇ψ = 0 and λ (ψ − margin of the cluster) = 0."""
    team = many(100, seed=5, dimension=2)
    optimum = max_min(team)
    model, group = expand(team, optimum.positions), clusters(team)[team.owner]
    margins = cluster_margins(team, model.value, clusters(team))
    size = np.zeros(len(group))
    for block in model.blocks:
        size[block.number] = np.linalg.norm(block.gradient, axis=1)
    slope = np.abs(model.gradient(optimum.multipliers)).max(axis=1)
    steepest = np.zeros(len(margins))
    np.maximum.at(steepest, group, size)
    assert np.all(slope <= 1e-4 * steepest[clusters(team)] + 1e-9)  # square root of the solver's tolerance
    assert np.all(optimum.multipliers * (model.value - margins[group]) <= 1e-4 * np.abs(model.value))


@pytest.mark.parametrize("seed", range(4))
def test_agrees_with_an_independent_solver(seed: int) -> None:
    """SLSQP on (x, t); local methods are global for concave problems."""
    team = many(1, seed=100 + seed, dimension=2, decades=0)
    optimum = max_min(team)

    def slack(z: np.ndarray) -> np.ndarray:
        return values_and_gradients(team, z[:-1].reshape(-1, 2))[0] - z[-1]

    def slope(z: np.ndarray) -> np.ndarray:
        return np.hstack([expand(team, z[:-1].reshape(-1, 2)).jacobian().toarray(), -np.ones((len(team.owner), 1))])

    start = np.random.default_rng(seed).normal(size=(team.count, 2))
    first = np.append(start, values_and_gradients(team, start)[0].min())
    last = -np.eye(len(first))[-1]
    rule = {"type": "ineq", "fun": slack, "jac": slope}
    found = minimize(lambda z: -z[-1], first, jac=lambda _: last, method="SLSQP", constraints=rule, options={"maxiter": 500, "ftol": 1e-10})
    assert optimum.margin == pytest.approx(-found.fun, abs=1e-6)  # SLSQP's own stop, with room for a flat optimum


def test_smooth_concave_constraints() -> None:
    """1 − ‖·‖ about (±2, 0), softened by 1e-6, and a tether of 1: t = 1 − δ and t = 1 − (4 − 2δ)² at shift δ from the centres."""

    def soft(x: jnp.ndarray, center: jnp.ndarray) -> jnp.ndarray:
        return 1 - jnp.sqrt(1e-12 + jnp.sum((x - center) ** 2))

    right, left = (cs.constraint(soft, reads=(name,), center=np.array([c, 0.0])) for name, c in (("a", 2.0), ("b", -2.0)))
    optimum = max_min(cs.Team([cs.Agent("a", [right]), cs.Agent("b", [cs.near("a", 1), left])]))
    assert optimum.margin == pytest.approx((-9 + np.sqrt(33)) / 8, abs=1e-6)  # the softening, and 1e-9 of the polish


def test_the_seed_decides_and_nothing_else() -> None:
    one, same = (max_min(case("e"), seed=3) for _ in range(2))
    np.testing.assert_array_equal(one.positions, same.positions)


def test_no_limit() -> None:
    optimum = max_min(cs.Team([cs.Agent("a", [cs.halfspace([1, 0], 1)])]))
    assert optimum.unbounded
    assert optimum.margin > 0


def test_one_cluster_without_limit_does_not_spoil_the_others() -> None:
    optimum = max_min(cs.Team([cs.Agent("a", [cs.halfspace([1, 0], 1)]), cs.Agent("b", [cs.within([0, 0], 2), cs.within([1, 0], 2)])]))
    assert not optimum.unbounded
    assert optimum.margin == pytest.approx(4 - 0.25, abs=SOLVER)


def test_teams_without_constraints() -> None:
    assert max_min(cs.Team([cs.Agent("a"), cs.Agent("b")])).margin == np.inf
    assert max_min(cs.Team([cs.Agent("a"), cs.Agent("b", [cs.within([0, 0], 1)])])).margin == pytest.approx(1, abs=SOLVER)


def test_a_grid_of_five_hundred() -> None:
    """Two thousand constraints at once: the multipliers prove the margin (weak duality), so that no second solver is needed."""
    team = grid(500)
    optimum = max_min(team)
    model = expand(team, optimum.positions)
    assert optimum.multipliers @ model.value == pytest.approx(optimum.margin, abs=1e-5)
    assert np.abs(model.gradient(optimum.multipliers)).max() < 1e-4  # square root of the solver's tolerance


def test_the_concave_part_lies_below_and_is_exact_where_all_is_concave() -> None:
    team = cs.Team([cs.Agent("a", [cs.expr("a.x**2 - 2*a.y**2"), cs.within([1, 0], 1)])])
    at, y = np.array([[0.3, -0.2]]), np.array([[0.5, 0.7]])
    model = expand(team, at)
    lower = concave_part(model).values(y)
    expected = model.values(y) - [y[0, 0] ** 2, 0]  # the curvature of x² is what is left out
    np.testing.assert_allclose(lower, expected, atol=1e-12)  # rounding
