"""Summary of a run, as a JSON document: how it ended, and its measures."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from consat import __version__
from consat.certify.certificate import bounds
from consat.numerics import number, on_device
from consat.problem.graphs import members
from consat.problem.objective import Objective, SmoothingSchedule, weigh
from consat.problem.team import Team
from consat.problem.units import Scale
from consat.results.trace import Trace
from consat.runs.advice import warnings_of
from consat.runs.verdicts import verdicts
from consat.scenario import Scenario
from consat.scenario.robots import Robots, blocked_goals
from consat.settings import Settings

SCHEMA = "consat.run/1"
MOST_LISTED = 10_000
"""Largest number of agents that the summary lists one by one."""
NEAR = 0.05
"""Relative gap to the proven bound up to which a formation counts as least violating."""
NEARLY = 1e-3
"""Absolute gap to the proven bound up to which a formation counts as least violating, times the team's unit of ψ or 1, if that is less."""


def summarise(
    scenario: Scenario, settings: Settings, schedule: SmoothingSchedule, size: Scale, trace: Trace, *, full: bool = False,
    robots: Robots | None = None, since: float = 0.0,
) -> dict[str, Any]:  # fmt: skip
    """The document that ``run --json`` prints (schema consat.run/1).

    Args:
        scenario: the scenario.
        settings: resolved settings.
        schedule: schedule of ν.
        size: the team's natural scale.
        trace: trace of the run.
        full: whether to list every agent, also above `MOST_LISTED` agents.
        robots: the robots; None for points.
        since: the time from which the constraints of the scenario were in force, s; verdicts over time begin there.
    """
    whole, position = scenario.team, trace.end
    team = whole.at(float(trace.steps[-1]) * (trace.period or 1.0))
    nu = schedule.final
    margins, multipliers = map(np.asarray, weigh(Objective.at_positions(team), on_device(position), nu))
    margin = float(margins.min(initial=np.inf))
    certificate = bounds(team, position, nu)
    listed = full or team.count <= MOST_LISTED
    period = 1.0 if trace.clock == "time" else trace.period
    return {
        "schema": SCHEMA,
        "scenario": scenario.name,
        "version": __version__,
        "protocol": settings.protocol.kind,
        "estimates": settings.protocol.estimates,
        "seed": settings.start.seed,
        "status": status_of(trace.ending, margin, certificate.upper, size.psi),
        "verdict": certificate.verdict,
        "margin": number(margin),
        "smooth_margin": number(trace.smooth_margin[-1]),
        "bounds": [number(certificate.lower), None if certificate.upper is None else number(certificate.upper)],
        "satisfied_from": {
            "time": None if trace.satisfied_from is None or period is None else trace.satisfied_from * period,
            "round": None if trace.satisfied_from is None or trace.clock != "round" else int(trace.satisfied_from),
        },
        "known": trace.known,
        "known_from": trace.known_from,
        "rounds": int(trace.steps[-1]) if trace.clock == "round" else None,
        "time": float(trace.steps[-1]) if trace.clock == "time" else None,
        "ending": trace.ending,
        "messages": trace.messages,
        "floats_sent": trace.floats_sent,
        "bytes": trace.bytes,
        "positions": {agent: [number(x) for x in row] for agent, row in zip(team.ids, position, strict=True)} if listed else None,
        "agents": _agents(team, margins, multipliers, trace.violated) if listed else None,
        "clusters": members(team, trace.cluster) if listed else None,
        "motion": trace.motion,
        "verdicts": _verdicts(whole, trace, since) if whole.moves else None,
        "on_the_way": None if trace.violated is None else _on_the_way(team, trace.violated),
        "count": team.count,
        "warnings": [
            *([] if robots is None else blocked_goals(robots, whole)),
            *warnings_of(
                team, trace, schedule.at(float(trace.steps[-1])) if trace.clock == "time" else nu, size, str(settings.protocol.kind)
            ),
        ],
        "result": None,
        "seconds": {key: round(value, 4) for key, value in trace.seconds.items()},
    } | ({"robots": None, "obstacles": None} if robots is None else robots.entries)


def _verdicts(team: Team, trace: Trace, since: float) -> list[dict[str, Any]]:
    """Certified verdicts over the time of a run from `since`, s; see `consat.runs.verdicts`."""
    period = trace.period or 1.0
    recorded = trace.recorded is None and trace.file is None

    def seen(time: float) -> np.ndarray | None:
        if not recorded:
            return None
        k = int(np.searchsorted(trace.steps * period, time + 0.5 * period)) - 1
        return np.asarray(trace.position[max(k, 0)])

    return verdicts(team, float(trace.steps[-1]) * period, seen, since=since)


def status_of(ending: str, margin: float, upper: float | None, psi: float) -> str:
    """Status of a run. ``least-violating`` is returned only where it is proven.

    Args:
        ending: reason why the run ended.
        margin: margin of the team at the end; not finite where a position is not, +∞ without constraints.
        upper: proven upper bound on the best margin of any formation; None without one.
        psi: the team's unit of ψ.
    """
    if ending == "diverged":
        return "diverged"
    if margin > 0:
        return "satisfied"
    if upper is None or upper > 0:
        return "not-converged"
    return "least-violating" if upper - margin <= max(NEAR * -upper, NEARLY * min(psi, 1.0)) else "not-converged"


def _agents(team: Team, margins: np.ndarray, multipliers: np.ndarray, violated: np.ndarray | None) -> Mapping[str, Any]:
    violated = np.full(len(margins), np.nan) if violated is None else violated
    least = np.full(team.count, np.inf)
    np.minimum.at(least, team.owner, margins)
    agents: dict[str, Any] = {agent: {"margin": number(value), "constraints": []} for agent, value in zip(team.ids, least, strict=True)}
    for owner, name, margin, multiplier, share in zip(team.owner, team.names, margins, multipliers, violated, strict=True):
        entry = {"name": name, "margin": number(margin), "multiplier": number(multiplier), "violated_share": number(share)}
        agents[team.ids[owner]]["constraints"].append(entry)
    return agents


def _on_the_way(team: Team, violated: np.ndarray) -> Mapping[str, Any]:
    """Entry ``on_the_way``: number of watched constraints, number of those that were violated at any time, and the worst of them.

    Args:
        team: the team.
        violated: (M,) fraction of the run for which each constraint was violated; NaN where it is not watched.
    """
    watched, ever = int(np.count_nonzero(~np.isnan(violated))), int(np.count_nonzero(violated > 0))
    worst = None
    if ever:
        k = int(np.nanargmax(violated))
        worst = {"agent": team.ids[team.owner[k]], "constraint": team.names[k], "violated_share": float(violated[k])}
    return {"watched": watched, "violated": ever, "worst": worst}
