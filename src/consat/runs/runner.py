"""`run` and `resume`: simulate a team or a scenario and return the result."""

from __future__ import annotations

import dataclasses
import functools
import os
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, Literal

import jax

from consat.engine import checkpoint as checkpoints
from consat.engine.files import Files, claim
from consat.engine.recording import Choice, Who
from consat.engine.rounds import simulate_rounds
from consat.errors import InvalidSettings
from consat.numerics import float64
from consat.problem.team import Team
from consat.protocols import FLOWS, ROUNDS, with_gains
from consat.protocols.estimates import Estimates
from consat.results.result import RESULT, Result
from consat.results.trace import Trace
from consat.runs.advice import around_loops
from consat.runs.options import Options
from consat.runs.preparation import Prepared, named, protocol_entries, robots_of, scenario_of, settings_of, with_auxiliary
from consat.runs.restarting import BRIEFLY, ELSEWHERE, best_start, looks_elsewhere
from consat.runs.summary import summarise
from consat.scenario import Scenario, loads
from consat.settings import Layout, Sends, Settings, Smoothing, Stop


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
    burst: tuple[float, float] | None = None,
    rate: float | None = None,
    speed: float | None = None,
    robots: Any = None,
    obstacles: Sequence[Any] | None = None,
    wind: Sequence[float] = (),
    noise: float = 0.0,
    simulator: str | None = None,
    sends: Sends = "all",
    auxiliary: float | None = None,
    restarts: int | None = None,
    record: bool | None = None,
    agents: Who = None,
    every: int = 1,
    out: str | os.PathLike[str] | None = None,
    checkpoint: float | None = None,
    force: bool = False,
    full: bool = False,
    progress: Callable[[float, float], None] = lambda *_: None,
) -> Result:
    """Simulate a team that searches, by a distributed protocol, for a formation in which every constraint holds.

    Args:
        team: a `consat.Team`, or a scenario: the path of a file, or the name of a packaged one such as ``case-b``.
        protocol: a key of `consat.protocols.ROUNDS` (discrete rounds) or `consat.protocols.FLOWS` (continuous time). The default is
            ``interior-point``, or ``admm`` for teams described at `consat.runs.preparation.why_admm`.
        estimates: ``local``: each agent holds copies of only the positions that its constraints need; ``full``: of all positions of its
            cluster, as in the paper.
        seed: random seed of starts, initial estimates and message loss.
        start: ``(low, high)`` of the box from which starts are drawn, numbers or (d,) arrays, length.
        smoothing: ν_α and ν_β, or ``auto``.
        until: end of the run, s; for protocols in rounds only together with `rate`. Implies ``stop="never"``.
        rounds: number of rounds. Implies ``stop="never"``.
        stop: ``satisfied``, ``converged`` or ``never``; by default ``satisfied``, and ``converged`` for ``max-min``.
        loss: probability that a message is lost; for rounds.
        sleep: probability that an agent skips a round; for rounds.
        burst: ``(p, q)``, losses in bursts: each direction of a link turns bad with probability p per round, and good again with
            probability q. A bad link delivers no message. For rounds.
        rate: rounds per second, Hz. By default `consat.runs.options.RATE` where constraints move with time or robots drive; else rounds
            take no time.
        speed: largest speed of a body, length/s; positions then follow estimates. If None, bodies are at their agents' estimates.
        robots: model of the bodies, such as ``consat.Unicycle(radius=0.1)``: one model for all, a mapping from ids to models, or the name
            of a kind; by default that of the scenario.
        obstacles: obstacles that robots avoid, as returned by `consat.disc` and similar functions; by default those of the scenario.
        wind: (d,) velocity of the air, m/s, for robots.
        noise: largest error of a robot's measured position, m.
        simulator: integrates the bodies of robots: ``mujoco``, or, if None, the robots' own models.
        sends: ``all``: every agent sends in every round; ``events``: only what is news, see `consat.protocols.sending`. For rounds.
        auxiliary: radius, length, of a constraint that is added to every agent: to stay within it of the team's centre (paper, remark 2).
        restarts: number of starts, with `seed` and the seeds after it, which run as one computation. The result is that of the start whose
            run ends with the largest margin. By default it is 1, but 5 starts are tried if the first does not satisfy a team with ψ that
            are neither concave nor convex nor quadratic, unless `rounds` or `stop` is given. For rounds.
        record: whether to record all estimates and integral states; by default only while they are few.
        agents: agents to record: ids, ``all`` or ``none``; by default all, but a sample of 1,000 of teams above 10,000.
        every: record one round, or one sample of a flow, in `every`.
        out: directory for the result file ``result.nc``, which grows during the run; by default the record is held in memory.
        checkpoint: seconds between two checkpoints in `out`, from which `resume` continues; no checkpoints if None.
        force: whether to overwrite results of another scenario in `out`.
        full: whether to list every agent in the summary, also for large teams.
        progress: called with the fraction done and the margin.

    Returns:
        The result. Divergence, time-out and infeasibility do not raise; see its status and verdict.

    Raises:
        InvalidTeam: agents that depend on each other are not connected by links (Assumption 1).
        InvalidScenario: the scenario has faults.
        InvalidSettings: the settings do not fit together, or `out` is not writable or holds results of another scenario.
    """
    options = Options(
        protocol=protocol, estimates=estimates, seed=seed, start=start, smoothing=smoothing, until=until, rounds=rounds, stop=stop,
        loss=loss, sleep=sleep, speed=speed, auxiliary=auxiliary, record=record, agents=agents, every=every,
        wind=tuple(map(float, wind)), noise=noise, simulator=simulator, restarts=restarts, sends=sends,
        burst=None if burst is None else tuple(map(float, burst)),  # type: ignore[arg-type]
    )  # fmt: skip
    if checkpoint is not None and out is None:
        raise InvalidSettings("checkpoint needs out: the directory in which the checkpoint and the result stand")
    scenario = scenario_of(team)
    options = dataclasses.replace(options, robots=robots_of(robots, obstacles, scenario), rate=scenario.rate if rate is None else rate)
    if out is not None:
        claim(Path(out), scenario.name, force=force)
    files = None if out is None else Files(Path(out), checkpoint)
    return _start(scenario, options, files, full, progress)


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
    """Continue an interrupted run from its last checkpoint. The result is bit for bit that of an uninterrupted run.

    Args:
        out: directory of the interrupted run.
        team: the same team; needed only if it holds functions that no file can store.
        rounds: new number of rounds, counted from the start; as before if None.
        until: new end time, s; as before if None.
        checkpoint: seconds between two checkpoints; as before if None.
        full: see `run`.
        progress: see `run`.

    Raises:
        InvalidResult: there is no checkpoint, it is not readable, or it belongs to another problem.
    """
    files = Files(Path(out), checkpoint, checkpoints.read(Path(out) / checkpoints.NAME))
    about = files.about
    changed: dict[str, Any] = {key: value for key, value in (("rounds", rounds), ("until", until)) if value is not None}
    options = dataclasses.replace(Options.of(about["given"]), **changed)
    if team is None and not about["scenario"]:
        raise InvalidSettings(f"{out}: the team of this run holds Python functions; give resume the same team")
    scenario = scenario_of(team) if team is not None else loads(about["scenario"], about["name"])
    return _start(scenario, options, files, full, progress)


