"""Builds a team and settings from the plain data of a scenario file. Checks the keys; `consat.problem.team` and `consat.settings` check
the values."""

from __future__ import annotations

import functools
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any, Final, NamedTuple

import numpy as np
from pydantic import ValidationError

from consat.errors import AT_KEY, Fault, InvalidInput, InvalidTeam, counted, shown
from consat.problem.agent import Agent
from consat.problem.constraints import KINDS
from consat.problem.groups import MOST, Each, Group
from consat.problem.index import who_is
from consat.problem.links import Links
from consat.problem.parameters import LARGEST, is_number, is_printable
from consat.problem.team import Team
from consat.scenario.document import Document, Path
from consat.scenario.mappings import constraint
from consat.scenario.words import complaints, unknown_key
from consat.settings import Settings

if TYPE_CHECKING:
    from consat.robots.obstacles import Obstacle
    from consat.scenario.robots import Robots

VERSION: Final = 1
SETTINGS: Final = ("start", "protocol", "smoothing")
KEYS: Final = ("consat", "name", "dimension", "unit", "count", "agents", "communication", "robots", "obstacles", "rate", *SETTINGS)
AGENT_KEYS: Final = ("id", "start", "robot", "constraints")
GROUP_KEYS: Final = ("group", "count", "shape", "spacing", "scatter", "seed", "constraints")
MEMBER_KEYS: Final = ("of", "agent")
"""Additional keys of constraints in a group, besides those of their kind."""
COMMUNICATION_KEYS: Final = ("links", "graph")


class _Faults:
    """Collects faults. A fault at or below the path of an earlier one is dropped, because it is usually a consequence of it."""

    def __init__(self, known: Iterable[Fault]) -> None:
        self.found: list[Fault] = []
        self.paths = {fault.path for fault in known if fault.path}

    def add(self, path: Path, message: str, where: str = "", offset: int = 0) -> None:
        self.take([Fault(path, message, where, offset)])

    def take(self, faults: Iterable[Fault]) -> None:
        """Add the faults whose paths are not at or below that of an earlier call."""
        fresh = [fault for fault in faults if not any(fault.path[: n + 1] in self.paths for n in range(len(fault.path)))]
        self.found += fresh
        self.paths |= {fault.path for fault in fresh}

    def keys(self, path: Path, data: Mapping[str, Any], allowed: Sequence[str], where: str = "") -> dict[str, Any]:
        """The entries of a mapping whose keys are allowed and whose values are not null. Adds a fault for each unknown key."""
        self.take([unknown_key((*path, key), allowed, where) for key in data if key not in allowed])
        return {key: data[key] for key in data if key in allowed and data[key] is not None}


class Built(NamedTuple):
    """The content of a scenario file.

    Attributes:
        team: the team.
        settings: settings of a run.
        name: name of the scenario; None if not given.
        robots: robots and obstacles; None if there are no robots.
        rate: rounds per second, Hz; None if not given.
    """

    team: Team
    settings: Settings
    name: str | None
    robots: Robots | None
    rate: float | None


def build(document: Document) -> Built:
    """Build the team and the settings from a parsed file.

    Raises:
        InvalidScenario: the file has faults. The error holds all of them, with their places.
    """
    data = document.root.plain if document.root else None
    if not isinstance(data, dict):
        what = "the file is empty" if data is None else f"the file holds {shown(data)}"
        message = f"{what}, but must hold keys and values, beginning with consat: {VERSION}; for an example: consat init"
        raise document.invalid([Fault((), message)])
    faults = _Faults(document.faults)
    _version(data, faults, document)
    data = faults.keys((), data, KEYS)
    name = data.get("name")
    if name is not None and not is_printable(name):
        faults.add(("name",), f"name is {shown(name)}, but must be a printable text; put numbers in quotes")
    dimension = data.get("dimension", 2)
    settings = _settings({key: data[key] for key in SETTINGS if key in data}, dimension, faults)
    agents = _agents(data.get("agents"), data.get("count"), faults)
    links = _links(data.get("communication"), faults)
    robots, rate = _robots(data, dimension, faults), _rate(data.get("rate"), faults)
    team = None
    try:
        team = Team(agents, links, dimension, unit=data.get("unit"))
    except InvalidTeam as error:
        faults.take(error.faults)
    if faults.found or document.faults or team is None:
        raise document.invalid(faults.found)
    if robots is not None and (crowded := _crowded(robots, team, rate)):
        raise document.invalid(crowded)
    return Built(team, settings, name, robots, rate)


def _rate(data: Any, faults: _Faults) -> float | None:
    if data is None:
        return None
    if not is_number(data) or not 0 < data <= LARGEST:
        faults.add(("rate",), f"rate is {shown(data)}, but must be a positive number, rounds a second")
        return None
    return float(data)


