"""Boundaries of ψ without closed-form geometry, traced as polylines, for views outside matplotlib."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from consat.problem.team import Team
from consat.views.areas import contours
from consat.views.figures import grid, regions

FINE = 81
MOST = 40
"""Most constraints whose boundaries are traced. If there are more, none is."""


def outlines(team: Team, numbers: Sequence[int], x: np.ndarray, low: np.ndarray, high: np.ndarray) -> list[list[np.ndarray]]:
    """Trace ψ = 0 on the first two axes, with the owner moved and all other agents at their positions.

    Args:
        team: the team.
        numbers: indices of the constraints.
        x: (N, d) positions of all agents.
        low: (2,) lower corner of the view.
        high: (2,) upper corner of the view.

    Returns:
        for each constraint the polylines (K, 2) of its boundary, with the side ψ > 0 on their left.
    """
    along, points = grid(low, high, FINE)
    chosen = [family for family in team.families if np.isin(family.number, numbers).any()]
    values = regions(team, x, points, chosen)
    return [list(contours(along[0], along[1], values[k].reshape(FINE, FINE).T)) for k in numbers]
