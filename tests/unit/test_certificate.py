import jax.numpy as jnp
import numpy as np
import pytest
from scipy.optimize import minimize

import consat as cs
from consat.certify.certificate import bounds
from consat.certify.levels import radii
from consat.certify.optimum import cluster_margins, max_min
from consat.certify.quadratics import expand, values_and_gradients
from consat.numerics import float64
from consat.problem.graphs import clusters
from consat.problem.objective import Nu, Objective, margin_bounds
from tests.unit.teams import MARGINS, case, grid, many

TABLE = {
    # ν: lower, Σ λψ at the maximiser of β, and the paper's interval (design, section 6)
    ("c", 5.0): (0.1220, 0.1875, -0.079, 0.279),
    ("c", 100.0): (0.1823, 0.1861, 0.173, 0.191),
    ("d", 5.0): (-0.1600, -0.0789, -0.344, 0.014),
    ("d", 100.0): (-0.0861, -0.0814, -0.094, -0.077),
}


@float64
def smooth_optimum(team: cs.Team, nu: float) -> np.ndarray:
    """The maximiser of β, by BFGS with a gradient from the weights."""
    objective = Objective.at_positions(team)

    def descent(flat: np.ndarray) -> tuple[float, np.ndarray]:
        x = flat.reshape(team.count, -1)
        weights = np.asarray(objective.multipliers(jnp.asarray(x), Nu(nu, nu)))
        gradients = values_and_gradients(team, x)[1]
        slope = np.zeros_like(x)
        for family, gradient in zip(team.families, gradients, strict=True):
            np.add.at(slope, family.agents, weights[family.number][:, None, None] * gradient)
        return -float(objective.smooth_margin(jnp.asarray(x), Nu(nu, nu))), -slope.ravel()

    x = np.zeros(team.count * 2)
    for _ in range(3):  # restarts: BFGS stalls at high ν
        x = minimize(descent, x, jac=True, method="BFGS", options={"gtol": 1e-11}).x
    return x.reshape(-1, 2)


@pytest.mark.parametrize(("letter", "nu"), TABLE)
@float64
def test_table_of_the_design(letter: str, nu: float) -> None:
    team, (lower, upper, low, high) = case(letter), TABLE[letter, nu]
    x = smooth_optimum(team, nu)
    with_nu = bounds(team, x, Nu(nu, nu), refine=False)
    half = 6e-5  # the table has four digits, the paper's interval three
    assert with_nu.lower == pytest.approx(lower, abs=half)
    objective = Objective.at_positions(team)
    psi = values_and_gradients(team, x)[0]
    weights, beta = (np.asarray(f(jnp.asarray(x), Nu(nu, nu))) for f in (objective.multipliers, objective.smooth_margin))
    assert weights @ psi == pytest.approx(upper, abs=half)
    assert MARGINS[letter] - 1e-5 <= with_nu.upper <= upper + half
    assert margin_bounds(team, float(beta), Nu(nu, nu)) == pytest.approx((low, high), abs=6e-4)


def test_nu_of_five_proves_case_d_infeasible_where_the_papers_interval_cannot() -> None:
    team = case("d")
    assert bounds(team, smooth_optimum(team, 5.0), Nu(5.0, 5.0), refine=False).verdict == "infeasible"


@pytest.mark.parametrize("off", [0.0, 1e-2, 1.0, 1e2])
@pytest.mark.parametrize("unit", [1e-3, 1.0, 1e3])
def test_refinement_is_sharp_wherever_it_starts(off: float, unit: float) -> None:
    team = case("d", unit)
    x = np.array([[0.96, 0], [-0.47, 0], [-0.96, 0]]) + off * np.random.default_rng(0).normal(size=(3, 2))
    found = bounds(team, unit * x)
    assert found.verdict == "infeasible"
    assert found.upper == pytest.approx(MARGINS["d"] * unit**2, abs=1e-5 * unit**2)  # MARGINS has five digits


