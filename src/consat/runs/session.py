"""`Session`: a team that is advanced round by round, and can be changed between two rounds.

Constraint parameters are arguments of the compiled rounds, so that a change of a parameter does not compile. Adding or removing agents,
constraints or links compiles the rounds again; the agents keep their state.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable, Sequence
from typing import Any, Literal, NamedTuple, Self

import jax
import numpy as np
from numpy.typing import ArrayLike

from consat.certify.certificate import Verdict, judged
from consat.certify.reasons import explain
from consat.engine.bodies import Body
from consat.engine.carry import Names, carried, placed, robots_carried
from consat.engine.chunks import CHUNK, Chunk, OneProcess
from consat.engine.live import Live
from consat.engine.recording import Choice, Memory, Rows, velocities
from consat.engine.round import Now
from consat.engine.rounds import driven
from consat.engine.tally import Tally, known_of
from consat.engine.world import world_of
from consat.errors import Fault, InvalidSettings, InvalidTeam
from consat.numerics import float64, on_device
from consat.problem import structure
from consat.problem.agent import Agent
from consat.problem.changes import Change, changed, changes_of, is_adjustment, is_structural, place_of
from consat.problem.constraints.library import ADJUSTABLE, farthest
from consat.problem.graphs import require_connected
from consat.problem.parameters import Spot, vector
from consat.problem.team import Team
from consat.problem.units import scale
from consat.protocols import FLOWS, PAIRED, ROUNDS, with_gains
from consat.protocols.interior_point import InteriorState
from consat.protocols.local.interior.layout import form_of
from consat.results.result import Result
from consat.results.trace import Trace
from consat.runs.options import RATE, Options
from consat.runs.preparation import Prepared, copies_of, robots_of, scenario_of, settings_of
from consat.runs.summary import summarise
from consat.scenario import Scenario
from consat.settings import Layout, Sends, Smoothing

PLACES = frozenset(("center", "vector", "radius", "low", "high"))
"""Parameters that are lengths: while they are small, a constraint does not ask an agent to move beyond the team's region."""


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


