"""Preparation of a run: resolves the scenario, the settings, the layout of copies and the initial estimates."""

from __future__ import annotations

import dataclasses
import os
from collections.abc import Callable
from typing import TYPE_CHECKING, Any, NamedTuple

import jax
import numpy as np

from consat.certify.certificate import bounds
from consat.certify.quadratics import shape_of
from consat.errors import InvalidInput, InvalidSettings, InvalidTeam, counted
from consat.problem.graphs import loop_length
from consat.problem.objective import SmoothingSchedule
from consat.problem.team import Team
from consat.problem.units import Scale, automatic, scale, start_box
from consat.protocols import FLOWS, PAIRED, ROUNDS
from consat.protocols.estimates import Estimates
from consat.protocols.local.interior import Way, route_of
from consat.runs.options import Options
from consat.scenario import Scenario, dump, load
from consat.settings import Layout, ProtocolSettings, Settings, Start

if TYPE_CHECKING:
    from consat.robots import Drive
    from consat.scenario.robots import Robots

DEFAULT_PROTOCOL = "interior-point"
MANY = 5000
"""Number of agents above which admm is the default protocol, because its rounds take less time."""
FULL = 30
"""Number of agents above which admm is the default protocol in the layout ``full``."""
LONG = 64
"""Mean length of loops, in links, above which admm is the default protocol: what an interior-point step tells comes back around the loop
so late that the steps do not settle."""
DENSE, SEVERAL = 3.0, 250
"""Number of links for each agent, and number of agents, beyond which admm is the default protocol. Measured on random geometric graphs:
300 agents take 45 and 70 rounds by interior-point, 37 and 38 by admm; 500 agents 72 and 74; 1000 agents more than 300, and 66."""
SHARP = 5e-4
"""Gap between the margin and the proven bound at which max-min ends, in the team's unit of ψ."""


def robots_of(robots: Any, obstacles: Any, scenario: Scenario) -> Robots | None:
    """The robots of a run; see `consat.scenario.robots.asked`. None for a team of points, without an import of `consat.robots`."""
    if robots is None and obstacles is None and scenario.robots is None:
        return None
    from consat.scenario.robots import asked

    return asked(robots, obstacles, scenario.robots, scenario.team.ids)


def scenario_of(team: Team | Scenario | str | os.PathLike[str]) -> Scenario:
    """The argument `team` of `run` as a scenario. Its text is empty if no file can hold the team."""
    if isinstance(team, Scenario):
        return team
    if not isinstance(team, Team):
        return load(team)
    try:
        text = dump(team, Settings(), "team")
    except InvalidInput:
        text = ""
    return Scenario(name="team", team=team, settings=Settings(), text=text, source="team")


def with_auxiliary(scenario: Scenario, radius: float) -> Scenario:
    """Copy of the scenario with the auxiliary constraint, of this radius, added to every agent."""
    from consat.certify import assumptions

    return dataclasses.replace(scenario, team=assumptions.with_auxiliary(scenario.team, radius))


def default_protocol(team: Team, layout: Layout) -> str:
    """The default protocol of a team; see `why_admm`."""
    return DEFAULT_PROTOCOL if why_admm(team, layout) is None else "admm"


def why_admm(team: Team, layout: Layout) -> str | None:
    """Reason why admm is the default protocol of a team; None if interior-point is."""
    if jax.process_count() > 1:
        return "several processes run the team"
    if team.count > MANY:
        return f"there are more than {MANY:,} agents, and a round of admm takes less time"
    if layout == "full" and team.count > FULL:
        return f"there are more than {FULL} agents of which everybody holds everything, and messages would be too wide"
    shape = shape_of(team)
    if not shape.concave.all() and not shape.wild and len(team.links) >= team.count:
        return "some constraints keep agents apart and the links form loops, where admm takes fewer rounds"
    if team.count > SEVERAL and len(team.links) > DENSE * team.count:
        return f"there are more than {SEVERAL} agents with more than {DENSE:g} links for each, where admm takes fewer rounds"
    if (length := loop_length(team.count, team.links)) > LONG:
        return f"the links form loops of {length:.0f} agents on the average, where admm takes fewer rounds"
    return None