def _robots(data: Mapping[str, Any], dimension: Any, faults: _Faults) -> Robots | None:
    """The robots and obstacles; None if there are no robots, or if they have faults."""
    agents = data.get("agents")
    entries = enumerate(agents if isinstance(agents, list) else [])
    own = [(i, entry) for i, entry in entries if isinstance(entry, dict) and entry.get("robot")]
    if not own and "robots" not in data and "obstacles" not in data:
        return None
    from consat.scenario.robots import Robots, kind_of, model_of

    common, known = data.get("robots"), len(faults.found)
    made = _obstacles(data.get("obstacles"), dimension, faults)
    if common is None and not own:
        if made:
            faults.add(("obstacles",), "there are obstacles, but no robots to keep clear of them; add robots: {kind: point}")
        return None
    base = common if isinstance(common, dict) else {"kind": "point"}
    whole = _made(functools.partial(model_of, base), ("robots",), "robots", faults)
    if whole is None:  # a fault of the common description is reported once, not for each agent
        return None
    each_own = {}
    for i, entry in own:
        make = functools.partial(model_of, entry["robot"], f"agent {entry.get('id')!r}, robot", base)
        model = _made(make, ("agents", i, "robot"), "", faults)
        if model is not None:
            each_own[str(entry.get("id"))] = model
    if len(faults.found) > known:
        return None
    for model, path in ((whole, ("robots", "kind")), *((each, ("robots",)) for each in each_own.values())):
        if isinstance(dimension, int) and dimension not in model.dimensions:
            allowed = " or ".join(map(str, model.dimensions))
            faults.add(path, f"{kind_of(model)} robots move in {allowed} dimensions, but the team has {dimension}", "robots")
            return None
    return Robots(whole, each_own, tuple(made))


def _obstacles(data: Any, dimension: Any, faults: _Faults) -> list[Obstacle]:
    from consat.scenario.robots import obstacle_of

    if data is not None and not isinstance(data, list):
        example = "[{kind: disc, center: [0, 0], radius: 1}]"
        faults.add(("obstacles",), f"obstacles is {shown(data)}, but must be a list such as {example}")
        data = None
    made: list[Obstacle] = []
    for k, item in enumerate(data or []):
        each = _made(functools.partial(obstacle_of, item), ("obstacles", k), f"obstacles[{k}]", faults)
        if each is None:
            continue
        made.append(each)
        if isinstance(dimension, int) and each.dimension != dimension and 1 <= dimension <= 64:
            message = f"it lies in {each.dimension} dimensions, but the team has {dimension}"
            faults.add(("obstacles", k), message, f"obstacles[{k}]")
    return made


def _made(make: Callable[[], Any], path: Path, where: str, faults: _Faults) -> Any:
    """The result of `make`; None if it raises, with its faults added at `path`."""
    try:
        return make()
    except InvalidInput as error:
        faults.take([replace(fault, path=(*path, *fault.path), where=fault.where or where) for fault in error.faults])
        return None


def _crowded(robots: Robots, team: Team, rate: float | None) -> list[Fault]:
    """Faults of given starts that lie in an obstacle or overlap each other."""
    from consat.robots.obstacles import map_of, start_faults

    given = np.flatnonzero(np.isfinite(team.starts).all(axis=1))
    if not len(given):
        return []
    size = np.broadcast_to(np.asarray(robots.fleet(list(team.ids)).radius, dtype=float), (team.count,))
    ids = [team.ids[i] for i in given.tolist()]
    found = start_faults(ids, team.starts[given], size[given], map_of(robots.obstacles, team.dimension))
    return [replace(fault, path=("agents", int(given[int(fault.path[1])]), "start")) for fault in found]


def _version(data: Mapping[str, Any], faults: _Faults, document: Document) -> None:
    version = data.get("consat")
    if isinstance(version, int) and version > VERSION:
        message = f"the scenario is of version {shown(version)}, but this consat reads version {VERSION}; upgrade consat"
        raise document.invalid([Fault(("consat",), message)])
    if version is None:
        faults.add(("consat",), f"the version is missing; a scenario begins with the line consat: {VERSION}")
    elif type(version) is not int or version != VERSION:
        faults.add(("consat",), f"the version is {shown(version)}, but must be {VERSION}")


def _settings(data: Mapping[str, Any], dimension: Any, faults: _Faults) -> Settings:
    try:
        settings = Settings.model_validate(data, by_alias=True, by_name=False)
    except ValidationError as error:
        faults.take(complaints(error, data))
        return Settings()
    for side in settings.start.box or ():
        if isinstance(side, tuple) and isinstance(dimension, int) and len(side) != dimension:
            message = (
                f"a side of the box has {counted(len(side), 'entry', 'entries')}, but must have {dimension}, "
                "one for each dimension of the team"
            )
            faults.add(("start", "box"), message, "start")
    return settings


