"""Path planning around obstacles, on the host, for each robot from the public map.

In the plane: a visibility graph between the corners of the obstacles, grown by the body's radius and a clearance (Lozano-Pérez and Wesley,
1979). It is built once for a map; a path is a shortest path in it. In space: a shortest path in a grid, whose waypoints are left out
where the straight way is clear. SciPy computes the shortest paths.
"""

from __future__ import annotations

import itertools
import math

import jax
import jax.numpy as jnp
import numpy as np
import shapely
from scipy.sparse import coo_array, csr_array
from scipy.sparse.csgraph import dijkstra

from consat.numerics import float64
from consat.robots.obstacles import Map

CLEARANCE = 0.25
"""Additional distance of planned paths from obstacles, relative to the size."""
CORNERS = 2
"""Segments that approximate a quarter circle of a grown obstacle's outline."""
CELLS = 40_000
"""Most cells of the grid in space, about."""
TOUCH = 0.999
"""Fraction of the size that a straight way must keep from obstacles. Below 1, a robot that slides along a wall still has a clear way."""
SAMPLES = 128
"""Number of samples of a straight way in space; of a long way, a multiple of it."""


class Planner:
    """Plans paths for bodies of one size on one map.

    Args:
        obstacles: map of the obstacles.
        size: radius that a robot keeps free, m.
    """

    def __init__(self, obstacles: Map, size: float) -> None:
        self._roads = _Roads(obstacles, size) if obstacles.dimension == 2 else _Grid(obstacles, size)

    def path(self, start: np.ndarray, goal: np.ndarray) -> np.ndarray:
        """(W, d) waypoints from a start, (d,), to a goal, (d,). The last waypoint is the goal.

        The path is the goal alone if the straight way is clear, or if there is no path. The safety filter prevents contact in both cases.
        """
        return self._roads.path(np.asarray(start, dtype=float), np.asarray(goal, dtype=float))

    def paths(self, starts: np.ndarray, goals: np.ndarray) -> np.ndarray:
        """(N, W, d) one `path` for each of N robots, padded with its goal. W is a power of 2, so that few programs are compiled."""
        found = [self.path(start, goal) for start, goal in zip(starts, goals, strict=True)]
        width = 1 << max(max(map(len, found), default=1) - 1, 0).bit_length()
        return np.stack([np.concatenate([path, np.repeat(path[-1:], width - len(path), axis=0)]) for path in found])

    def seen(self, starts: np.ndarray, goals: np.ndarray) -> np.ndarray:
        """(N,) whether the straight way from each start, (N, d), to its goal, (N, d), is clear of obstacles."""
        return self._roads.seen(starts, goals)

    def stale(self, paths: np.ndarray, goals: np.ndarray, tolerance: float) -> bool:
        """Whether any goal, (N, d), is farther than `tolerance`, m, from the end of its path, (N, W, d)."""
        return bool(np.any(np.linalg.norm(paths[:, -1] - goals, axis=1) > tolerance))


