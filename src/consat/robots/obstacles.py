"""Obstacles: a public map of discs, boxes and polygons, as convex parts whose nearest points are known in closed form.

A polygon is as many segments as it has edges: who is outside and keeps away from each of them stays outside, whether it is convex or not.
"""

from __future__ import annotations

import functools
import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import shapely
from jax import Array

from consat.errors import Fault, InvalidInput, shown
from consat.numerics import float64

HALVINGS = 40
"""To find the point of a robot's segment that is nearest to a part: down to 1e-12 of the segment."""


@dataclass(frozen=True)
class Obstacle:
    """Base of obstacles; made by `disc`, `box` and `polygon`.

    Attributes:
        dimension: of the space it lies in.
    """

    @property
    def dimension(self) -> int:
        raise NotImplementedError


@dataclass(frozen=True)
class Disc(Obstacle):
    """A disc, or a ball."""

    center: tuple[float, ...]
    radius: float

    @property
    def dimension(self) -> int:
        return len(self.center)


@dataclass(frozen=True)
class Box(Obstacle):
    """A box whose sides are along the axes."""

    low: tuple[float, ...]
    high: tuple[float, ...]

    @property
    def dimension(self) -> int:
        return len(self.low)


@dataclass(frozen=True)
class Polygon(Obstacle):
    """A simple polygon, of either orientation."""

    vertices: tuple[tuple[float, float], ...]

    @property
    def dimension(self) -> int:
        return 2


def disc(center: Sequence[float], radius: float) -> Disc:
    """A disc in the plane, or a ball in space.

    Args:
        center: d numbers, m.
        radius: m, positive.

    Raises:
        InvalidInput: one line for each argument that cannot be used.
    """
    faults: list[Fault] = []
    place = _vector(center, (2, 3), "center", "obstacle 'disc'", faults)
    size = _number(radius, "radius", "obstacle 'disc'", faults)
    if faults:
        raise InvalidInput(faults)
    return Disc(place, size)


def box(low: Sequence[float], high: Sequence[float]) -> Box:
    """A box between two corners.

    Args:
        low: d numbers, m.
        high: d numbers, m, each above that of `low`.

    Raises:
        InvalidInput: one line for each argument that cannot be used.
    """
    where, faults = "obstacle 'box'", list[Fault]()
    below, above = _vector(low, (2, 3), "low", where, faults), _vector(high, (2, 3), "high", where, faults)
    if not faults and len(below) != len(above):
        faults.append(Fault(("high",), f"must have as many numbers as low, {len(below)}, but has {len(above)}", f"{where}, high"))
    elif not faults and not all(a < b for a, b in zip(below, above, strict=True)):
        faults.append(Fault(("high",), f"must be above low, {list(below)}, on every axis, but is {list(above)}", f"{where}, high"))
    if faults:
        raise InvalidInput(faults)
    return Box(below, above)


def polygon(vertices: Sequence[Sequence[float]]) -> Polygon:
    """A polygon in the plane.

    Args:
        vertices: three points or more, m, in order, either way round; the last one is joined to the first.

    Raises:
        InvalidInput: not points in the plane, fewer than three, a vertex that is given twice, or edges that cross or touch.
    """
    where, path = "obstacle 'polygon', vertices", ("vertices",)
    try:
        points = np.array(vertices, dtype=float)
    except (TypeError, ValueError):
        points = np.zeros(0)
    if points.ndim != 2 or points.shape[1] != 2 or not np.isfinite(points).all():
        raise InvalidInput([Fault(path, f"must be points of 2 finite numbers each, but are {shown(vertices)}", where)])
    if len(points) < 3:
        raise InvalidInput([Fault(path, f"must be at least 3, but are {len(points)}", where)])
    seen: dict[tuple[float, float], int] = {}
    for index, point in enumerate(map(tuple, points.tolist())):
        if point in seen:
            text = f"vertex {index} repeats vertex {seen[point]}, {list(point)}; give each once, the last is joined to the first"
            raise InvalidInput([Fault((*path, index), text, where)])
        seen[point] = index
    shape = shapely.Polygon(points)
    flat = np.linalg.matrix_rank(points - points[0]) < 2
    if flat or not shape.is_valid:
        text = "lie on one line, but must enclose something" if flat else _crossing(points)
        raise InvalidInput([Fault(path, text, where)])
    return Polygon(tuple((float(x), float(y)) for x, y in points))


def _crossing(points: np.ndarray) -> str:
    """Which edges of a polygon cross or touch."""
    edges = [shapely.LineString([a, b]) for a, b in zip(points, np.roll(points, -1, axis=0), strict=True)]
    count = len(edges)
    for first in range(count):
        for second in range(first + 1, count):
            shared = shapely.intersection(edges[first], edges[second])
            adjoining = (second - first) % count in {1, count - 1}
            if (not adjoining and not shared.is_empty) or (adjoining and shared.length > 0.0):
                return f"must be those of a polygon that does not cross itself, but edges {first} and {second} meet"
    return "must be those of a polygon that does not cross itself"


