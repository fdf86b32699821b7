"""A team that runs in rounds and can be changed between two rounds, for `Session`.

One `Running` is for one structure of the team: its agents, links and constraints. Constraint parameters are arguments of its compiled
rounds, so that they can be set without a compilation. For another structure `Running.become` compiles the rounds again and transfers the
state.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import numpy as np

from consat.engine.carry import Names, carried, placed, robots_carried
from consat.engine.chunks import OneProcess
from consat.engine.live import Live
from consat.engine.recording import Choice
from consat.engine.simulation import RoundsSimulation
from consat.engine.world import world_of
from consat.numerics import on_device
from consat.problem.changes import Change
from consat.problem.constraints.library import ADJUSTABLE, farthest
from consat.problem.graphs import require_connected
from consat.problem.team import Team
from consat.problem.units import Scale, scale
from consat.protocols import PAIRED, ROUNDS, with_gains
from consat.protocols.interior_point import InteriorState
from consat.protocols.local.interior.batches import form_of
from consat.runs.options import Options
from consat.runs.preparation import Prepared, copies_of

PLACES = frozenset(("center", "vector", "radius", "low", "high"))
"""Parameters that are lengths: while they are small, a constraint does not ask an agent to move beyond the team's region."""


class Running:
    """A team of one structure that runs in rounds.

    Args:
        ready: the prepared team, with a protocol in rounds.
        options: faults, bodies and sending.
        first: (C, d) initial estimates; if None, those of the settings.

    Raises:
        InvalidTeam: agents that depend on each other are not connected by links.
        InvalidSettings: the options contradict each other.

    Attributes:
        ready: the prepared team, with the parameters of its beginning.
        body: motion of the bodies.
        simulation: the rounds, their counters and their state.
        parameters: present constraint parameters of each family, as arrays that `set` modifies in place.
    """

    def __init__(self, ready: Prepared, options: Options, first: np.ndarray | None = None) -> None:
        team, settings, kind = ready.team, ready.settings, str(ready.settings.protocol.kind)
        require_connected(team)
        body, faults = options.pace(kind, team).body, options.faults(settings.start.seed)
        assert body is not None, "a session has a rate"
        live = Live.of(team, 1.0 / body.rate, all_of_them=True)
        assert live is not None
        protocol = with_gains(ROUNDS[kind](), settings.protocol)
        world = world_of(
            team, ready.copies, ready.schedule.final, ready.size, convex=ready.convex, faults=faults, body=body,
            speaks=protocol.speaks, live=live, events=options.events,
        )  # fmt: skip
        first = ready.first(drive=body.drive) if first is None else first
        choice = Choice.of(team, ready.copies, "all", estimates=False)
        self._per, self.parameters = protocol.per, live.parameters
        self._engine = OneProcess(protocol, world, first, faults.seed, choice, None)
        self._extent = ready.size.extent / ready.size.length
        self._well_inside = ready.size.reach - float(np.abs(ready.size.center).max(initial=0.0))
        self.ready, self.body = ready, body
        self.simulation = RoundsSimulation(team, self._engine, choice, 1.0 / body.rate)

    @property
    def team(self) -> Team:
        """The team with the present parameters of its constraints. Parameters that move with time keep their schedules."""
        team = self.ready.team
        families = [
            dataclasses.replace(family, parameters={key: np.array(value) for key, value in own.items()})
            for family, own in zip(team.families, self.parameters, strict=True)
        ]
        return team.with_constraints(families, team.owner, team.names)

    @property
    def margins(self) -> np.ndarray:
        """(N,) margins of the agents where their bodies are, of the constraints as they are."""
        return self._engine.margins(self.simulation.state, self.simulation.tally.done)

    @property
    def headings(self) -> np.ndarray | None:
        """(N,) headings of the robots, rad; None where bodies are points."""
        drive, robots = self.body.drive, self.simulation.state.robots
        return None if drive is None or robots is None else np.array(drive.model.heading(robots.state))

    # ---- changes of parameters and positions --------------------------------------------------------------------------------------------

    def set(self, changes: Sequence[Change]) -> None:
        """Set constraint parameters. All proofs restart."""
        for change in changes:
            for key, value in change.given.items():
                self.parameters[change.family][key][change.member] = value
            self._reach_out(change)
        state = self.simulation.state
        if isinstance(state.state, InteriorState):
            owners = {int(self.ready.team.owner[change.number]) for change in changes}
            self.simulation.state = state._replace(state=state.state.changed(list(owners)))

    def place(self, i: int, position: np.ndarray) -> None:
        """Set the position of the body of agent `i`, (d,)."""
        self.simulation.state = placed(self.simulation.state, self._engine.world, i, position, own=self.body.reach is None)

    def _reach_out(self, change: Change) -> None:
        """Enlarge the region of proofs, if needed, so that it covers a changed constraint."""
        size, world, family = self.ready.size, self._engine.world, self.ready.team.families[change.family]
        interior = world.everyone.interior
        if interior is None or family.psi not in ADJUSTABLE:
            return
        if PLACES.issuperset(change.given) and all(np.abs(np.asarray(value)).max() <= self._well_inside for value in change.given.values()):
            return  # the most frequent case
        own = {key: np.asarray(array)[[change.member]] for key, array in self.parameters[change.family].items()}
        asked = farthest(family.psi, own, np.asarray(size.center)) / size.length
        if asked <= self._extent:
            return
        self._extent = asked if family.arity == 1 else self._extent + asked  # relative to another agent, which may itself be that far out
        interior = dataclasses.replace(interior, units=interior.units._replace(extent=on_device(self._extent)))
        self._engine.world = dataclasses.replace(world, everyone=dataclasses.replace(world.everyone, interior=interior))

    # ---- changes of the structure -------------------------------------------------------------------------------------------------------

    def bends_otherwise(self, team: Team) -> bool:
        """Whether the compiled curvature of a user-defined constraint is not valid for the same team with other parameters."""
        before = self.ready.team
        return any(
            form_of(old, team.dimension) != form_of(new, team.dimension)
            for old, new in zip(before.families, team.families, strict=True)
            if old.psi not in ADJUSTABLE
        )

    def become(self, team: Team, options: Options) -> Running:
        """The run of a team of another structure. Agents that stay keep their states. This object is not modified.

        Raises:
            InvalidTeam: agents that depend on each other are not connected by links.
        """
        before = self.ready
        copies = copies_of(team, before.settings.protocol)
        ready = before._replace(team=team, copies=copies, size=_covering(before.size, team))
        place = self._bodies(ready)
        new = Running(ready, options, first=place[copies.position])
        new.simulation.start()
        pairs = str(ready.settings.protocol.kind) in PAIRED
        names = [Names.of(each.team, each.copies, pairs=pairs) for each in (before, ready)]
        old, fresh = self.simulation.state, new.simulation.state
        inner = carried(self._per, old.state, fresh.state, *names)
        inner = inner.begun_anew() if isinstance(inner, InteriorState) else inner
        robots = fresh.robots
        if robots is not None and old.robots is not None and new.body.drive is not None:
            robots = robots_carried(new.body.drive.model, old.robots, robots, names[0].agent, names[1].agent)
        new.simulation.state = fresh._replace(state=inner, body=on_device(place), key=old.key, robots=robots)
        uncounted = np.zeros(len(new.simulation.choice.watched), dtype=int)
        new.simulation.tally = dataclasses.replace(self.simulation.tally, violated=uncounted)
        new._extent = max(self._extent, new._extent)
        return new

    def _bodies(self, ready: Prepared) -> np.ndarray:
        """(N, d) positions of the bodies of a team of another structure: who is new is at its start, or at a random one."""
        team, place = ready.team, self.simulation.positions()
        before = {agent: k for k, agent in enumerate(self.ready.team.ids)}
        body = ready.first()[ready.copies.own]
        for i, agent in enumerate(team.ids):
            if agent in before:
                body[i] = place[before[agent]]
            elif np.isfinite(team.starts[i]).all():
                body[i] = team.starts[i]
        return body


def _covering(size: Scale, team: Team) -> Scale:
    """The same units, and a region of proofs that covers the constraints of another team."""
    now = scale(team)
    extent = now.extent + now.reach + float(np.linalg.norm(np.asarray(now.center) - np.asarray(size.center)))
    return size._replace(extent=max(size.extent, extent))
