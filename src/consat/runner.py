"""`run`: from a team or a scenario to a result."""

from __future__ import annotations

import dataclasses
import functools
import os
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, Literal, NamedTuple

import jax
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
from consat.scenario import Scenario, dump, load, loads
from consat.settings import Settings, Smoothing, Start
from consat.simulate import Stop
from consat.simulate import checkpoint as checkpoints
from consat.simulate.files import RESULT, Files
from consat.simulate.flows import simulate_flow
from consat.simulate.kernel import Body, Weather
from consat.simulate.recording import Choice, Who
from consat.simulate.rounds import simulate_rounds
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
    agents: Who = None,
    every: int = 1,
    out: str | os.PathLike[str] | None = None,
    checkpoint: float | None = None,
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
        agents: of whom to record anything: ids, ``all`` or ``none``; by default all, of more than 10,000 a sample of 1,000.
        every: each how manieth round, or sample of a flow, to record.
        out: a directory, for a result file ``result.nc`` that grows as the run goes on; by default the record is held in memory.
        checkpoint: seconds between two checkpoints in `out`, from which `resume` goes on; none if None.
        full: whether to list every agent in the summary, however many.
        progress: called with the fraction done and the margin.

    Returns:
        the result; divergence, time-out and infeasibility are told by its status and verdict.

    Raises:
        InvalidTeam: agents that depend on each other cannot reach one another (Assumption 1).
        InvalidScenario: the scenario has faults.
        InvalidSettings: the settings do not fit together.
    """
    given = {
        "protocol": protocol, "estimates": estimates, "seed": seed, "start": start, "smoothing": smoothing,
        "until": until, "rounds": rounds, "stop": stop, "loss": loss, "sleep": sleep, "rate": rate, "speed": speed,
        "auxiliary": auxiliary, "record": record, "agents": agents, "every": every,
    }  # fmt: skip
    if checkpoint is not None and out is None:
        raise InvalidSettings("checkpoint needs out: the directory in which the checkpoint and the result stand")
    files = None if out is None else Files(Path(out), checkpoint)
    return _start(scenario_of(team), given, files, full, progress)


def resume(
    out: str | os.PathLike[str],
    team: Team | None = None,
    *,
    rounds: int | None = None,
    until: float | None = None,
    checkpoint: float | None = None,
    full: bool = False,
    progress: Callable[[float, float], None] = lambda *_: None,
) -> Result:
    """Go on, bit for bit, where a run with `checkpoint` was interrupted, by whatever.

    Args:
        out: the directory of that run.
        team: the same team, if it holds functions that no file can hold.
        rounds: end after so many instead, counted from the start.
        until: end of a flow instead, s.
        checkpoint: seconds between two checkpoints; as before if None.
        full: see `run`.
        progress: see `run`.

    Raises:
        InvalidResult: there is no checkpoint, it cannot be read, or it is of another problem.
    """
    files = Files(Path(out), checkpoint, checkpoints.read(Path(out) / checkpoints.NAME))
    about = files.about
    given = dict(about["given"]) | {key: value for key, value in (("rounds", rounds), ("until", until)) if value is not None}
    if given["smoothing"] not in (None, "auto"):
        given["smoothing"] = Smoothing.model_validate(given["smoothing"])
    if team is None and not about["scenario"]:
        raise InvalidSettings(f"{out}: the team of this run holds Python functions; give resume the same team")
    scenario = scenario_of(team) if team is not None else loads(about["scenario"], about["name"])
    return _start(scenario, given, files, full, progress)


def _start(
    scenario: Scenario, given: Mapping[str, Any], files: Files | None, full: bool, progress: Callable[[float, float], None]
) -> Result:
    """Check the settings, and run; `given` are the arguments of `run`."""
    about = {"scenario": scenario.text, "name": scenario.source, "given": {key: _as_data(value) for key, value in given.items()}}
    if given["auxiliary"] is not None:
        scenario = with_auxiliary(scenario, given["auxiliary"])
    settings = settings_of(scenario.settings, given)
    kind = settings.protocol.kind
    if kind not in FLOWS and kind not in ROUNDS:
        raise InvalidSettings(f"there is no protocol {kind!r}; choose one of {', '.join((*ROUNDS, *FLOWS))}")
    until, rounds, loss, sleep, rate, speed = (given[key] for key in ("until", "rounds", "loss", "sleep", "rate", "speed"))
    default = "never" if until is not None or rounds is not None else "converged" if kind == "max-min" else "satisfied"
    options: dict[str, Any] = {"stop": given["stop"] or default, "progress": progress}
    if jax.process_count() > 1 and (kind in FLOWS or (files is not None and files.checkpoints(about) is not None)):
        raise InvalidSettings("several processes run protocols in rounds, and without checkpoints")
    keep = _Keep(given["agents"], given["record"], given["every"], files, about)
    if kind in FLOWS:
        _refuse(f"protocol {kind} flows in continuous time; use until", rounds=rounds, loss=loss, sleep=sleep, rate=rate, speed=speed)
        return _run(scenario, settings, full, keep, functools.partial(_flow, until=until, **options))
    _refuse(f"protocol {kind} goes in rounds; use rounds", until=until)
    if (speed is not None and rate is None) or not all(value is None or value > 0 for value in (speed, rate)):
        raise InvalidSettings("speed and rate must be positive, and speed needs rate: a body moves at most speed/rate a round")
    if not (0 <= loss < 1 and 0 <= sleep < 1):
        raise InvalidSettings(f"loss is {loss} and sleep is {sleep}, but both must be probabilities below 1")
    weather = Weather(loss, sleep, settings.start.seed)
    body = None if rate is None else Body(rate, np.inf if speed is None else speed)
    simulate = functools.partial(_rounds, rounds=rounds, weather=weather, body=body, **options)
    return _run(scenario, settings, full, keep, simulate)


def _as_data(value: Any) -> Any:
    """An argument of `run` as JSON can hold it."""
    if isinstance(value, Smoothing):
        return value.model_dump(by_alias=True)
    if isinstance(value, np.ndarray | np.generic):
        return value.tolist()
    return value if isinstance(value, str) or not isinstance(value, Sequence) else [_as_data(each) for each in value]


def settings_of(asked: Settings, given: Mapping[str, Any]) -> Settings:
    """What the scenario asks for, and `given` overrides."""
    start, seed = given["start"], given["seed"]
    kind, estimates = given["protocol"] or asked.protocol.kind or DEFAULT_PROTOCOL, given["estimates"] or asked.protocol.estimates
    return asked.model_copy(
        update={
            "start": Start(box=asked.start.box if start is None else start, seed=asked.start.seed if seed is None else seed),
            "protocol": asked.protocol.model_copy(update={"kind": kind, "estimates": estimates}),
            "smoothing": given["smoothing"] or asked.smoothing,
        }
    )


def _refuse(why: str, **given: float | None) -> None:
    if wrong := [name for name, value in given.items() if value]:
        raise InvalidSettings(f"{why}; {', '.join(wrong)} means nothing to it")


class Prepared(NamedTuple):
    """A team made ready to run.

    Attributes:
        team: the team.
        copies: the layout of estimates.
        schedule: of ν.
        size: the team's natural size.
        settings: what holds.
    """

    team: Team
    copies: Estimates
    schedule: Schedule
    size: Scale
    settings: Settings

    @classmethod
    def of(cls, team: Team, settings: Settings) -> Prepared:
        """Raises: InvalidTeam: agents that depend on each other cannot reach one another."""
        size = scale(team)
        schedule = Schedule.of(automatic(size) if settings.smoothing == "auto" else settings.smoothing)
        return cls(team, Estimates.of(team, settings.protocol.estimates), schedule, size, settings)

    def first(self, start: Start | None = None) -> np.ndarray:
        """(C, d) first estimates, drawn as the settings say, or otherwise."""
        return first_estimates(self.team, self.copies, start or self.settings.start, self.size)

    @property
    def convex(self) -> bool:
        """Whether every ψ is known to be concave."""
        return bool(shape_of(self.team).concave.all())

    def hopeless(self, position: np.ndarray) -> bool:
        """Whether (N, d) positions prove that no formation satisfies every constraint."""
        return bounds(self.team, position, self.schedule.final).verdict == "infeasible"

    @property
    def enough(self) -> Callable[[np.ndarray], bool] | None:
        """Says of (N, d) positions whether no formation is better by more than a tolerance; None where nobody asks."""
        return (lambda position: _gap(self.team, position) <= SHARP * self.size.psi) if self.settings.protocol.kind == "max-min" else None


@dataclasses.dataclass(frozen=True)
class _Keep:
    """What is kept of a run, and where; `agents`, `record` and `every` as in `run`, `about` what `resume` must know."""

    agents: Who
    record: bool | None
    every: int
    files: Files | None
    about: Mapping[str, Any]

    def options(self, team: Team, copies: Estimates, clock: str) -> dict[str, Any]:
        """Arguments of `simulate_rounds` and `simulate_flow`."""
        choice = Choice.of(team, copies, self.agents, self.record, self.every)
        if self.files is None or jax.process_index() > 0:  # process 0 writes for all
            return {"choice": choice}
        return {"choice": choice, "sink": self.files.sink(team, copies, choice, clock), "checkpoint": self.files.checkpoints(self.about)}


@float64
def _run(scenario: Scenario, settings: Settings, full: bool, keep: _Keep, simulate: Callable[..., Trace]) -> Result:
    team = scenario.team
    ready = Prepared.of(team, settings)
    options = keep.options(team, ready.copies, "time" if settings.protocol.kind in FLOWS else "round")
    trace = simulate(ready, **options)
    summary = summarise(scenario, settings, ready.schedule, ready.size, trace, full)
    if keep.files is not None and jax.process_index() == 0:
        summary["result"] = str(keep.files.directory / RESULT)
        trace = keep.files.finish(options["sink"], trace, team, summary, scenario.text)
    return Result(summary, trace=trace, team=team, scenario=scenario.text)


def _flow(on: Prepared, **options: Any) -> Trace:
    asked = on.settings.protocol
    flow = with_gains(FLOWS[str(asked.kind)](), asked)
    return simulate_flow(on.team, flow, on.copies, on.schedule, on.first(), infeasible=on.hopeless, **options)


def _rounds(on: Prepared, **options: Any) -> Trace:
    asked = on.settings.protocol
    return simulate_rounds(
        on.team, with_gains(ROUNDS[str(asked.kind)](), asked), on.copies, on.schedule.final, on.size, on.first(),
        convex=on.convex, hopeless=on.hopeless, enough=on.enough, **options,
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

    scenario = scenario_of(team)
    if auxiliary is not None:
        scenario = with_auxiliary(scenario, auxiliary)
    problem = scenario.team
    optimum = max_min(problem, seed=seed)
    certificate = bounds(problem, optimum.positions, multipliers=optimum.multipliers)
    return {
        "schema": SOLVE_SCHEMA,
        "scenario": scenario.name,
        "margin": number(optimum.margin),
        "bounds": [number(certificate.lower), None if certificate.upper is None else number(certificate.upper)],
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
    where = (team.count, d), (copies.count, d)
    drawn, first = (random.uniform(low, high, shape) for shape in where)
    if team.around is not None:  # what the box gives, moved into the box that each has of its own
        place, reach = team.around
        half = np.where(high > low, (high - low) / 2, 1.0)
        for values, whose in ((drawn, slice(None)), (first, copies.position)):
            near = place[whose] + reach[whose][:, None] * (values - (low + high) / 2) / half
            values[...] = np.where(np.isnan(near), values, near)
    first[copies.own] = np.where(np.isnan(team.starts), drawn, team.starts)
    return first


def summarise(scenario: Scenario, settings: Settings, schedule: Schedule, size: Scale, trace: Trace, full: bool) -> dict[str, Any]:
    """What ``run --json`` prints (schema consat.run/1)."""
    team, position = scenario.team, trace.end
    nu = schedule.final
    margins, multipliers = map(np.asarray, weigh(Objective.at_positions(team), jnp.asarray(position), nu))
    margin = number(margins.min(initial=np.inf))
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
        "status": status_of(trace.ending, trace.moved_lately, margin, certificate.verdict, size.length),
        "verdict": certificate.verdict,
        "margin": margin,
        "smooth_margin": number(trace.smooth_margin[-1]),
        "bounds": [number(certificate.lower), None if certificate.upper is None else number(certificate.upper)],
        "satisfied_from": {
            "time": None if trace.satisfied_from is None or period is None else trace.satisfied_from * period,
            "round": None if trace.satisfied_from is None or trace.clock != "round" else int(trace.satisfied_from),
        },
        "known_from": trace.known_from,
        "rounds": int(trace.steps[-1]) if trace.clock == "round" else None,
        "time": float(trace.steps[-1]) if trace.clock == "time" else None,
        "ending": trace.ending,
        "messages": trace.messages,
        "floats_sent": trace.floats_sent,
        "positions": {agent: [number(x) for x in row] for agent, row in zip(team.ids, position, strict=True)} if listed else None,
        "agents": _agents(team, margins, multipliers) if listed else None,
        "clusters": _clusters(team, trace.cluster) if listed else None,
        "count": team.count,
        "result": None,
        "seconds": {key: round(value, 4) for key, value in trace.seconds.items()},
    }


def with_auxiliary(scenario: Scenario, radius: float) -> Scenario:
    """The scenario with the auxiliary constraint added to every agent."""
    from consat import assumptions

    return dataclasses.replace(scenario, team=assumptions.with_auxiliary(scenario.team, radius))


def _auxiliary(team: Team, radius: float, multipliers: np.ndarray) -> dict[str, Any]:
    """Says that the auxiliary constraint was added, and on whom it binds: then the radius is too small."""
    from consat.assumptions import binding_auxiliaries

    return {"radius": radius, "binding": binding_auxiliaries(team, multipliers, BINDING)}


def scenario_of(team: Team | Scenario | str | os.PathLike[str]) -> Scenario:
    """What `run` was given, as a scenario."""
    if isinstance(team, Scenario):
        return team
    if not isinstance(team, Team):
        return load(team)
    try:
        text = dump(team, Settings(), "team")
    except InvalidInput:
        text = ""
    return Scenario(name="team", team=team, settings=Settings(), text=text, source="team")


def status_of(ending: str, moved: float, margin: float | None, verdict: str, length: float) -> str:
    """How a run ended, for people: `moved` is how far any agent moved lately, `length` the team's unit of length."""
    if ending == "diverged":
        return "diverged"
    if margin is not None and margin > 0:
        return "satisfied"
    arrived = moved <= AT_REST * length
    return "least-violating" if verdict == "infeasible" and arrived else "not-converged"


def _agents(team: Team, margins: np.ndarray, multipliers: np.ndarray) -> Mapping[str, Any]:
    agents: dict[str, Any] = {agent: {"margin": None, "constraints": []} for agent in team.ids}
    for owner, name, margin, multiplier in zip(team.owner, team.names, margins, multipliers, strict=True):
        agent = agents[team.ids[owner]]
        value = number(margin)
        agent["constraints"].append({"name": name, "margin": value, "multiplier": number(multiplier)})
        agent["margin"] = value if agent["margin"] is None or value is None else min(agent["margin"], value)
    return agents


def _clusters(team: Team, cluster: np.ndarray) -> list[list[str]]:
    members: list[list[str]] = [[] for _ in range(int(cluster.max(initial=-1)) + 1)]
    for agent, label in zip(team.ids, cluster, strict=True):
        members[label].append(agent)
    return members


def number(value: Any) -> float | None:
    """A float for JSON, which knows no infinity: null instead."""
    return float(value) if np.isfinite(value) else None
