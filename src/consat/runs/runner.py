"""`run`: from a team or a scenario to a result."""

from __future__ import annotations

import dataclasses
import functools
import os
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, Literal

import jax
import numpy as np

from consat.errors import InvalidSettings
from consat.estimates import Estimates, Layout
from consat.numerics import float64
from consat.protocols import FLOWS, ROUNDS, with_gains
from consat.result import RESULT, Result
from consat.runs.advice import around_loops
from consat.runs.preparation import Prepared, named, scenario_of, settings_of, told, with_auxiliary
from consat.runs.restarting import best_start
from consat.runs.summary import summarise
from consat.scenario import Scenario, loads
from consat.settings import Settings, Smoothing
from consat.simulate import Stop
from consat.simulate import checkpoint as checkpoints
from consat.simulate.files import Files, claim
from consat.simulate.flows import simulate_flow
from consat.simulate.kernel import Body, Weather
from consat.simulate.recording import Choice, Who
from consat.simulate.rounds import simulate_rounds
from consat.teams.team import Team
from consat.trace import Trace


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
    restarts: int = 1,
    record: bool | None = None,
    agents: Who = None,
    every: int = 1,
    out: str | os.PathLike[str] | None = None,
    checkpoint: float | None = None,
    force: bool = False,
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
        restarts: runs from so many starts, of this seed and those after it, as one computation, and tells of the one that ends with the
            largest margin. In rounds only.
        record: whether to keep all estimates and integral states; by default while they are few.
        agents: of whom to record anything: ids, ``all`` or ``none``; by default all, of more than 10,000 a sample of 1,000.
        every: each how manieth round, or sample of a flow, to record.
        out: a directory, for a result file ``result.nc`` that grows as the run goes on; by default the record is held in memory.
        checkpoint: seconds between two checkpoints in `out`, from which `resume` goes on; none if None.
        force: whether to overwrite results of another scenario in `out`.
        full: whether to list every agent in the summary, however many.
        progress: called with the fraction done and the margin.

    Returns:
        the result; divergence, time-out and infeasibility are told by its status and verdict.

    Raises:
        InvalidTeam: agents that depend on each other cannot reach one another (Assumption 1).
        InvalidScenario: the scenario has faults.
        InvalidSettings: the settings do not fit together, or `out` cannot be written to or holds results of another scenario.
    """
    given = {
        "protocol": protocol, "estimates": estimates, "seed": seed, "start": start, "smoothing": smoothing,
        "until": until, "rounds": rounds, "stop": stop, "loss": loss, "sleep": sleep, "rate": rate, "speed": speed,
        "auxiliary": auxiliary, "restarts": restarts, "record": record, "agents": agents, "every": every,
    }  # fmt: skip
    if checkpoint is not None and out is None:
        raise InvalidSettings("checkpoint needs out: the directory in which the checkpoint and the result stand")
    scenario = scenario_of(team)
    if out is not None:
        claim(Path(out), scenario.name, force=force)
    files = None if out is None else Files(Path(out), checkpoint)
    return _start(scenario, given, files, full, progress)


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
    about = {
        "scenario": scenario.text,
        "scenario_name": scenario.name,
        "name": scenario.source,
        "given": {key: _as_data(value) for key, value in given.items()},
    }
    if given["auxiliary"] is not None:
        scenario = with_auxiliary(scenario, given["auxiliary"])
    settings = settings_of(scenario.settings, given, scenario.team)
    kind = settings.protocol.kind
    until, rounds, loss, sleep, rate, speed = (given[key] for key in ("until", "rounds", "loss", "sleep", "rate", "speed"))
    restarts = given.get("restarts", 1)
    if restarts < 1:
        raise InvalidSettings(f"restarts is {restarts}, but must be at least 1: from how many starts to run")
    default = "never" if until is not None or rounds is not None else "converged" if kind == "max-min" else "satisfied"
    options: dict[str, Any] = {"stop": given["stop"] or default, "progress": progress}
    if jax.process_count() > 1 and (kind in FLOWS or (files is not None and files.checkpoints(about) is not None)):
        raise InvalidSettings("several processes run protocols in rounds, and without checkpoints")
    more = told(scenario.team, settings.protocol.model_copy(update={"kind": named(scenario.settings, given)})) | {"restarts": None}
    keep = _Keep(given["agents"], given["record"], given["every"], files, about)
    if kind in FLOWS:
        rounds_only = {"rounds": rounds, "loss": loss, "sleep": sleep, "rate": rate, "speed": speed, "restarts": restarts - 1}
        _refuse(f"protocol {kind} flows in continuous time; use until", **rounds_only)
        return _run(scenario, settings, full, keep, more, functools.partial(_flow, until=until, **options))
    _refuse(f"protocol {kind} goes in rounds; use rounds", until=until)
    if (speed is not None and rate is None) or not all(value is None or value > 0 for value in (speed, rate)):
        raise InvalidSettings("speed and rate must be positive, and speed needs rate: a body moves at most speed/rate a round")
    if not (0 <= loss < 1 and 0 <= sleep < 1):
        raise InvalidSettings(f"loss is {loss} and sleep is {sleep}, but both must be probabilities below 1")
    if restarts > 1:
        _refuse("restarts are runs in one process of agents that are where they want to be", rate=rate, processes=jax.process_count() - 1)
        found = best_start(scenario.team, settings, restarts, Weather(loss, sleep), rounds=rounds, stop=given["stop"])
        settings = settings.model_copy(update={"start": settings.start.model_copy(update={"seed": found["seed"]})})
        more |= {"restarts": found}
    weather = Weather(loss, sleep, settings.start.seed)
    body = None if rate is None else Body(rate, np.inf if speed is None else speed)
    simulate = functools.partial(_rounds, rounds=rounds, weather=weather, body=body, **options)
    return _run(scenario, settings, full, keep, more, simulate)


def _as_data(value: Any) -> Any:
    """An argument of `run` as JSON can hold it."""
    if isinstance(value, Smoothing):
        return value.model_dump(by_alias=True)
    if isinstance(value, np.ndarray | np.generic):
        return value.tolist()
    return value if isinstance(value, str) or not isinstance(value, Sequence) else [_as_data(each) for each in value]


def _refuse(why: str, **given: float | None) -> None:
    if wrong := [name for name, value in given.items() if value]:
        raise InvalidSettings(f"{why}; {', '.join(wrong)} means nothing to it")


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
def _run(
    scenario: Scenario, settings: Settings, full: bool, keep: _Keep, more: Mapping[str, Any], simulate: Callable[..., Trace]
) -> Result:
    team = scenario.team
    ready = Prepared.of(team, settings)
    options = keep.options(team, ready.copies, "time" if settings.protocol.kind in FLOWS else "round")
    trace = simulate(ready, **options)
    summary = summarise(scenario, settings, ready.schedule, ready.size, trace, full)
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
    asked = on.settings.protocol
    flow = with_gains(FLOWS[str(asked.kind)](), asked)
    return simulate_flow(on.team, flow, on.copies, on.schedule, on.first(), infeasible=on.hopeless, **options)


def _rounds(on: Prepared, **options: Any) -> Trace:
    asked = on.settings.protocol
    return simulate_rounds(
        on.team, with_gains(ROUNDS[str(asked.kind)](), asked), on.copies, on.schedule.final, on.size, on.first(),
        convex=on.convex, hopeless=on.hopeless, enough=on.enough, then=on.then, **options,
    )  # fmt: skip
