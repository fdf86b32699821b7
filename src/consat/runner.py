"""`run`: from a team or a scenario to a result."""

from __future__ import annotations

import dataclasses
import os
from collections.abc import Callable, Mapping
from typing import Any, Literal

import jax.numpy as jnp
import numpy as np

from consat import __version__
from consat.errors import InvalidSettings
from consat.estimates import Estimates, Layout
from consat.numerics import float64
from consat.objective import Objective, Schedule
from consat.protocols import FLOWS, Flow
from consat.result import Result
from consat.scale import Scale, automatic, scale, start_box
from consat.scenario import Scenario, dump, load
from consat.errors import InvalidTeam
from consat.settings import ProtocolSettings, Settings, Smoothing, Start
from consat.simulate import Stop, simulate_flow
from consat.team import Team
from consat.trace import Trace

DEFAULT_PROTOCOL = "gradient-flow"
SCHEMA = "consat.run/1"
MOST_LISTED = 10_000
"""Above this many agents the summary leaves out what it says of each."""


def run(
    team: Team | Scenario | str | os.PathLike[str],
    *,
    protocol: str | None = None,
    estimates: Layout | None = None,
    seed: int | None = None,
    start: tuple[Any, Any] | None = None,
    smoothing: Smoothing | Literal["auto"] | None = None,
    until: float | None = None,
    stop: Stop | None = None,
    record: bool | None = None,
    full: bool = False,
    progress: Callable[[float, float], None] = lambda *_: None,
) -> Result:
    """Let a team find, together, a formation in which every constraint holds.

    Args:
        team: a `consat.Team`, or a scenario: the path of a file, or the name of a packaged one such as ``case-b``.
        protocol: how they talk; one of `consat.protocols.FLOWS`.
        estimates: ``local``: each holds only the positions its constraints need; ``full``: all of its cluster (the paper).
        seed: of the random starts and first estimates.
        start: ``(low, high)`` of the box they are drawn from, numbers or (d,) arrays, length.
        smoothing: ν_α and ν_β, or ``auto``.
        until: end of a flow, s; implies ``stop="never"``.
        stop: ``satisfied`` (default), ``converged`` or ``never``.
        record: whether to keep all estimates and integral states; by default while they are few.
        full: whether to list every agent in the summary, however many.
        progress: called with the fraction done and the margin.

    Returns:
        the result; divergence, time-out and infeasibility are told by its status and verdict.

    Raises:
        InvalidTeam: agents that depend on each other cannot reach one another (Assumption 1).
        InvalidScenario: the scenario has faults.
        InvalidSettings: the settings do not fit together.
    """
    scenario = _scenario(team)
    asked = scenario.settings
    settings = asked.model_copy(
        update={
            "start": Start(box=asked.start.box if start is None else start, seed=asked.start.seed if seed is None else seed),
            "protocol": asked.protocol.model_copy(
                update={"kind": protocol or asked.protocol.kind or DEFAULT_PROTOCOL, "estimates": estimates or asked.protocol.estimates}
            ),
            "smoothing": smoothing or asked.smoothing,
            "until": until or asked.until,
            "stop": stop or asked.stop or ("satisfied" if until is None else "never"),
        }
    )
    return _run(scenario, settings, record, full, progress)


@float64
def _run(scenario: Scenario, settings: Settings, record: bool | None, full: bool, progress: Callable[[float, float], None]) -> Result:
    team = scenario.team
    flow = _flow(settings.protocol)
    copies = Estimates.of(team, settings.protocol.estimates)
    size = scale(team) if settings.smoothing == "auto" or settings.start.box is None else None
    smoothing = automatic(size) if settings.smoothing == "auto" and size else settings.smoothing
    assert isinstance(smoothing, Smoothing)
    schedule = Schedule.of(smoothing)
    trace = simulate_flow(
        team, flow, copies, schedule, first_estimates(team, copies, settings.start, size),
        until=settings.until, stop=settings.stop or "satisfied", record=record, progress=progress,
    )  # fmt: skip
    return Result(summarise(scenario, settings, schedule, trace, full), trace=trace, team=team, scenario=scenario.text)


def first_estimates(team: Team, copies: Estimates, start: Start, size: Scale | None) -> np.ndarray:
    """(C, d) first estimates, drawn where nothing is given; the row of each agent's own position is its start (paper, section IV-E).

    Raises:
        InvalidSettings: the box has another dimension than the team.
    """
    d = team.dimension
    if start.box is None:
        low, high = start_box(size or scale(team))
    else:
        low, high = (np.atleast_1d(np.asarray(side, dtype=float)) for side in start.box)
        if len(low) not in (1, d):
            raise InvalidSettings(
                f"the start box has {len(low)} numbers a side, but must have 1 or {d}, one for each dimension of the team"
            )
    random = np.random.default_rng(start.seed)
    drawn = random.uniform(low, high, (team.count, d))
    first = random.uniform(low, high, (copies.count, d))
    first[copies.own] = np.where(np.isnan(team.starts), drawn, team.starts)
    return first


