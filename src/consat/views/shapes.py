"""Geometry of library constraints: balls and half-spaces. A region that several agents share is listed once.

The geometry is computed from the parameters, for views of crowds, in space, and outside matplotlib. All other ψ must be evaluated: see
`consat.views.regions.regions`.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Hashable, Mapping
from dataclasses import dataclass
from typing import Any, Final

import numpy as np

from consat.problem.team import Team

BALLS: Final[Mapping[str, bool]] = {"within": False, "outside": True, "near": False, "apart": True, "displacement": False}
"""Kinds whose boundary is a ball. The value says whether the owner must stay outside."""
WALLS: Final = ("halfspace", "box")
MOST_SHAPES: Final = 20_000
"""Most constraints of a team whose regions are drawn. Of a team with more, none is."""
WAYS: Final = 20
"""Number of times at which moving balls are sampled for a view that holds their motion, about."""


@dataclass(frozen=True, eq=False)
class Balls:
    """K balls. Equal balls of several owners are merged to one.

    Attributes:
        center: (K, d) centre; relative to the agent `around` if there is one.
        around: (K,) index of the agent that the ball moves with, or -1.
        radius: (K,) radius.
        keeps_out: (K,) whether the owners must stay outside.
        moves: (K,) whether the ball moves, with an agent or by a schedule.
        owners: for each ball the indices of its owners, ascending.
        numbers: for each ball the indices of its constraints, ascending.
    """

    center: np.ndarray
    around: np.ndarray
    radius: np.ndarray
    keeps_out: np.ndarray
    moves: np.ndarray
    owners: tuple[tuple[int, ...], ...]
    numbers: list[list[int]]

    def at(self, x: np.ndarray) -> np.ndarray:
        """(K, d) absolute centres, with the team at x (N, d)."""
        return self.center + np.where(self.around[:, None] >= 0, x[self.around], 0.0)

    def boxes(self, x: np.ndarray) -> np.ndarray:
        """(K, 2, d) boxes around the balls, low and high corner, with the team at x (N, d)."""
        center, radius = self.at(x)[:, None], self.radius[:, None, None]
        return np.concatenate([center - radius, center + radius], axis=1)


@dataclass(frozen=True, eq=False)
class Walls:
    """K half-spaces normal·x ≤ offset. Equal half-spaces of several owners are merged to one.

    Attributes:
        normal: (K, d) unit vector towards the forbidden side.
        offset: (K,) distance of the boundary from the origin, along `normal`.
        owners: for each half-space the indices of its owners, ascending.
        numbers: for each half-space the indices of its constraints, ascending.
    """

    normal: np.ndarray
    offset: np.ndarray
    owners: tuple[tuple[int, ...], ...]
    numbers: list[list[int]]


@dataclass(frozen=True, eq=False)
class Shapes:
    """Geometry of a team's constraints.

    Attributes:
        balls: constraints of the kinds in `BALLS`.
        walls: constraints of the kinds in `WALLS`.
        others: (M',) indices of constraints without closed-form geometry; of equal ones, the first.
    """

    balls: Balls
    walls: Walls
    others: np.ndarray


def shapes(team: Team, time: float = 0.0) -> Shapes:
    """The geometry of a team's constraints at a time, s. Number and order of balls and walls are the same at all times."""
    first, ties = alike(team), moves(team)
    numbers: dict[int, list[int]] = defaultdict(list)
    for number, same in enumerate(first.tolist()):
        numbers[same].append(number)
    balls: list[tuple[Any, ...]] = []
    walls: list[tuple[Any, ...]] = []
    others: list[int] = []
    for family in team.at(time).families:
        for k in np.flatnonzero(first[family.number] == family.number).tolist():
            number, given = int(family.number[k]), {name: value[k] for name, value in family.parameters.items()}
            if family.kind in BALLS and "radius" in given and family.sources is None:
                center = given.get("center", given.get("vector", np.zeros(team.dimension)))
                around = int(family.agents[k, 1]) if family.arity == 2 else -1
                balls.append((center, around, given["radius"], BALLS[family.kind], ties[number], numbers[number]))
            elif family.kind in WALLS and (wall := _wall(given)) is not None:
                walls.append((*wall, numbers[number]))
            else:
                others.append(number)

    def column(rows: list[tuple[Any, ...]], place: int, kind: type = float) -> np.ndarray:
        return np.array([row[place] for row in rows], dtype=kind)

    def owners(rows: list[tuple[Any, ...]]) -> tuple[tuple[int, ...], ...]:
        return tuple(tuple(np.asarray(team.owner)[row[-1]].tolist()) for row in rows)

    def vectors(rows: list[tuple[Any, ...]]) -> np.ndarray:
        return column(rows, 0).reshape(-1, team.dimension)

    return Shapes(
        Balls(
            vectors(balls), column(balls, 1, int), column(balls, 2), column(balls, 3, bool), column(balls, 4, bool),
            owners(balls), [row[-1] for row in balls],
        ),
        Walls(vectors(walls), column(walls, 1), owners(walls), [row[-1] for row in walls]),
        np.array(sorted(others), dtype=int),
    )  # fmt: skip


def alike(team: Team) -> np.ndarray:
    """(M,) for each constraint the index of the first one that has the same region at all positions and times; it may be itself.

    Regions are the same for the same function, the same parameters at all times, and the same agents besides the owner.
    """
    found, instants = np.arange(len(team.owner)), team.instants
    for place, family in enumerate(team.families):
        values = [np.ascontiguousarray(value) for instant in instants for _, value in sorted(instant.families[place].parameters.items())]
        first: dict[Hashable, int] = {}
        for k in np.argsort(family.number).tolist():
            reads = tuple(-1 if agent == family.owner[k] else int(agent) for agent in family.agents[k])
            number = int(family.number[k])
            found[number] = first.setdefault((reads, *(value[k].tobytes() for value in values)), number)
    return found


def moves(team: Team) -> np.ndarray:
    """(M,) whether the region of a constraint moves, with teammates or by a schedule."""
    found = np.zeros(len(team.owner), dtype=bool)
    for family in team.families:
        found[family.number] = family.arity > 1
        for track in family.tracks.values():
            found[family.number[track.rows]] = True
    return found


def boxes(team: Team) -> np.ndarray:
    """(B, 2, d) the distinct ``box`` constraints of the team, low and high corner."""
    lows, highs = (
        {
            int(owner): corner
            for family in team.families
            if family.kind == "box" and family.sources is None and side in family.parameters
            for owner, corner in zip(family.owner, family.parameters[side], strict=True)
        }
        for side in ("low", "high")
    )
    both = [np.stack([lows[owner], highs[owner]]) for owner in sorted(lows.keys() & highs.keys())]
    return np.unique(np.array(both, dtype=float).reshape(-1, 2, team.dimension), axis=0)


def ways(team: Team, times: np.ndarray) -> np.ndarray:
    """(B, 2, d) boxes around the balls that move by a schedule, at about `WAYS` of the given times, s."""
    found = [np.zeros((0, 2, team.dimension))]
    if team.moves:
        for time in times[:: max(1, len(times) // WAYS)].tolist():
            balls = shapes(team, time).balls
            found.append(balls.boxes(np.zeros((team.count, team.dimension)))[balls.moves & (balls.around < 0)])
    return np.concatenate(found)


def _wall(given: Mapping[str, np.ndarray]) -> tuple[np.ndarray, float] | None:
    """Unit normal and offset of a `consat.halfspace`, or of one side of a `consat.box`; None if the parameters fit neither."""
    if "normal" in given:
        length = float(np.linalg.norm(given["normal"]))
        return np.asarray(given["normal"]) / length, float(given["offset"]) / length
    if "axis" in given and "high" in given:
        return np.asarray(given["axis"]), float(given["axis"] @ given["high"])
    if "axis" in given and "low" in given:
        return -np.asarray(given["axis"]), -float(given["axis"] @ given["low"])
    return None
