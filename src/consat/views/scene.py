"""Drawing of the formation at any recorded moment: paths, constraint regions, links and labels on one set of axes.

A small team has at most `FEW` agents and `MOST_CONSTRAINTS` constraints: each agent has its colour, marker and name. A larger team
is drawn as a crowd: agents are dots coloured by margin.
"""

from __future__ import annotations

import functools
from collections.abc import Iterator, Sequence
from typing import Any, cast

import numpy as np
from matplotlib.artist import Artist
from matplotlib.cm import ScalarMappable
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patheffects import withStroke

from consat.problem.team import Team
from consat.results.result import Result
from consat.views import areas, bodies, crowd, space
from consat.views.areas import Area, Ground
from consat.views.colours import AREA, FEW, GREY, LINK, SHARED, TRAIL, classes, colour, marker
from consat.views.crowd import MOST_LINES, View
from consat.views.record import Record, between
from consat.views.regions import grid, regions, view
from consat.views.shapes import MOST_SHAPES, Shapes, boxes, moves, shapes, ways
from consat.views.words import label, plain, typeset

MOST_CONSTRAINTS, MOST_ENTRIES = 40, 16
GRID = 241
"""Grid points per axis of the view at which ψ is evaluated."""
DOTS: Any = (0, (1, 1.5))
MOST_MAP = 2.0
"""The view may cut obstacles that are larger than this factor times the extent of the paths."""