def _start(scenario: Scenario, options: Options, files: Files | None, full: bool, progress: Callable[[float, float], None]) -> Result:
    """Resolve and check the settings, then run."""
    about = {"scenario": scenario.text, "scenario_name": scenario.name, "name": scenario.source, "given": options.data}
    if options.auxiliary is not None:
        scenario = with_auxiliary(scenario, options.auxiliary)
    team = scenario.team
    settings = settings_of(scenario.settings, options, team)
    kind = str(settings.protocol.kind)
    if jax.process_count() > 1:
        _require_simple(kind, team, options, files is not None and files.checkpoints(about) is not None)
    more = protocol_entries(team, settings.protocol.model_copy(update={"kind": named(scenario.settings, options)}))
    keep = _Keep(options, files, about)
    how: dict[str, Any] = {"stop": options.stop_for(kind), "progress": progress}
    if kind in FLOWS:
        options.require_flow(kind, team)
        return _run(scenario, settings, full, keep, more | {"restarts": None}, functools.partial(_flow, until=options.until, **how))
    how |= options.pace(kind, team)._asdict() | {"events": options.events}

    def run_from(seed: int, found: Mapping[str, Any] | None) -> Result:
        there = settings.model_copy(update={"start": settings.start.model_copy(update={"seed": seed})})
        return _run(scenario, there, full, keep, more | {"restarts": found}, functools.partial(_rounds, faults=options.faults(seed), **how))

    if options.many_starts:
        assert options.restarts is not None
        found = best_start(team, settings, options, options.restarts)
        return run_from(found["seed"], found)
    result = run_from(settings.start.seed, None)
    if (files is None or files.checkpoints(about) is None) and looks_elsewhere(team, options, result.summary):
        found = best_start(team, settings, dataclasses.replace(options, rounds=BRIEFLY, stop="satisfied"), ELSEWHERE)
        if found["satisfied"]:
            return run_from(found["seed"], found)
    return result


