"""The formation at any recorded moment: paths, constraint regions, links and labels on one set of axes."""

from __future__ import annotations

import functools
import math
from collections.abc import Iterator, Sequence
from typing import Any, cast

import numpy as np
from matplotlib.artist import Artist
from matplotlib.cm import ScalarMappable
from matplotlib.colors import CenteredNorm
from matplotlib.contour import QuadContourSet
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patheffects import withStroke

from consat.problem.team import Team
from consat.results.result import Result
from consat.views.figures import GREY, STYLES, colour, grid, marker, number, plain, recorded, regions, view

MOST_AGENTS, MOST_CONSTRAINTS, MOST_ENTRIES, MOST_LINES = 12, 40, 16, 2000
GRID = 241  # points along each side of the view at which ψ is evaluated


def _directions(points: np.ndarray, lengths: Sequence[int]) -> list[np.ndarray]:
    """For each name the direction from its agent, at a point (N, 2) in pt, in which it meets the fewest others."""
    around = [np.array([np.cos(a), np.sin(a)]) for a in np.pi / 4 * np.array([1, 3, 7, 5, 2, 6, 0, 4])]
    taken, sizes, chosen = list(points), [np.array([6.0, 6.0])] * len(points), []
    for point, length in zip(points, lengths, strict=True):
        size = np.array([3.4 * length, 6.0])
        places = [point + direction * (7 + size) for direction in around]
        meets = [sum(bool(np.all(np.abs(place - t) < size + s)) for t, s in zip(taken, sizes, strict=True)) for place in places]
        best = meets.index(min(meets))
        chosen.append(around[best])
        taken.append(places[best])
        sizes.append(size)
    return chosen


