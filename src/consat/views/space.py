"""Drawing in three dimensions: balls, half-spaces cut by the view, cross-sections of other ψ, and shadows of the agents on a floor."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any, Final

import numpy as np
from contourpy import contour_generator
from matplotlib.artist import Artist
from matplotlib.colors import to_rgba
from mpl_toolkits.mplot3d.art3d import Line3DCollection, Poly3DCollection

from consat.problem.team import Team
from consat.views.colours import SHARED, colour, colour_of
from consat.views.regions import grid, regions
from consat.views.shapes import Balls, Shapes, Walls

MOST_BALLS: Final = 60
"""Most balls that are drawn. If there are more, only keep-outs are drawn, and at most this many."""
MOST_FINE: Final = 12
"""Most balls that are drawn finely. If there are more, each has fewer faces."""
SECTION: Final = 61
FLOOR: Final = "0.55"


def sphere(center: np.ndarray, radius: float, around: int = 25, down: int = 13) -> np.ndarray:
    """(3, around, down) grid of points on a sphere."""
    longitude, latitude = np.meshgrid(np.linspace(0, 2 * np.pi, around), np.linspace(0, np.pi, down), indexing="ij")
    unit = np.stack([np.cos(longitude) * np.sin(latitude), np.sin(longitude) * np.sin(latitude), np.cos(latitude)])
    return np.asarray(center[:, None, None] + radius * unit)


def balls(axes: Any, found: Balls, x: np.ndarray, chosen: Sequence[int], goal: Any = None) -> Iterator[Artist]:
    """Draw balls: goals almost transparent, keep-outs solid, both with three great circles.

    Args:
        axes: 3-D axes to draw on.
        found: the balls.
        x: (N, d) positions of the team.
        chosen: indices of the balls to draw.
        goal: colour of goals; None for the colours of their owners.
    """
    many = len(chosen) > MOST_FINE
    angle = np.linspace(0, 2 * np.pi, 25 if many else 49)
    ring = np.stack([np.cos(angle), np.sin(angle), 0 * angle], axis=1)
    rings = np.stack([ring, ring[:, [0, 2, 1]], ring[:, [2, 0, 1]]])
    fineness, centers = (13, 7) if many else (25, 13), found.at(x)
    for k in chosen:
        solid, center, radius = bool(found.keeps_out[k]), centers[k], found.radius[k]
        shade = colour_of(found.owners[k]) if goal is None else SHARED if solid else goal
        yield axes.plot_surface(
            *sphere(center, radius, *fineness),
            color=SHARED if solid else shade,
            alpha=0.45 if solid else 0.07,
            linewidth=0,
            shade=solid,
            zorder=1 if solid else 0.5,
            gid="keep-out" if solid else "region",
        )
        lines = Line3DCollection(center + radius * rings, colors=shade, linewidths=0.9 if solid else 0.8, alpha=0.9 if solid else 0.55)
        lines.set_gid("boundary")
        lines.set_zorder(1.2)
        yield axes.add_collection3d(lines, autolim=False)


def walls(axes: Any, found: Walls, low: np.ndarray, high: np.ndarray) -> Iterator[Artist]:
    """Draw the boundaries of half-spaces within the view. Those of the same owners cut each other, so that sides form a box."""
    for k, corners in faces(found, low, high):
        shade = colour_of(found.owners[k])
        look: dict[str, Any] = {"facecolors": [to_rgba(shade, 0.08)], "edgecolors": [to_rgba(shade, 0.8)], "linewidths": 1.0}
        face = Poly3DCollection([corners], **look, gid="region", zorder=0.4)
        yield axes.add_collection3d(face, autolim=False)


def faces(found: Walls, low: np.ndarray, high: np.ndarray) -> Iterator[tuple[int, np.ndarray]]:
    """Yield the index of each half-space and the corners, (C, d), of its boundary within a box, cut by the others of the same owners.

    In the plane the boundary is a line with two corners.
    """
    for k, (normal, offset) in enumerate(zip(found.normal, found.offset, strict=True)):
        corners = _face(normal, offset, low, high)
        for j, owners in enumerate(found.owners):
            if j != k and owners == found.owners[k]:
                corners = _cut(corners, found.normal[j], found.offset[j])
        if len(corners) >= 2:
            yield k, corners[: None if len(normal) > 2 else 2]


def _face(normal: np.ndarray, offset: float, low: np.ndarray, high: np.ndarray) -> np.ndarray:
    """(C, d) corners of the plane normal·x = offset within a box: a large square, cut by the sides of the box."""
    middle, sides = (low + high) / 2, np.eye(len(low))
    foot, size = middle + (offset - middle @ normal) * normal, 2 * float(np.linalg.norm(high - low))
    if len(low) == 2:
        along = np.array([-normal[1], normal[0]])
        corners = foot + size * np.array([-along, along])
    else:
        across = np.cross(normal, np.eye(3)[np.argmin(np.abs(normal))])
        across /= np.linalg.norm(across)
        up = np.cross(normal, across)
        corners = foot + size * np.array([across + up, across - up, -across - up, -across + up])
    for k, side in enumerate(sides):
        corners = _cut(_cut(corners, side, high[k]), -side, -low[k])
    return corners


def _cut(corners: np.ndarray, normal: np.ndarray, offset: float) -> np.ndarray:
    """The part of a convex polygon (C, d) with normal·x ≤ offset (Sutherland and Hodgman, 1974)."""
    kept: list[np.ndarray] = []
    beyond = corners @ normal - offset if len(corners) else np.zeros(0)
    for k, (here, there) in enumerate(zip(corners, np.roll(corners, -1, axis=0), strict=True)):
        a, b = beyond[k], beyond[(k + 1) % len(corners)]
        if a <= 0:
            kept.append(here)
        if (a < 0 < b) or (b < 0 < a):
            kept.append(here + a / (a - b) * (there - here))
    return np.array(kept).reshape(-1, len(normal))


def sections(axes: Any, team: Team, numbers: Sequence[int], x: np.ndarray, low: np.ndarray, high: np.ndarray) -> Iterator[Artist]:
    """Draw the boundary of ψ on the three coordinate planes through its owner, for the constraints `numbers`; x: (N, 3)."""
    along = np.linspace(low, high, SECTION, axis=-1)
    for owner in sorted({int(team.owner[k]) for k in numbers}):
        mine = [k for k in numbers if team.owner[k] == owner]
        lines: list[np.ndarray] = []
        for axis in range(3):
            flat = [other for other in range(3) if other != axis]
            _, plane = grid(low[flat], high[flat], SECTION)
            place = np.empty((len(plane), 3))
            place[:, flat], place[:, axis] = plane, x[owner, axis]
            for psi in regions(team, x, place)[mine]:
                values = np.ma.masked_invalid(psi.reshape(SECTION, SECTION).T)
                for line in contour_generator(along[flat[0]], along[flat[1]], values).lines(0.0):
                    whole = np.empty((len(line), 3))
                    whole[:, flat], whole[:, axis] = line, x[owner, axis]
                    lines.append(whole)
        if lines:
            yield axes.add_collection3d(
                Line3DCollection(lines, colors=colour(owner), linewidths=1.0, alpha=0.7, gid="boundary", zorder=1.2), autolim=False
            )


def chosen(found: Shapes) -> list[int]:
    """Indices of the balls to draw; see `MOST_BALLS`."""
    everything = list(range(len(found.balls.radius)))
    if len(everything) <= MOST_BALLS:
        return everything
    return [k for k in everything if found.balls.keeps_out[k]][:MOST_BALLS]


def shadows(axes: Any, trail: np.ndarray, floor: float, *, paths: bool) -> Iterator[Artist]:
    """Draw depth cues: on the floor, a dot below each agent, and a vertical stem up to it.

    Args:
        axes: 3-D axes to draw on.
        trail: (T, N, 3) positions over time; the last are the agents.
        floor: height of the floor.
        paths: whether to draw the paths on the floor, too.
    """
    feet = np.concatenate([trail[-1, :, :2], np.full((trail.shape[1], 1), floor)], axis=1)
    yield axes.scatter(*feet.T, s=10, color=FLOOR, marker=".", depthshade=False, zorder=0.3, gid="shadow")
    stems = Line3DCollection(np.stack([feet, trail[-1]], axis=1), colors=FLOOR, linewidths=0.6, linestyles=":", zorder=0.3, gid="shadow")
    yield axes.add_collection3d(stems, autolim=False)
    if paths and len(trail) > 1:
        below = np.concatenate([trail[:, :, :2], np.full((*trail.shape[:2], 1), floor)], axis=2).swapaxes(0, 1)
        yield axes.add_collection3d(Line3DCollection(below, colors="0.82", linewidths=0.8, zorder=0.2, gid="shadow"), autolim=False)