def _directions(points: np.ndarray, lengths: Sequence[int]) -> list[np.ndarray]:
    """Unit vectors from agents to their labels, chosen so that labels overlap least.

    Args:
        points: (N, 2) positions of the agents, pt.
        lengths: number of letters of each label.
    """
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
    """Artists for the formation of a result on one set of axes. Each `show` moves them to another moment.

    1-D positions are drawn against time; of more than three dimensions the first two axes are drawn. A moment is a sample index; a
    fractional one is interpolated between two samples.

    Args:
        result: result of a run with recorded positions.
        axes: matplotlib axes to draw on; None for those of a new figure.
        fine: grid points per axis of the view at which ψ is evaluated.

    Attributes:
        axes, figure: where the formation is drawn.
        moving: the artists that `show` changes.
        record: positions and margins.
        x: (T, N, d) positions, as in `record`.
        steps: (T,) times, s, or round numbers, as in `record`.
        last: index of the last finite sample, as in `record`.
    """

    def __init__(self, result: Result, axes: Any = None, fine: int = GRID) -> None:
        self.record = record = Record(result)
        data, team = record.data, record.team
        self.x, self.steps, self.last = record.x, record.steps, record.last
        self._few = self.x.shape[1] <= FEW and (team is None or len(team.owner) <= MOST_CONSTRAINTS)
        self._name, self._ids = plain(result.summary["scenario"]), [plain(name, 14) for name in record.ids]
        self._sample = [f"{self.x.shape[1]} of {result.summary['count']:,} agents"] if "final_position" in result.data else []
        self._fine, self._team = fine, team if team is not None and 0 < len(team.owner) <= MOST_SHAPES else None
        self._links = team.links if team is not None and len(team.links) <= MOST_LINES else np.zeros((0, 2), dtype=int)
        self._line, self._space = self.x.shape[2] == 1, self.x.shape[2] == 3
        own = axes is None
        self.axes: Any = axes or Figure(layout="compressed").add_subplot(projection="3d" if self._space else None)
        self.figure = cast(Any, self.axes.get_figure())
        self.moving: list[Artist] = []
        self._areas: list[Area] = []
        self._ground: Ground | None = None
        self._shapes: Shapes | None = None
        self._lawn: list[Artist] = []
        seen = self.x.shape[2] in (2, 3)
        self._crew: bodies.Crew | None = None
        self._robots, self._map = bodies.robots(result, data) if seen else (None, ())
        if self._team is not None and (self._space or not self._few):
            self._shapes = shapes(self._team, self.record.times[self.last])
        ratio = self._frame([str(name) for name in data["axis"].values], None if team is None else team.unit)
        rows, letters = self._legend() if self._few else self._crowd_legend(own)
        if own:
            height = max(5.2, 0.6 + 0.235 * rows)  # room for the legend; letters are taller at low resolutions
            self.figure.set_size_inches(1.5 + (height - 0.8) * ratio + 0.08 * letters, height + 0.6 * (not self._few))
        if self._space:
            list(self._in_space(self.x[self.last], self.last, moving=False))
        else:
            self._cast()

    # ---- static parts

    def _frame(self, names: Sequence[str], unit: str | None) -> float:
        """Set limits and labels, and draw the map and the static regions. Returns the aspect ratio of the axes, width by height."""
        axes, team, x = self.axes, self._team, self.x[self.last]
        axis_count = 3 if self._space else 2
        seen = self._then(self.last) if self._few else None
        paths = self.x[: self.last + 1, :, :axis_count]
        low, high, self._cut = view(paths, x, seen, self._boxes(x, axis_count))
        lattice = grid(low, high, 2 if self._space else self._fine)
        labels = [label(f"position {name}", unit) for name in names]
        if self._line:
            until = float(self.steps[self.last]) or 1.0
            low, high = np.array([-0.03 * until, low[0]]), np.array([1.1 * until, high[0]])
            labels = ["time t [s]" if self.record.clock == "time" else "round", *labels]
            self._columns = np.unique(self.record.moments(200, 0.5))
        for axis, text, a, b in zip("xyz", labels, low, high, strict=False):
            axes.set(**{f"{axis}lim": (a, b), f"{axis}label": text})
        axes.set_aspect("auto" if self._line else "equal")
        unit_size = (high - low)[:2] if self._line else np.full(2, np.max(high - low))
        self._view = View(low, high, unit_size, *lattice)
        axes.grid(color="0.92", linewidth=0.8)
        axes.set_axisbelow(True)
        if self._space:
            axes.computed_zorder = False  # the given zorder holds, so that agents are visible through regions
        (bodies.map_in_space if self._space else bodies.map_in_plane)(axes, self._map)
        if team is not None:
            self._settle(team, x)
        points = 330.0 * self.record.trail(self.last)[-1, :, :2] / self._view.unit
        self._where = _directions(points[: len(self._ids)], list(map(len, self._ids))) if self._few else []
        return 1.25 if self._line or self._space else float((high - low)[0] / (high - low)[1])

    def _boxes(self, x: np.ndarray, axes: int) -> np.ndarray:
        """(B, 2, p) boxes that the view must hold besides the regions that `view` finds."""
        if self._team is None:
            return self._near(axes)
        found = [self._near(axes), boxes(self._team)[:, :, :axes], ways(self._team, self.record.times[: self.last + 1])[:, :, :axes]]
        if not self._few and self._shapes is not None and not self._line:
            balls = self._shapes.balls
            found.append(balls.boxes(x)[balls.around < 0, :, :axes])
        return np.concatenate(found)

    def _near(self, axes: int) -> np.ndarray:
        """(B, 2, p) boxes around the obstacles that are at most `MOST_MAP` times as large as the extent of the paths."""
        if not self._map:
            return np.zeros((0, 2, min(axes, self.x.shape[2])))
        around, paths = bodies.bounds(self._map, axes), self.x[: self.last + 1, :, :axes]
        way = float((np.nanmax(paths, axis=(0, 1)) - np.nanmin(paths, axis=(0, 1))).max())
        return around[np.ptp(around, axis=1).max(axis=1) <= MOST_MAP * way]

    def _settle(self, team: Any, x: np.ndarray) -> None:
        """Prepare the regions. Small team: evaluate ψ and create the artists that `show` updates. Crowd: draw the fixed regions."""
        if self._line and self._few:
            times = between(self.record.times, self._columns)
            columns = zip(times, between(self.x, self._columns), strict=True)
            values = np.stack([regions(team.at(time), at, self._view.points) for time, at in columns], axis=2)
            self._areas, self._tube = areas.areas(team, values), values
        elif self._few and not self._space:
            self._values = self._view.psi(team.at(self.record.times[self.last]), x)
            self._moves = moves(team)
            self._areas = areas.areas(team, self._values)
        elif self._few:
            self._areas = areas.areas(team)
        elif self._shapes is not None and not self._space and not self._line:
            self._lawn = crowd.lawn(self.axes, cast(Team, self._then(self.last)), self._shapes, x, self._view)
        if self._few and not self._space:
            self._ground = Ground(self.axes, team, self._areas, self._view.unit)

    def _then(self, moment: float) -> Team | None:
        """The team with its constraints at a moment; None if it has none to draw."""
        return None if self._team is None else self._team.at(self.record.time(moment))

    def _crowd_legend(self, own: bool) -> tuple[int, int]:
        """Draw the colour bar of the agents' margins, and a legend below. Returns the rows and letters to make room for, as `_legend`."""
        palette, norm, edges, extend = classes(self.record.agent_margin[self.last])
        self._colours = ScalarMappable(norm, palette)
        place: dict[str, Any] = {"pad": 0.12, "shrink": 0.75} if self._space else {"pad": 0.03}
        place |= {"label": r"agent margin $\barα_i$ (red: violated)", "ticks": edges, "spacing": "uniform", "extend": extend}
        bar = self.figure.colorbar(self._colours, ax=self.axes, **place)
        bar.ax.set_yticklabels([typeset(edge) for edge in edges])
        found = None if self._line else self._shapes
        agent = Line2D([], [], marker="o", color=palette(0.9), markeredgecolor="0.2", linestyle="", label="agent")
        lines: list[Any] = [agent] if self._robots is None else bodies.legend(self._robots, self._map)
        lines += crowd.legend(found, self.x.shape[1], links=len(self._links) > 0, in_space=self._space)
        where: dict[str, Any] = {"loc": "outside lower center"} if own else {"loc": "upper center", "bbox_to_anchor": (0.5, -0.14)}
        (self.figure if own else self.axes).legend(handles=lines, ncols=min(3, len(lines)), frameon=False, **where)
        return 0, 8

    def _legend(self) -> tuple[int, int]:
        """Draw the legend of agents and regions. Returns its number of rows, and the letters of its longest entry."""
        line, team, ids = functools.partial(Line2D, [], []), self._team, self._ids
        lines: list[Any] = [line(color=colour(i), marker=marker(i), label=name) for i, name in enumerate(ids)]
        lines.append(line(color=GREY, marker="o", markerfacecolor="white", linestyle="", label="start"))
        if len(self._links) and not self._line:
            lines.append(line(color=LINK, linewidth=1, linestyle=DOTS, label="communication link"))
        lines += bodies.legend(self._robots, self._map)
        if self._space:
            lines.append(line(color=space.FLOOR, marker=".", linestyle=":", label="shadow on the floor"))
        if team is not None and self._areas:
            lines.append(line(linestyle="", label="\nregions, as the others stand:"))
            lines += self._region_lines()
        beside = (1.1 if self._space else 1.02, 1.0)
        self.axes.legend(handles=lines, loc="upper left", bbox_to_anchor=beside, frameon=False, borderaxespad=0)
        return len(lines) + 1, max(len(str(entry.get_label())) for entry in lines)

    def _region_lines(self) -> Iterator[Any]:
        """Legend entries for regions: one per name; for many regions, the meaning of the line styles only."""
        line = functools.partial(Line2D, [], [])
        entries = {f"{self._owners(area)}: {plain(area.name)}": area for area in reversed(self._areas)}
        if len(entries) > MOST_ENTRIES:
            yield line(color=GREY, linewidth=1.2, label="edge of a constraint")
            if any(area.keeps_out for area in self._areas):
                yield areas.legend_patch(SHARED, "keep out")
        else:
            for name, area in reversed(entries.items()):
                dash: Any = "-" if self._space else area.style
                if area.keeps_out:
                    yield areas.legend_patch(area.colour, f"{name}, keep out")
                else:
                    yield line(color=area.colour, linestyle=dash, linewidth=1.2, label=name)
        if any(area.leaves for area in self._areas):
            yield line(color=GREY, marker=3, linewidth=1.2, label="forbidden side")
        if not self._space:
            yield line(color=GREY, linewidth=8, alpha=0.25, solid_capstyle="butt", label="where an agent may be")

    def _owners(self, area: Area) -> str:
        names = [self._ids[owner] for owner in area.owners]
        return ", ".join(names) if len(names) <= 3 else f"{len(names)} agents"

    # ---- moving parts

    def _cast(self) -> None:
        """Create the artists in the plane; `show` moves them."""
        trail, axes = self.record.trail(0.0), self.axes
        ground = [] if self._ground is None else self._ground.artists
        look: dict[str, Any] = {"linewidth": 1.0, "linestyle": DOTS} if self._few else {"linewidth": 0.7}
        self._wires = Line2D([], [], color=LINK, alpha=0.8, zorder=1.5, gid="link", **look)
        axes.add_artist(self._wires)
        self._names: list[Any] = []
        every, robots = range(self.x.shape[1]), self._robots
        if robots is not None:
            self._crew = bodies.Crew(axes, robots, [colour(i) for i in every] if self._few else None)
        crew = [] if self._crew is None else self._crew.artists
        if self._few:
            room = 0.0 if robots is None else (robots.radius + robots.offset) / self._view.unit[0]
            away = np.broadcast_to(np.maximum(7.0, 3 + 330 * room), len(every))
            self._paths = [axes.plot([], [], **_path(i))[0] for i in every]
            starts = [axes.plot(*trail[0, i, :, None], **_start(i))[0] for i in every]
            self._heads = [axes.plot([], [], **self._head(i))[0] for i in every]
            for i, name in enumerate(self._ids):
                x, y = self._where[i]
                place = {"ha": ("center", "left", "right")[round(x)], "va": ("center", "bottom", "top")[round(y)], "zorder": 6}
                self._names.append(
                    axes.annotate(name, trail[0, i], (away[i] * x, away[i] * y), textcoords="offset points", **_ink(i), **place)
                )
            self.moving = [*ground, self._wires, *self._paths, *starts, *crew, *self._heads, *self._names]
            return
        self._paths = [axes.plot([], [], color=TRAIL, linewidth=1.0, zorder=1, gid="path")[0]]
        if len(every) <= MOST_LINES:
            size = 3.5 if len(every) < 200 else 1.5
            axes.plot(*trail[0].T, "o", color=TRAIL, markerfacecolor="white", markersize=size, zorder=1.2, gid="start")
        self.moving = [self._paths[0], self._wires, *crew]
        if not crew:
            self._dots = axes.scatter(*trail[-1].T, **crowd.dots(len(every)))
            self.moving.append(self._dots)

    def show(self, moment: float) -> None:
        """Draw the formation at a moment."""
        trail, sample = self.record.trail(moment), int(moment)
        if self._space:
            for artist in self.moving:
                artist.remove()
            regions = self._in_space(self.record.where(moment), moment, moving=True)
            self.moving = [*regions, *space.shadows(self.axes, trail, float(self._view.low[2]), paths=self._few)]
            self.moving += self._agents(trail) if self._few else self._crowd(trail, sample)
            if self._robots is not None and self._few:
                shades = [colour(i) for i in range(self.x.shape[1])]
                self.moving += bodies.balls(self.axes, trail[-1], self._robots.radius, shades)
            style: dict[str, Any] = {"color": LINK, "linewidth": 1 if self._few else 0.6, "linestyle": DOTS, "gid": "link"}
            self.moving += self.axes.plot(*_joined(trail[-1][self._links]), **style)
        else:
            self._move(trail, moment)
        clock = f"{between(self.steps, moment)[0]:.1f}".removesuffix(".0")
        time = f"t = {clock} s" if self.record.clock == "time" else f"round {self.steps[sample]:.0f}"
        notes = [*self._sample, *["starts out of view"] * self._cut] + [f"the first two of {self.x.shape[2]} axes"] * (self.x.shape[2] > 3)
        margin = f", margin {typeset(self.record.margin[sample])}" if np.isfinite(self.record.margin[sample]) else ""
        self.axes.set_title("\n".join([f"{self._name} at {time}{margin}", *(f"({note})" for note in notes)]))

    def _move(self, trail: np.ndarray, moment: float) -> None:
        """Move the artists in the plane to a moment; `trail` from `_trail`."""
        if not self._line:
            self._wires.set_data(*_joined(trail[-1][self._links]))
        if self._ground is not None:
            self._move_ground(self._ground, moment)
        if self._crew is not None:
            self._crew.show(trail[-1], moment)
        if not self._few:
            self._move_crowd(trail, moment)
            return
        for i, (path, head, name) in enumerate(zip(self._paths, self._heads, self._names, strict=True)):
            path.set_data(*trail[:, i].T)
            head.set_data(*trail[-1, i, :, None])
            name.xy = trail[-1, i]

    def _move_ground(self, ground: Ground, moment: float) -> None:
        if self._line:
            seen = np.count_nonzero(self._columns <= moment)
            ground.show(between(self.steps, self._columns[:seen]), self._view.along[0], self._tube[:, :, :seen])
            return
        if self._moves.any():
            now = cast(Team, self._then(moment))
            families = [family for family in now.families if self._moves[family.number].any()]
            self._values[self._moves] = self._view.psi(now, self.record.where(moment), families)[self._moves]
        across, up = self._view.along
        ground.show(across, up, self._values)

    def _move_crowd(self, trail: np.ndarray, moment: float) -> None:
        self._paths[0].set_data(*_joined(crowd.thin(trail)))
        if self._lawn and self._team is not None and self._team.moves:
            for artist in self._lawn:
                artist.remove()
            self.moving = [artist for artist in self.moving if artist not in self._lawn]
            found, then = shapes(self._team, self.record.time(moment)), cast(Team, self._then(moment))
            self._lawn = crowd.lawn(self.axes, then, found, self.record.where(moment), self._view)
            self.moving += self._lawn
        margins = self.record.agent_margin[int(moment)]
        if self._crew is not None:
            self._crew.paint(self._shades(margins))
        else:
            self._dots.set_offsets(trail[-1])
            self._dots.set_facecolor(self._shades(margins))
        for name in self._names:
            name.remove()
            self.moving.remove(name)
        style: dict[str, Any] = {"fontsize": 8, "path_effects": [withStroke(linewidth=2, foreground="w")], "zorder": 6}
        self._names = [
            self.axes.annotate(self._ids[i], trail[-1, i], (5, 5), textcoords="offset points", clip_on=True, annotation_clip=True, **style)
            for i in ([] if self._line else crowd.worst(margins, trail[-1], self._view.unit))
        ]
        self.moving += self._names

    def _shades(self, margins: np.ndarray) -> Any:
        return self._colours.to_rgba(np.ma.masked_invalid(margins))

    def _in_space(self, x: np.ndarray, moment: float, *, moving: bool) -> Iterator[Artist]:
        """Draw regions in space with the team at x (N, d): only those that move, or only those that don't."""
        team = self._then(moment)
        if self._team is None or team is None or self._shapes is None:
            return
        found, ties = shapes(self._team, self.record.time(moment)) if self._team.moves else self._shapes, moves(self._team)
        chosen = [k for k in space.chosen(found) if bool(found.balls.moves[k]) == moving]
        yield from space.balls(self.axes, found.balls, x, chosen, None if self._few else AREA)
        if not moving:
            yield from space.walls(self.axes, found.walls, self._view.low, self._view.high)
        others = [k for k in found.others.tolist() if ties[k] == moving]
        if self._few and others:
            yield from space.sections(self.axes, team, others, x, self._view.low, self._view.high)

    def _agents(self, trail: np.ndarray) -> Iterator[Artist]:
        """Draw a small team in space."""
        for i, name in enumerate(self._ids):
            yield from self.axes.plot(*trail[:, i].T, **_path(i))
            yield from self.axes.plot(*trail[0, i, :, None], **_start(i))
            yield from self.axes.plot(*trail[-1, i, :, None], **self._head(i))
            yield self.axes.text(*trail[-1, i], f"  {name}", **_ink(i))

    def _head(self, agent: int) -> dict[str, Any]:
        """Marker style of an agent's position; a small dot if its body is drawn around it."""
        return _head(agent) | ({} if self._robots is None else {"markersize": 3.5, "marker": "o", "markeredgewidth": 0.6})

    def _crowd(self, trail: np.ndarray, sample: int) -> Iterator[Artist]:
        """Draw a crowd in space, coloured by margin."""
        count = trail.shape[1]
        if count <= MOST_LINES:
            yield from self.axes.plot(*_joined(crowd.thin(trail)), color=TRAIL, linewidth=0.8, zorder=1, gid="path")
        yield self.axes.scatter(*trail[-1].T, c=self._shades(self.record.agent_margin[sample]), depthshade=False, **crowd.dots(count))


def _path(agent: int) -> dict[str, Any]:
    return {"color": colour(agent), "linewidth": 1.7, "alpha": 0.85, "zorder": 3, "gid": "path"}


def _start(agent: int) -> dict[str, Any]:
    look = {"markerfacecolor": "white", "markersize": 7, "zorder": 4, "gid": "start"}
    return {"color": colour(agent), "marker": marker(agent), "linestyle": "", **look}


def _head(agent: int) -> dict[str, Any]:
    look = {"markeredgecolor": "white", "markersize": 8, "zorder": 5, "gid": "head"}
    return {"color": colour(agent), "marker": marker(agent), "linestyle": "", **look}


def _ink(agent: int) -> dict[str, Any]:
    """Text style of an agent's name."""
    return {"color": colour(agent), "weight": "bold", "path_effects": [withStroke(linewidth=2.5, foreground="w")]}


def _joined(segments: np.ndarray) -> np.ndarray:
    """Lines (S, K, p) → one line (p, S·(K + 1)), separated by NaN, because one artist is much faster than many."""
    return np.concatenate([segments, np.full_like(segments[:, :1], np.nan)], axis=1).reshape(-1, segments.shape[2]).T
