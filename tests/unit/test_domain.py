"""ψ that end somewhere are −∞ beyond, and nothing that is no number gets into margins, gradients or the states of a run."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import consat as cs
from consat.numerics import float64
from consat.problem.constraints.domain import Extended, extended
from consat.problem.constraints.library import KINDS
from consat.problem.objective import Nu, Objective

A = cs.Agent

ENDING: dict[str, Callable[..., Any]] = {
    "pole": lambda p, q: 3.0 - 1.0 / jnp.sum((p - q) ** 2),
    "log": lambda p, q: jnp.log(jnp.sum((p - q) ** 2)),
    "root": lambda p, q: jnp.sqrt(4.0 - jnp.sum((p - q) ** 2)) - 1.0,
    "power": lambda p, q: (4.0 - jnp.sum((p - q) ** 2)) ** 1.5 - 1.0,
    "exponential": lambda p, q: 1.0 - jnp.exp(jnp.sum((p - q) ** 2) - 9.0),
    "unlimited": lambda p, q: 1.0 / jnp.sum((p - q) ** 2) - 1.0,
}
OUTSIDE = {"pole": 0.0, "log": 0.0, "root": 3.0, "power": 3.0, "exponential": 40.0, "unlimited": 0.0}
"""A distance at which each is no finite number."""


@pytest.mark.parametrize("name", ENDING)
@float64
def test_value_and_derivatives_are_those_of_psi_inside_and_finite_outside(name: str) -> None:
    psi = ENDING[name]
    flat = lambda f: lambda x: f(x[:2], x[2:])  # noqa: E731
    inside, outside = jnp.array([0.3, -0.2, 1.1, 0.7]), jnp.array([0.0, 0.0, OUTSIDE[name], 0.0])
    for derivative in (lambda f: f, jax.grad, jax.hessian, lambda f: jax.jacfwd(jax.value_and_grad(f))):
        seen, true = (jax.tree.leaves(derivative(flat(f))(inside)) for f in (Extended(psi), psi))
        np.testing.assert_allclose(np.concatenate([np.ravel(s) for s in seen]), np.concatenate([np.ravel(t) for t in true]), rtol=1e-14)
    extension = flat(Extended(psi))
    assert extension(outside) == -np.inf
    assert not np.any(jax.grad(extension)(outside))
    assert not np.any(jax.jacfwd(jax.grad(extension))(outside))


def test_quadratics_pay_nothing() -> None:
    for kind in ("within", "outside", "near", "apart", "halfspace"):
        made = {"within": ([0, 0], 1), "outside": ([0, 0], 1), "near": ("b", 1), "apart": ("b", 1), "halfspace": ([1, 0], 1)}[kind]
        team = cs.Team([A("a", [KINDS[kind](*made)]), A("b", [])])
        (family,) = team.families
        assert extended(family.psi, family.arity, 2, family.parameters) is family.psi


@pytest.mark.parametrize("name", ENDING)
@float64
def test_gradients_of_others_go_on_where_one_ends(name: str) -> None:
    """p's disc still pulls; no weight, multiplier, objective or gradient is NaN."""
    disc = cs.within([9, 9], 1)
    both = cs.Team([A("p", [disc, cs.constraint(ENDING[name], reads=("p", "q"))]), A("q", [cs.within([0, 0], 1)])])
    alone = cs.Team([A("p", [disc]), A("q", [cs.within([0, 0], 1)])])
    x, nu = jnp.array([[0.0, 0.0], [OUTSIDE[name], 0.0]]), Nu(0.01, 0.01)
    seen, true = Objective.at_positions(both), Objective.at_positions(alone)
    np.testing.assert_array_equal(seen.agent_margins(x), [-np.inf, true.agent_margins(x)[1]])
    np.testing.assert_allclose(seen.gradient(x, nu), true.gradient(x, nu), rtol=1e-12)
    np.testing.assert_allclose(seen.ascent(x, nu), true.ascent(x, nu), rtol=1e-12)
    np.testing.assert_array_equal(seen.multipliers(x, nu), [0.0, 1.0, 0.0])
    assert seen.smooth_margin(x, nu) == -np.inf


@pytest.mark.parametrize(("name", "protocol"), [("root", None), ("exponential", "admm")])
def test_teams_are_satisfied_from_any_start(name: str, protocol: str | None) -> None:
    """The discs hold the two between 0 and 10 apart; every ψ has room there. Starts reach far beyond its domain."""
    team = cs.Team(
        [A("p", [cs.constraint(ENDING[name], reads=("p", "q")), cs.within([0, 0], 3)]), A("q", [cs.within([4, 0], 3)])],
    )
    for seed in range(3):
        result = cs.run(team, protocol=protocol, seed=seed)
        assert result.summary["status"] == "satisfied", (seed, result.summary["margin"])
        assert result.summary["rounds"] <= 100
        positions = np.array(list(result.summary["positions"].values()))
        assert cs.margins(team, positions).min() == pytest.approx(result.summary["margin"])


def test_estimates_on_a_pole_are_moved_off() -> None:
    """All begin at one point, where ψ is −∞ and has no gradient."""
    team = cs.Team([A("p", [cs.expr("3 - 1/norm2(p - q)")], start=[1, 1]), A("q", [], start=[1, 1])])
    assert cs.run(team, start=(1, 1)).summary["status"] == "satisfied"


def test_a_plateau_far_from_the_slope_is_left() -> None:
    flat = cs.expr("tanh(4 - norm2(p - q))")
    team = cs.Team([A("p", [flat], start=[0, 0]), A("q", [flat], start=[50, 0])])
    assert cs.run(team).summary["status"] == "satisfied"


@pytest.mark.parametrize(
    ("psi", "said"),
    [
        ("tanh(4 - norm2(p - q))", "psi of p's gap is violated and flat at the end (a plateau)"),
        ("sqrt(-1 - norm2(p - q))", "psi of p's gap is no finite number at the end"),
        ("1 - norm2(p - q)", None),
    ],
)
def test_who_cannot_know_where_to_go_is_named(psi: str, said: str | None) -> None:
    """No rounds: both stay where they are, 50 apart."""
    team = cs.Team([A("p", [cs.expr(psi, name="gap")], start=[0, 0]), A("q", [], start=[50, 0])])
    result = cs.run(team, rounds=0)
    assert result.summary["margin"] is None or result.summary["margin"] < 0
    if said is None:
        assert result.summary["warnings"] == []
    else:
        (warning,) = result.summary["warnings"]
        assert warning.startswith(said)
        assert "What would help: a start" in warning
        assert warning in str(result)


def test_an_agent_whose_psi_is_no_number_has_no_margin_to_tell() -> None:
    """Its other constraint's would be false."""
    team = cs.Team([A("p", [cs.expr("sqrt(-1 - norm2(p))"), cs.within([0, 0], 1)], start=[0, 0])])
    assert cs.run(team, rounds=0).summary["agents"]["p"]["margin"] is None
