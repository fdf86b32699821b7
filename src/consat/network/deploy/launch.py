"""Launches a whole team as processes on this machine, watches it until it has converged, and returns a `Result` as any other run."""

from __future__ import annotations

import time
import uuid
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final, Literal

import numpy as np

from consat.engine.rules import HOLD, SETTLED
from consat.errors import NetworkError
from consat.faults import Faults
from consat.network.deploy.commands import Script, Stage, Timed, load_commands, no_commands
from consat.network.deploy.dashboard import board
from consat.network.deploy.fleet import Fleet, free_ports
from consat.network.deploy.observer import Observer
from consat.network.node.modes import DEFAULT_MODE, RATE, Manner, Mode, protocol_of
from consat.network.node.part import Part, split
from consat.network.node.problem import Alone
from consat.numerics import float64
from consat.problem.changes import changed, changes_of
from consat.problem.objective import SmoothingSchedule
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
"""Time limit of a launch if `Plan.until` is not given, s."""
WINDOW: Final = 1.0
"""Shortest time without motion after which a team counts as converged, s."""
LINK_WINDOW: Final = 10.0
"""The same in mode link, measured in the time of the protocol, s."""
ROUND_TRIPS: Final = 10.0
"""Number of longest message delays that are added to this time."""

Stop = Literal["satisfied", "converged", "never"]
"""Condition for the end of a launch: all agents know the outcome, the team has converged, or none."""


@dataclass(frozen=True)
class Plan:
    """Options of a launch.

    Attributes:
        mode: communication mode of the agents.
        rate: turns per second, Hz; None for the default of the mode.
        pace: in mode link, protocol time per real time, s/s.
        speed: largest speed of a body, length/s; None for no limit.
        loss: probability that an incoming message is dropped.
        burst: (p, q) of losses in bursts, see `consat.faults.Faults`; None for no bursts.
        delay: (low, high) range of the random delay of incoming messages, s.
        rounds: number of turns; None for no limit.
        until: duration, s, counted from the time when all agents have begun; None for no limit.
        stop: condition for an earlier end; None for the default in `ending`.
        keys: folder of the team's keys, see ``consat keys``; None for links without protection.
        commands: path of a file of timed changes, see `consat.network.deploy.commands`; None for no changes.
        sends: ``all``, or only what is news: ``events``; see `consat.protocols.sending`.
    """

    mode: Mode = DEFAULT_MODE
    rate: float | None = None
    pace: float = 1.0
    speed: float | None = None
    loss: float = 0.0
    burst: tuple[float, float] | None = None
    delay: tuple[float, float] = (0.0, 0.0)
    rounds: int | None = None
    until: float | None = None
    stop: Stop | None = None
    keys: Path | None = None
    commands: Path | None = None
    sends: Sends = "all"

    def __post_init__(self) -> None:
        Manner(self.mode, self.rate, self.pace, sends=self.sends)  # raises once, before any agent starts, if options are not valid
        Faults(self.loss, burst=self.burst, delay=self.delay)

    @property
    def ending(self) -> Stop:
        """The condition for the end.

        By default ``never`` if `rounds` or `until` is given. Otherwise ``satisfied`` in mode interior-point, which ends once all agents
        know the outcome, and ``converged`` in the other modes.
        """
        if self.rounds is not None or self.until is not None:
            return self.stop or "never"
        return self.stop or ("satisfied" if self.mode == "interior-point" else "converged")

    def options(self) -> list[str]:
        """The corresponding command line options of ``consat agent``."""
        given = {
            "--mode": self.mode, "--rate": self.rate, "--speed": self.speed, "--rounds": self.rounds,
            "--pace": self.pace if self.pace != 1.0 else None, "--loss": self.loss or None,
            "--burst": None if self.burst is None else f"{self.burst[0]},{self.burst[1]}",
            "--delay": f"{self.delay[0]},{self.delay[1]}" if self.delay[1] else None, "--keys": self.keys,
            "--sends": None if self.sends == "all" else self.sends,
        }  # fmt: skip
        return [text for name, value in given.items() if value is not None for text in (name, str(value))]