@pytest.mark.parametrize(("seed", "dimension"), [(0, 2), (1, 2), (2, 3), (3, 1)])
def test_thousands_of_random_problems(seed: int, dimension: int) -> None:
    """A formation's margin can never exceed a valid upper bound: no tolerance there. 4 × 500 problems, each at four formations."""
    team = many(500, seed, dimension)
    cluster, random = clusters(team), np.random.default_rng(seed)
    optimum = max_min(team)
    best = cluster_margins(team, values_and_gradients(team, optimum.positions)[0], cluster)
    size = np.maximum(np.abs(best), np.ptp(optimum.positions) * 1e-9)
    for off, refine in ((0.0, False), (1e-2, False), (1.0, True), (100.0, False)):
        x = optimum.positions + off * random.normal(size=optimum.positions.shape)
        found = bounds(team, x, refine=refine)
        lower, upper = found.clusters.T
        assert np.all(lower <= best + 1e-6 * size + 1e-9)  # the solver's own error
        assert np.all(upper >= best)
        assert found.verdict != ("infeasible" if best.min() > 0 else "feasible")
        if refine:
            assert np.mean(upper <= best + 1e-3 * size + 1e-6) > 0.95
    proven = bounds(team, optimum.positions, refine=False, multipliers=optimum.multipliers).clusters[:, 1]
    assert np.all(proven >= best)
    assert np.mean(proven <= best + 1e-5 * size + 1e-7) > 0.99  # as sharp as the multipliers, 1e-9 in their own units


def test_infeasible_is_never_said_of_a_feasible_team() -> None:
    """Teams built around a formation that satisfies them by a hair."""
    random = np.random.default_rng(7)
    for _ in range(40):
        hidden, by = random.normal(size=(3, 2)), 10.0 ** random.uniform(-14, -1)
        centers = random.normal(size=(3, 2)) * 3
        agents = []
        for i, center in enumerate(centers):
            radius = np.sqrt(np.sum((hidden[i] - center) ** 2) + by)
            agents.append(cs.Agent(f"a{i}", [cs.within(center, radius), cs.within(2 * hidden[i] - center, radius)]))
        team = cs.Team(agents)
        assert values_and_gradients(team, hidden)[0].min() > -1e-12  # radius² and the distance round differently
        if values_and_gradients(team, hidden)[0].min() > 0:
            for x in (hidden, hidden + random.normal(size=(3, 2))):
                assert bounds(team, x).verdict != "infeasible"


def test_several_clusters_one_infeasible() -> None:
    team = cs.Team([cs.Agent("bad", [cs.within([0, 0], 1), cs.within([4, 0], 1)]), cs.Agent("good", [cs.within([9, 9], 2)])])
    found = bounds(team, np.zeros((2, 2)))
    assert found.verdict == "infeasible"
    assert found.upper == pytest.approx(-3, abs=1e-6)
    np.testing.assert_allclose(found.clusters[:, 1], [-3, 4], atol=1e-5)
    assert set(found.binding) == {0, 1, 2}


def test_not_concave_proves_nothing_but_what_its_concave_part_proves() -> None:
    assert bounds(cs.Team([cs.Agent("a", [cs.apart("b", 1)]), cs.Agent("b")]), np.zeros((2, 2))).upper is None
    team = cs.Team([cs.Agent("a", [cs.within([0, 0], 1), cs.within([3, 0], 1), cs.outside([0, 0], 0.1)])])
    found = bounds(team, np.zeros((1, 2)))
    assert found.verdict == "infeasible"
    assert found.multipliers[2] == 0


def test_bounds_of_a_team_that_only_knows_differences() -> None:
    """Translation invariant: no region holds anyone, and yet 1 is the best margin."""
    team = cs.Team([cs.Agent("a", [cs.near("b", 1)]), cs.Agent("b", [cs.near("a", 2)])])
    assert bounds(team, np.array([[0.0, 0], [5, 5]])).upper == pytest.approx(1, abs=1e-6)


