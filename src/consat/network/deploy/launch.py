"""A whole team as processes on this machine, watched until it has converged, and a `Result` as from any other run."""

from __future__ import annotations

import time
import uuid
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final, Literal

import numpy as np

from consat.engine.rounds import HOLD, SETTLED
from consat.errors import NetworkError
from consat.network.deploy.dashboard import board
from consat.network.deploy.fleet import Fleet, free_ports
from consat.network.deploy.observer import Observer
from consat.network.node.modes import DEFAULT_MODE, RATE, Manner, Mode, protocol_of
from consat.network.node.part import Part, split
from consat.network.node.problem import Alone
from consat.numerics import float64
from consat.problem.objective import Schedule
from consat.problem.team import Team
from consat.problem.units import automatic, scale
from consat.protocols import ROUNDS
from consat.results.result import Result
from consat.results.trace import Ending
from consat.runs.preparation import copies_of, default_protocol
from consat.runs.summary import summarise
from consat.scenario import Scenario
from consat.settings import Settings

PATIENCE: Final = 600.0
"""A team may take so long when nobody says, s."""
WINDOW: Final = 1.0
"""A team that did not move for so long, s, has converged …"""
LINK_WINDOW: Final = 10.0
"""… and in mode link for so long by the protocol's own clock; …"""
ROUND_TRIPS: Final = 10.0
"""… and for so many times the longest delay."""

Stop = Literal["satisfied", "converged", "never"]


@dataclass(frozen=True)
class Plan:
    """How a team is launched.

    Attributes:
        mode: how the agents talk.
        rate: turns a second, Hz; None for the mode's own.
        pace: of link, seconds of the protocol's time in each real one.
        speed: the most that a body moves, length/s; None for no limit.
        loss: probability that a message is dropped where it arrives.
        delay: (low, high) for which each is held back there, s.
        rounds: how many turns; None for no end.
        until: how long, s; None for no end.
        stop: when to end earlier; unless `rounds` or `until` say when, once all agents know all that there is to find (interior-point), or
            after convergence.
        keys: folder of the team's keys, see ``consat keys``; None for links without protection.
    """

    mode: Mode = DEFAULT_MODE
    rate: float | None = None
    pace: float = 1.0
    speed: float | None = None
    loss: float = 0.0
    delay: tuple[float, float] = (0.0, 0.0)
    rounds: int | None = None
    until: float | None = None
    stop: Stop | None = None
    keys: Path | None = None

    def __post_init__(self) -> None:
        Manner(self.mode, self.rate, self.pace)  # what no agent could run is refused here, once

    @property
    def ending(self) -> Stop:
        """When to end."""
        if self.rounds is not None or self.until is not None:
            return self.stop or "never"
        return self.stop or ("satisfied" if self.mode == "interior-point" else "converged")

    def options(self) -> list[str]:
        """Of ``consat agent``."""
        given = {
            "--mode": self.mode, "--rate": self.rate, "--speed": self.speed, "--rounds": self.rounds,
            "--pace": self.pace if self.pace != 1.0 else None, "--loss": self.loss or None,
            "--delay": f"{self.delay[0]},{self.delay[1]}" if self.delay[1] else None, "--keys": self.keys,
        }  # fmt: skip
        return [text for name, value in given.items() if value is not None for text in (name, str(value))]


@float64
def launch(scenario: Scenario, plan: Plan, *, quiet: bool = True, full: bool = False) -> Result:
    """Start a team, watch it, stop it.

    Args:
        scenario: whose protocol, if it names one, must suit the mode.
        plan: how.
        quiet: no table in the terminal.
        full: whether to list every agent in the summary, however many.

    Raises:
        InvalidTeam: a cluster is not connected by links, or a constraint is a Python function, which no other process can be given.
        InvalidSettings: the mode does not run the scenario's protocol.
        NetworkError: an agent's process failed.
    """
    team = scenario.team
    settings = _settings(team, scenario.settings, plan.mode)
    scenario = replace(scenario, settings=settings)
    ports = free_ports(team.count)
    addresses = {agent: f"tcp/127.0.0.1:{port}" for agent, port in zip(team.ids, ports, strict=True)}
    parts = split(scenario, run=f"launch-{uuid.uuid4().hex[:12]}", addresses=addresses)
    size = scale(team)
    starts = np.array([part.first[part.team.ids.index(agent)] for agent, part in parts.items()])
    observer = Observer(team, starts, "round" if plan.mode == "lockstep" else "time")
    began = time.monotonic()
    with Fleet(parts, plan.options(), exact=plan.mode == "lockstep") as fleet:
        for agent in team.ids:
            _start(fleet, observer, plan, agent, settings.start.seed)
        ending = _watch(
            fleet, observer, plan, _rules(parts, plan, size.length), _Watch(f"{scenario.name}, {plan.mode}", quiet, settings.start.seed)
        )
        up = _up(observer, began)
        observer.take(fleet.stop())
    seconds = {"compile": up - began, "run": time.monotonic() - up}
    schedule = Schedule.of(automatic(size) if settings.smoothing == "auto" else settings.smoothing)
    trace = observer.trace(copies_of(team, settings.protocol), schedule.final, ending, seconds)
    summary = summarise(scenario, settings, schedule, size, trace, full) | {"mode": plan.mode, "network": observer.network()}
    return Result(summary, trace=trace, team=team, scenario=scenario.text)


