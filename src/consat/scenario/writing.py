"""Writes a team and its settings as the text of a scenario file.

Short values are written in the style of JSON, which is part of YAML 1.2. The layout is chosen for human readers.
"""

from __future__ import annotations

import dataclasses
import json
import re
from collections.abc import Callable, Iterator, Mapping
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from consat.errors import Fault, InvalidTeam
from consat.problem.constraints import KINDS, OWNER, Constraint, box
from consat.problem.constraints.record import flatten
from consat.problem.family import Family
from consat.problem.groups import Each, Group
from consat.problem.links import TOPOLOGIES, topology
from consat.problem.schedule import Schedule
from consat.problem.team import Team
from consat.scenario.document import resolve
from consat.scenario.mappings import required
from consat.scenario.schema import GROUP_KEYS, SETTINGS, VERSION
from consat.settings import Settings

if TYPE_CHECKING:
    from consat.scenario.robots import Robots

WIDTH: Final = 110
"""Lists and mappings of up to this many characters are written on one line."""

MOST_WRITTEN: Final = 10_000
"""Largest number of single agents, and of links, that are written."""

_WORDS = re.compile(r"[A-Za-z][\w-]*( [\w-]+)*", re.ASCII)
_UNPRINTED = re.compile("[\x7f-\x9f\u2028\u2029\ufeff]")


def dump(
    team: Team, settings: Settings | None = None, name: str = "team", *, robots: Robots | None = None, rate: float | None = None
) -> str:
    """The text of a scenario file for a team. Loading it gives an equal team.

    Args:
        team: a team with library constraints and text expressions only. A `consat.box` is written as half-spaces.
        settings: start, protocol and smoothing of the file; defaults are left out.
        name: name of the scenario.
        robots: robots and obstacles; None if agents are points that move freely.
        rate: rounds per second, Hz.

    Raises:
        InvalidTeam: the team cannot be written: constraints are Python functions (the message names them), a group has separate values for
            each member, or there are too many single agents or links.
    """
    grouped = team.members is not None and any(isinstance(member, Group) for member in team.members)
    if not grouped and team.count > MOST_WRITTEN:
        message = f"there are {team.count} agents, but at most {MOST_WRITTEN} are written one by one; make the team of consat.Group"
        raise InvalidTeam([Fault(("agents",), message, "agents")])
    singles = _agents(team)
    if grouped:
        counts = {member.count for member in team.members or () if isinstance(member, Group)}
        shared = len(counts) == 1
        agents = [_group(each, k, shared) if isinstance(each, Group) else next(singles) for k, each in enumerate(team.members or ())]
        count = {"count": counts.pop()} if shared else {}
    else:
        agents, count = list(singles), {}
    machines = {} if robots is None else robots.data
    for agent in agents:
        if agent.get("id") in (own := machines.get("own", {})):
            agent["robot"] = own[agent["id"]]
    about = {key: machines[key] for key in ("robots", "obstacles") if machines.get(key)} | ({} if rate is None else {"rate": rate})
    chosen = (settings or Settings()).model_dump(mode="json", by_alias=True, exclude_defaults=True, include=set(SETTINGS))
    head = {"consat": VERSION, "name": name, "dimension": team.dimension} | ({} if team.unit is None else {"unit": team.unit}) | count
    return write(head | {"agents": agents, "communication": _communication(team)} | about | chosen)


def _agents(team: Team) -> Iterator[dict[str, Any]]:
    """The entries of the agents that are not members of a group."""
    members = team.ids if team.members is None else team.members
    grouped = [isinstance(member, Group) for member in members]
    alone = ~np.repeat(grouped, [member.count if isinstance(member, Group) else 1 for member in members])
    owned: dict[int, dict[int, dict[str, Any]]] = {i: {} for i in np.flatnonzero(alone).tolist()}
    faults = []
    for family in team.families:
        chosen = np.flatnonzero(alone[family.owner])
        for k, entry in zip(chosen.tolist(), _constraints(team, family, chosen), strict=True):
            owned[int(family.owner[k])][int(family.number[k])] = entry
    for owner, constraints in owned.items():
        for place, number in enumerate(sorted(constraints)):
            if "kind" not in constraints[number]:
                message = "it is a Python function, which no file can hold; use a library constraint or consat.expr"
                path = ("agents", owner, "constraints", place)
                faults.append(Fault(path, message, f"agent {team.ids[owner]!r}, constraint {team.names[number]!r}"))
    if faults:
        raise InvalidTeam(faults)
    for i, constraints in owned.items():
        start, own = team.starts[i], [constraints[number] for number in sorted(constraints)]
        yield {"id": team.ids[i]} | ({} if np.isnan(start).any() else {"start": start.tolist()}) | ({"constraints": own} if own else {})