class _Engine(NamedTuple):
    """Engine for one structure of the team.

    Attributes:
        ready: the prepared team when the engine was built.
        carrier: engine that computes the rounds.
        live: constraint parameters, as NumPy arrays that are modified in place.
    """

    ready: Prepared
    carrier: OneProcess
    live: Live


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
        self._protocol = with_gains(ROUNDS[kind](), settings.protocol)
        self._body = self._body_of(scenario.team)
        self._faults = self._options.faults(settings.start.seed)
        ready = Prepared.of(scenario.team, settings)
        self._engine = self._built(ready, ready.first(drive=self._body.drive), self._body)
        self._extent = ready.size.extent / ready.size.length
        self._well_inside = ready.size.reach - float(np.abs(ready.size.center).max(initial=0.0))
        state, chunk = self._engine.carrier.start()
        self._state: Now = state
        self._tally, self._record = Tally(), Memory()
        self._own_margins: np.ndarray | None = None
        self._changed_at, self._stepped = 0, True
        self._take(chunk)

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
            self._state, chunk = self._engine.carrier.advance(self._state, self._tally.done, count, None, 1)
            self._take(chunk)
            left -= count
        return self

    def _take(self, chunk: Chunk) -> None:
        chunk = jax.tree.map(np.asarray, chunk)
        numbers = self._tally.add(chunk)
        count = len(numbers)
        kept = [leaf[:count] for leaf in (chunk.margin, chunk.smooth_margin, chunk.bound, chunk.kept.position, chunk.kept.agent_margin)]
        margin, smooth, bound, position, margins = kept
        self._own_margins, self._positions, self._stepped = margins[-1], position[-1], True
        chosen = numbers % self._record.every == 0
        if chosen.any():
            heading = None if self._body.drive is None else chunk.kept.heading[:count]
            rows = Rows(numbers, position, None, margin, smooth, margins, None, None, bound, heading)
            self._record.append(rows.where(np.flatnonzero(chosen)))

    @property
    def round(self) -> int:
        """Number of rounds so far."""
        return self._tally.done

    @property
    def protocol(self) -> str:
        """Name of the protocol, such as ``interior-point``."""
        return self._kind

    @property
    def rate(self) -> float:
        """Rounds per second, Hz."""
        return self._body.rate

    @property
    def time(self) -> float:
        """Time since the start, s: `round` / `rate`."""
        return self._tally.done / self._body.rate

    @property
    def positions(self) -> np.ndarray:
        """(N, d) positions of the bodies, in the order of ``session.team.ids``."""
        return np.array(self._positions)

    @property
    def margins(self) -> np.ndarray:
        """(N,) the margin of every agent, in the order of ``session.team.ids``."""
        return np.array(self._margins())

    @property
    @float64
    def headings(self) -> np.ndarray | None:
        """(N,) headings of the robots, rad; None where bodies are points."""
        drive, robots = self._body.drive, self._state.robots
        return None if drive is None or robots is None else np.array(drive.model.heading(robots.state))

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
        return known_of(self._tally) if self._stepped else None

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
        team, live = self._engine.ready.team, self._engine.live.parameters
        changes = changes_of(team, agent, constraint, parameters, live)
        if not is_adjustment(team, changes):
            new = changed(self.team, changes)
            if is_structural(team, changes) or self._bends_otherwise(new):
                self._restructure(new)
                return self
        for change in changes:
            for key, value in change.given.items():
                live[change.family][key][change.member] = value
            self._reach_out(change)
        self._note_changes({int(team.owner[change.number]) for change in changes})
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
        self._state = placed(self._state, self._engine.carrier.world, i, value, own=self._body.reach is None)
        self._positions = np.asarray(self._state.body)
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
            new.starts[-1] = np.mean([self._positions[self._place_of(new.ids[k])] for k in near], axis=0)
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
        options = dataclasses.replace(self._options, loss=share)
        self._faults = options.faults(self._faults.seed)
        self._options = options
        self._restructure(self.team)
        return self

    # ---- looking ------------------------------------------------------------------------------------------------------------------------

    @property
    def dimension(self) -> int:
        """d, the dimension of the space."""
        return self._engine.ready.team.dimension

    @property
    def team(self) -> Team:
        """The team with the present parameters of its constraints. Parameters that move with time keep their schedules."""
        team = self._engine.ready.team
        families = [
            dataclasses.replace(family, parameters={key: np.array(value) for key, value in own.items()})
            for family, own in zip(team.families, self._engine.live.parameters, strict=True)
        ]
        return team.with_constraints(families, team.owner, team.names)

    @float64
    def assess(self) -> Assessment:
        """Certify the team centrally, with the constraints at the present time."""
        return assessed(self.team.at(self.time))

    @float64
    def result(self) -> Result:
        """Result of the rounds so far, as of `consat.run`. Agents that were removed are not in it."""
        ready, tally = self._engine.ready, self._tally
        rows = self._record.close()
        if not len(rows.step) or rows.step[-1] != tally.done:
            margin, smooth, bound = (np.array([number]) for number in (tally.margin, tally.smooth_margin, tally.bound))
            heading = None if (now := self.headings) is None else now[None]
            done, own = np.array([tally.done]), self._margins()[None]
            last = Rows(done, self._positions[None], None, margin, smooth, own, None, None, bound, heading)
            rows = rows.joined(last) if len(rows.step) else last
        period, team = 1.0 / self._body.rate, self.team
        trace = Trace(
            clock="round", steps=rows.step, position=rows.position, velocity=velocities(rows.step, rows.position, period),
            margin=rows.margin, smooth_margin=rows.smooth_margin, agent_margin=rows.agent_margin, estimate=None, integral=None,
            holder=ready.copies.holder, held=ready.copies.position, cluster=ready.copies.cluster, ending="out of time",
            satisfied_from=float(tally.last_bad + 1) if tally.last_bad < tally.done else None, messages=tally.messages,
            floats_sent=tally.floats, bytes=tally.bytes, known=self.known, known_from=None,
            seconds={"compile": 0.0, "run": 0.0}, period=period,
            bound=rows.bound, heading=rows.heading, motion=tally.motion(period) | driven(team, self._engine.carrier.world, self._state),
        )  # fmt: skip
        scenario = dataclasses.replace(scenario_of(team), name=self._name)
        summary = summarise(
            scenario, ready.settings, ready.schedule, ready.size, trace, robots=self._options.robots, since=self._changed_at * period
        )
        return Result(summary, trace=trace, team=team, scenario=scenario.text)

    def __repr__(self) -> str:
        team = self._engine.ready.team
        return f"<Session of {self._name}: {team.count} agents, round {self.round}, margin {self.margin:.4g}>"

    # ---- inside -------------------------------------------------------------------------------------------------------------------------

    def _mark_change(self) -> None:
        """What was found out of the team before holds no more."""
        self._own_margins, self._changed_at, self._stepped = None, self.round, False

    @float64
    def _margins(self) -> np.ndarray:
        """(N,) margins of the agents where they are, of the constraints as they are; computed anew after a change."""
        if self._own_margins is None:
            self._own_margins = self._engine.carrier.margins(self._state, self.round)
        return self._own_margins

    def _body_of(self, team: Team) -> Body:
        """Motion of the bodies of a team."""
        body = self._options.pace(self._kind, team).body
        assert body is not None, "a session has a rate"
        return body

    def _built(self, ready: Prepared, first: np.ndarray, body: Body) -> _Engine:
        team = ready.team
        require_connected(team)
        live = Live.of(team, 1.0 / body.rate, all_of_them=True)
        assert live is not None
        world = world_of(
            team, ready.copies, ready.schedule.final, ready.size, convex=ready.convex, faults=self._faults, body=body,
            speaks=self._protocol.speaks, live=live, events=self._options.events,
        )  # fmt: skip
        choice = Choice.of(team, ready.copies, "all", estimates=False)
        carrier = OneProcess(self._protocol, world, first, self._faults.seed, choice, None)
        return _Engine(ready, carrier, live)

    def _restructure(self, team: Team) -> None:
        """Build an engine for a team of another structure, and transfer the state. If an error is raised, the session is unchanged."""
        old = self._engine
        copies = copies_of(team, old.ready.settings.protocol)
        now, size = scale(team), old.ready.size  # units stay the same, but the region of proofs must cover the new constraints
        extent = now.extent + now.reach + float(np.linalg.norm(np.asarray(now.center) - np.asarray(size.center)))
        ready = old.ready._replace(team=team, copies=copies, size=size._replace(extent=max(size.extent, extent)))
        kind = str(ready.settings.protocol.kind)
        names = [Names.of(each.team, each.copies, pairs=kind in PAIRED) for each in (old.ready, ready)]
        first, place = self._first(ready)
        body = self._body_of(team)
        engine = self._built(ready, first, body)
        state, _ = engine.carrier.start()
        inner = carried(self._protocol.per, self._state.state, state.state, *names)
        robots = state.robots
        if robots is not None and self._state.robots is not None and body.drive is not None:
            robots = robots_carried(body.drive.model, self._state.robots, robots, names[0].agent, names[1].agent)
        inner = inner.begun_anew() if isinstance(inner, InteriorState) else inner
        state = state._replace(state=inner, body=on_device(place), key=self._state.key, robots=robots)
        # the session is modified only below, where no error can be raised
        self._record = self._record.renamed(names[0].agent, names[1].agent)
        self._tally.violated = np.zeros(len(Choice.of(team, copies, "none").watched), dtype=int)
        self._engine, self._state, self._positions, self._body = engine, state, place, body
        self._mark_change()
        self._extent = max(self._extent, ready.size.extent / ready.size.length)

    def _first(self, ready: Prepared) -> tuple[np.ndarray, np.ndarray]:
        """(C, d) initial estimates, each at the position of its owner's body, and (N, d) positions of bodies."""
        team, copies = ready.team, ready.copies
        place = {agent: k for k, agent in enumerate(self._engine.ready.team.ids)}
        drawn = ready.first()
        body = drawn[copies.own]
        for i, agent in enumerate(team.ids):
            if agent in place:
                body[i] = self._positions[place[agent]]
            elif np.isfinite(team.starts[i]).all():
                body[i] = team.starts[i]
        return body[copies.position], body

    def _place_of(self, agent: str) -> int:
        return place_of(self._engine.ready.team, agent)

    def _bends_otherwise(self, team: Team) -> bool:
        """Whether the compiled curvature of a user-defined constraint is not valid for a team with other parameters."""
        before = self._engine.ready.team
        return any(
            form_of(old, team.dimension) != form_of(new, team.dimension)
            for old, new in zip(before.families, team.families, strict=True)
            if old.psi not in ADJUSTABLE
        )

    def _reach_out(self, change: Change) -> None:
        """Enlarge the region of proofs, if needed, so that it covers a changed constraint."""
        size, carrier = self._engine.ready.size, self._engine.carrier
        family = self._engine.ready.team.families[change.family]
        if carrier.world.everyone.interior is None or family.psi not in ADJUSTABLE:
            return
        if PLACES.issuperset(change.given) and all(np.abs(np.asarray(value)).max() <= self._well_inside for value in change.given.values()):
            return  # the most frequent case
        own = {key: np.asarray(array)[[change.member]] for key, array in self._engine.live.parameters[change.family].items()}
        asked = farthest(family.psi, own, np.asarray(size.center)) / size.length
        if asked <= self._extent:
            return
        self._extent = asked if family.arity == 1 else self._extent + asked  # relative to another agent, which may itself be that far out
        everyone, interior = carrier.world.everyone, carrier.world.everyone.interior
        interior = dataclasses.replace(interior, units=interior.units._replace(extent=on_device(self._extent)))
        carrier.world = dataclasses.replace(carrier.world, everyone=dataclasses.replace(everyone, interior=interior))

    def _note_changes(self, owners: Iterable[int]) -> None:
        """Raise the count of changes of the agents whose constraints have changed, and drop their bounds, so that all proofs restart."""
        inner = self._state.state
        if isinstance(inner, InteriorState):
            self._state = self._state._replace(state=inner.changed(list(owners)))


@float64
def assessed(team: Team) -> Assessment:
    """Certify a team with constant constraints centrally."""
    best, found = judged(team)
    lower, upper = (None if value is None or not np.isfinite(value) else float(value) for value in (found.lower, found.upper))
    return Assessment(found.verdict, (lower, upper), explain(team, best), best.positions)
