"""Runs a whole team as processes on this machine until it has converged, and returns a `Result` as any other run."""

from __future__ import annotations

import time
import uuid
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Final

import numpy as np

from consat.engine.rules import HOLD, SETTLED
from consat.faults import Faults
from consat.network.deploy.commands import read_commands
from consat.network.deploy.dashboard import board
from consat.network.deploy.fleet import Fleet, free_ports
from consat.network.deploy.observer import Observer
from consat.network.deploy.supervisor import WINDOW, Supervisor
from consat.network.node.modes import DEFAULT_MODE, RATE, Mode, NodeSettings, protocol_of
from consat.network.node.part import Part, split
from consat.network.node.problem import OwnSolver
from consat.numerics import float64
from consat.problem.objective import SmoothingSchedule
from consat.problem.team import Team
from consat.problem.units import automatic, scale
from consat.protocols import ROUNDS
from consat.results.result import Result
from consat.results.trace import Ending
from consat.runs.preparation import copies_of, default_protocol, protocol_entries
from consat.runs.summary import summarise
from consat.scenario import Scenario, dump
from consat.scenario.document import decode
from consat.settings import Sends, Settings, Stop

PATIENCE: Final = 600.0
"""Time limit of a launch if `Plan.until` is not given, s."""
LINK_WINDOW: Final = 10.0
"""Shortest time without motion in mode link, in the time of the protocol, s; see `WINDOW`."""
ROUND_TRIPS: Final = 10.0
"""Number of longest message delays that are added to this time."""

BODILESS: Final = (
    "launch simulates each robot as a point, without its size and limits, and without obstacles; consat run simulates robots, and "
    "consat agent --sensor stdin commands real ones"
)
"""Warning for a scenario with robots."""


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
    text = "" if plan.commands is None else decode(plan.commands.read_bytes(), str(plan.commands))
    script = read_commands(text, str(plan.commands), team, plan.mode, plan.until)
    ports = free_ports(team.count)
    addresses = {agent: f"tcp/127.0.0.1:{port}" for agent, port in zip(team.ids, ports, strict=True)}
    absent = frozenset(team.ids) - script.begin.present
    parts = split(scenario, run=f"launch-{uuid.uuid4().hex[:12]}", addresses=addresses, absent=absent)
    size = scale(team)
    starts = np.array([part.first[part.own] for part in parts.values()])
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
    schedule = SmoothingSchedule.of(automatic(size) if settings.smoothing == "auto" else settings.smoothing)
    team = supervisor.stage.present_team()[0]
    trace = observer.trace(
        copies_of(supervisor.tree or team, settings.protocol), schedule.final, ending, seconds, supervisor.stages, supervisor.tick
    )
    if supervisor.done:  # the margins of the trace cover the earlier states; the verdict is about the final team
        team = team.at(float(trace.steps[-1]) * (trace.period or 1.0))
        scenario = replace(scenario, team=team, text=dump(team, settings, scenario.name))
    summary = summarise(scenario, settings, schedule, size, trace, full=full)
    summary |= protocol_entries(team, settings.protocol) | {"mode": plan.mode, "network": observer.network() | {"ended": ended}}
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
    latest = observer.latest
    known, since = observer.all_known()[0], observer.concluded()
    since = None if since is None else max(since, earliest)
    if (stop == "satisfied" or known == "infeasible") and since is not None and latest - since >= rules.window:
        return "satisfied" if known == "satisfied" else "settled"
    rests = latest >= max(rules.earliest, earliest, supervisor.still_from + rules.window) and observer.settled(rules.window, rules.distance)
    return "settled" if rests else None
