"""The best of many starts: where ψ are not concave the least violation depends on the start, and what is found is called found."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner

import consat as cs
from consat.cli.commands import cli
from consat.errors import InvalidSettings

CROWD = """consat: 1
agents:
  - {id: a1, constraints: [{kind: box, low: [-2, -1], high: [3, 1]}]}
  - id: a2
    constraints:
      - {kind: within, center: [0, 0], radius: 1}
      - {kind: apart, agent: a1, radius: 5.5}
communication: {graph: task}
"""
"""Two bodies that are too far apart: a1 goes to the left end of its box or to the right one, which is farther."""


def test_the_best_of_many_starts_is_the_run_from_that_start(tmp_path) -> None:
    file = tmp_path / "crowd.yaml"
    file.write_text(CROWD)
    single = [cs.run(file, seed=seed, protocol="max-min", rounds=60).summary for seed in range(1, 5)]
    margins = [told["margin"] for told in single]
    assert max(margins) < 0, "nobody satisfies this team"
    assert max(margins) - min(margins) > 1e-2, "starts end differently"
    result = cs.run(file, seed=1, protocol="max-min", rounds=60, restarts=4)
    told = result.summary
    best = int(np.argmax(margins))
    assert (told["seed"], told["restarts"]["seed"], told["restarts"]["count"], told["restarts"]["satisfied"]) == (1 + best, 1 + best, 4, 0)
    assert told["margin"] == pytest.approx(max(margins), abs=1e-9)
    assert told["restarts"]["margins"] == pytest.approx(margins, abs=1e-9)
    # nothing proves that this is the least violation, and nobody says so
    assert (told["status"], told["known"]) == ("not-converged", None)
    assert "the least found, not proven" in str(result)
    assert "4 starts" in str(result)


def test_restarts_on_the_command_line() -> None:
    done = CliRunner().invoke(cli, ["run", "case-e", "--restarts", "0"])
    assert "Invalid value for '--restarts': 0 is not in the range x>=1" in done.output


def test_restarts_go_with_protocols_in_rounds_alone() -> None:
    for options in ({"protocol": "gradient-flow"}, {"rate": 10.0}):
        with pytest.raises(InvalidSettings, match="restarts"):
            cs.run("case-e", restarts=2, **options)
    with pytest.raises(InvalidSettings, match="at least 1"):
        cs.run("case-e", restarts=0)


def test_a_run_looks_from_other_starts_by_itself_where_curvature_is_wild(tmp_path: Path) -> None:
    """A lesser maximum at 0 beside the one at 2π that satisfies."""
    team = cs.Team([cs.Agent("a", [cs.expr("cos(a[0]) - 0.05*(a[0] - 6.28)**2 - 0.5")])], dimension=1)
    alone = [cs.run(team, seed=seed, start=(-2, 8), restarts=1).summary["status"] for seed in range(4)]
    assert {"satisfied", "not-converged"} <= set(alone)
    seed = alone.index("not-converged")
    result = cs.run(team, seed=seed, start=(-2, 8), out=tmp_path / "run")
    told = result.summary
    assert (told["status"], told["restarts"]["count"]) == ("satisfied", 5)
    assert told["seed"] == told["restarts"]["seed"] != seed
    assert "5 starts" in str(result)
    assert cs.Result.load(tmp_path / "run" / "result.nc").summary["seed"] == told["seed"]
    again = cs.run(team, seed=told["seed"], start=(-2, 8)).summary
    assert (again["margin"], again["restarts"]) == (told["margin"], None)
    assert cs.run(team, seed=seed, start=(-2, 8), rounds=50).summary["status"] == "not-converged", "one run is asked for"
