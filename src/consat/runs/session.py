"""`Session`: a team that is advanced round by round, and can be changed between two rounds.

Constraint parameters are arguments of the compiled rounds, so that a change of a parameter does not compile. Adding or removing agents,
constraints or links compiles the rounds again; the agents keep their state.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable, Sequence
from typing import Any, Literal, NamedTuple, Self

import numpy as np
from numpy.typing import ArrayLike

from consat.certify.certificate import Verdict, judged
from consat.certify.reasons import explain
from consat.engine.chunks import CHUNK
from consat.engine.loop import traced
from consat.engine.recording import Memory, Rows
from consat.engine.tally import known_of
from consat.errors import Fault, InvalidSettings, InvalidTeam
from consat.numerics import float64
from consat.problem import structure
from consat.problem.agent import Agent
from consat.problem.changes import changed, changes_of, is_adjustment, is_structural, place_of
from consat.problem.parameters import Spot, vector
from consat.problem.team import Team
from consat.protocols import FLOWS, ROUNDS
from consat.results.result import Result
from consat.runs.options import RATE, Options
from consat.runs.preparation import Prepared, robots_of, scenario_of, settings_of
from consat.runs.running import Running
from consat.runs.summary import summarise
from consat.scenario import Scenario
from consat.settings import Layout, Sends, Smoothing


class Assessment(NamedTuple):
    """Certificate by an observer of the whole team, for the present constraints.

    Attributes:
        verdict: ``feasible``, ``infeasible`` or ``undecided``; proven.
        bounds: (lower, upper) bounds on the best margin of any formation; None where there is no bound.
        reasons: sentences about what limits the team, which constraints conflict, and what would help.
        positions: (N, d) a formation with margin ``bounds[0]``.
    """

    verdict: Verdict
    bounds: tuple[float | None, float | None]
    reasons: list[str]
    positions: np.ndarray


class Session:
    """A team that is advanced by rounds and can be changed between them.

    Args:
        team: a `consat.Team` or a scenario, as in `consat.run`.
        protocol: a protocol in rounds; as in `consat.run`.
        estimates: as in `consat.run`.
        seed: random seed of starts and message loss.
        start: ``(low, high)`` of the box from which starts are drawn, length.
        smoothing: as in `consat.run`.
        loss: probability that a message is lost.
        sleep: probability that an agent skips a round.
        burst: losses in bursts, as in `consat.run`.
        rate: rounds per second, Hz, for schedules, robots and `time`. By default that of the scenario, or 20.
        speed: largest speed of a body, length/s; if None, bodies are at their agents' estimates.
        robots: model of the bodies, as in `consat.run`. A robot that joins later has the model of the first by default.
        obstacles: obstacles that robots avoid, as in `consat.run`.
        wind: as in `consat.run`.
        noise: as in `consat.run`.
        simulator: as in `consat.run`.
        sends: as in `consat.run`.

    Raises:
        InvalidTeam: agents that depend on each other are not connected by links (Assumption 1).
        InvalidScenario: the scenario has faults.
        InvalidSettings: the settings do not fit together.
    """

    @float64
    def __init__(
        self, team: Team | Scenario | str, *, protocol: str | None = None, estimates: Layout | None = None, seed: int | None = None,
        start: tuple[Any, Any] | None = None, smoothing: Smoothing | None = None, loss: float = 0.0, sleep: float = 0.0,
        burst: tuple[float, float] | None = None,
        rate: float | None = None, speed: float | None = None, robots: Any = None, obstacles: Sequence[Any] | None = None,
        wind: Sequence[float] = (), noise: float = 0.0, simulator: str | None = None, sends: Sends = "all",
    ) -> None:  # fmt: skip
        scenario = scenario_of(team)
        self._options = Options(
            protocol=protocol, estimates=estimates, seed=seed, start=start, smoothing=smoothing, loss=loss, sleep=sleep, burst=burst,
            rate=rate or scenario.rate or RATE, speed=speed, stop="never", wind=tuple(map(float, wind)), noise=noise,
            simulator=simulator, sends=sends,
            robots=robots_of(robots, obstacles, scenario),
        )  # fmt: skip
        self._name = scenario.name
        settings = settings_of(scenario.settings, self._options, scenario.team)
        kind = self._kind = str(settings.protocol.kind)
        if kind in FLOWS:
            raise InvalidSettings(
                f"protocol {kind} flows in continuous time, but a session goes in rounds; choose one of {', '.join(ROUNDS)}"
            )
        self._running = Running(Prepared.of(scenario.team, settings), self._options)
        self._record = Memory()
        self._changed_at = 0
        self._take(self._running.simulation.start())

    # ---- stepping -----------------------------------------------------------------------------------------------------------------------

    @float64
    def step(self, rounds: int = 1) -> Self:
        """Advance by a number of rounds.

        Args:
            rounds: number of rounds, at least 0.

        Raises:
            InvalidSettings: `rounds` is not a whole number from 0.
        """
        if isinstance(rounds, bool) or not isinstance(rounds, int | np.integer) or rounds < 0:
            raise InvalidSettings(f"rounds is {rounds!r}, but must be a whole number from 0")
        left = int(rounds)
        while left:
            count = min(CHUNK, left)
            self._take(self._running.simulation.go(count, self._record.every))
            left -= count
        return self

    def _take(self, rows: Rows) -> None:
        self._record.append(rows)
        recorded = len(rows.step) and rows.step[-1] == self.round
        self._own_margins, self._stepped = rows.agent_margin[-1] if recorded else None, True

    @property
    def round(self) -> int:
        """Number of rounds so far."""
        return self._running.simulation.tally.done

    @property
    def protocol(self) -> str:
        """Name of the protocol, such as ``interior-point``."""
        return self._kind

    @property
    def rate(self) -> float:
        """Rounds per second, Hz."""
        return self._running.body.rate

    @property
    def time(self) -> float:
        """Time since the start, s: `round` / `rate`."""
        return self.round / self.rate

    @property
    def positions(self) -> np.ndarray:
        """(N, d) positions of the bodies, in the order of ``session.team.ids``."""
        return self._running.simulation.positions()

    @property
    def margins(self) -> np.ndarray:
        """(N,) the margin of every agent, in the order of ``session.team.ids``."""
        return np.array(self._margins())

    @property
    @float64
    def headings(self) -> np.ndarray | None:
        """(N,) headings of the robots, rad; None where bodies are points."""
        return self._running.headings

    @property
    def margin(self) -> float:
        """The smallest of `margins`: positive if every constraint of every agent holds."""
        return float(self._margins().min(initial=np.inf))

    @property
    def satisfied(self) -> bool:
        """Whether every constraint holds."""
        return self.margin > 0

    @property
    def known(self) -> Literal["satisfied", "infeasible"] | None:
        """What every agent knows by itself about the team: ``satisfied``, ``infeasible`` or None."""
        return known_of(self._running.simulation.tally) if self._stepped else None

    # ---- changing -----------------------------------------------------------------------------------------------------------------------

    @float64
    def change(self, agent: str, constraint: str, **parameters: Any) -> Self:
        """Change parameters of a constraint from the next round on. This does not compile, unless a parameter becomes a schedule or stops
        being one, or the curvature of a user-defined constraint changes.

        Args:
            agent: owner of the constraint.
            constraint: name of the constraint.
            parameters: new values, such as ``center=[3, 1]`` or ``radius=2``; also ``weight``.

        Raises:
            InvalidTeam: unknown agent, constraint or parameter, or an invalid value; the session is unchanged.
        """
        if not parameters:
            return self
        team = self._running.ready.team
        changes = changes_of(team, agent, constraint, parameters, self._running.parameters)
        if not is_adjustment(team, changes):
            new = changed(self.team, changes)
            if is_structural(team, changes) or self._running.bends_otherwise(new):
                self._restructure(new)
                return self
        self._running.set(changes)
        self._mark_change()
        return self

    @float64
    def place(self, agent: str, position: ArrayLike) -> Self:
        """Set the position of an agent's body, for example after it was pushed or measured.

        Args:
            agent: id of the agent.
            position: (d,) new position, length.

        Raises:
            InvalidTeam: unknown agent, or not a position; the session is unchanged.
        """
        i = self._place_of(agent)
        faults: list[Fault] = []
        value = vector(position, self.dimension, Spot(("position",), "position", f"agent {agent!r}", faults))
        if value is None:
            raise InvalidTeam(faults)
        self._running.place(i, value)
        self._own_margins, self._stepped = None, False
        return self

    @float64
    def add(self, agent: Agent, links: Iterable[str] | None = None) -> Self:
        """Add an agent.

        Args:
            agent: the agent with its constraints. Without a start it starts at the mean position of the agents that it is linked to.
            links: ids of the agents to link it to; by default those whose positions its constraints read.

        Raises:
            InvalidTeam: the agent does not fit the team; the session is unchanged.
        """
        new = structure.with_agent(self.team, agent, links)
        near = [k for i, j in new.links.tolist() for k in (i, j) if new.count - 1 in (i, j) and k != new.count - 1]
        if agent.start is None and near:
            new.starts[-1] = np.mean(self.positions[[self._place_of(new.ids[k]) for k in near]], axis=0)
        self._restructure(new)
        return self

    @float64
    def remove(self, agent: str) -> Self:
        """Remove an agent, its constraints, its links, and all constraints that read its position.

        Raises:
            InvalidTeam: unknown agent, the last agent, or the remaining agents would not be connected; the session is unchanged.
        """
        self._restructure(structure.without_agent(self.team, agent))
        return self

    @float64
    def connect(self, one: str, other: str) -> Self:
        """Add a link between two agents.

        Raises:
            InvalidTeam: unknown agents, or the link exists; the session is unchanged.
        """
        self._restructure(structure.with_link(self.team, one, other))
        return self

    @float64
    def disconnect(self, one: str, other: str) -> Self:
        """Remove the link between two agents.

        Raises:
            InvalidTeam: no such link, or agents that depend on each other would not be connected without it; the session is unchanged.
        """
        new = structure.without_link(self.team, one, other)
        structure.require_connected(new, f"without the link [{one}, {other}]")
        self._restructure(new)
        return self

    @float64
    def add_constraint(self, agent: str, constraint: Any) -> Self:
        """Add a constraint to an agent.

        Args:
            agent: id of the owner.
            constraint: a constraint, as returned by `consat.within` and similar functions.

        Raises:
            InvalidTeam: the constraint does not fit the team, or reads an agent that is not connected to the owner; the session is
                unchanged.
        """
        self._restructure(structure.with_constraint(self.team, agent, constraint))
        return self

    @float64
    def remove_constraint(self, agent: str, constraint: str) -> Self:
        """Remove a constraint of an agent, given by its name.

        Raises:
            InvalidTeam: unknown agent or constraint; the session is unchanged.
        """
        self._restructure(structure.without_constraint(self.team, agent, constraint))
        return self

    @float64
    def become(self, team: Team) -> Self:
        """Replace the team. Agents whose ids were in the old team keep their positions and states.

        Args:
            team: the new team, of the same dimension.

        Raises:
            InvalidTeam: another dimension, or agents that depend on each other are not connected; the session is unchanged.
        """
        if team.dimension != self.dimension:
            raise InvalidTeam([Fault(("dimension",), f"dimension is {team.dimension}, but must stay {self.dimension}", "dimension")])
        structure.require_connected(team, "the team")
        self._restructure(team)
        return self

    @float64
    def lose(self, share: float) -> Self:
        """Set the probability that a message is lost. The rounds are compiled again.

        Args:
            share: probability in [0, 1).

        Raises:
            InvalidSettings: `share` is out of range.
        """
        self._restructure(self.team, dataclasses.replace(self._options, loss=share))
        return self

    # ---- looking ------------------------------------------------------------------------------------------------------------------------

    @property
    def dimension(self) -> int:
        """d, the dimension of the space."""
        return self._running.ready.team.dimension

    @property
    def team(self) -> Team:
        """The team with the present parameters of its constraints. Parameters that move with time keep their schedules."""
        return self._running.team

    @float64
    def assess(self) -> Assessment:
        """Certify the team centrally, with the constraints at the present time."""
        return assessed(self.team.at(self.time))

    @float64
    def result(self) -> Result:
        """Result of the rounds so far, as of `consat.run`. Agents that were removed are not in it."""
        ready, simulation, team = self._running.ready, self._running.simulation, self.team
        rows = self._record.close()
        rows = rows.where(rows.step < self.round + self._stepped)  # without a last row that is of the team before a change
        if not len(rows.step) or rows.step[-1] != self.round:
            rows = rows.joined(self._present())
        seconds = {"compile": 0.0, "run": 0.0}
        trace = traced(simulation, rows, ready.copies, simulation.choice, ending="out of time", seconds=seconds)
        trace = dataclasses.replace(
            trace, known=self.known, satisfied_from=trace.satisfied_from if self.satisfied else None,
            known_from=None, violated=None,  # they were counted with other constraints
        )  # fmt: skip
        scenario = dataclasses.replace(scenario_of(team), name=self._name)
        summary = summarise(
            scenario, ready.settings, ready.schedule, ready.size, trace, robots=self._options.robots, since=self._changed_at / self.rate
        )
        return Result(summary, trace=trace, team=team, scenario=scenario.text)

    def __repr__(self) -> str:
        team = self._running.ready.team
        return f"<Session of {self._name}: {team.count} agents, round {self.round}, margin {self.margin:.4g}>"

    # ---- inside -------------------------------------------------------------------------------------------------------------------------

    def _mark_change(self) -> None:
        """What was found out of the team before holds no more."""
        self._own_margins, self._changed_at, self._stepped = None, self.round, False

    @float64
    def _margins(self) -> np.ndarray:
        """(N,) margins of the agents where they are, of the constraints as they are; computed anew after a change."""
        if self._own_margins is None:
            self._own_margins = self._running.margins
        return self._own_margins

    def _present(self) -> Rows:
        """Record of the team as it is."""
        rows = self._running.simulation.look()
        return rows if self._stepped else rows._replace(margin=np.array([self.margin]), smooth_margin=np.full(1, np.nan))

    def _restructure(self, team: Team, options: Options | None = None) -> None:
        """Change the structure of the team, or the options. If an error is raised, the session is unchanged."""
        options = options or self._options
        new = self._running.become(team, options)
        self._record = self._record.renamed(self._running.ready.team.ids, team.ids)
        self._running, self._options = new, options
        self._mark_change()

    def _place_of(self, agent: str) -> int:
        return place_of(self._running.ready.team, agent)


@float64
def assessed(team: Team) -> Assessment:
    """Certify a team with constant constraints centrally."""
    best, found = judged(team)
    lower, upper = (None if value is None or not np.isfinite(value) else float(value) for value in (found.lower, found.upper))
    return Assessment(found.verdict, (lower, upper), explain(team, best), best.positions)