def _links(data: Any, faults: _Faults) -> Links:
    path: Path = ("communication",)
    example = "{links: [[a1, a2]]} or {graph: ring}"
    if data is None:
        return "task"
    if not isinstance(data, dict):
        faults.add(path, f"communication is {shown(data)}, but must be a mapping such as {example}")
        return "task"
    data = faults.keys(path, data, COMMUNICATION_KEYS)
    links, graph = data.get("links"), data.get("graph")
    if (links is None) == (graph is None):
        what = "neither links nor a graph" if links is None else "both links and a graph"
        faults.add(path, f"communication has {what}, but must have one of them, such as {example}")
    if links is None:
        if graph is not None and not isinstance(graph, str):
            faults.add((*path, "graph"), f"graph is {shown(graph)}, but must be a word such as ring")
        return graph if isinstance(graph, str) else "task"
    if not isinstance(links, list):
        faults.add((*path, "links"), f"links is {shown(links)}, but must be a list of pairs such as [[a1, a2], [a2, a3]]")
        return "task"
    return links


def _agents(data: Any, count: Any, faults: _Faults) -> list[Agent | Group]:
    """The agents and groups. `count` is the number of members of each group that gives none itself."""
    if data is None:
        faults.add(("agents",), "agents is missing; it must be a list such as [{id: a1, constraints: [..]}]")
        return []
    if not isinstance(data, list):
        faults.add(("agents",), f"agents is {shown(data)}, but must be a list such as [{{id: a1, constraints: [..]}}]")
        return []
    grouped = [isinstance(entry, dict) and "group" in entry for entry in data]
    if count is not None and not any(group and entry.get("count") is None for group, entry in zip(grouped, data, strict=True)):
        faults.add(("count",), "count is of groups that have none of their own, but there are none", offset=AT_KEY)
    return [
        _group(entry, count, ("agents", i), faults) if group else _agent(entry, ("agents", i), faults)
        for i, (entry, group) in enumerate(zip(data, grouped, strict=True))
    ]


def _agent(data: Any, path: Path, faults: _Faults) -> Agent:
    where = f"agents[{path[-1]}]"
    if not isinstance(data, dict):
        faults.add(path, f"it is {shown(data)}, but must be a mapping such as {{id: a1, constraints: [..]}}", where)
        return Agent(data if isinstance(data, str) else "")
    data = faults.keys(path, data, AGENT_KEYS, where)
    if "id" not in data:
        faults.add((*path, "id"), "id is missing; every agent needs one, such as a1", where)
    name = data.get("id", "")
    where = who_is(int(path[-1]), name)
    made = [_constraint(item, at, where, faults) for at, item in _constraints(data, path, where, faults)]
    return Agent(name, made, data.get("start"))


def _group(data: dict[str, Any], count: Any, path: Path, faults: _Faults) -> Group:
    name = data["group"]
    where = f"group {name!r}" if isinstance(name, str) and name.strip() else f"agents[{path[-1]}]"
    data = faults.keys(path, data, GROUP_KEYS, where)
    if "count" not in data and count is None:
        faults.add((*path, "count"), "count is missing; it tells how many agents the group stands for", where)
    elif "count" not in data and not (type(count) is int and 1 <= count <= MOST):
        faults.add(("count",), f"count is {shown(count)}, but must be a whole number from 1 to {MOST}")
        count = 1
    made = [_each(item, at, where, faults) for at, item in _constraints(data, path, where, faults)]
    given = {key: data[key] for key in ("shape", "spacing", "scatter", "seed") if key in data}
    return Group(name, data.get("count", count), made, **given)


def _each(data: Any, path: Path, where: str, faults: _Faults) -> Each:
    """A constraint of a group, with the keys `MEMBER_KEYS` that select its owners and the agent it reads."""
    if not isinstance(data, dict):
        return Each(_constraint(data, path, where, faults))
    keys = MEMBER_KEYS if data.get("kind") == "expr" else MEMBER_KEYS[:1]
    return Each(_constraint(data, path, where, faults, keys), data.get("of"), data.get("agent") if "agent" in keys else None)


def _constraints(data: dict[str, Any], path: Path, where: str, faults: _Faults) -> list[tuple[Path, Any]]:
    constraints = data.get("constraints", [])
    if not isinstance(constraints, list):
        faults.add((*path, "constraints"), f"constraints is {shown(constraints)}, but must be a list of mappings", where)
        return []
    return [((*path, "constraints", k), item) for k, item in enumerate(constraints)]


def _constraint(data: Any, path: Path, owner: str, faults: _Faults, besides: tuple[str, ...] | None = None) -> Any:
    """The constraint at `path`, made from its mapping; see `consat.scenario.mappings.constraint`. `owner`: its agent or group in words."""
    kind, name = (data.get("kind"), data.get("name")) if isinstance(data, dict) else (None, None)
    known = isinstance(kind, str) and kind in KINDS
    where = f"{owner}, constraint {repr(name if isinstance(name, str) else kind) if known else int(path[-1]) + 1}"
    made, found = constraint(data, where, besides)
    faults.take([replace(fault, path=(*path, *fault.path)) for fault in found])
    return made
