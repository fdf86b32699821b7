"""Changes of constraint parameters while a team runs. They pass the same checks as the parameters of a scenario."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from consat.errors import Fault, InvalidTeam, closest, shown
from consat.problem.constraints.library import ADJUSTABLE, adjustable
from consat.problem.constraints.record import Number, Vector, flatten
from consat.problem.family import Family
from consat.problem.parameters import Moving, Spot, checked, still
from consat.problem.schedule import Schedule
from consat.problem.team import Team


class Change(NamedTuple):
    """New parameters of one constraint.

    Attributes:
        number: index of the constraint in the team's order.
        family: index of its family in `Team.families`.
        member: index of the constraint within its family.
        given: the new values, by parameter name: arrays or schedules. ``weight`` may be among them.
    """

    number: int
    family: int
    member: int
    given: Mapping[str, Moving]


def changes_of(
    team: Team, agent: str, constraint: str, parameters: Mapping[str, Any], now: Sequence[Mapping[str, Any]] | None = None
) -> list[Change]:
    """The checked changes that give new parameters to one constraint, or to every side of a box.

    Args:
        team: the team.
        agent: id of the agent that owns the constraint.
        constraint: name of the constraint.
        parameters: new values, written as in a scenario, such as ``center=[3, 1]``.
        now: current parameters of each family. If None, those of `team.families`.

    Raises:
        InvalidTeam: there is no such agent, constraint or parameter, or a value is not allowed.
    """
    changes = []
    for number, given in _sides(team, agent, constraint, parameters, now or [family.parameters for family in team.families]):
        f, m = team.slots[number].tolist()
        changes.append(Change(number, f, m, _checked(team, number, team.families[f], given)))
    return changes


def is_structural(team: Team, changes: Sequence[Change]) -> bool:
    """Whether a change affects a weight, a schedule, or a parameter that moves with time. Rounds must then be compiled again."""
    return any(
        key == "weight" or isinstance(value, Schedule) or isinstance(parameter(team, change.number, key), Schedule)
        for change in changes
        for key, value in change.given.items()
    )


def is_adjustment(team: Team, changes: Sequence[Change]) -> bool:
    """Whether the changes affect only constant values of `ADJUSTABLE` parameters, which leave the curvature of every constraint as is."""
    return not is_structural(team, changes) and all(team.families[change.family].psi in ADJUSTABLE for change in changes)


def changed(team: Team, changes: Sequence[Change]) -> Team:
    """The team with the changes applied: parameters, weights and schedules. All constraints are checked and grouped again."""
    agents = list(team.agents)
    start = np.searchsorted(team.owner, team.owner)
    for change in changes:
        number, given = change.number, change.given
        i = int(team.owner[number])
        own = list(flatten(agents[i].constraints))
        k = number - int(start[number])
        old = own[k]
        parameters = {key: dataclasses.replace(each, value=given[key]) if key in given else each for key, each in old.parameters.items()}
        own[k] = dataclasses.replace(old, parameters=parameters, weight=float(np.asarray(given.get("weight", old.weight))))
        agents[i] = dataclasses.replace(agents[i], constraints=own)
    return Team(agents, team.linked, team.dimension, unit=team.unit)


def adjusted(team: Team, changes: Sequence[Change]) -> Team:
    """The team with an adjustment applied; see `is_adjustment`. The families are kept, so no constraint is checked or traced again."""
    families = list(team.families)
    for change in changes:
        family = families[change.family]
        parameters = dict(family.parameters)
        for key, value in change.given.items():
            parameters[key] = np.array(parameters[key], dtype=float)
            parameters[key][change.member] = value
        families[change.family] = dataclasses.replace(family, parameters=parameters)
    return team.with_constraints(families, team.owner, team.names)


def place_of(team: Team, agent: str) -> int:
    """The index of an agent in `Team.ids`. Raises: InvalidTeam: there is no such agent."""
    found = team.place.get(agent) if isinstance(agent, str) else None
    if found is None:
        raise InvalidTeam([Fault((), f"there is no such agent in the team{closest(agent, team.ids)}", f"agent {shown(agent)}")])
    return found


def named(team: Team, agent: str, constraint: str) -> list[int]:
    """The indices, in the team's order, of an agent's constraint with this name: one index, or those of all sides of a box.

    Raises:
        InvalidTeam: there is no such agent or constraint.
    """
    i = place_of(team, agent)
    low, high = np.searchsorted(team.owner, [i, i + 1])
    names = {team.names[k]: k for k in range(int(low), int(high))}
    if not isinstance(constraint, str):
        raise InvalidTeam([Fault((), f"the name of a constraint must be a text, but is {shown(constraint)}", f"agent {agent!r}")])
    if constraint in names:
        return [names[constraint]]
    sides = [k for name, k in names.items() if name.startswith((f"{constraint}.low[", f"{constraint}.high["))]
    if not sides:
        own = ", ".join(map(repr, list(names)[:8])) or "none"
        message = f"there is no constraint {shown(constraint)}{closest(constraint, names)}; it has {own}"
        raise InvalidTeam([Fault((), message, f"agent {agent!r}")])
    return sides


def _sides(
    team: Team, agent: str, constraint: str, parameters: Mapping[str, Any], now: Sequence[Mapping[str, Any]]
) -> list[tuple[int, Mapping[str, Any]]]:
    """(constraint index, its new parameters) pairs. For a box, ``low`` and ``high`` are distributed over its sides."""
    numbers = named(team, agent, constraint)
    if len(numbers) == 1:
        return [(numbers[0], parameters)]
    where = f"agent {agent!r}, constraint {constraint!r}"
    if unknown := [key for key in parameters if key not in ("low", "high", "weight")]:
        raise InvalidTeam([Fault((), f"there is no parameter {unknown[0]!r}; it has low, high and weight", where)])
    own = {side: next(k for k in numbers if f".{side}[" in team.names[k]) for side in ("low", "high")}
    limits = {side: parameters.get(side, parameter(team, k, side, now)) for side, k in own.items()}
    faults: list[Fault] = []
    checked(Vector(limits["high"], above=limits["low"]), team.dimension, Spot(("high",), "high", where, faults))
    if faults:
        raise InvalidTeam(faults)
    return [
        (k, given)
        for k in numbers
        if (given := {key: value for key, value in parameters.items() if key == "weight" or f".{key}[" in team.names[k]})
    ]


def parameter(team: Team, number: int, key: str, now: Sequence[Mapping[str, Any]] | None = None) -> Moving:
    """The current value of a parameter of one constraint, or its schedule if it moves with time. `now`: as in `changes_of`."""
    f, m = team.slots[number].tolist()
    family = team.families[f]
    track = family.tracks.get(key)
    return (track and track.schedule(m)) or np.asarray((family.parameters if now is None else now[f])[key])[m]


def _checked(team: Team, number: int, family: Family, given: Mapping[str, Any]) -> dict[str, Moving]:
    """The new values as arrays or schedules. Raises: InvalidTeam: a parameter is unknown or its value is not allowed."""
    where = f"agent {team.ids[team.owner[number]]!r}, constraint {team.names[number]!r}"
    faults: list[Fault] = []
    values: dict[str, Moving] = {}
    own = adjustable(family.kind, family.psi, family.parameters)
    allowed = {**own, "weight": Number(None, positive=True)}
    for key, value in given.items():
        if key not in allowed:
            message = f"there is no parameter {key!r} to change{closest(key, own)}; it has {', '.join(allowed)}"
            faults.append(Fault((key,), message, where))
            continue
        parameter = dataclasses.replace(allowed[key], value=value)
        found = (still if key == "weight" else checked)(parameter, team.dimension, Spot((key,), key, where, faults))
        if found is None:
            continue
        shape = family.parameters[key].shape[1:] if key != "weight" else ()
        if (found.values.shape[1:] if isinstance(found, Schedule) else found.shape) != shape:
            faults.append(Fault((key,), f"{key} is {shown(value)}, but must have shape {shape}", where))
        values[key] = found
    if faults:
        raise InvalidTeam(faults)
    return values
