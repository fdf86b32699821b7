"""Distributed safety filter: each robot stays on its side of a plane between itself and each nearby robot or obstacle.

Each robot i computes its filter alone, from its measurements. `place` is its position; `stop` is where it comes to rest if it halts now.
For each neighbour j, s_i and s_j are the closest points of the two segments [place, stop], n = (s_i − s_j)/‖s_i − s_j‖, and the gap is
g = ‖s_i − s_j‖ − (size_i + size_j). For each obstacle, s_j is the point of the obstacle that is closest to the robot's segment. The filter
chooses the reachable velocity nearest to the wished one for which the next segment [place, stop] stays in

    n·x ≥ n·s_i − share·g/2   (neighbours: each robot uses half)    n·x ≥ n·s_i − share·g   (obstacles)

The command is then checked with the model's own step. If there is no such velocity, or the check fails, the robot halts. The theorem, its
conditions and its proof are in docs/robots.md.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from consat.numerics import add_up
from consat.robots.model import Model, along, dot, shortened, squared
from consat.robots.neighbours import Near
from consat.robots.obstacles import Map

ROUNDING = 1e-9
"""Tolerance of a row, m/s, and of the check of a step, m. The addition `HAIR` to the radius covers it."""
HAIR = 1e-6
"""Addition to each body's radius against rounding, m."""
FLAT = 1e-12
"""Length of a projected normal below which a row counts as constant: no reachable velocity changes its value."""
VOID = -1e9
"""Right-hand side of an unused row, m/s, or of an unused plane, m: it never binds."""
TINY = 1e-18
"""Squared length below which a segment counts as a point, m²."""


class Planes(NamedTuple):
    """Half-spaces n·x ≥ least in which the next segment [place, stop] of each robot must lie.

    Attributes:
        normals: (N, k, d) unit vectors, towards the robot.
        least: (N, k) smallest allowed n·x, m; `VOID` where there is no plane.
        slack: (N,) largest distance that a robot may move in a step and the halt after it, m. It keeps robots clear of all without a plane.
    """

    normals: Array
    least: Array
    slack: Array


def steered(model: Model[Any], state: Any, wish: Array, straight: Array, planes: Planes, dt: float) -> tuple[Array, Array, Array]:
    """The commands nearest to wished velocities that keep every robot on its side of its planes.

    A robot halts where there is no such command, or where the model's own step leaves the planes. Also finds the velocity nearest to
    `straight` within the planes, without limits of acceleration: solved with the first problem as one of 2 N robots, which halves the size
    of the compiled program.

    Args:
        model: model of the robots.
        state: state of the N robots.
        wish: (N, d) wished velocity, m/s.
        straight: (N, d) second wished velocity, m/s; its speed is the limit of the second problem.
        planes: planes from `neighbour_planes` and `obstacle_planes`, combined by `joined`.
        dt: duration of the command, s.

    Returns:
        (N, m) commands, (N,) whether the robot moves on, and (N, d) the velocity nearest to `straight`, m/s; 0 if there is none.
    """
    count, (center, radius) = len(wish), model.reach(state, dt)
    limits = model.rows(state, planes.normals, planes.least, dt)
    wishes = jnp.concatenate([shortened(wish, model.bounded(planes.slack, dt)) - center, straight])
    normals = jnp.concatenate([planes.normals, planes.normals])
    rows = jnp.concatenate([limits - along(planes.normals, center), limits])
    found, there = nearest(wishes, normals, rows, jnp.concatenate([radius, jnp.linalg.norm(straight, axis=1)]))
    command = model.command(state, center + found[:count], dt)
    kept = jnp.all(model.lowest(state, command, planes.normals, dt) >= planes.least - ROUNDING, axis=1)
    moves = there[:count] & kept & (model.farthest(state, command, dt) <= planes.slack + ROUNDING)
    return jnp.where(moves[:, None], command, model.halt(state, dt)), moves, found[count:]


