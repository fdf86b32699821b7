"""Drawing of a crowd: regions that don't move with agents, agents coloured by margin, and the names of the worst violated."""

from __future__ import annotations

import functools
from collections.abc import Iterator, Sequence
from typing import Any, Final, NamedTuple

import numpy as np
from matplotlib.artist import Artist
from matplotlib.lines import Line2D
from matplotlib.patches import Circle, Patch, PathPatch
from matplotlib.path import Path

from consat.problem.family import Family
from consat.problem.team import Team
from consat.views import areas, space
from consat.views.colours import AREA, LINK, SHARED, TRAIL
from consat.views.regions import contours, regions
from consat.views.shapes import Shapes

MOST_LINES: Final = 2000
"""Most agents whose paths are drawn, and most links."""
MOST_HATCHED, MOST_WALLS, MOST_OTHERS, MOST_TINTED = 60, 40, 20, 200
"""Most hatched keep-outs, walls, other ψ, and goal regions drawn with an edge."""
MOST_TIGHTEST, MOST_ASKED = 3, 20
"""How many of the agents with the worst violation have a label, and among how many they are chosen so that labels don't overlap."""


class View(NamedTuple):
    """What axes in the plane show.

    Attributes:
        low, high: (2,) corners.
        unit: (2,) size on each axis; lengths of strokes and distances of labels are relative to it.
        along: (p, K) coordinates of a grid on each axis.
        points: (K^p, p) points of the grid.
    """

    low: np.ndarray
    high: np.ndarray
    unit: np.ndarray
    along: np.ndarray
    points: np.ndarray

    def psi(self, team: Team, x: np.ndarray, families: Sequence[Family] | None = None) -> np.ndarray:
        """(M, K, K) every ψ on the grid, rows upwards, with all other agents at x (N, d); see `regions`."""
        count = self.along.shape[1]
        return regions(team, x, self.points, families).reshape(-1, count, count).swapaxes(1, 2)


def lawn(axes: Any, team: Team, found: Shapes, x: np.ndarray, view: View) -> list[Artist]:
    """Draw the regions of a crowd in the plane, except those that move with agents. Returns the new artists.

    Args:
        axes: matplotlib axes to draw on.
        team: the team, with its constraints at the moment.
        found: their geometry.
        x: (N, d) positions.
        view: what the axes show.
    """
    before = set(axes.get_children())
    center, fixed = found.balls.at(x)[:, :2], found.balls.around < 0
    goals, bars = (np.flatnonzero(fixed & (found.balls.keeps_out == out)) for out in (False, True))
    radius = found.balls.radius
    if len(goals):
        circles = [Path.circle(center[k], radius[k]) for k in goals]  # same orientation, so that overlaps are tinted once
        union = PathPatch(Path.make_compound_path(*circles), facecolor=(*AREA, 0.1), edgecolor="none", zorder=0.6, gid="region")
        axes.add_artist(union)
    if 0 < len(goals) <= MOST_TINTED:
        ring: dict[str, Any] = {"facecolors": "none", "edgecolors": [(*AREA, 0.55)], "linewidths": 0.7, "gid": "boundary"}
        areas.discs(axes, center[goals], radius[goals], zorder=0.7, **ring)
    if len(bars) > MOST_HATCHED:
        dark: dict[str, Any] = {"facecolors": [(0.3, 0.3, 0.3, 0.35)], "edgecolors": [(0.3, 0.3, 0.3, 0.8)], "linewidths": 0.6}
        areas.discs(axes, center[bars], radius[bars], zorder=0.8, gid="keep-out", **dark)
    for k in bars if len(bars) <= MOST_HATCHED else ():
        areas.hatched(axes, SHARED).set_path(Path.circle(center[k], radius[k]))
        axes.add_artist(Circle(center[k], radius[k], fill=False, edgecolor=SHARED, zorder=2, gid="boundary"))
    for normal, offset in list(zip(found.walls.normal, found.walls.offset, strict=True))[:MOST_WALLS]:
        areas.wall(axes, view.low, view.high, normal, offset, SHARED)
    others = [family for family in team.families if family.arity == 1 and np.isin(family.number, found.others).any()]
    if 0 < sum(family.size for family in others) <= MOST_OTHERS:
        values, (across, up) = view.psi(team, x, others), view.along
        for number in sorted(int(number) for family in others for number in family.number):
            for line in contours(across, up, values[number]):
                axes.add_artist(Line2D(*line.T, color=AREA, linewidth=1.0, zorder=2, gid="boundary"))
    return [artist for artist in axes.get_children() if artist not in before]


def legend(found: Shapes | None, count: int, *, links: bool, in_space: bool) -> Iterator[Any]:
    """Yield the legend entries of a crowd: paths, links, shadows and regions.

    Args:
        found: geometry of the constraints; None if no regions are drawn.
        count: number of agents.
        links: whether links are drawn.
        in_space: whether the team moves in three dimensions.
    """
    line = functools.partial(Line2D, [], [])
    if count <= MOST_LINES:
        yield line(color=TRAIL, linewidth=2, marker="o", markerfacecolor="white", markersize=4, label="start and path")
    if links:
        yield line(color=LINK, linewidth=0.9, label="communication link")
    if found is None:
        return
    if in_space:
        yield line(color=space.FLOOR, marker=".", linestyle=":", label="shadow on the floor")
    drawn = space.chosen(found) if in_space else np.flatnonzero(found.balls.around < 0).tolist()
    kinds = {bool(found.balls.keeps_out[k]) for k in drawn}
    if False in kinds:
        yield Patch(facecolor=(*AREA, 0.12), edgecolor=(*AREA, 0.7), label="region to be in")
    if True in kinds:
        yield areas.legend_patch(SHARED, "keep-out")


def worst(margins: np.ndarray, places: np.ndarray, unit: np.ndarray) -> list[int]:
    """Indices of the agents to label: the worst violated whose labels don't overlap. margins: (N,); places, (N, 2), and unit, (2,)."""
    found: list[int] = []
    for i in np.argsort(margins)[:MOST_ASKED]:
        clear = all(np.any(np.abs(places[i] - places[other]) > unit * [0.08, 0.03]) for other in found)
        if margins[i] <= 0 and clear and len(found) < MOST_TIGHTEST:
            found.append(int(i))
    return found


def thin(trail: np.ndarray) -> np.ndarray:
    """Paths (T, N, p) → (N, K, p), with fewer samples if there are very many; no samples for more than `MOST_LINES` agents."""
    steps, count = trail.shape[:2]
    if count > MOST_LINES:
        return trail[:0].swapaxes(0, 1)
    return np.concatenate([trail[: -1 : max(1, steps * count // 400_000)], trail[-1:]]).swapaxes(0, 1)


def dots(count: int) -> dict[str, Any]:
    """Marker style of a crowd of `count` agents."""
    return {"s": 40 if count < 60 else 22 if count < 200 else 9, "edgecolors": "0.2", "linewidths": 0.5, "zorder": 5, "gid": "head"}
