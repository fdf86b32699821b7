"""The robots of a team and the obstacles on its map, from a scenario or from the arguments of `consat.run`."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Final

import jax.numpy as jnp
import numpy as np

from consat.errors import Fault, InvalidInput, closest, shown
from consat.numerics import float64
from consat.problem.team import Team
from consat.robots.double import Double
from consat.robots.fleet import Fleet
from consat.robots.model import Model
from consat.robots.obstacles import Obstacle, box, disc, map_of, polygon
from consat.robots.point import Point
from consat.robots.quadrotor import Quadrotor
from consat.robots.unicycle import Unicycle
from consat.scenario.mappings import checked

KINDS: Final[Mapping[str, Any]] = {"point": Point, "double": Double, "unicycle": Unicycle, "quadrotor": Quadrotor}
"""The model of each kind of robot. The other keys of a mapping are its arguments."""
SHAPES: Final[Mapping[str, Any]] = {"disc": disc, "box": box, "polygon": polygon}
"""The factory of each kind of obstacle."""


@dataclass(frozen=True, eq=False)
class Robots:
    """The robots of a team, and the obstacles.

    Attributes:
        common: the robot of each agent without one of its own.
        own: robots of single agents, by id.
        obstacles: the public map.
    """

    common: Model[Any]
    own: Mapping[str, Model[Any]] = field(default_factory=dict)
    obstacles: tuple[Obstacle, ...] = ()

    def fleet(self, ids: Sequence[str]) -> Model[Any]:
        """One model for the team. Parameters that differ are arrays; different kinds make a `Fleet`."""
        each = [self.own.get(agent, self.common) for agent in ids]
        if all(model is each[0] for model in each):
            return each[0]
        kinds = list(dict.fromkeys(type(model) for model in each))
        models = [_stacked(kind, [model for model in each if type(model) is kind]) for kind in kinds]
        return models[0] if len(kinds) == 1 else Fleet(models, np.array([kinds.index(type(model)) for model in each]))

    @property
    def data(self) -> dict[str, Any]:
        """Plain data as in a scenario file: ``robots``, ``obstacles``, and ``own``, the robots by id."""
        own = {agent: model_data(model) for agent, model in self.own.items()}
        return {"robots": model_data(self.common), "obstacles": [obstacle_data(each) for each in self.obstacles], "own": own}

    @property
    def entries(self) -> dict[str, Any]:
        """Plain data as in ``run --json``: like `data`, with ``own`` inside ``robots``."""
        data = self.data
        own = {"own": data["own"]} if data["own"] else {}
        return {"robots": data["robots"] | own, "obstacles": data["obstacles"]}

    @classmethod
    def of(cls, data: Mapping[str, Any]) -> Robots:
        """From plain data, as in `data`."""
        own = {agent: model_of(each) for agent, each in data["own"].items()}
        return cls(model_of(data["robots"]), own, tuple(obstacle_of(each) for each in data["obstacles"]))


def asked(robots: Any, obstacles: Any, known: Robots | None, ids: Sequence[str]) -> Robots | None:
    """The robots of a run: those given, else those of the scenario.

    Args:
        robots: a model for all, a mapping from ids to models, or the name of a kind; None for those of the scenario.
        obstacles: obstacles, as `consat.disc` returns; None for those of the scenario.
        known: robots of the scenario.
        ids: ids of the team.

    Raises:
        InvalidInput: an argument is wrong.
    """
    place = _map(obstacles, known)
    if robots is None and known is None and place:
        raise InvalidInput([Fault(("robots",), "there are obstacles, but no robots to keep clear of them; give robots, too", "robots")])
    if robots is None or (known is not None and isinstance(robots, str) and robots == kind_of(known.common)):
        return None if known is None else dataclasses.replace(known, obstacles=place)
    if isinstance(robots, str):
        return Robots(model_of({"kind": robots}), {}, place)
    if isinstance(robots, Mapping):
        if missing := [agent for agent in ids if agent not in robots]:
            raise InvalidInput([Fault(("robots",), f"there is none for agent {missing[0]!r}; give one for each agent", "robots")])
        if unknown := [agent for agent in robots if agent not in set(ids)]:
            raise InvalidInput([Fault(("robots",), f"there is no agent {shown(unknown[0])}{closest(unknown[0], ids)}", "robots")])
    models = list(robots.values()) if isinstance(robots, Mapping) else [robots]
    if wrong := [model for model in models if type(model) not in KINDS.values()]:
        names = ", ".join(f"consat.{kind.__name__}" for kind in KINDS.values())
        raise InvalidInput([Fault(("robots",), f"{shown(wrong[0])} is no robot; use one of {names}", "robots")])
    own = {agent: model for agent, model in robots.items() if model is not models[0]} if isinstance(robots, Mapping) else {}
    return Robots(models[0], own, place)


def _map(obstacles: Any, known: Robots | None) -> tuple[Obstacle, ...]:
    if obstacles is None:
        return () if known is None else known.obstacles
    if wrong := [each for each in obstacles if not isinstance(each, Obstacle)]:
        raise InvalidInput([Fault(("obstacles",), f"{shown(wrong[0])} is no obstacle; use consat.disc and its like", "obstacles")])
    return tuple(obstacles)


def kind_of(model: Model[Any]) -> str:
    """The name of a model's kind."""
    return next(name for name, kind in KINDS.items() if type(model) is kind)


