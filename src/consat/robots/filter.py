"""The distributed safety filter: each robot keeps to its side of a plane between itself and everything that is near.

Each robot i, by itself, from what it measures: for each neighbour j the closest points of the two segments [place, stop], s_i and s_j, with
n = (s_i − s_j)/‖s_i − s_j‖ and the gap g = ‖s_i − s_j‖ − (size_i + size_j); for each obstacle the closest point of its own segment and of
the obstacle. The next velocity is the one nearest to the wish for which the next segment [place, stop] stays in

    n·x ≥ n·s_i − share·g/2   (neighbours; each gives half)        n·x ≥ n·s_i − share·g   (obstacles)

and which can be reached. What was found is checked against the model's own step; a robot for which it fails halts. The theorem, its
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
"""Of a row, m/s, and of a checked step, m. `HAIR` keeps it from adding up."""
HAIR = 1e-6
"""Added to each body's radius, m."""
FLAT = 1e-12
"""What a row is, per m/s, that no velocity within reach can change."""
VOID = -1e9
"""The right side of a row that never binds, m/s, and of a plane, m."""
TINY = 1e-18
"""Squared lengths, m², below which a segment is a point."""


class Planes(NamedTuple):
    """Half-spaces n·x ≥ least in which the next segment [place, stop] of each robot must lie.

    Attributes:
        normals: (N, k, d) unit vectors.
        least: (N, k), m; `VOID` where there is no plane.
        slack: (N,) how far from where it is a robot may come in a step and the halt after it, m, for the sake of all without a plane.
    """

    normals: Array
    least: Array
    slack: Array


def filtered(model: Model[Any], state: Any, wish: Array, planes: Planes, dt: float) -> tuple[Array, Array]:
    """The command nearest to a wished velocity that keeps every robot on its side of its planes.

    Args:
        model: of the robots.
        state: of N robots.
        wish: (N, d), m/s.
        planes: from `neighbour_planes` and `obstacle_planes`, `joined`.
        dt: how long the command is held, s.

    Returns:
        (N, m) the command, and (N,) whether it moves on; where not, it halts.
    """
    center, radius = model.reach(state, dt)
    rows = model.rows(state, planes.normals, planes.least, dt) - along(planes.normals, center)
    change, there = nearest(shortened(wish, model.bounded(planes.slack, dt)) - center, planes.normals, rows, radius)
    return _checked(model, state, center + change, there, planes, dt)


def steered(model: Model[Any], state: Any, wish: Array, straight: Array, planes: Planes, dt: float) -> tuple[Array, Array, Array]:
    """As `filtered`, and beside it, (N, d), the velocity nearest to another one, `straight`, (N, d), that the planes leave to a robot which
    could take up any speed at once. Both problems are solved as one, of 2 N robots: that halves what is compiled."""
    center, radius = model.reach(state, dt)
    limits = model.rows(state, planes.normals, planes.least, dt)
    wishes = jnp.concatenate([shortened(wish, model.bounded(planes.slack, dt)) - center, straight])
    normals = jnp.concatenate([planes.normals, planes.normals])
    rows = jnp.concatenate([limits - along(planes.normals, center), limits])
    found, there = nearest(wishes, normals, rows, jnp.concatenate([radius, jnp.linalg.norm(straight, axis=1)]))
    count = len(wish)
    return *_checked(model, state, center + found[:count], there[:count], planes, dt), found[count:]


def _checked(model: Model[Any], state: Any, velocity: Array, there: Array, planes: Planes, dt: float) -> tuple[Array, Array]:
    """The command for a velocity (N, d) if there is one, (N,), and if the model's own step keeps the planes; else a halt."""
    command = model.command(state, velocity, dt)
    kept = jnp.all(model.lowest(state, command, planes.normals, dt) >= planes.least - ROUNDING, axis=1)
    moves = there & kept & (model.farthest(state, command, dt) <= planes.slack + ROUNDING)
    return jnp.where(moves[:, None], command, model.halt(state, dt)), moves


