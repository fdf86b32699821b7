"""`solve`: the best margin, found centrally."""

from __future__ import annotations

import dataclasses
import os
from typing import Any

import numpy as np

from consat.certify.certificate import BINDING, bounds
from consat.numerics import float64
from consat.problem.team import Team
from consat.problem.units import scale
from consat.results.summaries import Verdict
from consat.runs.preparation import scenario_of, with_auxiliary
from consat.runs.summary import number
from consat.scenario import Scenario

SCHEMA = "consat.solve/1"
PROVEN = 1e-6
"""A margin that is proven to be so near the best possible, in the team's unit of ψ, is the best possible."""


class Solution(dict[str, Any]):
    """What ``consat solve --json`` prints (schema consat.solve/1), with its main entries as attributes.

    Attributes:
        team: that was solved; None if it is not known.
    """

    team: Team | None = None

    @property
    def margin(self) -> float | None:
        """The best margin that was found; None if it is unbounded."""
        margin: float | None = self["margin"]
        return margin

    @property
    def bounds(self) -> tuple[float | None, float | None]:
        """Between what the best possible margin lies, proven; None where nothing is."""
        lower, upper = self["bounds"]
        return lower, upper

    @property
    def verdict(self) -> Verdict:
        """Whether the constraints can all hold."""
        verdict: Verdict = self["verdict"]
        return verdict

    @property
    def positions(self) -> dict[str, list[float | None]]:
        """Where everybody stands, by id."""
        positions: dict[str, list[float | None]] = self["positions"]
        return positions

    @property
    def reasons(self) -> list[str]:
        """What binds or conflicts, in words."""
        reasons: list[str] = self["reasons"]
        return reasons

    def _repr_html_(self) -> str:
        from consat.views import notebook

        return notebook.solution(self, self.team)


@float64
def solve(team: Team | Scenario | str | os.PathLike[str], *, seed: int = 0, auxiliary: float | None = None) -> Solution:
    """Find the best margin that any formation can have, centrally, with a certificate; see `consat.certify.optimum.max_min`.

    Args:
        team: as in `run`.
        seed: of the starts, where there are many.
        auxiliary: as in `run`.

    Returns:
        what ``consat solve --json`` prints (schema consat.solve/1): ``proven`` says whether ``bounds`` show that no formation has a better
        margin, ``reasons`` what binds or conflicts, in words.
    """
    from consat.certify.optimum import max_min
    from consat.certify.reasons import explain

    scenario = scenario_of(team)
    if auxiliary is not None:
        scenario = with_auxiliary(scenario, auxiliary)
    problem = scenario.team
    optimum = max_min(problem, seed=seed)
    certificate = bounds(problem, optimum.positions, multipliers=optimum.multipliers)
    proven = certificate.upper is not None and certificate.upper - optimum.margin <= PROVEN * scale(problem).psi
    optimum = dataclasses.replace(optimum, exact=optimum.exact or proven)
    solution = Solution({
        "schema": SCHEMA,
        "scenario": scenario.name,
        "margin": number(optimum.margin),
        "bounds": [number(certificate.lower), None if certificate.upper is None else number(certificate.upper)],
        "proven": proven,
        "verdict": certificate.verdict,
        "positions": {agent: [number(x) for x in row] for agent, row in zip(problem.ids, optimum.positions, strict=True)},
        "binding": [
            {"agent": problem.ids[problem.owner[k]], "constraint": problem.names[k], "multiplier": float(optimum.multipliers[k])}
            for k in np.argsort(-optimum.multipliers, kind="stable")
            if optimum.multipliers[k] > BINDING
        ],
        "method": optimum.method,
        "auxiliary": None if auxiliary is None else _auxiliary(problem, auxiliary, optimum.multipliers),
        "reasons": explain(problem, optimum),
    })  # fmt: skip
    solution.team = problem
    return solution


def _auxiliary(team: Team, radius: float, multipliers: np.ndarray) -> dict[str, Any]:
    """Says that the auxiliary constraint was added, and on whom it binds: then the radius is too small."""
    from consat.certify.assumptions import binding_auxiliaries

    return {"radius": radius, "binding": binding_auxiliaries(team, multipliers, BINDING)}