def _settings(team: Team, asked: Settings, mode: Mode) -> Settings:
    """The protocol that runs is the mode's own, unless the scenario asks for one; in lockstep it is that of `run`."""
    kind = asked.protocol.kind or (default_protocol(team, asked.protocol.estimates) if mode == "lockstep" else None)
    return asked.model_copy(update={"protocol": asked.protocol.model_copy(update={"kind": protocol_of(mode, kind)})})


@dataclass(frozen=True)
class _Rules:
    """When a team has converged: in rounds or s."""

    window: float
    distance: float
    earliest: float


def _rules(parts: Mapping[str, Part], plan: Plan, length: float) -> _Rules:
    if plan.mode == "lockstep":
        part = next(iter(parts.values()))
        protocol = ROUNDS[protocol_of(plan.mode, part.settings.protocol.kind)]()
        earliest = protocol.earliest(Alone.of(part, protocol.speaks))
        return _Rules(HOLD, SETTLED * length, earliest + HOLD)
    window = max(WINDOW, LINK_WINDOW / plan.pace if plan.mode == "link" else 0.0, HOLD / (plan.rate or RATE[plan.mode]))
    return _Rules(window + ROUND_TRIPS * plan.delay[1], SETTLED * length, -np.inf)


@dataclass(frozen=True)
class _Watch:
    """How a team is watched: title of the table, whether there is none, and the seed of agents that start anew."""

    title: str
    quiet: bool
    seed: int


def _start(fleet: Fleet, observer: Observer, plan: Plan, agent: str, seed: int) -> None:
    """Start an agent, or start it again where its body was last seen; in lockstep from what it has on disk."""
    ids = list(observer.team.ids)
    own = ["--seed", str(seed * len(ids) + ids.index(agent))]
    if observer.seen[agent].places:
        own += ["--position", ",".join(map(repr, observer.seen[agent].places[-1]))]
    if plan.mode == "lockstep":
        own += ["--memory", str(fleet.file(agent, "state"))]
    fleet.start(agent, *own)


def _mend(fleet: Fleet, observer: Observer, plan: Plan, seed: int) -> None:
    """Start those again that a signal has ended. Raises: NetworkError: one has failed by itself, and would again."""
    for agent in observer.team.ids:
        code = fleet.exit_code(agent) or 0
        if code > 0:
            raise NetworkError(f"the process of agent {agent!r} ended with exit code {code}")
        if code < 0:
            _start(fleet, observer, plan, agent, seed)


def _watch(fleet: Fleet, observer: Observer, plan: Plan, rules: _Rules, watch: _Watch) -> Ending:
    """Until the team is to be stopped; why. `Plan.until` counts from when all agents have begun. Who crashes is started again."""
    began = time.monotonic()
    end = None if plan.until is not None else began + PATIENCE
    agents = observer.team.ids
    try:
        with board(watch.title, quiet=watch.quiet) as draw:
            while end is None or time.monotonic() < end:
                observer.take(fleet.poll(0.05))
                draw(observer, {agent: fleet.running(agent) for agent in agents}, time.monotonic() - began)
                _mend(fleet, observer, plan, watch.seed)
                if not np.isfinite(observer.positions()).all():
                    return "diverged"
                if plan.rounds is not None and all(seen.finished or seen.ended for seen in observer.seen.values()):
                    return "out of time"
                if not all(seen.stamps for seen in observer.seen.values()):
                    continue
                if end is None:
                    end = time.monotonic() + (plan.until or 0.0)
                if (found := _ending(observer, plan.ending, rules)) is not None:
                    return found
    except KeyboardInterrupt:
        return "interrupted"
    return "out of time"


def _up(observer: Observer, began: float) -> float:
    """When the last agent had begun, by the clock of this machine."""
    return max([began, *(seen.born for seen in observer.seen.values() if seen.born is not None)])


def _ending(observer: Observer, stop: Stop, rules: _Rules) -> Ending | None:
    latest = min((seen.stamps[-1] if seen.stamps else -np.inf) for seen in observer.seen.values())
    known, since = observer.all_known()[0], observer.concluded()
    if stop != "never" and (stop == "satisfied" or known == "infeasible") and since is not None and latest - since >= rules.window:
        return "satisfied" if known == "satisfied" else "settled"
    if stop != "never" and latest >= rules.earliest and observer.settled(rules.window, rules.distance):
        return "settled"
    return None
