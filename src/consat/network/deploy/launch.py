"""Runs a whole team as processes on this machine until it has converged, and returns a `Result` as any other run."""

from __future__ import annotations

import signal
import time
import uuid
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Final, Literal

import numpy as np

from consat.engine.rounds import HOLD, SETTLED, TURN, TURN_HOP
from consat.errors import NetworkError
from consat.faults import Faults
from consat.network.deploy.commands import Script, Stage, Timed, load_commands, no_commands
from consat.network.deploy.dashboard import board
from consat.network.deploy.fleet import Fleet, free_ports
from consat.network.deploy.observer import Observer
from consat.network.node.modes import DEFAULT_MODE, RATE, Mode, NodeSettings, protocol_of
from consat.network.node.part import Part, split
from consat.network.node.problem import OwnSolver
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
from consat.runs.preparation import copies_of, default_protocol, told, way_of
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

BODILESS: Final = (
    "launch simulates each robot as a point, without its size and limits, and without obstacles; consat run simulates robots, and "
    "consat agent --sensor stdin commands real ones"
)
"""Warning for a scenario with robots."""

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
        faults: loss, bursts and delay of incoming messages. Each agent draws from a seed of its own, derived from that of the scenario.
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
    faults: Faults = field(default_factory=Faults)
    rounds: int | None = None
    until: float | None = None
    stop: Stop | None = None
    keys: Path | None = None
    commands: Path | None = None
    sends: Sends = "all"

    def __post_init__(self) -> None:
        NodeSettings(self.mode, self.rate, self.pace, sends=self.sends)  # raises once, before any agent starts, if options are not valid

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
        faults = self.faults
        given = {
            "--mode": self.mode, "--rate": self.rate, "--speed": self.speed, "--rounds": self.rounds,
            "--pace": self.pace if self.pace != 1.0 else None, "--loss": faults.loss or None,
            "--burst": None if faults.burst is None else f"{faults.burst[0]},{faults.burst[1]}",
            "--delay": f"{faults.delay[0]},{faults.delay[1]}" if faults.delay[1] else None, "--keys": self.keys,
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
        supervisor = Supervisor(fleet, observer, plan, scenario, script, parts)
        for agent in team.ids:
            supervisor.start(agent)
        ending = _watch(supervisor, _rules(parts, plan, size.length), f"{scenario.name}, {plan.mode}", quiet)
        up = supervisor.ready or time.monotonic()
        ended = supervisor.endings(began)
        observer.take(fleet.stop())
    seconds = {"compile": up - began, "run": time.monotonic() - up}
    schedule = Schedule.of(automatic(size) if settings.smoothing == "auto" else settings.smoothing)
    team = supervisor.stage.present_team()[0]
    trace = observer.trace(
        copies_of(supervisor.tree or team, settings.protocol), schedule.final, ending, seconds, supervisor.stages, supervisor.tick
    )
    if supervisor.done:  # the margins of the trace cover the earlier states; the verdict is about the final team
        team = team.at(float(trace.steps[-1]) * (trace.period or 1.0))
        scenario = replace(scenario, team=team, text=dump(team, settings, scenario.name))
    summary = summarise(scenario, settings, schedule, size, trace, full=full)
    summary |= told(team, settings.protocol) | {"mode": plan.mode, "network": observer.network() | {"ended": ended}}
    if supervisor.tree is not None:
        summary |= {"route": "tree", "why": "the links form loops and had not satisfied the team in time; it went over to a spanning tree"}
    summary["warnings"] += [*map(_warning, ended), *([] if scenario.robots is None else [BODILESS])]
    return Result(summary, trace=trace, team=team, scenario=scenario.text)


def _warning(ended: Mapping[str, Any]) -> str:
    """Warning about an agent whose process ended without being told to. `ended`: see `Supervisor.endings`."""
    again = "it was started again" if ended["restarted"] else "it was not started again"
    return f"the process of agent {ended['agent']!r} ended ({ended['how']}) at {ended['time']:.1f} s; {again}"


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
        earliest = protocol.earliest(OwnSolver.of(part, protocol.speaks))
        return _Rules(HOLD, SETTLED * length, earliest + HOLD)
    window = max(WINDOW, LINK_WINDOW / plan.pace if plan.mode == "link" else 0.0, HOLD / (plan.rate or RATE[plan.mode]))
    return _Rules(window + ROUND_TRIPS * plan.faults.delay[1], SETTLED * length, -np.inf)


class Supervisor:
    """Controls the agents of a launch: starts them, restarts those that end unasked, and sends them the time and the commands.

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
        tree: the team on the links of a spanning tree, along which it exchanges copies since `turn`; None while it does so along all links.
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
        self.tree: Team | None = None
        self._changed = -np.inf  # stamp of the last command or restart
        self._turned: float | None = None  # stamp at which `turn` has decided on a tree; None before
        self._endings: list[dict[str, Any]] = []
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
        """Start or restart an agent, with its body at its last reported position. In lockstep it resumes from its state on disk."""
        ids, seed = list(self.observer.team.ids), self._scenario.settings.start.seed
        own = ["--seed", str(seed * len(ids) + ids.index(agent))]
        if self.observer.records[agent].places:
            own += ["--position", ",".join(map(repr, self.observer.records[agent].places[-1]))]
        if self.plan.mode == "lockstep":
            own += ["--memory", str(self.fleet.file(agent, "state"))]
        if self.epoch is not None:
            own += ["--epoch", repr(self.epoch)]
        if agent in self._standby:
            own += ["--standby"]
        self.fleet.start(agent, *own)

    def restart_ended(self) -> None:
        """Restart the agents whose process has ended, except those that were told to end.

        Raises:
            NetworkError: a process ended with an error. A restart would fail again.
        """
        for agent, code in self._ended():
            if code > 0:
                raise NetworkError(f"the process of agent {agent!r} ended with exit code {code}")
            self._note(agent, code, restarted=True)
            self.observer.records[agent].lose()
            self.start(agent)
            self._changed = time.monotonic()

    def endings(self, began: float) -> list[dict[str, Any]]:
        """Entry ``ended`` of the summary: the processes that ended without being told to, each with its ``agent``, the ``time`` (s since
        all agents were ready, negative before), ``how`` it ended (a signal or an exit code), and whether it was ``restarted``.

        Args:
            began: start of the launch on the monotonic clock, s. Times count from it if the agents were never ready.
        """
        for agent, code in self._ended():
            self._note(agent, code, restarted=False)
        since = began if self.ready is None else self.ready
        return [{**each, "time": round(each["time"] - since, 3)} for each in self._endings]

    def _ended(self) -> list[tuple[str, int]]:
        """The agents whose process has ended without being told to, with the exit codes."""
        ended = []
        for agent, record in self.observer.records.items():
            told = agent not in self.stage.present and agent not in self._standby
            done = self.plan.rounds is not None and record.ended is not None and record.ended["why"] == "done"
            code = self.fleet.exit_code(agent)
            if code is not None and (code > 0 or not (told or done)):
                ended.append((agent, code))
        return ended

    def _note(self, agent: str, code: int, *, restarted: bool) -> None:
        ended = self.observer.records[agent].ended
        why = f"exit code {code}" if ended is None or code else ended["why"]
        how = signal.Signals(-code).name if code < 0 else why
        self._endings.append({"agent": agent, "time": time.monotonic(), "how": how, "restarted": restarted})

    def advance(self) -> None:
        """Send the agents the time once all are ready; after that, carry out the commands that are due."""
        if self.epoch is None:
            if not all(record.born is not None for record in self.observer.records.values()):
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
        self._changed = time.monotonic()
        if command.command == "change":
            part = self._parts[agent]
            team = changed(part.team, changes_of(part.team, agent, command.constraint, command.parameters))
            self._parts[agent] = replace(part, team=team)
            self.fleet.write(agent, self._parts[agent])  # for a restart after a crash
            self.fleet.tell(agent, {"command": "change", "constraint": command.constraint, **command.parameters})
            return True
        if command.command == "join" and not self._is_ready(agent):
            return False
        self.tree = self._turned = None
        self._split_again(command.after.present_team()[0])
        if command.command in ("leave", "join"):
            self._standby -= {agent}
            self.fleet.tell(agent, {"command": command.command})
        return True

    def _is_ready(self, agent: str) -> bool:
        """Whether an agent that is to join stands by. Starts its process if it does not run."""
        if agent not in self._standby and not self.fleet.running(agent):  # it left earlier
            self._standby.add(agent)
            self.observer.records[agent].lose()
            self.start(agent)
        return agent in self._standby and self.observer.records[agent].born is not None

    def turn(self) -> None:
        """Split the team along a spanning tree if it is not satisfied in time along links with loops.

        On the tree the agents can prove that they cannot be satisfied. `consat.run` does the same after the same number of rounds, see
        `consat.engine.rounds.TURN`. Here a new split costs seconds, so the team has at least `WINDOW`. Where messages are lost or late, it
        has proportionally more turns.
        """
        if self._turned is not None or not self._overdue():
            return
        self._turned = time.monotonic()
        team, protocol = self.stage.present_team()[0], self._scenario.settings.protocol
        then = way_of(team, str(protocol.kind), protocol.estimates).then
        if then is not None:
            self.tree = team.with_links(then.links)
            self._split_again(self.tree)

    @property
    def still_from(self) -> float:
        """The stamp from which standing still counts as convergence: not before `turn` has decided, and the agents follow the tree."""
        if self.tree is not None and self._turned is not None:
            born = [record.born for record in self.observer.present_records]
            return max((np.inf if each is None or each < self._turned else each for each in born), default=-np.inf)
        return np.inf if self._turned is None and self._may_turn and self._unsatisfied() else -np.inf

    @property
    def _may_turn(self) -> bool:
        return self.plan.mode == "interior-point" and not self.stage.team.moves

    def _unsatisfied(self) -> bool:
        """Whether an agent has reported a margin that is not positive. Bodies with a limited speed lag, so there estimates are judged."""
        kind = "margin" if self.plan.speed is None else "estimate_margin"
        margins = [record.report[kind] for record in self.observer.present_records if record.report is not None]
        return any(margin is not None and margin <= 0 for margin in margins)

    def _overdue(self) -> bool:
        """Whether the team has taken enough turns since its last change, and is still not satisfied."""
        plan, there = self.plan, self.observer.present_records
        if not (self._may_turn and self._unsatisfied() and all(record.stamps for record in there)):
            return False
        first = max(self._changed, min(record.stamps[0] for record in there))
        if min(record.stamps[-1] for record in there) < first + WINDOW:
            return False
        hops, rate = max(part.hops for part in self._parts.values()), plan.rate or RATE[plan.mode]
        turns = (TURN + TURN_HOP * hops) * (1.0 + plan.faults.delay[1] * rate) / (1.0 - plan.faults.loss)
        return bool(min(len(record.stamps) - np.searchsorted(record.stamps, first) for record in there) >= turns)

    def _split_again(self, team: Team) -> None:
        """Send new parts to the agents of `team`, because the holders of estimates and the paths of messages may have changed."""
        self._generation += 1
        addresses = {agent: self._parts[agent].listen for agent in team.ids}
        run = next(iter(self._parts.values())).run
        scenario = replace(self._scenario, team=team)
        self._parts |= split(scenario, run=run, addresses=addresses, epoch=self.epoch, generation=self._generation)
        for agent in team.ids:
            self.fleet.write(agent, self._parts[agent])
            self.fleet.tell(agent, {"command": "reload"})


def _watch(supervisor: Supervisor, rules: _Rules, title: str, quiet: bool) -> Ending:
    """Watch the team until it must be stopped. Returns why it ended. Restarts agents that crash.

    Args:
        supervisor: the agents.
        rules: criterion for convergence.
        title: title of the table in the terminal.
        quiet: whether to show no table.
    """
    began, plan, observer = time.monotonic(), supervisor.plan, supervisor.observer
    end = None if plan.until is not None else began + PATIENCE
    agents = observer.team.ids
    try:
        with board(title, quiet=quiet) as draw:
            while end is None or time.monotonic() < end:
                observer.take(supervisor.fleet.poll(0.05))
                draw(observer, {agent: supervisor.fleet.running(agent) for agent in agents}, time.monotonic() - began)
                supervisor.restart_ended()
                supervisor.advance()
                supervisor.turn()
                if not np.isfinite(observer.positions()).all():
                    return "diverged"
                if plan.rounds is not None and all(record.finished or record.ended for record in observer.present_records):
                    return "out of time"
                if not all(record.stamps for record in observer.present_records):
                    continue
                if end is None:
                    end = time.monotonic() + (plan.until or 0.0)
                if (found := _ending(supervisor, rules)) is not None:
                    return found
    except KeyboardInterrupt:
        return "interrupted"
    return "out of time"


def _ending(supervisor: Supervisor, rules: _Rules) -> Ending | None:
    observer, stop, earliest = supervisor.observer, supervisor.plan.ending, supervisor.earliest
    if stop == "never":
        return None
    latest = min((record.stamps[-1] if record.stamps else -np.inf) for record in observer.present_records)
    known, since = observer.all_known()[0], observer.concluded()
    since = None if since is None else max(since, earliest)
    if (stop == "satisfied" or known == "infeasible") and since is not None and latest - since >= rules.window:
        return "satisfied" if known == "satisfied" else "settled"
    rests = latest >= max(rules.earliest, earliest, supervisor.still_from + rules.window) and observer.settled(rules.window, rules.distance)
    return "settled" if rests else None
