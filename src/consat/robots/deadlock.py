"""Deadlock resolution: four rules that change a robot's wished velocity before the safety filter.

1. The wish bends around a neighbour that is ahead and coming closer, always to the same side (to the right in the plane).
2. While the filter refuses the straight way, the wish turns to that side, up to a right angle. A blocked ring becomes a roundabout.
3. While the filter allows the straight way, the wish turns back.
4. A robot that has arrived moves aside for a robot that has not.
"""

from __future__ import annotations

from dataclasses import dataclass

import jax.numpy as jnp
from jax import Array

from consat.robots.filter import Planes
from consat.robots.model import along, dot
from consat.robots.neighbours import Near


@dataclass(frozen=True)
class Rules:
    """Parameters of the rules. The values were tuned on circles and on random crowds (docs/benchmarks/robots.md).

    Attributes:
        bend: sideways part of the direction, relative to the part ahead, for a neighbour straight ahead at contact.
        reach: neighbours count up to the distance that a robot travels at top speed in this time, s.
        closing: fraction of a neighbour's weight that is proportional to the speed at which it comes closer, 0 to 1.
        refused: the straight way counts as refused if the filter leaves at most this fraction of the wished speed along it.
        up: rate at which a refused wish turns away, right angles per s.
        down: rate at which it turns back, right angles per s.
        aside: speed of an arrived robot away from a neighbour at contact, relative to its top speed.
    """

    bend: float = 1.5
    reach: float = 0.5
    closing: float = 0.7
    refused: float = 0.15
    up: float = 1.0
    down: float = 1.0
    aside: float = 1.0


@dataclass(frozen=True)
class Sight:
    """What N robots know of k neighbours each.

    Attributes:
        away: (N, k, d) unit vectors from the neighbours to the robot.
        gap: (N, k) distance between the kept discs along `away`, m; infinite where there is no neighbour.
        velocity: (N, k, d) velocities of the neighbours, m/s.
        underway: (N, k) whether the neighbour has not arrived yet.
    """

    away: Array
    gap: Array
    velocity: Array
    underway: Array


def sight(planes: Planes, place: Array, size: Array, velocity: Array, underway: Array, near: Near) -> Sight:
    """Collect what robots know of their neighbours.

    Args:
        planes: planes whose first columns are those of the neighbours, from `neighbour_planes`.
        place: (N, d) positions, m.
        size: (N,) radius that each robot keeps free, m.
        velocity: (N, d) velocities, m/s.
        underway: (N,) whether a robot has not arrived yet.
        near: neighbours of each robot.
    """
    there = near.who < len(place)
    index = jnp.minimum(near.who, len(place) - 1)
    normals = planes.normals[:, : near.who.shape[1]]
    gap = along(normals, place) - dot(normals, place[index]) - size[:, None] - size[index]
    return Sight(normals, jnp.where(there, gap, jnp.inf), velocity[index], underway[index] & there)


def bent(rules: Rules, ahead: Array, pace: Array, top: Array, *, underway: Array, blocked: Array, seen: Sight) -> Array:
    """(N, d) wished velocity after all rules, m/s.

    Args:
        rules: parameters of the rules.
        ahead: (N, d) unit vectors along the straight way.
        pace: (N,) wished speed, m/s.
        top: (N,) speed limit, m/s.
        underway: (N,) whether a robot has not arrived yet.
        blocked: (N,) angle to turn by, in right angles, 0 to 1, from `refused`.
        seen: the neighbours, from `sight`.
    """
    closeness = jnp.clip(1.0 - seen.gap / (rules.reach * top[:, None]), 0.0, 1.0)
    closing = jnp.clip(-dot((ahead * top[:, None])[:, None] - seen.velocity, seen.away) / top[:, None], 0.0, 1.0)
    closeness = closeness * (1.0 - rules.closing + rules.closing * closing)
    before = jnp.clip(-along(seen.away, ahead), 0.0, 1.0)
    round_ = jnp.sum((closeness * before)[..., None] * _quarter(seen.away, jnp.broadcast_to(ahead[:, None], seen.away.shape)), axis=1)
    way = ahead + rules.bend * round_
    way = way / jnp.maximum(jnp.linalg.norm(way, axis=1), 1e-9)[:, None]
    angle = (0.5 * jnp.pi * blocked)[:, None]
    way = (jnp.cos(angle) * way - jnp.sin(angle) * _quarter(way, way)) * pace[:, None]
    pushed = jnp.sum(jnp.where(seen.underway, closeness, 0.0)[..., None] * seen.away, axis=1)
    aside = ahead * pace[:, None] + rules.aside * top[:, None] * pushed
    return jnp.where(underway[:, None], way, aside)


def refused(rules: Rules, blocked: Array, ahead: Array, pace: Array, straight: Array, *, underway: Array, dt: float | Array) -> Array:
    """(N,) the angle `blocked` of rules 2 and 3 after `dt`, in right angles, 0 to 1.

    Args:
        rules: parameters of the rules.
        blocked: (N,) angle before.
        ahead: (N, d) unit vectors along the straight way.
        pace: (N,) wished speed, m/s.
        straight: (N, d) velocity nearest to the straight way that the filter allows, m/s.
        underway: (N,) whether a robot has not arrived yet.
        dt: time step, s.
    """
    stuck = underway & (jnp.sum(straight * ahead, axis=1) <= rules.refused * pace)
    return jnp.clip(blocked + dt * jnp.where(stuck, rules.up, -rules.down), 0.0, 1.0)


def _quarter(vectors: Array, ahead: Array) -> Array:
    """`vectors`, (…, d), turned by a right angle: counter-clockwise in the plane; zero on a line.

    In space they turn about the vertical axis, or about the first axis for robots that move steeply (`ahead`, (…, d)).
    """
    dimension = vectors.shape[-1]
    if dimension == 1:
        return jnp.zeros_like(vectors)
    if dimension == 2:
        return jnp.stack([-vectors[..., 1], vectors[..., 0]], axis=-1)
    x, y, z = vectors[..., 0], vectors[..., 1], vectors[..., 2]
    level = jnp.stack([-y, x, jnp.zeros_like(z)], axis=-1)
    steep = jnp.stack([jnp.zeros_like(x), -z, y], axis=-1)
    return jnp.where((jnp.abs(ahead[..., 2]) > 0.9)[..., None], steep, level)
