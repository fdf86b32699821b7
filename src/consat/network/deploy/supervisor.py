"""Supervises the agents of a launch: starts them, restarts those that end unasked, and sends them the time, the commands and new parts."""

from __future__ import annotations

import signal
import time
from collections.abc import Mapping
from dataclasses import replace
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from consat.engine.rules import TURN, TURN_HOP
from consat.errors import NetworkError
from consat.network.deploy.commands import Script, Stage, Timed
from consat.network.deploy.fleet import Fleet
from consat.network.deploy.observer import Observer
from consat.network.node.modes import RATE
from consat.network.node.part import Part, split
from consat.problem.changes import changed, changes_of
from consat.problem.team import Team
from consat.runs.options import RATE as ROUNDS_A_SECOND
from consat.runs.options import WATCHED
from consat.runs.preparation import way_of
from consat.scenario import Scenario

if TYPE_CHECKING:
    from consat.network.deploy.launch import Plan

WINDOW: Final = 1.0
"""Shortest time without motion after which a team counts as converged, s."""


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
        return np.inf if self.epoch is None else self.epoch - time.time() + time.monotonic() + last

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
            dismissed = agent not in self.stage.present and agent not in self._standby
            done = self.plan.rounds is not None and record.ended is not None and record.ended["why"] == "done"
            code = self.fleet.exit_code(agent)
            if code is not None and (code > 0 or not (dismissed or done)):
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
        `consat.engine.rules.TURN`. Here a new split costs seconds, so the team has at least `WINDOW`. Where messages are lost or late, it
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