def neighbour_planes(place: Array, stop: Array | None, size: Array, near: Near, share: float = 1.0, *, explained: float = np.inf) -> Planes:
    """The planes between robots, from measured positions.

    Args:
        place: (N, d) measured positions, m.
        stop: (N, d) where each robot comes to rest if it halts now, m; None if all robots halt at once.
        size: (N,) radius that each robot keeps free, m.
        near: neighbours of each robot, as indices into `place`.
        share: fraction of the gap that two robots together may use up in a step, in (0, 1].
        explained: largest overlap that noise alone can explain, m. A larger overlap, which the theorem excludes, may be impossible to
            remove in one step. The plane then only keeps the robot from coming nearer.

    Returns:
        one plane for each neighbour. The slack keeps robots clear of those beyond `near.beyond`.
    """
    there = near.who < len(place)
    index = jnp.minimum(near.who, len(place) - 1)
    own, other = place[:, None], place[index]
    if stop is not None:
        own, other = _closest(own, stop[:, None] - own, other, stop[index] - other)
    apart = own - other
    distance = jnp.sqrt(squared(apart))
    normals = apart / jnp.where(distance > 0.0, distance, 1.0)[..., None]
    gap = _explained(distance - size[:, None] - size[index], explained)
    least = dot(normals, own) - 0.5 * share * gap
    length = jnp.zeros_like(size) if stop is None else jnp.sqrt(squared(stop - place))
    beyond = near.beyond - length - jnp.max(length, initial=0.0) - size - jnp.max(size, initial=0.0)
    return Planes(normals, jnp.where(there, least, VOID), jnp.maximum(0.5 * share * beyond, 0.0))


def obstacle_planes(
    place: Array, stop: Array | None, size: Array, obstacles: Map, seen: int, *, share: float = 1.0, explained: float = np.inf
) -> Planes:
    """The planes between each robot and the nearest convex parts of obstacles.

    Args:
        place: as in `neighbour_planes`.
        stop: as in `neighbour_planes`.
        size: as in `neighbour_planes`.
        obstacles: map of the obstacles.
        seen: number of parts with a plane. The slack keeps robots clear of the others.
        share: fraction of the gap that a robot may use up in a step, in (0, 1].
        explained: as in `neighbour_planes`.
    """
    distance = obstacles.distances(place) - size[:, None]
    length = jnp.zeros_like(size) if stop is None else jnp.sqrt(squared(stop - place))
    count = distance.shape[1]
    seen = min(seen, count)
    index = jnp.argsort(distance, axis=1)
    beyond = jnp.take_along_axis(distance, index[:, seen : seen + 1], axis=1)[:, 0] if count > seen else jnp.full_like(size, jnp.inf)
    own, other = obstacles.closest(place, place if stop is None else stop, index[:, :seen])
    apart = own - other
    gap = jnp.sqrt(squared(apart))
    normals = apart / jnp.where(gap > 0.0, gap, 1.0)[..., None]
    least = dot(normals, own) - share * _explained(gap - size[:, None], explained)
    return Planes(normals, least, jnp.maximum(share * (beyond - length), 0.0))


def joined(first: Planes, second: Planes) -> Planes:
    """The planes of both sets, with the smaller slack."""
    return Planes(
        jnp.concatenate([first.normals, second.normals], axis=1),
        jnp.concatenate([first.least, second.least], axis=1),
        jnp.minimum(first.slack, second.slack),
    )


def margin(model: Model[Any], count: int, dt: float, noise: float, share: float = 1.0) -> float:
    """Addition to every body's radius, m, for position errors up to `noise`, m. It is `HAIR` + μ, derived in docs/robots.md.

    Args:
        model: model of the robots.
        count: number of robots, N.
        dt: duration of a command, s.
        noise: largest error of a measured position, m.
        share: as in `neighbour_planes`.
    """
    size, pace = np.asarray(model.size(count, dt)), np.asarray(model.pace(count))
    return HAIR + noise * (1.0 + np.sqrt(2.0) * pace.max() * dt / (share * size.min()))


def _explained(gap: Array, explained: float) -> Array:
    return jnp.where(gap < -explained, 0.0, gap)


def _divisor(value: Array) -> Array:
    return jnp.where(value > TINY, value, 1.0)


def _closest(own: Array, along_own: Array, other: Array, along_other: Array) -> tuple[Array, Array]:
    """The closest points of two segments, each a start and a vector to its end, (…, d); Ericson, Real-Time Collision Detection, 5.1.9."""
    apart = own - other
    a, e, f = squared(along_own), squared(along_other), dot(along_other, apart)
    b, c = dot(along_own, along_other), dot(along_own, apart)
    a, e = jnp.broadcast_to(a, b.shape), jnp.broadcast_to(e, b.shape)
    across = a * e - b * b
    s = jnp.where(across > TINY * a * e, jnp.clip((b * f - c * e) / _divisor(across), 0.0, 1.0), 0.0)
    t = jnp.where(e > TINY, jnp.clip((b * s + f) / _divisor(e), 0.0, 1.0), 0.0)
    s = jnp.where(a > TINY, jnp.clip((b * t - c) / _divisor(a), 0.0, 1.0), 0.0)
    t = jnp.where(e > TINY, jnp.clip((b * s + f) / _divisor(e), 0.0, 1.0), 0.0)
    return own + s[..., None] * along_own, other + t[..., None] * along_other


