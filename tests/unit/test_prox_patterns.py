"""Agents batched by pattern against the same agents padded, one by one, and among many others: what an agent computes is its own affair."""

from __future__ import annotations

from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import consat as cs
from consat.numerics import float64
from consat.problem.objective import Nu
from consat.protocols.estimates import Estimates
from consat.protocols.local import proximal as prox
from consat.protocols.local.lanewise import LOOPED
from consat.protocols.local.proximal import batches
from consat.protocols.local.proximal.hessians import UNROLLED, Alike, Dense, solve_symmetric
from consat.protocols.local.proximal.lanes import variance

EXACT = prox.Precision(1e-10)
ONE_STEP = prox.Precision(None)
ROUNDS = 30


@float64
def steps(team: cs.Team, precision: prox.Precision, count: int, *, convex: bool, v: np.ndarray, kappa: float = 2.0) -> np.ndarray:
    """Where so many steps towards the same points lead, each from where the last ended."""
    copies = Estimates.of(team, "local")
    plan = prox.buckets(team, copies.rows, copies.count, convex)
    nu, weight = Nu(jnp.asarray(5.0), jnp.asarray(5.0)), jnp.full(copies.count, kappa)

    @jax.jit
    def again(plan: prox.Plan, x: jax.Array, memory: prox.Memory) -> tuple[jax.Array, prox.Memory, jax.Array]:
        return prox.step(plan, nu, jnp.asarray(v), weight, x, memory, offset=0.0, precision=precision)

    x = jnp.asarray(v)
    memory = prox.recall(plan, nu, x, weight)
    for _ in range(count):
        x, memory, _ = again(plan, x, memory)
    return np.asarray(x)


def starts(team: cs.Team, box: float = 4.0) -> np.ndarray:
    return np.random.default_rng(3).uniform(-box, box, (Estimates.of(team, "local").count, 2))


@pytest.fixture
def by_pattern(monkeypatch: pytest.MonkeyPatch) -> Callable[[], None]:
    return lambda: monkeypatch.setattr(batches, "SMALL_TEAM", 0)


@pytest.mark.parametrize(("name", "convex"), [("convoy", True), ("lattice", True), ("swarm", False)])
def test_patterns_and_padding_agree(name: str, convex: bool, by_pattern: Callable[[], None]) -> None:
    team = cs.load(name, ["count=30"]).team
    v = starts(team)
    padded = steps(team, EXACT, 1, convex=convex, v=v)
    by_pattern()
    plan = prox.buckets(team, Estimates.of(team, "local").rows, len(v), convex)
    if convex:  # both end at the one solution, to 1e-10 of the forces, which κ = 2 turns into lengths
        assert any(batch.known for batch in plan.batches)
        np.testing.assert_allclose(steps(team, EXACT, 1, convex=convex, v=v), padded, atol=1e-8)
    else:
        assert np.isfinite(steps(team, EXACT, 1, convex=convex, v=v)).all()


def test_one_step_at_a_time_ends_at_the_solution(by_pattern: Callable[[], None]) -> None:
    team = cs.load("convoy", ["count=30"]).team
    v = starts(team, 100.0)
    exact = steps(team, EXACT, 1, convex=True, v=v)
    by_pattern()
    # quadratic convergence: thirty steps are more than enough for all digits of 1e2
    np.testing.assert_allclose(steps(team, ONE_STEP, ROUNDS, convex=True, v=v), exact, atol=1e-8)


def test_many_chunks_are_one_chunk(by_pattern: Callable[[], None], monkeypatch: pytest.MonkeyPatch) -> None:
    """Chunks, halves and the gathering of those who are not done change nothing beyond rounding."""
    by_pattern()
    team = cs.load("convoy", ["count=700"]).team
    v = starts(team, 20.0)
    whole = [steps(team, ONE_STEP, count, convex=True, v=v) for count in (1, 3)]
    monkeypatch.setattr(batches, "NARROWEST", 8)
    monkeypatch.setattr(batches, "WIDEST", 32)
    parts = [steps(team, ONE_STEP, count, convex=True, v=v) for count in (1, 3)]
    for one, many in zip(whole, parts, strict=True):
        np.testing.assert_allclose(many, one, rtol=1e-12, atol=1e-12)  # the same iterations; programs of other shapes may fuse otherwise