def _vector(value: Any, lengths: tuple[int, ...], name: str, where: str, faults: list[Fault]) -> tuple[float, ...]:
    try:
        array = np.array(value, dtype=float)
    except (TypeError, ValueError):
        array = np.zeros(0)
    if array.ndim != 1 or len(array) not in lengths or not np.isfinite(array).all():
        either = " or ".join(map(str, lengths))
        faults.append(Fault((name,), f"must be {either} finite numbers, but is {shown(value)}", f"{where}, {name}"))
        return ()
    return tuple(array.tolist())


def _number(value: Any, name: str, where: str, faults: list[Fault]) -> float:
    if isinstance(value, bool) or not isinstance(value, (int, float, np.floating, np.integer)) or not math.isfinite(value) or value <= 0:
        faults.append(Fault((name,), f"must be a positive finite number, but is {shown(value)}", f"{where}, {name}"))
        return 1.0
    return float(value)


@dataclass(frozen=True)
class Map:
    """Obstacles as arrays of convex parts, in this order: P₁ discs, P₂ boxes, P₃ edges of polygons.

    Attributes:
        dimension: d.
        centers: (P₁, d).
        radii: (P₁,).
        lows: (P₂, d).
        highs: (P₂, d).
        begins: (P₃, 2) of edges.
        ends: (P₃, 2).
        polygons: edges of each polygon, as (first, one past the last).
    """

    dimension: int
    centers: np.ndarray
    radii: np.ndarray
    lows: np.ndarray
    highs: np.ndarray
    begins: np.ndarray
    ends: np.ndarray
    polygons: tuple[tuple[int, int], ...]

    @property
    def count(self) -> int:
        """How many parts there are."""
        return len(self.radii) + len(self.lows) + len(self.begins)

    def distances(self, points: Array) -> Array:
        """(N, P) signed distance from points (N, d) to each part; an edge has no inside."""
        point = points[:, None]
        rounds = jnp.linalg.norm(point - jnp.asarray(self.centers)[None], axis=2) - jnp.asarray(self.radii)[None]
        outside = jnp.maximum(jnp.asarray(self.lows)[None] - point, point - jnp.asarray(self.highs)[None])
        squared = jnp.sum(jnp.maximum(outside, 0.0) ** 2, axis=2)
        out = squared > 0.0  # the root has no slope at 0
        boxes = jnp.where(out, jnp.sqrt(jnp.where(out, squared, 1.0)), jnp.max(outside, axis=2, initial=-jnp.inf))
        parts = [rounds, boxes]
        if len(self.begins):
            parts.append(jnp.linalg.norm(point - self._on_edges(point, jnp.arange(len(self.begins))[None]), axis=2))
        return jnp.concatenate(parts, axis=1)

    def signed_distance(self, points: Array) -> Array:
        """(N,) the distance from points (N, d) to the nearest obstacle, negative inside one, infinite where there is none.

        Its gradient is that of JAX: the unit vector away from the nearest point. Inside polygons are points round which the edges wind.
        """
        distances = self.distances(points)
        whole = len(self.radii) + len(self.lows)
        least = jnp.min(distances[:, :whole], axis=1, initial=jnp.inf)
        for first, last in self.polygons:
            edge = jnp.min(distances[:, whole + first : whole + last], axis=1)
            least = jnp.minimum(least, jnp.where(self._inside(points, first, last), -edge, edge))
        return least

    def closest(self, start: Array, stop: Array, index: Array) -> tuple[Array, Array]:
        """(N, k, d) the closest points of the segments [start, stop], (N, d) each, and of their parts (N, k); the second is on the part's
        surface. The distance to a convex set is convex along the segment, so that halving finds its least."""
        begin, way = start[:, None], (stop - start)[:, None]
        if stop is start:
            own = jnp.broadcast_to(begin, (*index.shape, start.shape[1]))
            return own, self._nearest_on(own, index)
        low, high = jnp.zeros(index.shape), jnp.ones(index.shape)

        def halve(_: int, ends: tuple[Array, Array]) -> tuple[Array, Array]:
            low, high = ends
            middle = 0.5 * (low + high)
            point = begin + middle[..., None] * way
            rising = jnp.sum((point - self._nearest_on(point, index)) * way, axis=2) > 0.0
            return jnp.where(rising, low, middle), jnp.where(rising, middle, high)

        low, high = jax.lax.fori_loop(0, HALVINGS, halve, (low, high))
        best = jnp.where(low == 0.0, low, high)  # an end that was never left is exact
        own = begin + best[..., None] * way
        return own, self._nearest_on(own, index)

    def _nearest_on(self, points: Array, index: Array) -> Array:
        """(N, k, d) the nearest point of part `index`, (N, k), to each of the points (N, k, d)."""
        rounds, boxes, edges = len(self.radii), len(self.lows), len(self.begins)
        nearest = points
        if rounds:
            which = jnp.clip(index, 0, rounds - 1)
            away = points - jnp.asarray(self.centers)[which]
            length = jnp.linalg.norm(away, axis=2)
            scale = jnp.asarray(self.radii)[which] / jnp.where(length > 0.0, length, 1.0)
            inside = length < jnp.asarray(self.radii)[which]
            surface = points - away * (1.0 - jnp.where(inside, 1.0, scale))[..., None]
            nearest = jnp.where((index < rounds)[..., None], surface, nearest)
        if boxes:
            which = jnp.clip(index - rounds, 0, boxes - 1)
            clipped = jnp.clip(points, jnp.asarray(self.lows)[which], jnp.asarray(self.highs)[which])
            nearest = jnp.where(((index >= rounds) & (index < rounds + boxes))[..., None], clipped, nearest)
        if edges:
            which = jnp.clip(index - rounds - boxes, 0, edges - 1)
            nearest = jnp.where((index >= rounds + boxes)[..., None], self._on_edges(points, which), nearest)
        return nearest

    def _on_edges(self, points: Array, index: Array) -> Array:
        begin = jnp.asarray(self.begins)[index]
        way = jnp.asarray(self.ends)[index] - begin
        part = jnp.sum((points - begin) * way, axis=2) / jnp.sum(way**2, axis=2)
        return begin + jnp.clip(part, 0.0, 1.0)[..., None] * way

    def _inside(self, points: Array, first: int, last: int) -> Array:
        """(N,) whether a ray to the right crosses the edges an odd number of times."""
        x, y = points[:, :1], points[:, 1:2]
        a, b = jnp.asarray(self.begins[first:last]), jnp.asarray(self.ends[first:last])
        crosses = (a[:, 1][None] > y) != (b[:, 1][None] > y)
        height = b[:, 1] - a[:, 1]
        at = a[:, 0][None] + (y - a[:, 1][None]) * ((b[:, 0] - a[:, 0]) / jnp.where(height == 0.0, 1.0, height))[None]
        return jnp.sum(crosses & (x < at), axis=1) % 2 == 1