@float64
def launch(scenario: Scenario, plan: Plan, *, quiet: bool = True, full: bool = False) -> Result:
    """Start a team as processes, watch it, stop it, and return the result.

    Args:
        scenario: the team and settings. If it names a protocol, the mode must be able to run it.
        plan: options of the launch.
        quiet: whether to show no table in the terminal.
        full: whether to list all agents in the summary, however many there are.

    Raises:
        InvalidTeam: a cluster is not connected by links, or a constraint is a Python function, which cannot be sent to another process.
        InvalidSettings: the mode cannot run the protocol of the scenario.
        InvalidScenario: a command cannot be carried out. No process has been started.
        NetworkError: the process of an agent failed.
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
    schedule = SmoothingSchedule.of(automatic(size) if settings.smoothing == "auto" else settings.smoothing)
    team = crew.stage.there()[0]
    trace = observer.trace(copies_of(team, settings.protocol), schedule.final, ending, seconds, crew.stages, crew.tick)
    if crew.done:  # the margins of the trace cover the earlier states; the verdict is about the final team
        team = team.at(float(trace.steps[-1]) * (trace.period or 1.0))
        scenario = replace(scenario, team=team, text=dump(team, settings, scenario.name))
    summary = summarise(scenario, settings, schedule, size, trace, full=full) | {"mode": plan.mode, "network": observer.network()}
    return Result(summary, trace=trace, team=team, scenario=scenario.text)


def _settings(team: Team, asked: Settings, mode: Mode) -> Settings:
    """The settings with the protocol to run: that of the scenario, else that of the mode; in lockstep the default of `consat.run`."""
    kind = asked.protocol.kind or (default_protocol(team, asked.protocol.estimates) if mode == "lockstep" else None)
    return asked.model_copy(update={"protocol": asked.protocol.model_copy(update={"kind": protocol_of(mode, kind)})})


@dataclass(frozen=True)
class _Rules:
    """Criterion for convergence. Times are in rounds (lockstep) or s.

    Attributes:
        window: time without motion.
        distance: motion up to this counts as none, length.
        earliest: first stamp at which convergence counts.
    """

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
    """Controls the agents of a launch: starts them, restarts them after a crash, sends them the time and the commands.

    Args:
        fleet: the processes of the agents.
        observer: collects what the agents report.
        plan: options of the launch.
        scenario: scenario of the team.
        script: the commands.
        parts: the part (local problem) of each agent at the start, by id.

    Attributes:
        stages: states of the team so far, in order of time.
        epoch: Unix time of t = 0, s; None until all agents are ready.
        ready: the same time on the monotonic clock of this machine, s.
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
        """The current state of the team."""
        return self.stages[-1]

    @property
    def done(self) -> int:
        """Number of commands carried out so far."""
        return len(self.stages) - 1

    @property
    def timed(self) -> bool:
        """Whether anything depends on time: there are commands, or constraints move."""
        return bool(self._script.commands) or self.stage.team.moves

    @property
    def tick(self) -> float:
        """Duration of a round, s; 1 if nothing depends on time."""
        return 1.0 / (self.plan.rate or ROUNDS_A_SECOND) if self.timed else 1.0

    @staticmethod
    def _stamp(unix: float) -> float:
        """The stamp of a Unix time: the time on the monotonic clock of this machine, s."""
        return unix - time.time() + time.monotonic()

    @property
    def earliest(self) -> float:
        """The first stamp at which the team may be done: after the last command and the last motion of constraints. ∞ while not known."""
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
        """Start or restart an agent, with its body where it was last seen. In lockstep it resumes from its state on disk."""
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
        """Restart agents whose process was ended by a signal.

        Raises:
            NetworkError: a process ended with an error. A restart would fail again.
        """
        for agent in self.observer.team.ids:
            code = self.fleet.exit_code(agent) or 0
            if code > 0:
                raise NetworkError(f"the process of agent {agent!r} ended with exit code {code}")
            if code < 0:
                self.start(agent)

    def act(self) -> None:
        """Send the agents the time once all are ready; after that, carry out the commands that are due."""
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
        """Carry out a command. Returns False if it must wait, because the agent that is to join is not ready."""
        agent = command.agents[0]
        if command.command == "change":
            part = self._parts[agent]
            team = changed(part.team, changes_of(part.team, agent, command.constraint, command.parameters))
            self._parts[agent] = replace(part, team=team)
            self.fleet.write(agent, self._parts[agent])  # for a restart after a crash
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
        """Whether an agent that is to join stands by. Starts its process if it does not run."""
        if agent not in self._standby and not self.fleet.running(agent):  # it left earlier
            self._standby.add(agent)
            self.observer.seen[agent].born = None
            self.start(agent)
        return agent in self._standby and self.observer.seen[agent].born is not None

    def _split_anew(self, team: Team) -> None:
        """Send new parts to the agents of `team`, because the holders of estimates and the paths of messages may have changed."""
        self._generation += 1
        addresses = {agent: self._parts[agent].listen for agent in team.ids}
        run = next(iter(self._parts.values())).run
        scenario = replace(self._scenario, team=team)
        self._parts |= split(scenario, run=run, addresses=addresses, epoch=self.epoch, generation=self._generation)
        for agent in team.ids:
            self.fleet.write(agent, self._parts[agent])
            self.fleet.tell(agent, {"command": "reload"})


def _watch(crew: Crew, rules: _Rules, title: str, quiet: bool) -> Ending:
    """Watch the team until it must be stopped. Returns why it ended. Restarts agents that crash.

    Args:
        crew: the agents.
        rules: criterion for convergence.
        title: title of the table in the terminal.
        quiet: whether to show no table.
    """
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