def model_data(model: Model[Any]) -> dict[str, Any]:
    """A model as plain data of a scenario file."""
    return _data(kind_of(model), model)


def obstacle_data(obstacle: Obstacle) -> dict[str, Any]:
    """An obstacle as plain data of a scenario file."""
    return _data(type(obstacle).__name__.lower(), obstacle)


def _data(kind: str, made: Any) -> dict[str, Any]:
    return {"kind": kind} | {each.name: _listed(getattr(made, each.name)) for each in dataclasses.fields(made)}


def _listed(value: Any) -> Any:
    if isinstance(value, np.ndarray):
        return value.tolist()
    return [_listed(each) for each in value] if isinstance(value, tuple) else value


def model_of(data: Any, where: str = "robots", base: Mapping[str, Any] | None = None) -> Model[Any]:
    """A model from a mapping of a scenario file.

    Args:
        data: the mapping.
        where: the mapping in words, for faults.
        base: mapping with defaults for missing keys, if it has the same kind.

    Raises:
        InvalidInput: the mapping has faults. Their paths begin at the mapping.
    """
    return _made(data, KINDS, where, "{kind: unicycle, radius: 0.1}", base)


def obstacle_of(data: Any) -> Obstacle:
    """An obstacle from a mapping of a scenario file; raises as `model_of`."""
    made: Obstacle = _made(data, SHAPES, "obstacle", "{kind: disc, center: [0, 0], radius: 1}", None)
    return made


def _made(data: Any, kinds: Mapping[str, Any], where: str, example: str, base: Mapping[str, Any] | None) -> Any:
    inherited: dict[str, Any] = {}
    if isinstance(data, Mapping) and base is not None:
        data = {"kind": base.get("kind"), **data}
        inherited = {key: value for key, value in base.items() if key != "kind"} if data["kind"] == base.get("kind") else {}
    given, faults = checked(data, kinds, where, example, base=inherited)
    if faults:
        raise InvalidInput(faults)
    try:
        return kinds[data["kind"]](**inherited | given)
    except InvalidInput as error:
        named = [f"{where}, {fault.path[0]}" if fault.path else where for fault in error.faults]
        raise InvalidInput(dataclasses.replace(fault, where=each) for fault, each in zip(error.faults, named, strict=True)) from None


@float64
def blocked_goals(robots: Robots, team: Team) -> list[str]:
    """Warnings about goals, constraints of the kind ``within``, whose centre is in an obstacle or too close to one, one sentence each.

    Args:
        robots: robots and obstacles.
        team: the team. Goals that move are checked at sample times.
    """
    size = np.broadcast_to(np.asarray(robots.fleet(list(team.ids)).radius, dtype=float), (team.count,))
    found: dict[tuple[int, int], str] = {}
    for instant in team.instants if robots.obstacles else ():
        for family in (each for each in instant.families if each.kind == "within"):
            for k, obstacle in enumerate(robots.obstacles):
                gaps = np.asarray(map_of((obstacle,), team.dimension).signed_distance(jnp.asarray(family.parameters["center"])))
                for row in np.flatnonzero(gaps < size[family.owner]).tolist():
                    number, owner = int(family.number[row]), int(family.owner[row])
                    free = gaps[row] + float(family.parameters["radius"][row]) >= size[owner]
                    what = "the centre" if free else "no point"
                    where = f"agent {team.ids[owner]!r}, constraint {team.names[number]!r}"
                    stand = f"obstacles[{k}] ({type(obstacle).__name__.lower()})"
                    clear = "is not clear" if free else "is clear"
                    found[number, k] = f"{where}: {what} of the goal {clear} of {stand} by the radius of the robot"
    return list(found.values())


def _stacked(kind: Any, models: Sequence[Any]) -> Any:
    """Join models of one kind. Parameters that differ become arrays."""
    values = {each.name: [getattr(model, each.name) for model in models] for each in dataclasses.fields(kind)}
    return kind(**{name: own[0] if all(value == own[0] for value in own) else np.array(own) for name, own in values.items()})