def _group(group: Group, place: int, same_count: bool) -> dict[str, Any]:
    """The entry of a group.

    Args:
        group: the group.
        place: its index among the agents and groups, for faults.
        same_count: whether its count is written once for all groups.

    Raises:
        InvalidTeam: the group has a separate value for each member, or a Python function.
    """
    path = ("agents", place)
    where = f"group {group.name!r}"
    if group.start is not None:
        raise InvalidTeam([Fault((*path, "start"), "no file can hold a start for each member of a group; use scatter", where)])
    given = {field.name: getattr(group, field.name) for field in dataclasses.fields(Group) if field.name in GROUP_KEYS}
    kept = {
        key: value
        for key, value in given.items()
        if key != "constraints" and value != _GROUP_DEFAULTS.get(key) and not (key == "count" and same_count)
    }
    constraints = []
    for k, item in enumerate(group.constraints):
        outer = item if isinstance(item, Each) else Each(item)
        for constraint in outer.constraint if isinstance(outer.constraint, list | tuple) else [outer.constraint]:
            entry = _each(constraint, outer)
            if entry is None:
                message = "no file can hold a Python function, or a value for each member; use a library constraint or consat.expr"
                raise InvalidTeam([Fault((*path, "constraints", k), message, where)])
            constraints.append(entry)
    return {"group": group.name} | kept | ({"constraints": constraints} if constraints else {})


def _each(constraint: Constraint, outer: Each) -> dict[str, Any] | None:
    """The entry of a constraint of a group; None if a file cannot hold it."""
    values = {key: _plain(parameter.value) for key, parameter in constraint.parameters.items()}
    arrays = [outer.of, outer.agent, *constraint.reads, *(values.values() if constraint.psi not in _SIDES else ())]
    if any(isinstance(value, np.ndarray) for value in arrays):
        return None
    other = outer.agent if constraint.source is not None else constraint.reads[1] if len(constraint.reads) > 1 else None
    entry = _described(constraint.psi, constraint.source, other, values)
    if entry is None:
        return None
    named = {} if constraint.name is None else {"name": constraint.name}
    weight = {} if constraint.weight == 1 else {"weight": float(constraint.weight)}
    plain = {key: list(value) if isinstance(value, tuple) else value for key, value in (entry | named | weight).items()}
    return plain | ({} if outer.of is None else {"of": outer.of})


def _described(psi: Callable[..., Any], source: str | None, agent: Any, values: dict[str, Any]) -> dict[str, Any] | None:
    """What a file says of a function ψ; None if a file cannot hold it.

    Args:
        psi: the function.
        source: its text, if it is a text expression.
        agent: what stands under ``agent``; None if nothing does.
        values: plain values of the parameters of a library function.
    """
    other = {} if agent is None else {"agent": agent}
    if source is not None:
        return {"kind": "expr", "psi": source} | other
    if psi in _SIDES:
        return _side(psi, values)
    return {"kind": _KIND_OF[psi]} | other | values if psi in _KIND_OF else None


def _side(psi: Callable[..., Any], parameters: Mapping[str, Any]) -> dict[str, Any]:
    """The entry of one side of a box, written as a half-space."""
    sign, bound = _SIDES[psi]
    normal, limit = sign * np.asarray(parameters["axis"], dtype=float), parameters[bound]
    if isinstance(limit, Mapping):
        offset: Any = {"times": limit["times"], "values": [float(normal @ np.asarray(value)) for value in limit["values"]]}
    else:
        offset = float(normal @ np.asarray(limit))
    return {"kind": "halfspace", "normal": normal.tolist(), "offset": offset}


def _plain(value: Any) -> Any:
    return value.plain() if isinstance(value, Schedule) else value


def write(data: Mapping[str, Any]) -> str:
    """The YAML text of plain data."""
    return "\n".join(_lines(data)) + "\n"


