"""Regions of constraints: where ψ > 0 for its owner, on a grid; their boundaries; and the box that shows them.

Regions are found in the same way for every ψ (library kind, expression or own function): ψ is evaluated with its owner at the points of a
grid and all other agents at their positions. The line ψ = 0 is the boundary of the region in which the constraint holds for its owner.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any, Final

import jax
import numpy as np
from contourpy import FillType, LineType, contour_generator
from jax import Array
from matplotlib.path import Path

from consat.numerics import float64
from consat.problem.family import Family
from consat.problem.team import Team

BATCH = 8192
FAR = 6.0
"""Paths are cut where they would make the view more than this factor wider, so that the formation stays visible."""
FINE = 81
"""Grid points per axis of traced outlines."""
EMPTY: Final = Path(np.zeros((0, 2)))
MOST_TRACED = 40
"""Most constraints whose boundaries are traced. If there are more, none is."""


@functools.partial(jax.jit, static_argnames="psi")
def _over(psi: Callable[..., Any], points: Any, arguments: Any, slot: Any, parameters: Mapping[str, Any], weight: Any) -> Array:
    def at(point: Array, arguments: Array, slot: Array, parameters: Mapping[str, Array], weight: Array) -> Array:
        return weight * psi(*arguments.at[slot, : len(point)].set(point), **parameters)

    return jax.vmap(jax.vmap(at, (0, None, None, None, None)), (None, 0, 0, 0, 0))(points, arguments, slot, parameters, weight)


@float64
def regions(team: Team, x: np.ndarray, points: np.ndarray, families: Sequence[Family] | None = None) -> np.ndarray:
    """Evaluate each ψ with its owner moved to other points and all other agents at their positions.

    Args:
        team: the team.
        x: (N, d) positions of all agents.
        points: (K, p) points for the owner. They replace its first p ≤ d coordinates.
        families: families of the constraints to evaluate; None for all.

    Returns:
        (M, K) weighted ψ of every constraint, in the team's order; NaN where it is not finite, and for constraints not in `families`.
    """
    count = len(points)
    batches = np.resize(points, (-(-count // BATCH), BATCH, points.shape[1]))  # batches of equal size, so that ψ is compiled once
    values = np.full((len(team.owner), batches.shape[0] * BATCH), np.nan)
    for family in team.families if families is None else families:
        slot = np.argmax(family.agents == family.owner[:, None], axis=1)
        parameters = {key: np.asarray(value) for key, value in family.parameters.items()}
        arguments, weight = np.asarray(x[family.agents], dtype=float), np.asarray(family.weight, dtype=float)
        for k, batch in enumerate(batches):
            at = slice(k * BATCH, (k + 1) * BATCH)
            values[family.number, at] = _over(family.psi, batch, arguments, slot, parameters, weight)
    return np.where(np.isfinite(values), values, np.nan)[:, :count]


def grid(low: np.ndarray, high: np.ndarray, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Grid in a box with corners `low` and `high`, (p,): (p, count) coordinates along each axis, and (count^p, p) grid points."""
    along = np.linspace(low, high, count, axis=-1)
    return along, np.stack(np.meshgrid(*along, indexing="ij"), axis=-1).reshape(-1, len(low))


def _sights(team: Team, x: np.ndarray, low: np.ndarray, high: np.ndarray) -> Iterator[tuple[int, np.ndarray]]:
    """Index and bounding box, (2, p), of every region ψ > 0, or forbidden region ψ < 0, that lies inside the given box."""
    count = {1: 401, 2: 81, 3: 31}[len(low)]
    along, points = grid(low, high, count)
    for k, values in enumerate(regions(team, x, points).reshape(-1, *(count,) * len(low))):
        for places in (np.argwhere(values > 0), np.argwhere(values < 0)):
            if len(places) and places.min() > 0 and places.max() < count - 1:
                ends = np.stack([places.min(axis=0) - 1, places.max(axis=0) + 1])
                yield k, np.take_along_axis(along, ends.T, axis=1).T


def contours(across: np.ndarray, up: np.ndarray, values: np.ndarray) -> Iterator[np.ndarray]:
    """Polylines (P, 2) on which values (L, K) are zero, the higher values on their left. A closed line ends at its first point."""
    if min(values.shape) > 1 and np.nanmin(values, initial=0.0) < 0 < np.nanmax(values, initial=0.0):
        lines: Any = contour_generator(across, up, np.ma.masked_invalid(values), line_type=LineType.Separate).lines(0.0)
        yield from lines


def filled(across: np.ndarray, up: np.ndarray, values: np.ndarray) -> Path:
    """Path around the points where values (L, K) are positive."""
    top = float(np.nanmax(values, initial=0.0))
    if min(values.shape) < 2 or top <= 0:
        return EMPTY
    found: Any = contour_generator(across, up, np.ma.masked_invalid(values), fill_type=FillType.OuterCode).filled(0.0, 2 * top)
    pieces = [Path(outline, code) for outline, code in zip(*found, strict=True)]
    return Path.make_compound_path(*pieces)


def view(paths: np.ndarray, x: np.ndarray, team: Team | None, boxes: np.ndarray | None = None) -> tuple[np.ndarray, np.ndarray, bool]:
    """The box to show. It holds the final formation, the regions, and the paths if they don't start far away (`FAR`).

    Args:
        paths: (T, N, p) positions over time, on the axes shown; the last is the final formation.
        x: (N, d) final positions on all axes.
        team: team whose regions are found by sampling; None if `boxes` already holds them.
        boxes: (B, 2, p) further boxes that the view should hold, low and high corner.

    Returns:
        low and high corner of the view, (p,) each, and whether it cuts off the beginning of paths.
    """
    everywhere, core = paths[np.isfinite(paths).all(axis=2)], paths[-1]  # an agent that joined later has no position before
    middle = (core.min(axis=0) + core.max(axis=0)) / 2
    half = max(float(np.ptp(core, axis=0).max()), 1e-3 * float(np.ptp(everywhere, axis=0).max())) or 1e-3
    count = 0 if team is None else len(team.owner)
    missing = set(range(count))
    for factor in 4.0 ** np.arange(12):  # widen the search until every region was found
        for k, box in _sights(team, x, middle - factor * half, middle + factor * half) if team is not None and missing else ():
            if k in missing and (len(missing) == count or np.ptp(box, axis=0).max() <= FAR * np.ptp(core, axis=0).max()):
                core = np.concatenate([core, box])
                missing.discard(k)
    for box in () if boxes is None else boxes:
        if np.ptp(np.concatenate([core, box]), axis=0).max() <= FAR * max(np.ptp(paths[-1], axis=0).max(), np.ptp(box, axis=0).max()):
            core = np.concatenate([core, box])
    both = np.concatenate([core, everywhere])
    cut = bool(np.ptp(both, axis=0).max() > FAR * np.ptp(core, axis=0).max() > 0)
    low, high = (core if cut else both).min(axis=0), (core if cut else both).max(axis=0)
    side = float((high - low).max()) or 1.0
    least = 0.75 if len(low) < 3 else 0.5  # the least length of the other sides, relative to the longest side
    spare = np.maximum(0.0, least * side - (high - low)) / 2 + (0.35 if cut else 0.08) * side
    return low - spare, high + spare, cut


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
