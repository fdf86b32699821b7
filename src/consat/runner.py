"""`run`: from a team or a scenario to a result."""

from __future__ import annotations

import dataclasses
import functools
import os
from collections.abc import Callable, Mapping
from typing import Any, Literal, NamedTuple

import jax.numpy as jnp
import numpy as np

from consat import __version__
from consat.certificate import BINDING, bounds
from consat.errors import InvalidInput, InvalidSettings
from consat.estimates import Estimates, Layout
from consat.numerics import float64
from consat.objective import Objective, Schedule, weigh
from consat.protocols import FLOWS, ROUNDS, with_gains
from consat.quadratics import shape_of
from consat.result import Result
from consat.scale import Scale, automatic, scale, start_box
from consat.scenario import Scenario, dump, load
from consat.settings import ProtocolSettings, Settings, Smoothing, Start
from consat.simulate import Stop
from consat.simulate.flows import simulate_flow
from consat.simulate.rounds import Body, Weather, simulate_rounds
from consat.team import Team
from consat.trace import Trace

DEFAULT_PROTOCOL = "admm"
SCHEMA = "consat.run/1"
SOLVE_SCHEMA = "consat.solve/1"
MOST_LISTED = 10_000
"""Above this many agents the summary leaves out what it says of each."""
SHARP = 5e-4
"""Max-min ends when the margin is proven to be within this, in units of the team's scale of ψ, of the best."""
AT_REST = 1e-2
"""A team whose last positions moved by less than this, in its units of length, counts as arrived."""