def _require_simple(kind: str, team: Team, options: Options, checkpoints: bool) -> None:
    """Check that several processes can run the team. Raises: InvalidSettings: they cannot."""
    if options.many_starts or options.robots is not None or options.burst is not None or options.events:
        message = "several processes run points, from one start, lose messages one by one, and send all; use one process for more"
        raise InvalidSettings(message)
    if kind in FLOWS or checkpoints:
        raise InvalidSettings("several processes run protocols in rounds, and without checkpoints")
    if team.moves:
        raise InvalidSettings("constraints move with time, which several processes do not follow; use one")


@dataclasses.dataclass(frozen=True)
class _Keep:
    """Recording of a run: options, output files, and `about`, the metadata that `resume` needs."""

    asked: Options
    files: Files | None
    about: Mapping[str, Any]

    def options(self, team: Team, copies: Estimates, clock: str) -> dict[str, Any]:
        """Keyword arguments of `simulate_rounds` and `simulate_flow` for recording."""
        choice = Choice.of(team, copies, self.asked.agents, self.asked.record, self.asked.every)
        if self.files is None or jax.process_index() > 0:  # only process 0 writes
            return {"choice": choice}
        sink = self.files.sink(team, copies, choice, clock, heading=self.asked.robots is not None)
        return {"choice": choice, "sink": sink, "checkpoint": self.files.checkpoints(self.about)}


@float64
def _run(
    scenario: Scenario, settings: Settings, full: bool, keep: _Keep, more: Mapping[str, Any], simulate: Callable[..., Trace]
) -> Result:
    team = scenario.team
    ready = Prepared.of(team, settings)
    options = keep.options(team, ready.copies, "time" if settings.protocol.kind in FLOWS else "round")
    trace = simulate(ready, **options)
    summary = summarise(scenario, settings, ready.schedule, ready.size, trace, full=full, robots=keep.asked.robots)
    summary |= more
    if trace.turned is not None:
        over = f"the links form loops and had not satisfied the team after {trace.turned:.0f} rounds; it went over to a spanning tree"
        summary |= {"route": "tree", "why": over}
    summary["warnings"] += around_loops(summary["route"], trace)
    if keep.files is not None and jax.process_index() == 0:
        summary["result"] = str(keep.files.directory / RESULT)
        trace = keep.files.finish(options["sink"], trace, team, summary, scenario.text)
    return Result(summary, trace=trace, team=team, scenario=scenario.text)


def _flow(on: Prepared, **options: Any) -> Trace:
    from consat.engine.flows import simulate_flow

    asked = on.settings.protocol
    flow = with_gains(FLOWS[str(asked.kind)](), asked)
    return simulate_flow(on.team, flow, on.copies, on.schedule, on.first(), infeasible=on.hopeless, **options)


def _rounds(on: Prepared, **options: Any) -> Trace:
    gains, body = on.settings.protocol, options["body"]
    return simulate_rounds(
        on.team, with_gains(ROUNDS[str(gains.kind)](), gains), on.copies, on.schedule.final, on.size,
        on.first(drive=None if body is None else body.drive),
        convex=on.convex, hopeless=on.hopeless, enough=on.enough,
        then=None if on.team.moves or (body is not None and body.drive is not None) else on.then, **options,
    )  # fmt: skip