def nearest(wish: Array, normals: Array, least: Array, radius: Array) -> tuple[Array, Array]:
    """For each of N robots, the velocity u nearest to `wish` with normals·u ≥ least and ‖u‖ ≤ radius. Exact, for d = 1, 2, 3.

    The rows are added one by one. If the best velocity so far satisfies the next row, it stays. Else the new best lies on the plane of that
    row, where the problem has one dimension less (Seidel's algorithm, which ORCA uses for its linear programs).

    Args:
        wish: (N, d) wished velocity, m/s.
        normals: (N, k, d) unit vectors.
        least: (N, k) right-hand sides, m/s; `VOID` or less for an unused row.
        radius: (N,) largest speed, m/s.

    Returns:
        (N, d) velocities, and (N,) whether there is a solution; the velocity is 0 where there is none.
    """
    rows = jnp.moveaxis(normals, (0, 1, 2), (2, 1, 0))  # robots on the last axis: vectorised operations read contiguous memory
    point, there = _nearest(wish.T, rows, jnp.maximum(least, VOID).T, radius)
    return jnp.where(there[None], point, 0.0).T, there


def _nearest(wish: Array, normals: Array, least: Array, radius: Array) -> tuple[Array, Array]:
    """As `nearest`, with robots on the last axes: wish (d, …), normals (d, k, …) of any length, least (k, …), radius (…)."""
    if len(wish) == 1:
        return _on_a_line(wish[0], normals[0], least, radius)
    length = jnp.sqrt(add_up(normals**2))
    flat = length < FLAT
    there = ~jnp.any(flat & (least > ROUNDING), axis=0)
    scale = 1.0 / jnp.where(flat, 1.0, length)
    normals, least = jax.lax.optimization_barrier((normals * scale[None], jnp.where(flat, VOID, least * scale)))

    count = len(least)
    foot, axes = normals * least[None], _axes(normals)  # the plane of each row: its point nearest to 0, and vectors that span it
    order = jnp.arange(count)
    before = (order[:, None] < order[None]).reshape(
        count, count, *(1,) * radius.ndim
    )  # on the plane of a row, only the rows before it count
    left = radius[None] ** 2 - least**2
    inner, fits = _nearest(
        jnp.stack([add_up(axis * wish[:, None]) for axis in axes]),
        jnp.stack([add_up(axis[:, None] * normals[:, :, None]) for axis in axes]),
        jnp.where(before, least[:, None] - add_up(foot[:, None] * normals[:, :, None]), VOID),
        jnp.sqrt(jnp.maximum(left, 0.0)),
    )
    inner, fits = jax.lax.optimization_barrier((inner, fits))
    best = foot + add_up([axis * part[None] for axis, part in zip(axes, inner, strict=True)])
    fits = fits & (left >= 0.0)
    size = jnp.sqrt(add_up(wish**2))
    point = wish * jnp.where(size > radius, radius / jnp.where(size > 0.0, size, 1.0), 1.0)[None]
    for row in range(count):
        kept = add_up(normals[:, row] * point) >= least[row]
        point, there = jnp.where(kept[None], point, best[:, row]), there & (kept | fits[row])
    return point, there


def _on_a_line(wish: Array, slopes: Array, least: Array, radius: Array) -> tuple[Array, Array]:
    """The problem in one dimension: slopes (k, …)·u ≥ least is an interval of u."""
    flat = jnp.abs(slopes) < FLAT
    ends = least / jnp.where(flat, 1.0, slopes)
    low = jnp.max(jnp.where(flat | (slopes < 0.0), -jnp.inf, ends), axis=0, initial=-jnp.inf)
    high = jnp.min(jnp.where(flat | (slopes > 0.0), jnp.inf, ends), axis=0, initial=jnp.inf)
    low, high = jnp.maximum(low, -radius), jnp.minimum(high, radius)
    there = (low <= high + ROUNDING) & ~jnp.any(flat & (least > ROUNDING), axis=0)
    return jnp.where(low <= high, jnp.clip(wish, low, high), 0.5 * (low + high))[None], there


def _axes(normal: Array) -> list[Array]:
    """d − 1 unit vectors (d, …) that span the plane perpendicular to `normal`, (d, …)."""
    if len(normal) == 2:
        return [jnp.stack([-normal[1], normal[0]])]
    x, y, z = normal
    sign = jnp.where(z < 0.0, -1.0, 1.0)  # Duff et al., Building an Orthonormal Basis, Revisited (2017)
    a = -1.0 / (sign + z)
    b = x * y * a
    return [jnp.stack([1.0 + sign * x * x * a, sign * b, -sign * x]), jnp.stack([b, sign + y * y * a, -y])]
