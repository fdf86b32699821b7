"""Ways out of deadlock: four rules by which each robot bends its wish before the safety filter, from what it sees.

* Circulation: the wish bends round whoever is ahead and closing in, always to the same side.
* While the filter refuses the straight way the wish turns away, up to a right angle; a blocked ring becomes a roundabout.
* While it doesn't, the wish turns back.
* Who has arrived steps aside for who hasn't.
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
    """How strong each rule is. The values were tuned on circles and on random crowds (docs/benchmarks/robots.md).

    Attributes:
        bend: sideways part of the wish before somebody in the way, at touch.
        reach: how far off others count, as the way at top speed in so many seconds.
        closing: the part of a neighbour's weight that depends on how fast it comes closer.
        refused: the straight way is refused when this part of the speed, or less, is left of it.
        up: right angles that a refused wish turns by, 1/s.
        down: right angles that it turns back by, 1/s.
        aside: speed of an arrived robot away from one that touches it, of its top speed.
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
    """What N robots see of k neighbours each.

    Attributes:
        away: (N, k, d) unit vectors from the neighbours.
        gap: (N, k) between surfaces, m; infinite where there is no neighbour.
        velocity: (N, k, d) of the neighbours, m/s.
        underway: (N, k) which of them have not arrived.
    """

    away: Array
    gap: Array
    velocity: Array
    underway: Array


def sight(planes: Planes, place: Array, size: Array, velocity: Array, underway: Array, near: Near) -> Sight:
    """What is seen of neighbours: their planes' normals, and positions (N, d), sizes (N,), velocities (N, d) and who is underway, (N,)."""
    there = near.who < len(place)
    index = jnp.minimum(near.who, len(place) - 1)
    normals = planes.normals[:, : near.who.shape[1]]
    gap = along(normals, place) - dot(normals, place[index]) - size[:, None] - size[index]
    return Sight(normals, jnp.where(there, gap, jnp.inf), velocity[index], underway[index] & there)


def bent(rules: Rules, ahead: Array, pace: Array, top: Array, *, underway: Array, blocked: Array, seen: Sight) -> Array:
    """The wish by all rules, (N, d), m/s.

    Args:
        rules: see there.
        ahead: (N, d) unit vector along the way.
        pace: (N,) wished speed, m/s.
        top: (N,) largest speed, m/s.
        underway: (N,) who has not arrived.
        blocked: (N,) right angles to turn by, from `refused`.
        seen: neighbours.
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
    """`blocked` after `dt`, given what velocity, (N, d), the filter leaves of the straight way."""
    stuck = underway & (jnp.sum(straight * ahead, axis=1) <= rules.refused * pace)
    return jnp.clip(blocked + dt * jnp.where(stuck, rules.up, -rules.down), 0.0, 1.0)


def _quarter(vectors: Array, ahead: Array) -> Array:
    """`vectors`, (…, d), turned by a right angle: counter-clockwise; in space about the vertical, or, for who goes up or down, about the
    first axis; on a line not at all."""
    dimension = vectors.shape[-1]
    if dimension == 1:
        return jnp.zeros_like(vectors)
    if dimension == 2:
        return jnp.stack([-vectors[..., 1], vectors[..., 0]], axis=-1)
    x, y, z = vectors[..., 0], vectors[..., 1], vectors[..., 2]
    level = jnp.stack([-y, x, jnp.zeros_like(z)], axis=-1)
    steep = jnp.stack([jnp.zeros_like(x), -z, y], axis=-1)
    return jnp.where((jnp.abs(ahead[..., 2]) > 0.9)[..., None], steep, level)