def neighbour_planes(place: Array, stop: Array | None, size: Array, near: Near, share: float = 1.0, *, explained: float = np.inf) -> Planes:
    """The planes between robots, from positions that were measured.

    Args:
        place: (N, d).
        stop: (N, d) where each comes to rest if it halts now; None where all halt at once.
        size: (N,) the radius that each keeps.
        near: neighbours, in `place`.
        share: of the gap that two robots may use up together in a step.
        explained: how deep an overlap may seem by noise alone, m. Who overlaps by more, which the theorem excludes, need not make up for it
            at once, which may be out of reach, but comes no nearer.
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
    """The planes between robots and the `seen` convex parts of obstacles that are nearest; arguments as for `neighbour_planes`."""
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
    """Both sets of planes."""
    return Planes(
        jnp.concatenate([first.normals, second.normals], axis=1),
        jnp.concatenate([first.least, second.least], axis=1),
        jnp.minimum(first.slack, second.slack),
    )


def margin(model: Model[Any], count: int, dt: float, noise: float, share: float = 1.0) -> float:
    """What is added to every body's radius so that positions may be wrong by up to `noise`, m; see docs/robots.md."""
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
    """The velocity nearest to `wish` with normals·u ≥ least and ‖u‖ ≤ radius, of each of N robots; exact, in 1, 2 and 3 dimensions.

    One row after the other: as long as the best velocity for the rows so far fulfils the next row it stays, else the new best lies on that
    row's plane, where the same problem has one dimension less (Seidel's algorithm; ORCA solves its linear programs so).

    Args:
        wish: (N, d).
        normals: (N, k, d) unit vectors.
        least: (N, k); `VOID`, or less, for a row that does not count.
        radius: (N,).

    Returns:
        (N, d) the velocity, and (N,) whether there is one; 0 where there is none.
    """
    rows = jnp.moveaxis(normals, (0, 1, 2), (2, 1, 0))  # the robots last: what is computed of all at once lies side by side in memory
    point, there = _nearest(wish.T, rows, jnp.maximum(least, VOID).T, radius)
    return jnp.where(there[None], point, 0.0).T, there


def _nearest(wish: Array, normals: Array, least: Array, radius: Array) -> tuple[Array, Array]:
    """As `nearest`, for wish (d, …), normals (d, k, …) of any length, least (k, …), radius (…)."""
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
    before = (order[:, None] < order[None]).reshape(count, count, *(1,) * radius.ndim)  # on its plane, a row minds those before it
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
    """One dimension: slopes (k, …) times u ≥ least is an interval."""
    flat = jnp.abs(slopes) < FLAT
    ends = least / jnp.where(flat, 1.0, slopes)
    low = jnp.max(jnp.where(flat | (slopes < 0.0), -jnp.inf, ends), axis=0, initial=-jnp.inf)
    high = jnp.min(jnp.where(flat | (slopes > 0.0), jnp.inf, ends), axis=0, initial=jnp.inf)
    low, high = jnp.maximum(low, -radius), jnp.minimum(high, radius)
    there = (low <= high + ROUNDING) & ~jnp.any(flat & (least > ROUNDING), axis=0)
    return jnp.where(low <= high, jnp.clip(wish, low, high), 0.5 * (low + high))[None], there


def _axes(normal: Array) -> list[Array]:
    """Unit vectors (d, …) that span the plane across `normal`, (d, …)."""
    if len(normal) == 2:
        return [jnp.stack([-normal[1], normal[0]])]
    x, y, z = normal
    sign = jnp.where(z < 0.0, -1.0, 1.0)  # Duff et al., Building an Orthonormal Basis, Revisited (2017)
    a = -1.0 / (sign + z)
    b = x * y * a
    return [jnp.stack([1.0 + sign * x * x * a, sign * b, -sign * x]), jnp.stack([b, sign + y * y * a, -y])]
