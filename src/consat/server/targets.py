"""Which constraints, with which parameters, an order about a shape of the scene changes."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, Final, NamedTuple

import numpy as np

from consat.errors import Fault, InvalidTeam
from consat.problem.changes import named, parameter
from consat.problem.family import Family
from consat.problem.team import Team

CENTERS: Final[Mapping[str, str]] = {"within": "center", "outside": "center", "displacement": "vector"}
"""The parameter that holds the centre of a ball, by kind."""
MOST_SHARED: Final = 64
"""Most constraints that one order can change."""


class Target(NamedTuple):
    """A constraint to change.

    Attributes:
        agent: id of its owner.
        name: name of the constraint, or of the box that it is a side of.
        numbers: its indices in the team; those of a box are its sides.
    """

    agent: str
    name: str
    numbers: list[int]


def ball(team: Team, numbers: list[int], center: Sequence[float] | None, radius: float | None) -> tuple[list[Target], dict[str, Any]]:
    """The constraints that share a ball, and their parameters for another centre or radius; None leaves it."""
    family, _ = family_of(team, numbers[0])
    parameters: dict[str, Any] = {} if radius is None else {"radius": radius}
    if center is not None:
        if family.kind not in CENTERS:
            raise InvalidTeam([Fault((), f"{family.kind} has no centre of its own; change its radius", "shape")])
        parameters[CENTERS[family.kind]] = center
    return _targets(team, numbers), parameters


def wall(team: Team, numbers: list[int], offset: float) -> tuple[list[Target], dict[str, Any]]:
    """The constraints that share a half-space, and their parameters for another offset along its unit normal."""
    family, k = family_of(team, numbers[0])
    given = {key: value[k] for key, value in family.parameters.items()}
    targets = _targets(team, numbers)
    if "normal" in given:
        return targets, {"offset": offset * float(np.linalg.norm(given["normal"]))}
    side, sign = ("high", 1.0) if "high" in given else ("low", -1.0)
    boxes = [each._replace(name=each.name.rpartition(f".{side}[")[0]) for each in targets]
    corner = parameters_of(team, named(team, boxes[0].agent, boxes[0].name), [side])[side]
    return boxes, {side: np.where(np.asarray(given["axis"]) > 0, sign * offset, corner).tolist()}


def _targets(team: Team, numbers: list[int]) -> list[Target]:
    if len(numbers) > MOST_SHARED:
        message = f"{len(numbers)} agents share it, but at most {MOST_SHARED} can be changed together while the team lives"
        raise InvalidTeam([Fault((), message, "shape")])
    return [Target(team.ids[team.owner[number]], team.names[number], [number]) for number in numbers]


def family_of(team: Team, number: int) -> tuple[Family, int]:
    """The family of a constraint, and its row."""
    f, row = team.slots[number].tolist()
    return team.families[f], row


def parameters_of(team: Team, numbers: Sequence[int], keys: Sequence[str]) -> dict[str, Any]:
    """Present values of some parameters of a constraint, schedules included."""
    found: dict[str, Any] = {}
    for number in numbers:
        family, k = family_of(team, number)
        found |= {key: parameter(team, number, key) for key in keys if key in family.parameters}
        if "weight" in keys:
            found["weight"] = float(family.weight[k])
    return found
