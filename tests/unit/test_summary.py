"""What is told of a run and of a solution is no more than what is proven, and what to do is said."""

import re

import numpy as np
import pytest

import consat as cs
from consat.certify.assumptions import report
from consat.certify.optimum import max_min
from consat.runs.summary import status_of
from consat.views import tables, words
from tests.unit.teams import case


@pytest.mark.parametrize(
    ("margin", "upper", "psi", "status"),
    [
        (-0.16, -0.0814, 1.0, "not-converged"),  # the paper's point of case D: twice the violation that is unavoidable
        (-24.0, -1.68, 1.0, "not-converged"),
        (-1.76, -1.68, 1.0, "least-violating"),  # within 5 %
        (-1.77, -1.68, 1.0, "not-converged"),
        (-0.0019, -0.001, 1.0, "least-violating"),  # within 1e-3
        (-0.0021, -0.001, 1.0, "not-converged"),
        (-0.0019, -0.001, 1e-3, "not-converged"),  # … of a team whose ψ are thousandths
        (-0.0019, -0.001, 1e3, "least-violating"),
        (-0.0004, 0.0004, 1.0, "not-converged"),  # near the best, but nothing proves that the constraints cannot all hold
        (-1e-9, None, 1.0, "not-converged"),
        (-np.inf, -1.0, 1.0, "not-converged"),
        (np.nan, -1.0, 1.0, "not-converged"),
        (1e-9, None, 1.0, "satisfied"),
        (np.inf, None, 1.0, "satisfied"),  # no constraints
    ],
)
def test_least_violating_is_said_only_where_it_is_proven(margin: float, upper: float | None, psi: float, status: str) -> None:
    assert status_of("settled", margin, upper, psi) == status
    assert status_of("diverged", margin, upper, psi) == "diverged"


def test_of_an_infeasible_team_the_best_margin_is_least_violating_and_a_worse_one_comes_with_what_to_do() -> None:
    best = cs.run(case("d"), protocol="max-min")
    assert best.summary["status"] == "least-violating"
    assert best.summary["margin"] == pytest.approx(max_min(case("d")).margin, abs=1e-3)
    assert "what to do" not in str(best)
    worse = cs.run(case("d"), protocol="proximal", rounds=30)
    assert worse.summary["status"] == "not-converged"
    assert worse.summary["verdict"] == "infeasible"
    assert "--protocol max-min" in str(worse)
    assert "--stop converged" in str(worse)


def test_a_team_without_constraints_is_satisfied() -> None:
    assert cs.run(cs.Team([cs.Agent("a")], dimension=2)).summary["status"] == "satisfied"


@pytest.mark.parametrize(
    ("ending", "protocol", "said"),
    [
        ("out of time", "admm", ["--protocol max-min", "--stop converged"]),
        ("settled", "gradient-flow", ["--protocol max-min"]),
        ("out of time", "max-min", ["--rounds"]),
        ("settled", "max-min", ["--restarts"]),
        ("interrupted", "admm", []),
    ],
)
def test_what_to_do_is_said_of_a_run_that_did_not_converge(ending: str, protocol: str, said: list[str]) -> None:
    summary = cs.run(case("d"), rounds=0).summary | {"ending": ending, "protocol": protocol}
    text = words.summary(summary)
    assert ("what to do" in text) == bool(said)
    assert all(option in text for option in said)
    assert ("--stop" in text) == ("--stop converged" in said)


@pytest.mark.parametrize(
    ("constraints", "proven", "said"),
    [
        # not concave, but the pillar does not matter, and what is left is proven
        ([cs.within([0, 0], 1), cs.outside([5, 5], 1)], True, "best margin 1, proven: none is better"),
        ([cs.within([0, 0], 1), cs.outside([0, 0], 0.5)], False, "best margin found 0.375; proven: none is better than 1"),
        ([], False, "best margin unbounded"),
    ],
)
def test_a_solution_is_the_best_possible_or_the_best_found_and_never_both(
    constraints: list[cs.Constraint], proven: bool, said: str
) -> None:
    answer = cs.solve(cs.Team([cs.Agent("a", constraints)], dimension=2))
    assert answer["proven"] is proven
    text = "\n".join(part for part in tables.solve(answer) if isinstance(part, str))
    assert f"  {said}\n" in text
    assert ("found" in text) == (not proven and bool(constraints))
    assert "not the best possible" not in text


def test_one_is_not_many() -> None:
    team = cs.Team([cs.Agent("a", [cs.within([0, 0], 1)])])
    findings = tables.check("one", report(team))
    run = cs.run(team, rounds=1)
    text = "\n".join([*(part for part in findings if isinstance(part, str)), str(run), str(cs.sweep(team, rounds=1))])
    assert "1 agent, 1 constraint, 1 cluster\n" in text
    assert "effort          1 round, 0 messages, 0 numbers sent" in text
    assert "team: 1 run of interior-point" in text
    assert not re.findall(r"\b1 (?:agents|constraints|clusters|rounds|runs|seeds|messages|numbers|entries)", text)
