"""What a page draws of a team, as plain data: balls, half-spaces and traced boundaries, and the box that holds them all.

The pages' script knows a ball as ``{center, around, radius, out, owners, names}``, a wall as ``{corners, normal, offset, owners, names,
place}``. Owners are places in the team; of each owner the name of its constraint is given.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Final

import numpy as np

from consat.problem.team import Team
from consat.views import space
from consat.views.figures import view
from consat.views.shapes import Shapes, Walls, alike, boxes, shapes, ways

MOST_SHAPES: Final = 20_000
"""Constraints; of a larger team no regions are drawn."""
FEW: Final = 12
"""Up to so many agents have colours of their own, as in the pages' script."""


def frame(
    team: Team | None, x: np.ndarray, times: np.ndarray | None = None, stand: np.ndarray | None = None
) -> tuple[np.ndarray, np.ndarray]:
    """The box to show, low and high, which holds the ways of moving balls, too.

    Args:
        team: whose regions are shown; None if nobody knows them.
        x: (T, N, d) paths, with d at most 3.
        times: (T,) s, at which they were there; by default none has passed.
        stand: (B, 2, d) boxes around obstacles.
    """
    if team is None or len(team.owner) > MOST_SHAPES:
        low, high, _ = view(x, x[-1], None, stand)
        return low, high
    times = np.zeros(1) if times is None else times
    dimension, balls = x.shape[2], shapes(team, float(times[-1])).balls
    around = [boxes(team)[:, :, :dimension], ways(team, times)[:, :, :dimension], *([] if stand is None else [stand])]
    if team.dimension <= 3:
        center, radius = balls.at(x[-1])[:, None, :dimension], balls.radius[:, None, None]
        fixed = np.concatenate([center - radius, center + radius], axis=1)
        around.append(fixed if x.shape[1] <= FEW else fixed[balls.around < 0])
    low, high, _ = view(x, x[-1], None, np.concatenate(around))
    return low, high


def constraints_of(team: Team, found: Shapes) -> tuple[list[list[int]], list[list[int]]]:
    """Of each ball, and of each half-space, the constraints that it stands for, by their numbers."""
    members: dict[int, list[int]] = {}
    first = alike(team)
    for number, same in enumerate(first.tolist()):
        members.setdefault(same, []).append(number)
    balls, walls = ([members[int(first[number])] for number in each.number] for each in (found.balls, found.walls))
    return balls, walls


def balls_of(team: Team, found: Shapes, members: list[list[int]]) -> list[dict[str, Any]]:
    """The balls of a team of at most three dimensions."""
    balls = found.balls
    return [
        {
            "center": balls.center[k].tolist(),
            "around": int(balls.around[k]),
            "radius": float(balls.radius[k]),
            "out": bool(balls.keeps_out[k]),
            "owners": [int(team.owner[number]) for number in members[k]],
            "names": [team.names[number] for number in members[k]],
        }
        for k in range(len(balls.radius))
        if team.dimension <= 3
    ]


def walls_of(team: Team, walls: Walls, members: list[list[int]], low: np.ndarray, high: np.ndarray) -> list[Mapping[str, Any]]:
    """Half-spaces as polygons within the view, of a team in the plane as lines; those of a box are cut by each other."""
    if team.dimension not in (2, 3):
        return []
    beyond = 10 * (high - low) * (team.dimension == 2)  # a reader may pan
    return [
        {
            "corners": np.round(corners, 6).tolist(),
            "normal": walls.normal[k].tolist(),
            "offset": float(walls.offset[k]),
            "owners": [int(team.owner[number]) for number in members[k]],
            "names": [team.names[number] for number in members[k]],
            "place": k,
        }
        for k, corners in space.faces(walls, low - beyond, high + beyond)
    ]