@pytest.mark.parametrize("turn", [0.0, 0.7])
def test_bounds_in_a_corridor(turn: float) -> None:
    """Invariant along the corridor alone, whichever way it runs: y_a ≤ −3 and y_b ≥ −1 within 1 of each other: 1 − (2 − 2s)² = −s."""
    across = np.array([-np.sin(turn), np.cos(turn)])
    team = cs.Team([cs.Agent("a", [cs.halfspace(across, -3)]), cs.Agent("b", [cs.near("a", 1), cs.halfspace(-across, 1)])])
    exact = max_min(team).margin
    assert exact == pytest.approx(-0.40693, abs=1e-5)
    found = bounds(team, np.array([[0.3, -2], [0.1, -1.0]]), multipliers=max_min(team).multipliers)
    assert exact <= found.upper <= exact + 1e-6


def test_concave_constraints_beyond_degree_two() -> None:
    def soft(x: jnp.ndarray, center: jnp.ndarray) -> jnp.ndarray:
        return 1 - jnp.sum(jnp.exp(x - center)) - jnp.sum(jnp.exp(center - x))

    team = cs.Team([cs.Agent("a", [cs.constraint(soft, reads=("a",), center=np.array([2.0, 0])), cs.within([0, 0], 1)])])
    optimum = max_min(team)
    assert optimum.exact
    found = bounds(team, np.zeros((1, 2)))
    assert optimum.margin <= found.upper <= optimum.margin + 1e-3


def test_diverged_positions_prove_nothing() -> None:
    for value in (np.nan, np.inf):
        found = bounds(case("c"), np.full((3, 2), value))
        assert found.verdict == "undecided"
        assert found.upper is None


def test_where_a_margin_is_no_number_a_bound_from_elsewhere_holds() -> None:
    for letter, verdict in (("c", "undecided"), ("d", "infeasible")):
        found = bounds(case(letter), np.full((3, 2), 1e200))
        assert found.lower == -np.inf
        assert found.verdict == verdict
        assert MARGINS[letter] - 1e-5 <= found.upper <= MARGINS[letter] + 0.01


def test_no_bound_comes_from_where_a_constraint_ends() -> None:
    """log(9 − ‖p‖²) is best at 0, and −∞ from 3 on: there it has no tangent."""
    team = cs.Team([cs.Agent("p", [cs.expr("log(9 - norm2(p))")])])
    for x in ([0.0, 0.0], [2.9, 0.0], [3.0, 0.0], [50.0, 0.0]):
        found = bounds(team, np.array([x]))
        assert found.upper is None or found.upper >= np.log(9) - 1e-9
    assert bounds(team, np.zeros((1, 2))).upper == pytest.approx(np.log(9))


def test_a_grid_is_certified_by_its_multipliers() -> None:
    team = grid(300)
    optimum = max_min(team)
    found = bounds(team, optimum.positions, refine=False, multipliers=optimum.multipliers)
    assert found.lower <= found.upper <= found.lower + 1e-4 * abs(found.lower)


def test_radii_hold_everyone_who_is_better() -> None:
    """On a line, a ≤ 0 and −5 ≤ b within 2 of each other, seen from a = 0, b = −1 with margin 0: a is in [−7, 0] and b in [−5, 2]."""
    team = cs.Team([cs.Agent("a", [cs.halfspace([1], 0)]), cs.Agent("b", [cs.near("a", 2), cs.halfspace([-1], 5)])], dimension=1)
    radius = radii(expand(team, np.array([[0.0], [-1]])), np.zeros(3), clusters(team))
    assert 7 <= radius[0] < 20
    assert 4 <= radius[1] < 20


def test_radii_hold_the_optimum_of_random_problems() -> None:
    """Any two formations of which one is the better: the better one is within the radii of the other."""
    team = many(300, 11, 2)
    cluster, optimum = clusters(team), max_min(team)
    best = cluster_margins(team, values_and_gradients(team, optimum.positions)[0], cluster)
    for off in (1e-3, 1e-1, 10.0):
        x = optimum.positions + off * np.random.default_rng(0).normal(size=optimum.positions.shape)
        model = expand(team, x)
        margins = cluster_margins(team, model.value, cluster)
        radius = radii(model, margins[cluster[team.owner]], cluster)
        away = np.linalg.norm(optimum.positions - x, axis=1)
        assert np.all((away <= radius * (1 + 1e-9)) | (margins > best)[cluster])
        assert np.isfinite(radius).all()  # every cluster of these has a region
