"""`solve`: compute the best margin of a team centrally."""

from __future__ import annotations

import dataclasses
import os
from typing import Any

import numpy as np

from consat.certify.certificate import BINDING, bounds
from consat.numerics import float64, number
from consat.problem.team import Team
from consat.problem.units import scale
from consat.results.summaries import Verdict
from consat.runs.preparation import scenario_of, with_auxiliary
from consat.scenario import Scenario

SCHEMA = "consat.solve/1"
PROVEN = 1e-6
"""Largest gap between margin and proven bound, in the team's unit of ψ, at which the margin counts as the best possible."""


class Solution(dict[str, Any]):
    """The document that ``consat solve --json`` prints (schema consat.solve/1), with its main entries as attributes.

    Attributes:
        team: the team that was solved; None if unknown.
    """

    team: Team | None = None

    @property
    def margin(self) -> float | None:
        """The best margin found; None if it is unbounded."""
        margin: float | None = self["margin"]
        return margin

    @property
    def bounds(self) -> tuple[float | None, float | None]:
        """Proven lower and upper bounds on the best possible margin; None where there is no bound."""
        lower, upper = self["bounds"]
        return lower, upper

    @property
    def verdict(self) -> Verdict:
        """Whether all constraints can hold: ``feasible``, ``infeasible`` or ``undecided``."""
        verdict: Verdict = self["verdict"]
        return verdict

    @property
    def positions(self) -> dict[str, list[float | None]]:
        """Positions of the agents in the formation found, by id."""
        positions: dict[str, list[float | None]] = self["positions"]
        return positions

    @property
    def reasons(self) -> list[str]:
        """Sentences about the binding or conflicting constraints."""
        reasons: list[str] = self["reasons"]
        return reasons

    def _repr_html_(self) -> str:
        from consat.views import notebook

        return notebook.solution(self, self.team)


@float64
def solve(team: Team | Scenario | str | os.PathLike[str], *, seed: int = 0, auxiliary: float | None = None) -> Solution:
    """Compute the best margin of any formation centrally, with a certificate; see `consat.certify.optimum.max_min`.

    Args:
        team: as in `run`.
        seed: random seed of the starts, where the method uses several.
        auxiliary: as in `run`.

    Returns:
        The document that ``consat solve --json`` prints (schema consat.solve/1). ``proven`` tells whether ``bounds`` prove that no
        formation has a better margin; ``reasons`` are sentences about the binding or conflicting constraints.
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
    """The entry ``auxiliary`` of the document: the radius, and the agents on which it binds, for which it is too small."""
    from consat.certify.assumptions import binding_auxiliaries

    return {"radius": radius, "binding": binding_auxiliaries(team, multipliers, BINDING)}