def run(
    team: Team | Scenario | str | os.PathLike[str],
    *,
    protocol: str | None = None,
    estimates: Layout | None = None,
    seed: int | None = None,
    start: tuple[Any, Any] | None = None,
    smoothing: Smoothing | Literal["auto"] | None = None,
    until: float | None = None,
    rounds: int | None = None,
    stop: Stop | None = None,
    loss: float = 0.0,
    sleep: float = 0.0,
    rate: float | None = None,
    speed: float | None = None,
    auxiliary: float | None = None,
    record: bool | None = None,
    full: bool = False,
    progress: Callable[[float, float], None] = lambda *_: None,
) -> Result:
    """Let a team find, together, a formation in which every constraint holds.

    Args:
        team: a `consat.Team`, or a scenario: the path of a file, or the name of a packaged one such as ``case-b``.
        protocol: how they talk; one of `consat.protocols.ROUNDS` (``admm`` by default) or `consat.protocols.FLOWS`.
        estimates: ``local``: each holds only the positions its constraints need; ``full``: all of its cluster (the paper).
        seed: of the random starts and first estimates, and of what gets lost.
        start: ``(low, high)`` of the box they are drawn from, numbers or (d,) arrays, length.
        smoothing: ν_α and ν_β, or ``auto``.
        until: end of a flow, s; implies ``stop="never"``.
        rounds: number of rounds; implies ``stop="never"``.
        stop: ``satisfied`` (default), ``converged`` or ``never``.
        loss: probability that a message is lost, in rounds.
        sleep: probability that an agent skips a round.
        rate: rounds a second, Hz, for a body that cannot jump; positions then follow estimates.
        speed: the most that such a body moves, length/s.
        auxiliary: adds to every agent the constraint to stay within this radius of the team's middle (paper, remark 2), length.
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
    if auxiliary is not None:
        scenario = _with_auxiliary(scenario, auxiliary)
    asked = scenario.settings
    settings = asked.model_copy(
        update={
            "start": Start(box=asked.start.box if start is None else start, seed=asked.start.seed if seed is None else seed),
            "protocol": asked.protocol.model_copy(
                update={"kind": protocol or asked.protocol.kind or DEFAULT_PROTOCOL, "estimates": estimates or asked.protocol.estimates}
            ),
            "smoothing": smoothing or asked.smoothing,
        }
    )
    kind = settings.protocol.kind
    if kind not in FLOWS and kind not in ROUNDS:
        raise InvalidSettings(f"there is no protocol {kind!r}; choose one of {', '.join((*ROUNDS, *FLOWS))}")
    stop = stop or ("never" if until is not None or rounds is not None else "converged" if kind == "max-min" else "satisfied")
    options: dict[str, Any] = {"stop": stop, "record": record, "progress": progress}
    if kind in FLOWS:
        _refuse(f"protocol {kind} flows in continuous time; use until", rounds=rounds, loss=loss, sleep=sleep, rate=rate, speed=speed)
        return _run(scenario, settings, full, functools.partial(_flow, settings.protocol, until=until, **options))
    _refuse(f"protocol {kind} goes in rounds; use rounds", until=until)
    if (speed is not None and rate is None) or not all(value is None or value > 0 for value in (speed, rate)):
        raise InvalidSettings("speed and rate must be positive, and speed needs rate: a body moves at most speed/rate a round")
    if not (0 <= loss < 1 and 0 <= sleep < 1):
        raise InvalidSettings(f"loss is {loss} and sleep is {sleep}, but both must be probabilities below 1")
    weather = Weather(loss, sleep, settings.start.seed)
    body = None if rate is None else Body(rate, np.inf if speed is None else speed)
    return _run(
        scenario, settings, full, functools.partial(_rounds, settings.protocol, rounds=rounds, weather=weather, body=body, **options)
    )


def _refuse(why: str, **given: float | None) -> None:
    if wrong := [name for name, value in given.items() if value]:
        raise InvalidSettings(f"{why}; {', '.join(wrong)} means nothing to it")


class _Prepared(NamedTuple):
    """A team made ready to run."""

    team: Team
    copies: Estimates
    schedule: Schedule
    size: Scale
    first: np.ndarray


@float64
def _run(scenario: Scenario, settings: Settings, full: bool, simulate: Callable[[_Prepared], Trace]) -> Result:
    team = scenario.team
    copies, size = Estimates.of(team, settings.protocol.estimates), scale(team)
    schedule = Schedule.of(automatic(size) if settings.smoothing == "auto" else settings.smoothing)
    trace = simulate(_Prepared(team, copies, schedule, size, first_estimates(team, copies, settings.start, size)))
    summary = summarise(scenario, settings, schedule, size, trace, full)
    return Result(summary, trace=trace, team=team, scenario=scenario.text)


def _flow(asked: ProtocolSettings, on: _Prepared, **options: Any) -> Trace:
    return simulate_flow(
        on.team, with_gains(FLOWS[str(asked.kind)](), asked), on.copies, on.schedule, on.first,
        infeasible=lambda position: bounds(on.team, position, on.schedule.final).verdict == "infeasible", **options,
    )  # fmt: skip


def _rounds(asked: ProtocolSettings, on: _Prepared, **options: Any) -> Trace:
    return simulate_rounds(
        on.team, with_gains(ROUNDS[str(asked.kind)](), asked), on.copies, on.schedule.final, on.size.length, on.first,
        convex=bool(shape_of(on.team).concave.all()),
        hopeless=lambda position: bounds(on.team, position, on.schedule.final).verdict == "infeasible",
        enough=(lambda position: _gap(on.team, position) <= SHARP * on.size.psi) if asked.kind == "max-min" else None, **options,
    )  # fmt: skip


def _gap(team: Team, position: np.ndarray) -> float:
    """How much better than this, at most, another formation could be."""
    certificate = bounds(team, position)
    return np.inf if certificate.upper is None else certificate.upper - certificate.lower


@float64
def solve(team: Team | Scenario | str | os.PathLike[str], *, seed: int = 0, auxiliary: float | None = None) -> dict[str, Any]:
    """Find the best margin that any formation can have, centrally, with a certificate; see `consat.reference.max_min`.

    Args:
        team: as in `run`.
        seed: of the starts, where there are many.
        auxiliary: as in `run`.

    Returns:
        what ``consat solve --json`` prints (schema consat.solve/1), and ``reasons``: what binds or conflicts, in words.
    """
    from consat.reasons import explain
    from consat.reference import max_min

    scenario = _scenario(team)
    if auxiliary is not None:
        scenario = _with_auxiliary(scenario, auxiliary)
    problem = scenario.team
    optimum = max_min(problem, seed=seed)
    certificate = bounds(problem, optimum.positions, multipliers=optimum.multipliers)
    return {
        "schema": SOLVE_SCHEMA,
        "scenario": scenario.name,
        "margin": _number(optimum.margin),
        "bounds": [_number(certificate.lower), None if certificate.upper is None else _number(certificate.upper)],
        "verdict": certificate.verdict,
        "positions": {agent: [_number(x) for x in row] for agent, row in zip(problem.ids, optimum.positions, strict=True)},
        "binding": [
            {"agent": problem.ids[problem.owner[k]], "constraint": problem.names[k], "multiplier": float(optimum.multipliers[k])}
            for k in np.argsort(-optimum.multipliers, kind="stable")
            if optimum.multipliers[k] > BINDING
        ],
        "method": optimum.method,
        "auxiliary": None if auxiliary is None else _auxiliary(problem, auxiliary, optimum.multipliers),
        "reasons": explain(problem, optimum),
    }


def first_estimates(team: Team, copies: Estimates, start: Start, size: Scale) -> np.ndarray:
    """(C, d) first estimates, drawn where nothing is given; the row of each agent's own position is its start (paper, section IV-E).

    Raises:
        InvalidSettings: the box has another dimension than the team.
    """
    d = team.dimension
    if start.box is None:
        low, high = start_box(size)
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


def summarise(scenario: Scenario, settings: Settings, schedule: Schedule, size: Scale, trace: Trace, full: bool) -> dict[str, Any]:
    """What ``run --json`` prints (schema consat.run/1)."""
    team, position = scenario.team, trace.position[-1]
    nu = schedule.final
    margins, multipliers = map(np.asarray, weigh(Objective.at_positions(team), jnp.asarray(position), nu))
    margin = _number(margins.min(initial=np.inf))
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
        "status": _status(trace, margin, certificate.verdict, size.length),
        "verdict": certificate.verdict,
        "margin": margin,
        "smooth_margin": _number(trace.smooth_margin[-1]),
        "bounds": [_number(certificate.lower), None if certificate.upper is None else _number(certificate.upper)],
        "satisfied_from": {
            "time": None if trace.satisfied_from is None or period is None else trace.satisfied_from * period,
            "round": None if trace.satisfied_from is None or trace.clock != "round" else int(trace.satisfied_from),
        },
        "known_from": trace.known_from,
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


def _with_auxiliary(scenario: Scenario, radius: float) -> Scenario:
    from consat.assumptions import with_auxiliary

    return dataclasses.replace(scenario, team=with_auxiliary(scenario.team, radius))


def _auxiliary(team: Team, radius: float, multipliers: np.ndarray) -> dict[str, Any]:
    """Says that the auxiliary constraint was added, and on whom it binds: then the radius is too small."""
    from consat.assumptions import binding_auxiliaries

    return {"radius": radius, "binding": binding_auxiliaries(team, multipliers, BINDING)}


def _scenario(team: Team | Scenario | str | os.PathLike[str]) -> Scenario:
    if isinstance(team, Scenario):
        return team
    if not isinstance(team, Team):
        return load(team)
    try:
        text = dump(team, Settings(), "team")
    except InvalidInput:
        text = ""
    return Scenario(name="team", team=team, settings=Settings(), text=text, source="team")


def _status(trace: Trace, margin: float | None, verdict: str, length: float) -> str:
    if trace.ending == "diverged":
        return "diverged"
    if margin is not None and margin > 0:
        return "satisfied"
    lately = trace.position[-min(10, len(trace.position)) :]
    arrived = len(trace.position) > 10 and np.abs(lately - lately[-1]).max(initial=0.0) <= AT_REST * length
    return "least-violating" if verdict == "infeasible" and arrived else "not-converged"


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