@float64
@pytest.mark.parametrize("size", [1, 2, UNROLLED, UNROLLED + 1, LOOPED, LOOPED + 1, 4 * LOOPED + 1])
def test_small_systems_are_solved(size: int) -> None:
    random = np.random.default_rng(size)
    factor = random.normal(size=(5, size, size))
    matrix = factor @ factor.transpose(0, 2, 1) + np.eye(size)
    matrix[3] -= 2 * np.linalg.eigvalsh(matrix[3])[0] * np.eye(size) * (size > 1) + 3 * np.eye(size) * (size == 1) * matrix[3]
    right = random.normal(size=(5, size, 2))
    found, positive = solve_symmetric(jnp.asarray(np.moveaxis(matrix, 0, -1)), jnp.asarray(np.moveaxis(right, 0, -1)))
    definite = np.linalg.eigvalsh(matrix)[:, 0] > 0
    np.testing.assert_array_equal(positive, definite)
    for k in np.flatnonzero(definite):  # condition numbers up to 1e3
        np.testing.assert_allclose(np.asarray(found)[..., k], np.linalg.solve(matrix[k], right[k]), rtol=1e-9, atol=1e-10)


@float64
@pytest.mark.parametrize("constraints", [1, 2, 4])
def test_alike_is_its_matrix(constraints: int) -> None:
    """B ⊗ I + Σ w a aᵀ, by blocks and directions, against the matrix written out."""
    rows, d, lanes = 3, 2, 5
    random = np.random.default_rng(constraints)
    factor = random.normal(size=(rows, rows, lanes))
    block = np.einsum("ija,kja->ika", factor, factor)
    gradients, p = random.normal(size=(constraints, rows * d, lanes)), random.dirichlet(np.ones(constraints), lanes).T
    mean, terms = variance([jnp.asarray(g) for g in gradients], jnp.asarray(p))
    np.testing.assert_allclose(mean, np.einsum("ka,kna->na", p, gradients), atol=1e-14)
    away = gradients - np.einsum("ka,kna->na", p, gradients)
    whole = np.stack([np.kron(block[..., k], np.eye(d)) for k in range(lanes)], axis=-1) + np.einsum("ka,kna,kma->nma", p, away, away)
    alike, dense = Alike(jnp.asarray(block), terms, d), Dense(jnp.asarray(whole), None, convex=True)
    np.testing.assert_allclose(alike.diagonal(), dense.diagonal(), rtol=1e-12)
    numbers = jnp.asarray(random.uniform(size=(rows * d, lanes)))
    assert (np.asarray(alike.absolute(numbers)) >= np.asarray(dense.absolute(numbers)) * (1 - 1e-12)).all()
    kappa = jnp.asarray(np.repeat(random.uniform(0.5, 2.0, (rows, lanes)), d, axis=0))
    multiplier, right = jnp.asarray(random.uniform(0.1, 1e3, lanes)), jnp.asarray(random.normal(size=(rows * d, 2, lanes)))
    np.testing.assert_allclose(alike.solve(kappa, multiplier, right), dense.solve(kappa, multiplier, right), rtol=1e-8, atol=1e-10)


@float64
def test_variance_of_weights_that_have_vanished() -> None:
    """Of p = (0, 0, 1) there is no spread, and the mean is the third."""
    gradients = [jnp.full((2, 1), value) for value in (1.0, 2.0, 5.0)]
    mean, terms = variance(gradients, jnp.asarray([[0.0], [0.0], [1.0]]))
    np.testing.assert_array_equal(mean, gradients[2])
    np.testing.assert_array_equal(sum(weight for weight, _ in terms), 0.0)
