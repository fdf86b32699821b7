"""Drawing of robots and obstacles: bodies to scale, with their headings, and the obstacles of the map."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final

import numpy as np
from matplotlib.artist import Artist
from matplotlib.colors import to_rgba
from matplotlib.lines import Line2D
from matplotlib.patches import Patch, PathPatch
from matplotlib.path import Path
from mpl_toolkits.mplot3d.art3d import Poly3DCollection

from consat.results.result import Result
from consat.robots.obstacles import Box, Disc, Obstacle
from consat.scenario.robots import Robots
from consat.views.areas import discs
from consat.views.space import sphere

if TYPE_CHECKING:
    import xarray as xr

SOLID: Final = "0.62"
"""Colour of obstacles. Only obstacles are solid grey; keep-outs are hatched."""
EDGE: Final = "0.25"
SIDES: Final = np.array([[0, 1, 3, 2], [4, 5, 7, 6], [0, 1, 5, 4], [2, 3, 7, 6], [0, 2, 6, 4], [1, 3, 7, 5]])
"""(6, 4) corner numbers of each side of a box in space. Bits 4, 2, 1 of a number say whether the corner is high on axis 0, 1, 2."""


@dataclass(frozen=True, eq=False)
class Bodies:
    """Bodies of the recorded agents.

    Attributes:
        radius: (N,) radius of each body, m.
        offset: (N,) distance of the body's centre behind the recorded position, along the heading, m.
        heading: (T, N) headings, rad; None if they were not recorded.
        turns: (N,) whether the agent has a heading.
    """

    radius: np.ndarray
    offset: np.ndarray
    heading: np.ndarray | None
    turns: np.ndarray

    def middle(self, x: np.ndarray, ahead: np.ndarray | None) -> np.ndarray:
        """(…, N, d) centres of the bodies.

        Args:
            x: (…, N, d) recorded positions.
            ahead: (…, N, 2) unit vectors along the headings, as `ahead` returns them; None for bodies centred on their positions.
        """
        if ahead is None:
            return x
        behind = np.zeros_like(x)
        behind[..., :2] = self.offset[:, None] * ahead
        return x - behind

    def ahead(self, moment: float) -> np.ndarray | None:
        """(N, 2) unit vectors along the headings at a moment, a sample index that may be fractional. Angles turn the shorter way round."""
        if self.heading is None:
            return None
        first, last = self.heading[int(moment)], self.heading[int(np.ceil(moment))]
        angle = first + (moment % 1) * (np.mod(last - first + np.pi, 2 * np.pi) - np.pi)
        return np.stack([np.cos(angle), np.sin(angle)], axis=-1)


def robots(result: Result, data: xr.Dataset) -> tuple[Bodies | None, tuple[Obstacle, ...]]:
    """The bodies of the agents in `data`, the recorded steps of a result, and the obstacles; None and () if the run had no robot layer."""
    summary = result.summary
    entry = summary.get("robots")
    if entry is None:
        return None, ()
    common = {key: value for key, value in entry.items() if key != "own"}
    known = Robots.of({"robots": common, "obstacles": summary.get("obstacles") or [], "own": entry.get("own", {})})
    radius, offset = sizes(known, [str(agent) for agent in data["agent"].values])
    return Bodies(radius, offset, data["heading"].values if "heading" in data else None, offset > 0), known.obstacles


def sizes(known: Robots, ids: Sequence[str]) -> tuple[np.ndarray, np.ndarray]:
    """(N,) radius of each agent's body, m, and (N,) distance of its centre behind the agent's position, along the heading, m."""
    models = [known.own.get(name, known.common) for name in ids]
    radius, offset = ([float(np.max(getattr(model, name, 0.0))) for model in models] for name in ("radius", "offset"))
    return np.array(radius, dtype=float), np.array(offset, dtype=float)


def bounds(found: Sequence[Obstacle], axes: int) -> np.ndarray:
    """(B, 2, axes) bounding boxes of obstacles, low and high corner, on the first axes."""
    boxes = [np.stack(_bounds(each))[:, :axes] for each in found]
    return np.stack(boxes) if boxes else np.zeros((0, 2, axes))


def _bounds(obstacle: Obstacle) -> tuple[np.ndarray, np.ndarray]:
    if isinstance(obstacle, Disc):
        return np.array(obstacle.center) - obstacle.radius, np.array(obstacle.center) + obstacle.radius
    if isinstance(obstacle, Box):
        return np.array(obstacle.low), np.array(obstacle.high)
    return np.min(obstacle.vertices, axis=0), np.max(obstacle.vertices, axis=0)


def outline(obstacle: Obstacle) -> Path:
    """Outline of an obstacle in the plane."""
    if isinstance(obstacle, Disc):
        return Path.circle((obstacle.center[0], obstacle.center[1]), obstacle.radius)
    if isinstance(obstacle, Box):
        (left, bottom), (right, top) = obstacle.low, obstacle.high
        corners = [(left, bottom), (right, bottom), (right, top), (left, top)]
    else:
        corners = list(obstacle.vertices)
    return Path([*corners, corners[0]], closed=True)


def map_in_plane(axes: Any, found: Sequence[Obstacle]) -> None:
    """Draw obstacles of the plane, solid grey."""
    for each in found:
        axes.add_artist(PathPatch(outline(each), facecolor=SOLID, edgecolor=EDGE, linewidth=1.2, zorder=0.9, gid="obstacle"))


def map_in_space(axes: Any, found: Sequence[Obstacle]) -> None:
    """Draw obstacles of space (balls and boxes), solid grey."""
    for each in found:
        if isinstance(each, Disc):
            axes.plot_surface(*sphere(np.array(each.center), each.radius), color=SOLID, alpha=0.9, linewidth=0, zorder=1, gid="obstacle")
        elif isinstance(each, Box):
            sides = np.array(np.meshgrid(*zip(each.low, each.high, strict=True), indexing="ij")).reshape(3, 8).T[SIDES]
            look: dict[str, Any] = {"facecolors": [to_rgba(SOLID, 0.85)], "edgecolors": [EDGE], "linewidths": 0.8}
            axes.add_collection3d(Poly3DCollection(sides, **look, gid="obstacle", zorder=1), autolim=False)


def balls(axes: Any, middle: np.ndarray, radius: np.ndarray, shades: Sequence[Any]) -> list[Artist]:
    """Draw bodies in space as balls: centres (N, 3), radii (N,), one colour each."""
    return [
        axes.plot_surface(*sphere(at, size), color=shade, linewidth=0, zorder=4, gid="body")
        for at, size, shade in zip(middle, radius, shades, strict=True)
    ]


class Crew:
    """Artists for bodies in the plane: a disc for each, and a stroke from its centre along its heading.

    Args:
        axes: matplotlib axes to draw on.
        found: the bodies.
        shades: (N,) colours; None if `paint` sets them later.
    """

    def __init__(self, axes: Any, found: Bodies, shades: Sequence[Any] | None) -> None:
        self._found = found
        somewhere = np.zeros((len(found.radius), 2))
        self._discs = discs(axes, somewhere, found.radius, edgecolors=EDGE, linewidths=0.8, zorder=4.5, gid="body")
        self._strokes = Line2D([], [], color=EDGE, linewidth=1.4, solid_capstyle="butt", zorder=4.6, gid="heading")
        axes.add_artist(self._strokes)
        if shades is not None:
            self._discs.set_facecolor([to_rgba(shade, 0.65) for shade in shades])
        self.artists: list[Artist] = [self._discs, self._strokes]

    def paint(self, shades: Any) -> None:
        """Set the colours of the bodies."""
        self._discs.set_facecolor(shades)

    def show(self, x: np.ndarray, moment: float) -> None:
        """Move the artists to a moment, a sample index that may be fractional; x: (N, 2) recorded positions at that moment."""
        found, ahead = self._found, self._found.ahead(moment)
        middle = found.middle(x, ahead)
        self._discs.set_offsets(middle)
        if ahead is not None and found.turns.any():
            tips = middle + found.radius[:, None] * ahead
            ends = np.stack([middle, tips, np.full_like(tips, np.nan)], axis=1)[found.turns]
            self._strokes.set_data(*ends.reshape(-1, 2).T)


def legend(found: Bodies | None, stand: Sequence[Obstacle]) -> list[Any]:
    """Legend entries for robots and obstacles."""
    entries: list[Any] = []
    if found is not None:
        style: dict[str, Any] = {"marker": "o", "markersize": 11, "markerfacecolor": "0.85", "markeredgecolor": EDGE, "linestyle": ""}
        words = "body, and where it looks" if found.turns.any() else "body"
        entries.append(Line2D([], [], **style, label=words))
    if stand:
        entries.append(Patch(facecolor=SOLID, edgecolor=EDGE, label="obstacle"))
    return entries
