"""Obstacles: a public map of discs, boxes and polygons, split into convex parts with nearest points in closed form.

The parts of a polygon are its edges. A robot that starts outside and keeps its distance from every edge stays outside, whether the polygon
is convex or not.
"""

from __future__ import annotations

import functools
import itertools
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar, TypeAlias

import jax
import jax.numpy as jnp
import numpy as np
import shapely
from jax import Array

from consat.errors import Fault, InvalidInput, shown
from consat.numerics import float64

HALVINGS = 40
"""Bisection steps for the point of a robot's segment that is nearest to a part. The error is about 1e-12 of the segment's length."""


@dataclass(frozen=True)
class Disc:
    """A disc, or a ball in space; see `disc`."""

    center: tuple[float, ...]
    radius: float

    @property
    def dimension(self) -> int:
        return len(self.center)


@dataclass(frozen=True)
class Box:
    """An axis-aligned box; see `box`."""

    low: tuple[float, ...]
    high: tuple[float, ...]

    @property
    def dimension(self) -> int:
        return len(self.low)


@dataclass(frozen=True)
class Polygon:
    """A simple polygon, clockwise or counter-clockwise; see `polygon`."""

    vertices: tuple[tuple[float, float], ...]
    dimension: ClassVar[int] = 2


Obstacle: TypeAlias = Disc | Box | Polygon
"""An obstacle. Its `dimension` is that of the space in which it lies, 2 or 3. Use `disc`, `box` or `polygon` to make one."""


def disc(center: Sequence[float], radius: float) -> Disc:
    """A disc in the plane, or a ball in space.

    Args:
        center: (2,) or (3,) centre, m.
        radius: radius, m, positive.

    Raises:
        InvalidInput: one line for each argument that cannot be used.
    """
    faults: list[Fault] = []
    place = _vector(center, "center", "obstacle 'disc'", faults)
    size = _number(radius, "radius", "obstacle 'disc'", faults)
    if faults:
        raise InvalidInput(faults)
    return Disc(place, size)


def box(low: Sequence[float], high: Sequence[float]) -> Box:
    """An axis-aligned box between two corners.

    Args:
        low: (2,) or (3,) lower corner, m.
        high: upper corner, m, above `low` on every axis.

    Raises:
        InvalidInput: one line for each argument that cannot be used.
    """
    where, faults = "obstacle 'box'", list[Fault]()
    below, above = _vector(low, "low", where, faults), _vector(high, "high", where, faults)
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
        vertices: (V, 2) at least three points, m, in order, clockwise or counter-clockwise. The last is connected to the first.

    Raises:
        InvalidInput: the vertices are not points in the plane, are fewer than three, lie on a line or repeat, or edges cross or touch.
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
    """Text of the fault that names two edges which cross or touch."""
    edges = [shapely.LineString([a, b]) for a, b in zip(points, np.roll(points, -1, axis=0), strict=True)]
    for first, second in itertools.combinations(range(len(edges)), 2):
        shared = shapely.intersection(edges[first], edges[second])
        adjoining = second - first in {1, len(edges) - 1}
        if shared.length > 0.0 if adjoining else not shared.is_empty:
            return f"must be those of a polygon that does not cross itself, but edges {first} and {second} meet"
    return "must be those of a polygon that does not cross itself"