def named(asked: Settings, given: Options) -> str | None:
    """The protocol that is named in the options or the scenario, or whose gains are given; None if the default applies."""
    tuned = "admm" if asked.protocol.penalty is not None or asked.protocol.relaxation is not None else None
    return given.protocol or asked.protocol.kind or tuned


def settings_of(asked: Settings, given: Options, team: Team) -> Settings:
    """Resolve the settings: those of the scenario, `asked`, overridden by the options, `given`, with the default protocol filled in.

    Raises:
        InvalidSettings: unknown protocol.
    """
    start, seed = given.start, given.seed
    estimates = given.estimates or asked.protocol.estimates
    kind = named(asked, given) or default_protocol(team, estimates)
    settings = asked.model_copy(
        update={
            "start": Start(box=asked.start.box if start is None else start, seed=asked.start.seed if seed is None else seed),
            "protocol": asked.protocol.model_copy(update={"kind": kind, "estimates": estimates}),
            "smoothing": given.smoothing or asked.smoothing,
        }
    )
    if kind not in FLOWS and kind not in ROUNDS:
        raise InvalidSettings(f"there is no protocol {kind!r}; choose one of {', '.join((*ROUNDS, *FLOWS))}")
    return settings


def copies_of(team: Team, asked: ProtocolSettings) -> Estimates:
    """Layout of the copies for a protocol; for the team's default protocol if none is named."""
    kind = asked.kind or default_protocol(team, asked.estimates)
    return way_of(team, kind, asked.estimates).copies if kind in PAIRED else Estimates.of(team, asked.estimates)


def way_of(team: Team, kind: str, layout: Layout) -> Way:
    """How copies are exchanged by a protocol that sends one message per pair. `max-min` uses a spanning tree, on which steps are exact."""
    return route_of(team, layout, exact=kind == "max-min")


def protocol_entries(team: Team, asked: ProtocolSettings) -> dict[str, Any]:
    """The keys ``protocol``, ``route`` and ``why`` of ``run --json`` and ``check --json``. `asked`: protocol settings, whose kind is None
    for the default protocol."""
    kind = asked.kind or default_protocol(team, asked.estimates)
    why = why_admm(team, asked.estimates) if asked.kind is None else None
    if kind not in PAIRED:
        return {"protocol": kind, "route": None, "why": why}
    way = way_of(team, kind, asked.estimates)
    return {"protocol": kind, "route": way.route, "why": way.why}


class Prepared(NamedTuple):
    """A team that is ready to run.

    Attributes:
        team: the team.
        copies: the layout of estimates.
        then: the layout to which the team switches if it is not satisfied in time; None without one.
        schedule: schedule of ν.
        size: the team's natural scale.
        settings: resolved settings.
    """

    team: Team
    copies: Estimates
    then: Estimates | None
    schedule: SmoothingSchedule
    size: Scale
    settings: Settings

    @classmethod
    def of(cls, team: Team, settings: Settings) -> Prepared:
        """Prepare a team. Raises: InvalidTeam: agents that depend on each other are not connected by links."""
        size = scale(team)
        schedule = SmoothingSchedule.of(automatic(size) if settings.smoothing == "auto" else settings.smoothing)
        kind, layout = str(settings.protocol.kind), settings.protocol.estimates
        if kind not in PAIRED:
            return cls(team, Estimates.of(team, layout), None, schedule, size, settings)
        way = way_of(team, kind, layout)
        return cls(team, way.copies, way.then, schedule, size, settings)

    def first(self, start: Start | None = None, drive: Drive | None = None) -> np.ndarray:
        """(C, d) random initial estimates.

        Args:
            start: box and seed; those of the settings if None.
            drive: the robots, whose starts must not overlap; None for points.
        """
        first = first_estimates(self.team, self.copies, start or self.settings.start, self.size)
        return first if drive is None else apart_from_all(self.team, self.copies, first, drive, (start or self.settings.start).seed)

    @property
    def convex(self) -> bool:
        """Whether every ψ is known to be concave."""
        return bool(shape_of(self.team).concave.all())

    def hopeless(self, position: np.ndarray) -> bool:
        """Whether the positions, (N, d), prove that no formation satisfies every constraint at the end of the schedules."""
        return bounds(self.at_the_end, position, self.schedule.final).verdict == "infeasible"

    @property
    def at_the_end(self) -> Team:
        """The team after the end of its schedules."""
        return self.team.at(float(self.team.knots.max(initial=0.0)))

    @property
    def enough(self) -> Callable[[np.ndarray], bool] | None:
        """Function that tells whether positions, (N, d), are within `SHARP` of the best margin; None for protocols other than max-min."""
        return (
            (lambda position: _gap(self.at_the_end, position) <= SHARP * self.size.psi)
            if self.settings.protocol.kind == "max-min"
            else None
        )