def _constraints(team: Team, family: Family, chosen: np.ndarray) -> Iterator[dict[str, Any]]:
    """The entries of the `chosen` members of a family. An entry has no ``kind`` if a file cannot hold the constraint."""
    for k, number in zip(chosen.tolist(), family.number[chosen].tolist(), strict=True):
        parameters = {key: values[k].tolist() for key, values in family.parameters.items()}
        moving = {key: track.schedule(k) for key, track in family.tracks.items()}
        parameters |= {key: schedule.plain() for key, schedule in moving.items() if schedule is not None}
        reads = [team.ids[i] for i in family.agents[k]]
        source = None if family.sources is None else family.sources[k]
        other = reads[1] if len(reads) > 1 and source is None else None
        entry = _described(family.psi, source, other, parameters) or {}
        others = [agent for agent, i in zip(reads, family.agents[k], strict=True) if i != family.owner[k]]
        derived = f"{entry.get('kind')}({', '.join(others)})" if others else entry.get("kind")
        if team.names[number] != derived:
            entry["name"] = team.names[number]
        if family.weight[k] != 1:
            entry["weight"] = float(family.weight[k])
        yield entry


_KIND_OF: Final[Mapping[Callable[..., Any], str]] = {
    made.psi: kind
    for kind, factory in KINDS.items()
    if kind not in ("box", "expr")
    for made in flatten(factory(**dict.fromkeys(required(factory), OWNER)))
}
_GROUP_DEFAULTS: Final = {field.name: field.default for field in dataclasses.fields(Group)}
_SIDES: Final = {side.psi: (-1.0, "low") if "low" in side.parameters else (1.0, "high") for side in box([0], [1])}
"""For the function of each side of a box: the sign of its normal, and the name of its parameter."""


def _communication(team: Team) -> dict[str, Any]:
    for graph in ("task", *TOPOLOGIES):
        whole = graph != "complete" or 2 * len(team.links) == team.count * (team.count - 1)
        if len(team.links) and whole and np.array_equal(topology(graph, team.count, team.families), team.links):
            return {"graph": graph}
    if len(team.links) > MOST_WRITTEN:
        message = f"there are {len(team.links)} links, but at most {MOST_WRITTEN} are written; use one of {', '.join(TOPOLOGIES)}"
        raise InvalidTeam([Fault(("communication", "links"), message, "communication")])
    return {"links": [[team.ids[i], team.ids[j]] for i, j in team.links]}


def _lines(value: Mapping[str, Any] | list[Any]) -> Iterator[str]:
    """The lines of a block. A short entry without a nested mapping takes one line; any other entry is an indented block."""
    entries = [(f"{_flow(key)}:", each) for key, each in value.items()] if isinstance(value, Mapping) else [("-", each) for each in value]
    for lead, each in entries:
        parts = each.values() if isinstance(each, dict) else each if isinstance(each, list) else ()
        if not any(_too_deep(part, lead) for part in parts):
            text = _flow(each)
            if len(text) <= WIDTH or not isinstance(each, dict | list):
                yield f"{lead} {text}"
                continue
        inner = _lines(each)
        yield f"- {next(inner)}" if lead == "-" else lead
        yield from (f"  {line}" for line in inner)


def _too_deep(part: Any, lead: str) -> bool:
    """Whether an entry with this part must be written as a block. A list entry on one line may hold a mapping if that is flat."""
    return any(map(_holds_mapping, part.values())) if isinstance(part, dict) and lead == "-" else _holds_mapping(part)


def _holds_mapping(value: Any) -> bool:
    return isinstance(value, dict) or (isinstance(value, list) and any(map(_holds_mapping, value)))


def _flow(value: Any) -> str:
    if isinstance(value, dict):
        return "{" + ", ".join(f"{_flow(key)}: {_flow(each)}" for key, each in value.items()) + "}"
    if isinstance(value, list):
        return "[" + ", ".join(map(_flow, value)) + "]"
    if isinstance(value, str):
        if _WORDS.fullmatch(value) and resolve(value) == value:
            return value
        return _UNPRINTED.sub(lambda odd: f"\\u{ord(odd[0]):04x}", json.dumps(value, ensure_ascii=False))
    return str(int(value)) if isinstance(value, float) and value.is_integer() and abs(value) < 1e15 else json.dumps(value)
