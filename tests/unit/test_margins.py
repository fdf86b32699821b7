"""`cs.margins` against NumPy, at sizes where a compiler has been wrong, and what it says of positions that are none of the team's."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np
import pytest

import consat as cs

M = np.array([[1.0, 0.3, 0.2], [0.1, 1.2, 0.4], [0.2, 0.1, 0.9]])
ROOT = Path(__file__).parents[2]


def reach(count: int) -> cs.Team:
    """Own constraints in 3-D, a lambda each, as people write them."""
    return cs.Team(
        [
            cs.Agent(f"a{i}", [cs.constraint(lambda p: 1.0 - jnp.sum((jnp.asarray(M) @ p) ** 2), reads=(f"a{i}",), name="reach")])
            for i in range(count)
        ],
        links=[],
        dimension=3,
    )


@pytest.mark.parametrize("count", [16_384, 16_385, 20_000, 32_769])
def test_no_value_is_miscompiled(count: int) -> None:
    """jax 0.10.2 computes 3616 of 20,000 of these wrong on a CPU, by up to 58 (jax issue 39103): from 16,385 on sums are split up."""
    team = reach(count)
    assert len(team.families) == 1  # one function, whatever the number of its copies
    x = np.random.default_rng(0).normal(size=(count, 3))
    np.testing.assert_allclose(cs.margins(team, x), 1 - ((x @ M.T) ** 2).sum(axis=1), atol=1e-9)


def test_each_agent_has_the_least_of_its_own() -> None:
    team = cs.Team([cs.Agent("a", [cs.within([0, 0], 2), cs.halfspace([1, 0], 0.5)]), cs.Agent("b", [cs.near("a", 3)]), cs.Agent("c", [])])
    x = [[1.0, 0.0], [1.0, 4.0], [9.0, 9.0]]
    found = cs.margins(team, x)
    assert isinstance(found, np.ndarray)
    assert found.dtype == np.float64
    assert found.tolist() == [-0.5, -7.0, np.inf]
    assert cs.margins(team, dict(zip("abc", x, strict=True))).tolist() == found.tolist()
    assert cs.margins(cs.Team([cs.Agent("a", [cs.expr("log(a.x)")])]), [[-1.0, 0.0]]).tolist() == [-np.inf]


@pytest.mark.parametrize(
    ("positions", "said"),
    [
        (
            np.zeros((3, 2)),
            r"positions have shape \(3, 2\), but must be numbers of shape \(2, 2\): one row an agent, in the order of team.ids",
        ),
        (np.zeros((2, 3)), r"shape \(2, 3\), but must be numbers of shape \(2, 2\)"),
        ([0.0, 1.0], r"shape \(2,\), but"),
        ([["x", 0], [0, 0]], "but must be numbers of shape"),
        ([[0, 0], [1]], "but must be numbers of shape"),
        ([[0, 0], [np.nan, 0]], r"the position of 'b' is \[nan, 0.0\], but must be finite"),
        ({"a": [0, 0]}, "one position for each of the 2 agents, but there is none of 'b'"),
        ({"a": [0, 0], "b": [0, 0], "c": [0, 0]}, "but there is one of 'c', who is not in the team"),
    ],
)
def test_positions_that_do_not_fit_are_refused(positions: Any, said: str) -> None:
    with pytest.raises(cs.ConsatError, match=said):
        cs.margins(cs.Team([cs.Agent("a", [cs.within([0, 0], 1)]), cs.Agent("b", [])]), positions)


def test_what_is_no_team_is_refused() -> None:
    with pytest.raises(cs.ConsatError, match=r"takes a team, but got 'case-b'; of a scenario file, consat.load\(FILE\).team is one"):
        cs.margins("case-b", np.zeros((3, 2)))  # type: ignore[arg-type]


def test_a_release_that_miscompiles_is_not_installed() -> None:
    """0.10.2 is neither allowed nor locked."""
    assert '"jax>=0.10,!=0.10.2"' in (ROOT / "pyproject.toml").read_text()
    assert not re.search(r"^jax(lib)?==0\.10\.2$", (ROOT / "requirements.lock").read_text(), re.MULTILINE)


def test_own_functions_without_parameters_that_are_no_quadratics(tmp_path: Path) -> None:
    """A norm and a box, as scripts have them, with warnings as errors."""
    script = """
import jax.numpy as jnp, consat as cs
centre = jnp.array([3.0, 0.0, 0.0])
reach = cs.constraint(lambda a: 1.0 - jnp.linalg.norm(a - centre), reads=("a",), name="reach")
box = cs.constraint(lambda a: 1 - jnp.max(jnp.abs(a - jnp.array([3.0, 1.0, 0.0]))), reads=("a",), name="box")
for one in (reach, box):
    print(cs.run(cs.Team([cs.Agent("a", [one])], links=[], dimension=3), seed=1).summary["margin"])
"""
    told = subprocess.run([sys.executable, "-W", "error", "-c", script], capture_output=True, text=True, cwd=tmp_path, check=False)
    assert told.returncode == 0, told.stderr
    assert all(0.5 < float(line) <= 1.0 for line in told.stdout.split())
