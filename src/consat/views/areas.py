"""Regions of constraints on 2-D axes: allowed regions are tinted, keep-outs are hatched.

A constraint that several agents share is drawn once. Values of ψ on a grid are converted to paths. The artists are created once; each
frame only replaces their paths.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from matplotlib.artist import Artist
from matplotlib.collections import EllipseCollection
from matplotlib.colors import to_rgba
from matplotlib.lines import Line2D
from matplotlib.patches import Patch, PathPatch
from matplotlib.path import Path

from consat.problem.team import Team
from consat.views.colours import STYLES, colour_of
from consat.views.regions import EMPTY, contours, filled
from consat.views.shapes import BALLS, alike, moves

HATCH: Final = "////"
TINT, SHADE = 0.15, 0.16


@dataclass(frozen=True)
class Area:
    """Region of one constraint, or of equal constraints of several agents.

    Attributes:
        number: index of the constraint in the team; of several, the first.
        name: name of the constraint. The sides of a box have the same name.
        owners: indices of the agents that have the constraint.
        keeps_out: whether the forbidden side is the inside.
        leaves: whether the boundary leaves the view, so that ticks must mark the forbidden side.
        moves: whether the region moves, with teammates or by a schedule.
        colour: colour of the boundary.
        style: line style of the boundary.
    """

    number: int
    name: str
    owners: tuple[int, ...]
    keeps_out: bool
    leaves: bool
    moves: bool
    colour: str
    style: Any


def areas(team: Team, values: np.ndarray | None = None) -> list[Area]:
    """The distinct regions of a team.

    Args:
        team: the team.
        values: (M, L, K) every ψ on a grid. If None, only library kinds are recognised as keep-outs, and `Area.leaves` is False.
    """
    first, owners, ties, found = alike(team), np.asarray(team.owner), moves(team), []
    kinds = {int(number): family.kind for family in team.families if family.sources is None for number in family.number}
    ranks: dict[int, dict[str, int]] = defaultdict(dict)
    for number in map(int, np.flatnonzero(first == np.arange(len(first)))):
        mine = tuple(sorted({int(owner) for owner in owners[first == number]}))
        kind, name = kinds.get(number, ""), team.names[number]
        name = name.rpartition(".")[0] if kind == "box" else name
        rank = ranks[int(owners[number])].setdefault(name, len(ranks[int(owners[number])]))
        keeps_out, leaves = BALLS.get(kind, False), False
        if values is not None:
            psi = values[number]
            edge = np.concatenate([psi[0], psi[-1], psi[:, 0], psi[:, -1]])
            keeps_out = keeps_out or bool((psi < 0).any() and (edge > 0).all())
            leaves = bool(not keeps_out and (edge > 0).any() and (edge < 0).any())
        style = "-" if keeps_out else STYLES[rank % len(STYLES)]
        found.append(Area(number, name, mine, keeps_out, leaves, bool(ties[number]), colour_of(mine), style))
    return found


class Ground:
    """Artists for the regions of a small team.

    Args:
        axes: matplotlib axes to draw on.
        team: the team.
        found: regions, from `areas`.
        unit: (2,) size of the view on each axis. The length of ticks is relative to it.

    Attributes:
        artists: the artists that `show` changes.
    """

    def __init__(self, axes: Any, team: Team, found: Sequence[Area], unit: np.ndarray) -> None:
        self.found, self._unit = found, unit
        first = alike(team)
        closed = {area.number for area in found if not area.keeps_out}
        alike_goals: dict[frozenset[int], list[int]] = {}
        mine: dict[int, set[int]] = {}
        for owner in map(int, np.unique(team.owner)):
            mine[owner] = set(first[np.flatnonzero(team.owner == owner)].tolist())
            if mine[owner] & closed:  # an agent with keep-outs alone may be almost everywhere: no tint
                alike_goals.setdefault(frozenset(mine[owner] & closed), []).append(owner)
        self._common: list[tuple[list[int], PathPatch]] = []
        for owners in alike_goals.values():
            numbers = sorted(set.intersection(*(mine[owner] for owner in owners)))
            self._common.append((numbers, _patch(axes, "region", facecolor=colour_of(owners), edgecolor="none", alpha=TINT, zorder=0.6)))
        self._edges = [
            _patch(axes, "boundary", fill=False, edgecolor=area.colour, linestyle=area.style, **_weight(area), zorder=2) for area in found
        ]
        self._ticks = [_patch(axes, "ticks", fill=False, edgecolor=area.colour, linewidth=0.8, zorder=2) for area in found]
        self._keep_outs = {area.number: hatched(axes, area.colour) for area in found if area.keeps_out}
        common = [patch for _, patch in self._common]
        self.artists: list[Artist] = [*common, *self._keep_outs.values(), *self._edges, *self._ticks]

    def show(self, across: np.ndarray, up: np.ndarray, values: np.ndarray) -> None:
        """Update the artists from the values of all ψ.

        Args:
            across: (K,) grid coordinates on the horizontal axis.
            up: (L,) grid coordinates on the vertical axis.
            values: (M, L, K) weighted ψ, NaN where not finite.
        """
        for numbers, patch in self._common:
            patch.set_path(filled(across, up, values[numbers].min(axis=0)))
        for area, edge, ticks in zip(self.found, self._edges, self._ticks, strict=True):
            psi = values[area.number]
            lines = list(contours(across, up, psi))
            edge.set_path(Path.make_compound_path(*map(Path, lines)))
            ticks.set_path(_strokes(lines if area.leaves else [], self._unit))
            if area.keeps_out:
                self._keep_outs[area.number].set_path(filled(across, up, -psi))


def _weight(area: Area) -> dict[str, float]:
    """Line width and opacity: regions that move are drawn lighter."""
    return {"linewidth": 1.0, "alpha": 0.65} if area.moves else {"linewidth": 1.4, "alpha": 1.0}


def _patch(axes: Any, gid: str, **style: Any) -> PathPatch:
    patch = PathPatch(EMPTY, gid=gid, **style)
    axes.add_artist(patch)
    return patch


def hatched(axes: Any, shade: Any) -> PathPatch:
    """Add a hatched patch without a path to the axes. All views draw keep-outs with it."""
    patch = _patch(axes, "keep-out", **keep_out_style(shade), zorder=1)
    patch.set_hatch_linewidth(0.7)
    return patch


def keep_out_style(shade: Any) -> dict[str, Any]:
    """Fill style of a keep-out: a tint and a hatch in the same colour."""
    return {"facecolor": to_rgba(shade, SHADE), "edgecolor": to_rgba(shade, 0.75), "hatch": HATCH, "linewidth": 0.0}


def discs(axes: Any, centers: np.ndarray, radii: np.ndarray, **style: Any) -> EllipseCollection:
    """Add discs of radii (K,) at centers (K, 2) to the axes, as one artist."""
    place: dict[str, Any] = {"units": "xy", "angles": 0.0, "offsets": centers, "offset_transform": axes.transData}
    found = EllipseCollection(2 * radii, 2 * radii, **place, **style)
    axes.add_collection(found, autolim=False)
    return found


def legend_patch(shade: Any, label: str) -> Patch:
    """Legend entry for a keep-out."""
    patch = Patch(**keep_out_style(shade), label=label)
    patch.set_hatch_linewidth(0.7)
    return patch


def _strokes(lines: Sequence[np.ndarray], unit: np.ndarray) -> Path:
    """Short ticks along boundary lines, on the side where ψ < 0: to the right of each line."""
    found = [np.zeros((0, 2, 2))]
    for piece in lines:
        line = piece / unit
        way = np.append(0.0, np.cumsum(np.hypot(*np.diff(line, axis=0).T)))
        at = np.arange(1 / 80, way[-1], 1 / 40)
        foot, ahead = (np.stack([np.interp(at + step, way, line[:, k]) for k in (0, 1)], axis=1) for step in (0.0, 1 / 4000))
        right = (ahead - foot)[:, ::-1] * [1.0, -1.0]
        found.append(np.stack([foot, foot + right / np.maximum(np.hypot(*right.T), 1e-300)[:, None] / 80], axis=1) * unit)
    segments = np.concatenate(found)
    return Path(segments.reshape(-1, 2), np.tile(np.array([Path.MOVETO, Path.LINETO], dtype=Path.code_type), len(segments)))


def wall(axes: Any, low: np.ndarray, high: np.ndarray, normal: np.ndarray, offset: float, shade: Any) -> None:
    """Draw the boundary of a half-space normal·x ≤ offset in the plane, with ticks on its forbidden side.

    Args:
        axes: matplotlib axes to draw on.
        low: (2,) lower corner of the view.
        high: (2,) upper corner of the view.
        normal: (2,) unit vector towards the forbidden side.
        offset: distance of the boundary from the origin, along `normal`.
        shade: colour.
    """
    middle, size = (low + high) / 2, float(np.linalg.norm(high - low))
    foot = middle - (middle @ normal - offset) * normal
    along = np.array([-normal[1], normal[0]]) * size
    line = np.stack([foot - along, foot + along])  # the forbidden side is to its right
    unit = np.full(2, float((high - low).max()))
    axes.add_artist(Line2D(*line.T, color=shade, linewidth=1.2, zorder=2, gid="boundary"))
    _patch(axes, "ticks", fill=False, edgecolor=shade, linewidth=0.8, zorder=2).set_path(_strokes([line], unit))
