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
from consat.network.deploy.commands import Script, Stage, Timed, load_commands, no_commands
from consat.network.deploy.dashboard import board
from consat.network.deploy.fleet import Fleet, free_ports
from consat.network.deploy.observer import Observer
from consat.network.node.modes import DEFAULT_MODE, RATE, Manner, Mode, protocol_of
from consat.network.node.part import Part, split
from consat.network.node.problem import Alone
from consat.numerics import float64
from consat.problem.changes import changed, changes_of
from consat.problem.objective import Schedule
from consat.problem.team import Team
from consat.problem.units import automatic, scale
from consat.protocols import ROUNDS
from consat.protocols.sending import Sends
from consat.results.result import Result
from consat.results.trace import Ending
from consat.runs.options import RATE as ROUNDS_A_SECOND
from consat.runs.options import WATCHED
from consat.runs.preparation import copies_of, default_protocol
from consat.runs.summary import summarise
from consat.scenario import Scenario, dump
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
        commands: a file of timed changes, see `consat.network.deploy.commands`.
        sends: ``all``, or only what is news: ``events``.
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
    commands: Path | None = None
    sends: Sends = "all"

    def __post_init__(self) -> None:
        Manner(self.mode, self.rate, self.pace, sends=self.sends)  # what no agent could run is refused here, once

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
            "--sends": None if self.sends == "all" else self.sends,
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
        InvalidScenario: a command cannot be carried out; nothing has started.
        NetworkError: an agent's process failed.
    """
    team = scenario.team
    settings = _settings(team, scenario.settings, plan.mode)
    scenario = replace(scenario, settings=settings)
    script = no_commands(team) if plan.commands is None else load_commands(plan.commands, team, plan.mode, plan.until)
    ports = free_ports(team.count)
    addresses = {agent: f"tcp/127.0.0.1:{port}" for agent, port in zip(team.ids, ports, strict=True)}
    absent = frozenset(team.ids) - script.begin.present
    parts = split(scenario, run=f"launch-{uuid.uuid4().hex[:12]}", addresses=addresses, absent=absent)
    size = scale(team)
    starts = np.array([part.first[part.team.ids.index(agent)] for agent, part in parts.items()])
    observer = Observer(team, starts, "round" if plan.mode == "lockstep" else "time")
    began = time.monotonic()
    with Fleet(parts, plan.options(), exact=plan.mode == "lockstep") as fleet:
        crew = Crew(fleet, observer, plan, scenario, script, parts)
        for agent in team.ids:
            crew.start(agent)
        ending = _watch(crew, _rules(parts, plan, size.length), f"{scenario.name}, {plan.mode}", quiet)
        up = crew.ready or time.monotonic()
        observer.take(fleet.stop())
    seconds = {"compile": up - began, "run": time.monotonic() - up}
    schedule = Schedule.of(automatic(size) if settings.smoothing == "auto" else settings.smoothing)
    team = crew.stage.there()[0]
    trace = observer.trace(copies_of(team, settings.protocol), schedule.final, ending, seconds, crew.stages, crew.tick)
    if crew.done:  # what it was before is in the margins of the trace; verdicts over time are of a team that is not changed
        team = team.at(float(trace.steps[-1]) * (trace.period or 1.0))
        scenario = replace(scenario, team=team, text=dump(team, settings, scenario.name))
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


class Crew:
    """The agents of a launch: started, started again when they crash, told the time and what changes.

    Args:
        fleet: their processes.
        observer: what they tell.
        plan: how they are launched.
        scenario: of the team.
        script: what changes.
        parts: as they start.

    Attributes:
        stages: how the team stood, one after the other, and since when.
        epoch: when t = 0 was, s of Unix time; None before all are ready.
        ready: the same by the monotonic clock of this machine.
    """

    def __init__(
        self, fleet: Fleet, observer: Observer, plan: Plan, scenario: Scenario, script: Script, parts: Mapping[str, Part]
    ) -> None:  # fmt: skip
        self.fleet, self.observer, self.plan = fleet, observer, plan
        self.stages = [script.begin]
        self.epoch: float | None = None
        self.ready: float | None = None
        self._scenario, self._script, self._parts = scenario, script, dict(parts)
        self._standby = set(parts) - script.begin.present
        self._generation = 0
        observer.present = script.begin.present

    @property
    def stage(self) -> Stage:
        """How the team stands now."""
        return self.stages[-1]

    @property
    def done(self) -> int:
        """How many commands have been carried out."""
        return len(self.stages) - 1

    @property
    def timed(self) -> bool:
        """Whether anything happens by the clock."""
        return bool(self._script.commands) or self.stage.team.moves

    @property
    def tick(self) -> float:
        """Of a round, s; one where nothing goes by time."""
        return 1.0 / (self.plan.rate or ROUNDS_A_SECOND) if self.timed else 1.0

    @staticmethod
    def _stamp(unix: float) -> float:
        """The stamp, by the monotonic clock of this machine, of a Unix time."""
        return unix - time.time() + time.monotonic()

    @property
    def earliest(self) -> float:
        """The first stamp at which the team may be done: when nothing is to happen any more; ∞ while that is not known."""
        if not self.timed:
            return -np.inf
        if self.done < len(self._script.commands):
            return np.inf
        team = self.stage.team
        moving = float(team.knots.max(initial=0.0)) if len(team.knots) or not team.moves else WATCHED
        last = max([moving, *(each.at for each in self._script.commands)])
        if self.plan.mode == "lockstep":
            return last / self.tick
        return np.inf if self.epoch is None else self._stamp(self.epoch) + last

    def start(self, agent: str) -> None:
        """Start an agent, or start it again where its body was last seen; in lockstep from what it has on disk."""
        ids, seed = list(self.observer.team.ids), self._scenario.settings.start.seed
        own = ["--seed", str(seed * len(ids) + ids.index(agent))]
        if self.observer.seen[agent].places:
            own += ["--position", ",".join(map(repr, self.observer.seen[agent].places[-1]))]
        if self.plan.mode == "lockstep":
            own += ["--memory", str(self.fleet.file(agent, "state"))]
        if self.epoch is not None:
            own += ["--epoch", repr(self.epoch)]
        if agent in self._standby:
            own += ["--standby"]
        self.fleet.start(agent, *own)

    def mend(self) -> None:
        """Start those again that a signal has ended. Raises: NetworkError: one has failed by itself, and would again."""
        for agent in self.observer.team.ids:
            code = self.fleet.exit_code(agent) or 0
            if code > 0:
                raise NetworkError(f"the process of agent {agent!r} ended with exit code {code}")
            if code < 0:
                self.start(agent)

    def act(self) -> None:
        """Tell the agents the time once all are ready, and then what changes, when it is due."""
        if self.epoch is None:
            if not all(seen.born is not None for seen in self.observer.seen.values()):
                return
            self.epoch, self.ready = time.time(), time.monotonic()
            if self.timed and self.plan.mode != "lockstep":
                self.observer.origin = self.ready
            for agent in self.observer.team.ids if self.timed else ():
                self.fleet.tell(agent, {"command": "clock", "epoch": self.epoch})
        commands, epoch = self._script.commands, self.epoch
        while self.done < len(commands) and time.time() - epoch >= commands[self.done].at and self._carry_out(commands[self.done]):
            self.stages.append(commands[self.done].after._replace(since=time.time() - epoch))
            self.observer.present = self.stage.present

    def _carry_out(self, command: Timed) -> bool:
        """Whether it is done; not before one who is to join is ready to."""
        agent = command.agents[0]
        if command.command == "change":
            part = self._parts[agent]
            team = changed(part.team, changes_of(part.team, agent, command.constraint, command.parameters))
            self._parts[agent] = replace(part, team=team)
            self.fleet.write(agent, self._parts[agent])  # for when it crashes
            self.fleet.tell(agent, {"command": "change", "constraint": command.constraint, **command.parameters})
            return True
        if command.command == "join" and not self._is_ready(agent):
            return False
        self._split_anew(command.after.there()[0])
        if command.command in ("leave", "join"):
            self._standby -= {agent}
            self.fleet.tell(agent, {"command": command.command})
        return True

    def _is_ready(self, agent: str) -> bool:
        """Whether one who is to join stands by; it is started if it does not run."""
        if agent not in self._standby and not self.fleet.running(agent):  # it has left before
            self._standby.add(agent)
            self.observer.seen[agent].born = None
            self.start(agent)
        return agent in self._standby and self.observer.seen[agent].born is not None

    def _split_anew(self, team: Team) -> None:
        """New parts for those who are there: who holds what, and along which links it travels, may be other than before."""
        self._generation += 1
        addresses = {agent: self._parts[agent].listen for agent in team.ids}
        run = next(iter(self._parts.values())).run
        scenario = replace(self._scenario, team=team)
        self._parts |= split(scenario, run=run, addresses=addresses, epoch=self.epoch, generation=self._generation)
        for agent in team.ids:
            self.fleet.write(agent, self._parts[agent])
            self.fleet.tell(agent, {"command": "reload"})


def _watch(crew: Crew, rules: _Rules, title: str, quiet: bool) -> Ending:
    """Until the team is to be stopped; why. `Plan.until` counts from when all agents have begun. Who crashes is started again."""
    began, plan, observer = time.monotonic(), crew.plan, crew.observer
    end = None if plan.until is not None else began + PATIENCE
    agents = observer.team.ids
    try:
        with board(title, quiet=quiet) as draw:
            while end is None or time.monotonic() < end:
                observer.take(crew.fleet.poll(0.05))
                draw(observer, {agent: crew.fleet.running(agent) for agent in agents}, time.monotonic() - began)
                crew.mend()
                crew.act()
                if not np.isfinite(observer.positions()).all():
                    return "diverged"
                if plan.rounds is not None and all(seen.finished or seen.ended for seen in observer.there):
                    return "out of time"
                if not all(seen.stamps for seen in observer.there):
                    continue
                if end is None:
                    end = time.monotonic() + (plan.until or 0.0)
                if (found := _ending(observer, plan.ending, rules, crew.earliest)) is not None:
                    return found
    except KeyboardInterrupt:
        return "interrupted"
    return "out of time"


def _ending(observer: Observer, stop: Stop, rules: _Rules, earliest: float) -> Ending | None:
    latest = min((seen.stamps[-1] if seen.stamps else -np.inf) for seen in observer.there)
    known, since = observer.all_known()[0], observer.concluded()
    since = None if since is None else max(since, earliest)
    if stop != "never" and (stop == "satisfied" or known == "infeasible") and since is not None and latest - since >= rules.window:
        return "satisfied" if known == "satisfied" else "settled"
    if stop != "never" and latest >= max(rules.earliest, earliest) and observer.settled(rules.window, rules.distance):
        return "settled"
    return None