def _vector(value: Any, name: str, where: str, faults: list[Fault]) -> tuple[float, ...]:
    try:
        array = np.array(value, dtype=float)
    except (TypeError, ValueError):
        array = np.zeros(0)
    if array.ndim != 1 or len(array) not in (2, 3) or not np.isfinite(array).all():
        faults.append(Fault((name,), f"must be 2 or 3 finite numbers, but is {shown(value)}", f"{where}, {name}"))
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
        dimension: dimension of space, d.
        centers: (P₁, d) centres of discs, m.
        radii: (P₁,) radii of discs, m.
        lows: (P₂, d) lower corners of boxes, m.
        highs: (P₂, d) upper corners of boxes, m.
        begins: (P₃, 2) first points of edges, m.
        ends: (P₃, 2) second points of edges, m.
        polygons: range of the edges of each polygon, as (first, one past the last).
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
        """Number of parts, P."""
        return len(self.radii) + len(self.lows) + len(self.begins)

    def distances(self, points: Array) -> Array:
        """(N, P) signed distance from points (N, d) to each part, m; negative inside discs and boxes. An edge has no inside."""
        point = points[:, None]
        rounds = jnp.linalg.norm(point - self.centers[None], axis=2) - self.radii[None]
        outside = jnp.maximum(self.lows[None] - point, point - self.highs[None])
        squared = jnp.sum(jnp.maximum(outside, 0.0) ** 2, axis=2)
        out = squared > 0.0  # the square root has no derivative at 0
        boxes = jnp.where(out, jnp.sqrt(jnp.where(out, squared, 1.0)), jnp.max(outside, axis=2, initial=-jnp.inf))
        parts = [rounds, boxes]
        if len(self.begins):
            parts.append(jnp.linalg.norm(point - self._on_edges(point, jnp.arange(len(self.begins))[None]), axis=2))
        return jnp.concatenate(parts, axis=1)

    def signed_distance(self, points: Array) -> Array:
        """(N,) signed distance from points (N, d) to the nearest obstacle, m; negative inside one, infinite without obstacles.

        JAX can differentiate it: the gradient is the unit vector away from the nearest point. The inside of a polygon follows the even-odd
        rule.
        """
        distances = self.distances(points)
        whole = len(self.radii) + len(self.lows)
        least = jnp.min(distances[:, :whole], axis=1, initial=jnp.inf)
        for first, last in self.polygons:
            edge = jnp.min(distances[:, whole + first : whole + last], axis=1)
            least = jnp.minimum(least, jnp.where(self._inside(points, first, last), -edge, edge))
        return least

    def closest(self, start: Array, stop: Array, index: Array) -> tuple[Array, Array]:
        """Closest points of the robots' segments and of parts.

        The distance to a convex part is convex along a segment, so bisection finds its minimum.

        Args:
            start: (N, d) start of each robot's segment.
            stop: (N, d) end of each robot's segment. The same object as `start` means that all segments are points.
            index: (N, k) the parts for each robot.

        Returns:
            (N, k, d) points on the segments, and (N, k, d) points on the surfaces of the parts.
        """
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
        best = jnp.where(low == 0.0, low, high)  # exact where the minimum is at an end of the segment
        own = begin + best[..., None] * way
        return own, self._nearest_on(own, index)

    def _nearest_on(self, points: Array, index: Array) -> Array:
        """(N, k, d) point of part `index`, (N, k), that is nearest to each of the points (N, k, d)."""
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
        """(N,) whether points are inside the polygon: a ray to the right crosses its edges `first` to `last` − 1 an odd number of times."""
        x, y = points[:, :1], points[:, 1:2]
        (left, low), (right, high) = self.begins[first:last].T[:, None], self.ends[first:last].T[:, None]
        crosses = (low > y) != (high > y)
        at = left + (y - low) * ((right - left) / np.where(high == low, 1.0, high - low))
        return jnp.sum(crosses & (x < at), axis=1) % 2 == 1


def map_of(obstacles: Sequence[Obstacle], dimension: int) -> Map:
    """Make the map of obstacles for a space of the given dimension.

    Raises:
        InvalidInput: an entry is not an obstacle, or has another dimension; one line each.
    """
    faults = []
    for index, each in enumerate(obstacles):
        if not isinstance(each, Obstacle):
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


@float64
def start_faults(names: Sequence[str], starts: np.ndarray, size: np.ndarray, obstacles: Map) -> list[Fault]:
    """Faults of start positions: too near an obstacle, or bodies that overlap.

    Args:
        names: ids of the N agents, for messages.
        starts: (N, d) start positions, m.
        size: (N,) radius that each robot keeps free, m.
        obstacles: map of the obstacles.
    """
    faults = []
    clearance = np.asarray(obstacles.signed_distance(jnp.asarray(starts))) - size
    for index in np.flatnonzero(clearance < 0.0).tolist():
        distance = clearance[index] + size[index]
        off = f"{distance:.4g} m" if distance > 0.0 else "inside one"
        text = f"start {starts[index].tolist()} must be {size[index]:g} m or more from every obstacle, but is {off}"
        faults.append(Fault(("agents", index, "start"), text, f"agent {names[index]!r}"))
    for first, second, distance in overlaps(starts, size):
        least = size[first] + size[second]
        text = f"start must be {least:g} m or more from that of agent {names[first]!r}, but is {distance:.4g} m: their bodies overlap"
        faults.append(Fault(("agents", second, "start"), text, f"agent {names[second]!r}"))
    return faults


def overlaps(places: np.ndarray, size: np.ndarray) -> Iterator[tuple[int, int, float]]:
    """Yield each pair of robots that overlap, and their distance, m. places: (N, d), m; size: (N,) radii, m."""
    from scipy.spatial import cKDTree

    for first, second in sorted(cKDTree(places).query_pairs(2.0 * size.max(initial=0.0))):
        distance = float(np.linalg.norm(places[first] - places[second]))
        if distance < size[first] + size[second]:
            yield int(first), int(second), distance
