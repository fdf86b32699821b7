"""The boundaries of ψ whose geometry cannot be read off, as polylines: for views outside matplotlib."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from consat.problem.team import Team
from consat.views.areas import contours
from consat.views.figures import grid, regions

FINE = 81
MOST = 40
"""Constraints of which boundaries are traced; of more, none."""


def outlines(team: Team, numbers: Sequence[int], x: np.ndarray, low: np.ndarray, high: np.ndarray) -> list[list[np.ndarray]]:
    """Where ψ = 0 for the owner, as the others stand, on the first two axes.

    Args:
        team: the team.
        numbers: which constraints.
        x: (N, d) where everybody is.
        low: (2,) corner of the view.
        high: (2,) its other corner.

    Returns:
        of each constraint its boundary, polylines (K, 2), the side where ψ > 0 on their left.
    """
    along, points = grid(low, high, FINE)
    chosen = [family for family in team.families if np.isin(family.number, numbers).any()]
    values = regions(team, x, points, chosen)
    return [list(contours(along[0], along[1], values[k].reshape(FINE, FINE).T)) for k in numbers]