class Scene:
    """The formation of a result on axes, drawn anew at every `show`; a still is the last moment of a film.

    In 1-D against time, beyond 3-D on the first two axes. A moment is a sample, or lies between two.

    Attributes:
        axes, figure: what it is drawn on.
        moving: what the last `show` drew.
        x: (T, N, d) positions.
        steps: (T,) times in s, or rounds.
        last: the last sample at which every position is finite.
    """

    def __init__(self, result: Result, axes: Any = None) -> None:
        data, team = recorded(result), None if "final_position" in result.data else result.team  # regions need everybody
        self.x, self._clock = data["position"].values, str(data["position"].dims[0])
        self.steps, self._margin, self._agent_margin = (data[name].values for name in (self._clock, "margin", "agent_margin"))
        finite = np.flatnonzero(np.isfinite(self.x).all(axis=(1, 2)))
        self.last = int(finite[-1]) if len(finite) else 0
        self._few = self.x.shape[1] <= MOST_AGENTS and (team is None or len(team.owner) <= MOST_CONSTRAINTS)
        self._name, self._ids = plain(result.summary["scenario"]), [plain(str(name), 14) for name in data["agent"].values if self._few]
        self._sample = [f"{self.x.shape[1]} of {result.summary['count']:,} agents"] if "final_position" in result.data else []
        self._team = team if self._few and team is not None and len(team.owner) else None
        self._links = team.links if team is not None and len(team.links) <= MOST_LINES else np.zeros((0, 2), dtype=int)
        self._line, self._space = self.x.shape[2] == 1, self.x.shape[2] == 3
        self.axes: Any = axes or Figure(layout="compressed").add_subplot(projection="3d" if self._space else None)
        self.figure = cast(Any, self.axes.get_figure())
        self.moving: list[Artist] = []
        ratio = self._frame([str(name) for name in data["axis"].values])
        rows, letters = self._legend() if self._few else self._colour_bar()
        if axes is None:
            self.figure.set_size_inches(1.5 + 4.4 * ratio + 0.075 * letters, max(5.2, 0.5 + 0.21 * rows))

    def _trail(self, moment: float) -> np.ndarray:
        """(K, N, 2 or 3) where the agents are drawn until a moment."""
        moments = np.append(np.arange(math.ceil(moment), dtype=float), moment)
        x = _between(self.x, moments)[:, :, : 3 if self._space else 2]
        return np.concatenate([np.broadcast_to(_between(self.steps, moments)[:, None, None], x.shape), x], axis=2) if self._line else x

    def _frame(self, names: Sequence[str]) -> float:
        """Limits and labels; returns how wide the axes should be for their height."""
        axes, team = self.axes, self._team
        low, high, self._cut = view(self.x[: self.last + 1, :, : 3 if self._space else 2], self.x[self.last], team)
        self._along, self._points = grid(low, high, 2 if self._space else GRID)
        labels = [f"{name} [length]" for name in names]
        if self._line:
            until = float(self.steps[self.last]) or 1.0
            low, high = np.array([-0.03 * until, low[0]]), np.array([1.1 * until, high[0]])
            labels = ["time t [s]" if self._clock == "time" else "round", *labels]
            self._columns = np.unique(moments(self, 200, 0.5))
            if team is not None:
                self._tube = np.stack([regions(team, x, self._points) for x in _between(self.x, self._columns)], axis=2)
        for axis, label, a, b in zip("xyz", labels, low, high, strict=False):
            axes.set(**{f"{axis}lim": (a, b), f"{axis}label": label})
        axes.set_aspect("auto" if self._line else "equal")
        self._unit = (high - low)[:2] if self._line else np.full(2, np.max(high - low))
        axes.grid(color="0.92", linewidth=0.8)
        axes.set_axisbelow(True)
        if self._space and team is not None:
            for k, sphere in _spheres(team).items():
                axes.plot_wireframe(*sphere, color=colour(team.owner[k]), linewidth=0.5, alpha=0.4)
        points = 330.0 * self._trail(self.last)[-1, :, :2] / self._unit
        self._where = _directions(points[: len(self._ids)], list(map(len, self._ids)))
        return 1.25 if self._line or self._space else float((high - low)[0] / (high - low)[1])

    def _colour_bar(self) -> tuple[int, int]:
        margins = self._agent_margin[self.last]
        bound = np.abs(margins[np.isfinite(margins)]).max(initial=0.0) or 1.0
        beside = 0.12 if self._space else 0.03
        self._colours = ScalarMappable(CenteredNorm(halfrange=bound), "RdBu")
        self.figure.colorbar(self._colours, ax=self.axes, label=r"agent margin $\barα_i$ (red: violated)", extend="both", pad=beside)
        return 0, 6

    def _legend(self) -> tuple[int, int]:
        """Who is who, and whose region is which; returns its rows and letters."""
        line, team, ids = functools.partial(Line2D, [], []), self._team, self._ids
        lines = [line(color=colour(i), marker=marker(i), label=name) for i, name in enumerate(ids)]
        lines.append(line(color=GREY, marker="o", markerfacecolor="white", linestyle="", label="start"))
        if len(self._links) and not self._line:
            lines.append(line(color="0.75", linewidth=1, label="communication link"))
        drawn = [] if team is None else [*(_spheres(team) if self._space else range(len(team.owner)))]
        if team is not None and drawn:
            lines.append(line(linestyle="", label="\n" + ("regions of `within`:" if self._space else "regions, as the others stand:")))
            for k in drawn if len(drawn) <= MOST_ENTRIES else ():
                shade, dash = self._stroke(k)
                lines.append(line(color=shade, linestyle=dash, linewidth=1.1, label=f"{ids[team.owner[k]]}: {plain(team.names[k])}"))
            if not self._space:
                lines.append(line(color=GREY, marker=3, linewidth=1.1, label="on this side ψ < 0"))
                lines.append(line(color=GREY, linewidth=8, alpha=0.25, solid_capstyle="butt", label="all of an agent's ψ > 0"))
        beside = (1.1 if self._space else 1.02, 1.0)
        self.axes.legend(handles=lines, loc="upper left", bbox_to_anchor=beside, frameon=False, borderaxespad=0)
        return len(lines) + 1, max(len(str(entry.get_label())) for entry in lines)

    def _stroke(self, constraint: Any) -> tuple[str, Any]:
        """The colour and style of a constraint's boundary: its owner's colour, a style for each of the owner's."""
        owner = cast(Team, self._team).owner
        rank = int(np.count_nonzero(owner[:constraint] == owner[constraint]))
        return colour(owner[constraint]), STYLES[rank % len(STYLES)]

    def show(self, moment: float) -> None:
        """Draw the formation at a moment."""
        for artist in self.moving:
            artist.remove()
        trail, sample = self._trail(moment), int(moment)
        self.moving = [*self._regions(moment), *(self._agents(trail) if self._few else self._crowd(trail, sample))]
        if not self._line:
            self.moving += self.axes.plot(*_joined(trail[-1][self._links]), color="0.75", linewidth=1 if self._few else 0.6, zorder=1.5)
        clock = f"{_between(self.steps, moment)[0]:.1f}".removesuffix(".0")
        time = f"t = {clock} s" if self._clock == "time" else f"round {self.steps[sample]:.0f}"
        notes = [*self._sample, *["starts out of view"] * self._cut] + [f"the first two of {self.x.shape[2]} axes"] * (self.x.shape[2] > 3)
        margin = f", margin {number(self._margin[sample])}" if np.isfinite(self._margin[sample]) else ""
        self.axes.set_title("\n".join([f"{self._name} at {time}{margin}", *(f"({note})" for note in notes)]))

    def _agents(self, trail: np.ndarray) -> Iterator[Artist]:
        for i, name in enumerate(self._ids):
            yield from self.axes.plot(*trail[:, i].T, color=colour(i), linewidth=1.6, alpha=0.85, zorder=3)
            yield from self.axes.plot(*trail[0, i, :, None], marker(i), color=colour(i), markerfacecolor="white", markersize=7, zorder=4)
            yield from self.axes.plot(*trail[-1, i, :, None], marker(i), color=colour(i), markersize=8, markeredgecolor="white", zorder=5)
            style: dict[str, Any] = {"color": colour(i), "weight": "bold", "path_effects": [withStroke(linewidth=2.5, foreground="w")]}
            if self._space:
                yield self.axes.text(*trail[-1, i], f"  {name}", **style)
            else:
                x, y = self._where[i]
                style |= {"ha": ("center", "left", "right")[round(x)], "va": ("center", "bottom", "top")[round(y)]}
                yield self.axes.annotate(name, trail[-1, i], (7 * x, 7 * y), textcoords="offset points", zorder=6, **style)

    def _crowd(self, trail: np.ndarray, sample: int) -> Iterator[Artist]:
        """Many agents, coloured by margin."""
        count = trail.shape[1]
        if count <= MOST_LINES:
            paths = np.concatenate([trail[: -1 : max(1, trail.shape[0] * count // 400_000)], trail[-1:]]).swapaxes(0, 1)
            yield from self.axes.plot(*_joined(paths), color="0.6", linewidth=0.7, alpha=0.6, zorder=1)
            yield from self.axes.plot(*trail[0].T, "o", color="0.6", markerfacecolor="white", markersize=3 if count < 200 else 1, zorder=4)
        style = {"s": 36 if count < 200 else 8, "edgecolors": "0.3", "linewidths": 0.5, "zorder": 5}
        yield self.axes.scatter(*trail[-1].T, c=self._colours.to_rgba(self._agent_margin[sample]), **style)

    def _regions(self, moment: float) -> Iterator[Artist]:
        if self._team is None or self._space:
            return
        if self._line:
            seen = np.count_nonzero(self._columns <= moment)
            across, up, values = _between(self.steps, self._columns[:seen]), self._along[0], self._tube[:, :, :seen]
        else:
            across, up = self._along
            values = regions(self._team, _between(self.x, moment)[0], self._points).reshape(-1, GRID, GRID).swapaxes(1, 2)
        for owner in np.unique(self._team.owner) if len(across) > 1 else ():
            mine = np.flatnonzero(self._team.owner == owner)
            common = values[mine].min(axis=0)
            if (common > 0).any():
                yield self.axes.contourf(across, up, common, [0.0, np.nanmax(common)], colors=[colour(owner)], alpha=0.13, zorder=0.5)
            for k in mine:
                if (values[k] > 0).any() and (values[k] < 0).any():
                    shade, dash = self._stroke(k)
                    edge = self.axes.contour(across, up, values[k], [0.0], colors=[shade], linestyles=[dash], linewidths=1.1, zorder=2)
                    yield edge
                    yield from self.axes.plot(*_joined(_ticks(edge, self._unit)), color=shade, linewidth=0.8, zorder=2)


def _between(series: np.ndarray, moment: Any) -> np.ndarray:
    """(K, …) the values of a series (T, …) at K moments."""
    moment = np.atleast_1d(moment)
    share = (moment % 1).reshape(-1, *(1,) * (series.ndim - 1))
    return (1 - share) * series[moment.astype(int)] + share * series[np.ceil(moment).astype(int)]


def _spheres(team: Team) -> dict[int, np.ndarray]:
    """(3, 17, 9) points on the sphere of every `within`, by number of the constraint."""
    around, down = np.meshgrid(np.linspace(0, 2 * np.pi, 17), np.linspace(0, np.pi, 9), indexing="ij")
    unit = np.stack([np.cos(around) * np.sin(down), np.sin(around) * np.sin(down), np.cos(down)])
    return {
        int(number): center[:, None, None] + radius * unit
        for family in team.families
        if family.kind == "within"
        for number, center, radius in zip(family.number, family.parameters["center"], family.parameters["radius"], strict=True)
    }


def _joined(segments: np.ndarray) -> np.ndarray:
    """(S, K, p) lines → (p, S·(K + 1)) one line, broken by NaN: one artist is much quicker than many."""
    return np.concatenate([segments, np.full_like(segments[:, :1], np.nan)], axis=1).reshape(-1, segments.shape[2]).T


def _ticks(edge: QuadContourSet, unit: np.ndarray) -> np.ndarray:
    """(K, 2, 2) short strokes that stand on a boundary, on the side where ψ < 0; contour lines run with the higher values on their left."""
    strokes = [np.zeros((0, 2, 2))]
    for piece in edge.allsegs[0]:
        line = piece / unit
        way = np.append(0.0, np.cumsum(np.hypot(*np.diff(line, axis=0).T)))
        at = np.arange(1 / 80, way[-1], 1 / 40)
        foot, ahead = (np.stack([np.interp(at + step, way, line[:, k]) for k in (0, 1)], axis=1) for step in (0.0, 1 / 4000))
        right = (ahead - foot)[:, ::-1] * [1.0, -1.0]
        strokes.append(np.stack([foot, foot + right / np.maximum(np.hypot(*right.T), 1e-300)[:, None] / 120], axis=1) * unit)
    return np.concatenate(strokes)


def moments(scene: Scene, count: int, movement: float) -> np.ndarray:
    """(count,) moments from start to end: by a share of `movement` evenly along the way travelled, for the rest by the clock."""
    x, clock = scene.x[: scene.last + 1], scene.steps[: scene.last + 1] - float(scene.steps[0])
    way = np.append(0.0, np.cumsum(np.linalg.norm(np.diff(x, axis=0), axis=(1, 2))))
    share = movement * way / (way[-1] or 1.0) + (1 - movement) * clock / (clock[-1] or 1.0)
    return np.interp(np.linspace(0.0, share[-1], count), share, np.arange(len(share)))