TURNS = 2000
"""Number of random tries for the start of a robot before an error is raised."""


def apart_from_all(team: Team, copies: Estimates, first: np.ndarray, drive: Drive, seed: int) -> np.ndarray:
    """(C, d) initial estimates in which robots without a given start do not overlap other robots or obstacles.

    Args:
        team: the team.
        copies: the layout of estimates.
        first: (C, d) initial estimates.
        drive: the robots.
        seed: random seed of new starts.

    Raises:
        InvalidTeam: given starts overlap.
        InvalidSettings: no free start was found for a robot.
    """
    from consat.robots import start_faults

    random, first = np.random.default_rng([seed, 1]), first.copy()
    place, size, given = first[copies.own], np.asarray(drive.size), np.isfinite(team.starts).all(axis=1)
    if found := start_faults(list(team.ids), place[given], size[given], drive.map):
        raise InvalidTeam(found)
    low, high = place.min(axis=0) - 4 * size.max(), place.max(axis=0) + 4 * size.max()
    done = given.copy()
    for i in np.flatnonzero(~given).tolist():
        for turn in range(TURNS):
            free = np.linalg.norm(place[done] - place[i], axis=1) >= size[done] + size[i]
            if free.all() and float(np.asarray(drive.map.signed_distance(place[i : i + 1]))[0]) >= size[i]:
                break
            place[i] = random.uniform(low, high)
            if turn == TURNS - 1:
                raise InvalidSettings(f"there is no room for the start of {team.ids[i]!r}; give it one, or a larger start box")
        done[i] = True
    first[copies.own] = place
    return first


def _gap(team: Team, position: np.ndarray) -> float:
    """Upper bound on the improvement of the margin by another formation; +∞ without a proven bound."""
    certificate = bounds(team, position)
    return np.inf if certificate.upper is None else certificate.upper - certificate.lower


def first_estimates(team: Team, copies: Estimates, start: Start, size: Scale) -> np.ndarray:
    """(C, d) random initial estimates. The row of each agent's own position is its start, where one is given (paper, section IV-E).

    Args:
        team: the team.
        copies: the layout of estimates.
        start: box and seed.
        size: the team's natural scale, for the default box.

    Raises:
        InvalidSettings: the box has another dimension than the team.
    """
    d = team.dimension
    if start.box is None:
        low, high = start_box(size)
    else:
        low, high = (np.atleast_1d(np.asarray(side, dtype=float)) for side in start.box)
        if len(low) not in (1, d):
            raise InvalidSettings(
                f"the start box has {counted(len(low), 'number')} a side, but must have 1 or {d}, one for each dimension of the team"
            )
    random = np.random.default_rng(start.seed)
    where = (team.count, d), (copies.count, d)
    drawn, first = (random.uniform(low, high, shape) for shape in where)
    if team.around is not None:  # map samples of the common box into each agent's own box
        place, reach = team.around
        half = np.where(high > low, (high - low) / 2, 1.0)
        for values, whose in ((drawn, slice(None)), (first, copies.position)):
            near = place[whose] + reach[whose][:, None] * (values - (low + high) / 2) / half
            values[...] = np.where(np.isnan(near), values, near)
    first[copies.own] = np.where(np.isnan(team.starts), drawn, team.starts)
    return first
