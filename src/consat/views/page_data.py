"""Data of a team for the scripts of the web pages: balls, half-spaces, and the box that holds them.

A ball is ``{center, around, radius, out, owners, names}``; a wall is ``{corners, normal, offset, owners, names, place}``. ``owners`` are
indices of agents in the team; ``names`` are the names of their constraints, in the same order.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from consat.problem.team import Team
from consat.views import space
from consat.views.colours import FEW
from consat.views.regions import view
from consat.views.shapes import MOST_SHAPES, Balls, Walls, boxes, shapes, ways


def frame(
    team: Team | None, x: np.ndarray, times: np.ndarray | None = None, stand: np.ndarray | None = None
) -> tuple[np.ndarray, np.ndarray]:
    """The box to show. It holds the paths (if they don't start far away), the regions with their motion, and the obstacles.

    Args:
        team: team whose regions are shown; None if they are unknown.
        x: (T, N, d) paths, with d at most 3.
        times: (T,) times of the positions, s; None for a single time, 0.
        stand: (B, 2, d) boxes around obstacles.

    Returns:
        low and high corner, (d,) each.
    """
    if team is None or len(team.owner) > MOST_SHAPES:
        low, high, _ = view(x, x[-1], None, stand)
        return low, high
    times = np.zeros(1) if times is None else times
    dimension, balls = x.shape[2], shapes(team, float(times[-1])).balls
    around = [boxes(team)[:, :, :dimension], ways(team, times)[:, :, :dimension], *([] if stand is None else [stand])]
    if team.dimension <= 3:
        every = balls.boxes(x[-1])
        around.append(every if x.shape[1] <= FEW else every[balls.around < 0])
    low, high, _ = view(x, x[-1], None, np.concatenate(around))
    return low, high


def balls_of(team: Team, balls: Balls) -> list[dict[str, Any]]:
    """Balls as plain data, for a team of at most three dimensions; else empty."""
    return [
        {
            "center": balls.center[k].tolist(),
            "around": int(balls.around[k]),
            "radius": float(balls.radius[k]),
            "out": bool(balls.keeps_out[k]),
            "owners": list(balls.owners[k]),
            "names": [team.names[number] for number in balls.numbers[k]],
        }
        for k in range(len(balls.radius))
        if team.dimension <= 3
    ]


def walls_of(team: Team, walls: Walls, low: np.ndarray, high: np.ndarray) -> list[Mapping[str, Any]]:
    """Boundaries of half-spaces as plain data: polygons within the view, or lines for a team in the plane.

    The sides of a box are cut by each other.

    Args:
        team: the team.
        walls: its half-spaces.
        low: lower corner of the view.
        high: upper corner of the view.
    """
    if team.dimension not in (2, 3):
        return []
    beyond = 10 * (high - low) * (team.dimension == 2)  # lines go on outside of the view, because the reader can pan
    return [
        {
            "corners": np.round(corners, 6).tolist(),
            "normal": walls.normal[k].tolist(),
            "offset": float(walls.offset[k]),
            "owners": list(walls.owners[k]),
            "names": [team.names[number] for number in walls.numbers[k]],
            "place": k,
        }
        for k, corners in space.faces(walls, low - beyond, high + beyond)
    ]