class _Roads:
    """Visibility graph of the corners of grown obstacles in the plane."""

    def __init__(self, obstacles: Map, size: float) -> None:
        clearance = CLEARANCE * size
        shapes = [
            shapely.Point(*center).buffer(radius, quad_segs=16) for center, radius in zip(obstacles.centers, obstacles.radii, strict=True)
        ]
        shapes += [shapely.box(*low, *high) for low, high in zip(obstacles.lows, obstacles.highs, strict=True)]
        shapes += [shapely.Polygon(obstacles.begins[first:last]) for first, last in obstacles.polygons]
        solid = shapely.union_all(shapes)
        self.walls = shapely.buffer(solid, TOUCH * size, quad_segs=16)
        # The chords of a coarse circle cut inside it. A larger radius keeps them outside the true circle.
        reach = (size + clearance) / math.cos(math.pi / (4 * CORNERS))
        grown = shapely.buffer(solid, reach, quad_segs=CORNERS).simplify(0.1 * clearance)
        rings = shapely.get_rings(shapely.get_parts(grown))
        corners = np.concatenate([np.zeros((0, 2)), *(shapely.get_coordinates(ring)[:-1] for ring in rings)])
        shapely.prepare(self.walls)
        self.corners = corners[~shapely.intersects_xy(self.walls, *corners.T)] if len(corners) else corners
        first, second = np.triu_indices(len(self.corners), 1)
        seen = self._clear(self.corners[first], self.corners[second])
        first, second = first[seen], second[seen]
        length = np.linalg.norm(self.corners[first] - self.corners[second], axis=1)
        count = len(self.corners)
        self.graph = csr_array(coo_array((np.r_[length, length], (np.r_[first, second], np.r_[second, first])), shape=(count, count)))

    def _clear(self, first: np.ndarray, second: np.ndarray) -> np.ndarray:
        """(M,) whether the straight way from each point (M, 2) to another (M, 2) is clear of all walls."""
        if len(first) == 0:
            return np.zeros(0, dtype=bool)
        return ~shapely.intersects(self.walls, shapely.linestrings(np.stack([first, second], axis=1)))

    def seen(self, starts: np.ndarray, goals: np.ndarray) -> np.ndarray:
        outside = [[self._outside(point) for point in points] for points in (starts, goals)]
        return self._clear(*(np.reshape(points, (-1, 2)) for points in outside))

    def path(self, start: np.ndarray, goal: np.ndarray) -> np.ndarray:
        start_out, goal_out = self._outside(start), self._outside(goal)
        if len(self.corners) == 0 or self._clear(start_out[None], goal_out[None])[0]:
            return goal[None]
        near_start, near_goal = self._seen_from(start_out), self._seen_from(goal_out)
        if not (np.isfinite(near_start).any() and np.isfinite(near_goal).any()):
            return goal[None]
        rest, following = self._to(near_goal)
        total = near_start + rest
        corner = int(np.argmin(total))
        if not np.isfinite(total[corner]):
            return goal[None]
        way = []
        while corner >= 0:
            way.append(self.corners[corner])
            corner = int(following[corner])
        return np.array([*way, goal])

    def _outside(self, point: np.ndarray) -> np.ndarray:
        """The point itself, or the nearest point outside the grown obstacles if it is within one."""
        place = shapely.Point(point)
        if not shapely.intersects(self.walls, place):
            return point
        boundary = shapely.boundary(self.walls)
        nearest = np.asarray(boundary.interpolate(boundary.project(place)).coords[0])
        away = nearest - point
        return nearest + 1e-6 * away / max(float(np.linalg.norm(away)), 1e-12)

    def _seen_from(self, point: np.ndarray) -> np.ndarray:
        """(V,) distance to each corner; infinite if the straight way to it is not clear."""
        seen = self._clear(np.broadcast_to(point, self.corners.shape), self.corners)
        return np.where(seen, np.linalg.norm(self.corners - point, axis=1), np.inf)

    def _to(self, ends: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Shortest ways from all corners to the goal; `ends`: (V,) length of the last leg from each corner, infinite if it is not clear.

        Returns:
            (V,) length of the shortest way from each corner, and (V,) the next corner on it, −1 if the goal is next.
        """
        count = len(ends)
        last = np.flatnonzero(np.isfinite(ends))
        whole = self.graph.tocoo()
        rows, columns = np.r_[whole.row, np.full(len(last), count)], np.r_[whole.col, last]
        graph = csr_array(coo_array((np.r_[whole.data, ends[last]], (rows, columns)), shape=(count + 1, count + 1)))
        rest, before = dijkstra(graph, indices=count, return_predecessors=True)
        return rest[:count], np.where(before[:count] == count, -1, before[:count])


class _Grid:
    """Grid graph in space. Each free node is connected to its free neighbours among the 26 around it."""

    def __init__(self, obstacles: Map, size: float) -> None:
        kept = (1.0 + CLEARANCE) * size
        self.signed_distance, self.size = jax.jit(obstacles.signed_distance), size
        corners = np.concatenate(
            [obstacles.centers - obstacles.radii[:, None], obstacles.centers + obstacles.radii[:, None], obstacles.lows, obstacles.highs]
        )
        if len(corners) == 0:
            self.nodes = np.zeros((0, 3))
            return
        around = 3.0 * kept
        low, high = corners.min(axis=0) - around, corners.max(axis=0) + around
        self.step = max(float(np.prod(high - low) / CELLS) ** (1 / 3), 0.5 * size)
        axes = [np.arange(a, b + self.step, self.step) for a, b in zip(low, high, strict=True)]
        shape = tuple(map(len, axes))
        nodes = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
        free = self._distance(nodes) > kept
        number = np.arange(len(nodes)).reshape(shape)
        rows, columns = [], []
        for move in itertools.product((-1, 0, 1), repeat=3):
            if move > (0, 0, 0):
                ahead = tuple(slice(max(m, 0), shape[axis] + min(m, 0)) for axis, m in enumerate(move))
                behind = tuple(slice(max(-m, 0), shape[axis] + min(-m, 0)) for axis, m in enumerate(move))
                rows.append(number[behind].ravel())
                columns.append(number[ahead].ravel())
        first, second = np.concatenate(rows), np.concatenate(columns)
        fine = free[first] & free[second]
        first, second = first[fine], second[fine]
        length = np.linalg.norm(nodes[first] - nodes[second], axis=1)
        self.graph = csr_array(coo_array((length, (first, second)), shape=(len(nodes), len(nodes))))
        self.nodes, self.free = nodes, np.flatnonzero(free)

    @float64
    def _distance(self, points: np.ndarray) -> np.ndarray:
        return np.asarray(self.signed_distance(jnp.asarray(points)))

    def _clear(self, first: np.ndarray, second: np.ndarray) -> bool:
        """Whether the straight way is clear for a body.

        Samples are at most a quarter of the size apart, so that the true smallest distance is at most an eighth of the size smaller than
        the sampled one.
        """
        length = float(np.linalg.norm(second - first))
        samples = SAMPLES * math.ceil(
            (length / (0.25 * self.size) + 1.0) / SAMPLES
        )  # few distinct numbers, so that few programs are compiled
        part = np.linspace(0.0, 1.0, samples)[:, None]
        return bool(np.all(self._distance(first + part * (second - first)) > 1.1 * self.size))

    def seen(self, starts: np.ndarray, goals: np.ndarray) -> np.ndarray:
        return np.array([self._clear(start, goal) for start, goal in zip(starts, goals, strict=True)], dtype=bool)

    def path(self, start: np.ndarray, goal: np.ndarray) -> np.ndarray:
        if len(self.nodes) == 0 or self._clear(start, goal):
            return goal[None]
        ends = [int(self.free[np.argmin(np.linalg.norm(self.nodes[self.free] - point, axis=1))]) for point in (start, goal)]
        rest, before = dijkstra(self.graph, directed=False, indices=ends[1], return_predecessors=True)
        if not np.isfinite(rest[ends[0]]):
            return goal[None]
        way, node = [start], ends[0]
        while node != ends[1]:
            way.append(self.nodes[node])
            node = int(before[node])
        way += [self.nodes[node], goal]
        straight, here = [], 0
        while here < len(way) - 1:
            ahead = next((index for index in range(len(way) - 1, here, -1) if self._clear(way[here], way[index])), here + 1)
            straight.append(way[ahead])
            here = ahead
        return np.array(straight)