def map_of(obstacles: Sequence[Obstacle], dimension: int) -> Map:
    """The map of some obstacles in a space of so many dimensions.

    Raises:
        InvalidInput: an obstacle of another dimension, or something that is none; one line each.
    """
    faults = []
    for index, each in enumerate(obstacles):
        if not isinstance(each, (Disc, Box, Polygon)):
            text = f"must be made by disc, box or polygon, but is {shown(each)}"
            faults.append(Fault(("obstacles", index), text, f"obstacle {index}"))
        elif each.dimension != dimension:
            kind = type(each).__name__.lower()
            text = f"lies in {each.dimension} dimensions, but the team in {dimension}"
            if isinstance(each, Polygon):
                text += "; in space there are discs (balls) and boxes"
            faults.append(Fault(("obstacles", index), text, f"obstacle {index} ({kind})"))
    if faults:
        raise InvalidInput(faults)
    discs = [each for each in obstacles if isinstance(each, Disc)]
    boxes = [each for each in obstacles if isinstance(each, Box)]
    corners = [np.array(each.vertices) for each in obstacles if isinstance(each, Polygon)]
    firsts = np.cumsum([0, *map(len, corners)]).tolist()
    rows = functools.partial(np.reshape, shape=(-1, dimension))
    return Map(
        dimension,
        rows(np.array([each.center for each in discs], dtype=float)),
        np.array([each.radius for each in discs], dtype=float),
        rows(np.array([each.low for each in boxes], dtype=float)),
        rows(np.array([each.high for each in boxes], dtype=float)),
        np.concatenate([np.zeros((0, 2)), *corners]),
        np.concatenate([np.zeros((0, 2)), *(np.roll(each, -1, axis=0) for each in corners)]),
        tuple(itertools.pairwise(firsts)),
    )


def _off(distance: float) -> str:
    return f"{distance:.4g} m" if distance > 0.0 else "inside one"


@float64
def start_faults(names: Sequence[str], starts: np.ndarray, size: np.ndarray, obstacles: Map) -> list[Fault]:
    """What is wrong with starts (N, d) of bodies of these sizes (N,): within an obstacle, or on top of each other."""
    from scipy.spatial import cKDTree

    faults = []
    clearance = np.asarray(obstacles.signed_distance(jnp.asarray(starts))) - size
    for index in np.flatnonzero(clearance < 0.0).tolist():
        off = _off(clearance[index] + size[index])
        text = f"start {starts[index].tolist()} must be {size[index]:g} m or more from every obstacle, but is {off}"
        faults.append(Fault(("agents", index, "start"), text, f"agent {names[index]!r}"))
    pairs = cKDTree(starts).query_pairs(2.0 * float(np.max(size, initial=0.0))) if len(starts) > 1 else set()
    for first, second in sorted(pairs):
        distance, least = float(np.linalg.norm(starts[first] - starts[second])), size[first] + size[second]
        if distance < least:
            text = f"start must be {least:g} m or more from that of agent {names[first]!r}, but is {distance:.4g} m: their bodies overlap"
            faults.append(Fault(("agents", int(second), "start"), text, f"agent {names[second]!r}"))
    return faults