def summarise(scenario: Scenario, settings: Settings, schedule: Schedule, trace: Trace, full: bool) -> dict[str, Any]:
    """What ``run --json`` prints (schema consat.run/1)."""
    team, position = scenario.team, trace.position[-1]
    observer, nu = Objective.at_positions(team), schedule.final
    margins = np.asarray(observer.psi(jnp.asarray(position)))
    multipliers = np.asarray(observer.multipliers(jnp.asarray(position), nu))
    margin = _number(margins.min(initial=np.inf))
    verdict = "feasible" if margin is not None and margin > 0 else "undecided"
    listed = full or team.count <= MOST_LISTED
    return {
        "schema": SCHEMA,
        "scenario": scenario.name,
        "version": __version__,
        "protocol": settings.protocol.kind,
        "estimates": settings.protocol.estimates,
        "seed": settings.start.seed,
        "status": _status(trace, margin, verdict),
        "verdict": verdict,
        "margin": margin,
        "smooth_margin": _number(trace.smooth_margin[-1]),
        "bounds": [margin, None],
        "satisfied_from": {
            "time": trace.satisfied_from if trace.clock == "time" else None,
            "round": trace.satisfied_from if trace.clock == "round" else None,
        },
        "rounds": len(trace.steps) - 1 if trace.clock == "round" else None,
        "time": float(trace.steps[-1]) if trace.clock == "time" else None,
        "ending": trace.ending,
        "messages": trace.messages,
        "floats_sent": trace.floats_sent,
        "positions": {agent: [_number(x) for x in row] for agent, row in zip(team.ids, position, strict=True)} if listed else None,
        "agents": _agents(team, margins, multipliers) if listed else None,
        "clusters": _clusters(team, trace.cluster) if listed else None,
        "count": team.count,
        "result": None,
        "seconds": {key: round(value, 4) for key, value in trace.seconds.items()},
    }


def _scenario(team: Team | Scenario | str | os.PathLike[str]) -> Scenario:
    if isinstance(team, Scenario):
        return team
    if not isinstance(team, Team):
        return load(team)
    try:
        text = dump(team, Settings(), "team")
    except InvalidTeam:
        text = ""
    return Scenario(name="team", team=team, settings=Settings(), text=text, source="team")


def _flow(asked: ProtocolSettings) -> Flow:
    if asked.kind not in FLOWS:
        raise InvalidSettings(f"there is no protocol {asked.kind!r}; choose one of {', '.join(FLOWS)}")
    flow = FLOWS[asked.kind]()
    gains = {key: value for key, value in (("k1", asked.k1), ("k2", asked.k2)) if value is not None}
    known = {field.name for field in dataclasses.fields(flow)}  # type: ignore[arg-type]
    if unknown := gains.keys() - known:
        raise InvalidSettings(f"protocol {asked.kind} has no gain {', '.join(sorted(unknown))}; leave it out")
    return dataclasses.replace(flow, **gains)  # type: ignore[type-var]


def _status(trace: Trace, margin: float | None, verdict: str) -> str:
    if trace.ending == "diverged":
        return "diverged"
    if margin is not None and margin > 0:
        return "satisfied"
    return "least-violating" if verdict == "infeasible" else "not-converged"


def _agents(team: Team, margins: np.ndarray, multipliers: np.ndarray) -> Mapping[str, Any]:
    agents: dict[str, Any] = {agent: {"margin": None, "constraints": []} for agent in team.ids}
    for owner, name, margin, multiplier in zip(team.owner, team.names, margins, multipliers, strict=True):
        agent = agents[team.ids[owner]]
        value = _number(margin)
        agent["constraints"].append({"name": name, "margin": value, "multiplier": _number(multiplier)})
        agent["margin"] = value if agent["margin"] is None or value is None else min(agent["margin"], value)
    return agents


def _clusters(team: Team, cluster: np.ndarray) -> list[list[str]]:
    members: list[list[str]] = [[] for _ in range(int(cluster.max(initial=-1)) + 1)]
    for agent, label in zip(team.ids, cluster, strict=True):
        members[label].append(agent)
    return members


def _number(value: Any) -> float | None:
    """A float for JSON, which knows no infinity: null instead."""
    return float(value) if np.isfinite(value) else None
