"""Who is near: the nearest few of each robot, from candidates that are looked for anew only when somebody has moved far enough.

All distances between a thousand robots, and the least forty of each, take as long as the rest of a step ten times. The list stays right
as long as the nearest that is not on it can't have come closer than the nearest that a robot needs.
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import Array

from consat.numerics import add_up

LISTED = 40
"""Candidates of each robot. In a packed crowd three shells around it have 36."""
ROUNDED = 1.0 - 1e-6
"""Distances are compared in float32, where JAX sorts ten times as fast; what is beyond is put that much nearer."""


class Candidates(NamedTuple):
    """who: (N, K) others; found: (N, d) where all were then; beyond: (N,) the distance, then, to the nearest that is not listed."""

    who: Array
    found: Array
    beyond: Array


class Near(NamedTuple):
    """who: (N, k) the nearest others, N where there is none; beyond: (N,) no other robot is nearer than this."""

    who: Array
    beyond: Array


def candidates(place: Array) -> Candidates:
    """Candidates for N robots at `place`, (N, d)."""
    count = len(place)
    squared = add_up([(place[:, axis][:, None] - place[:, axis][None]).astype(jnp.float32) ** 2 for axis in range(place.shape[1])])
    rows = jnp.arange(count, dtype=jnp.int32)
    squared = jnp.where(rows[:, None] == rows[None], jnp.float32(jnp.inf), squared)
    listed = min(LISTED, count - 1)
    least, index = _largest(-squared, min(listed + 1, count))
    found = jnp.sqrt(-least[:, -1]).astype(place.dtype) * ROUNDED
    return Candidates(index[:, :listed].astype(jnp.int32), place, found)


def near(known: Candidates, place: Array, seen: int, reach: float) -> tuple[Candidates, Near]:
    """The `seen` nearest within `reach` of each robot, and the candidates for the next time.

    Args:
        known: from the last time.
        place: (N, d) where all are now.
        seen: k.
        reach: of the sensors, m; who is farther is not looked at.
    """
    least, index, beyond, enough = _near(known, place, seen)
    complete = known.who.shape[1] == len(place) - 1
    if not complete:
        known = jax.lax.cond(jnp.all(enough | (beyond >= reach)), lambda: known, lambda: candidates(place))
        least, index, beyond, _ = _near(known, place, seen)
    return known, Near(jnp.where(least <= reach, index, len(place)).astype(jnp.int32), jnp.minimum(beyond, reach))


def _near(known: Candidates, place: Array, seen: int) -> tuple[Array, Array, Array, Array]:
    """(N, k) distances and indices of the nearest, (N,) what nobody else is nearer than, (N,) whether the list was long enough for that."""
    moved = jnp.sqrt(add_up([(place[:, axis] - known.found[:, axis]) ** 2 for axis in range(place.shape[1])]))
    unlisted = known.beyond - moved - jnp.max(moved)
    others = place[known.who]
    squared = add_up([(place[:, axis][:, None] - others[..., axis]) ** 2 for axis in range(place.shape[1])])
    count = known.who.shape[1]
    seen = min(seen, count)
    least, order = _largest(-squared.astype(jnp.float32), min(seen + 1, count))
    distance = jnp.sqrt(-least).astype(place.dtype)
    index = jnp.take_along_axis(known.who, order[:, :seen], axis=1)
    next_ = distance[:, seen] * ROUNDED if count > seen else jnp.full(len(place), jnp.inf)
    return distance[:, :seen], index, jnp.minimum(next_, unlisted), next_ <= unlisted


def _largest(rows: Array, count: int) -> tuple[Array, Array]:
    """The largest of each row and where they are. Without the barrier XLA makes it, and the slices that follow, a sort of whole rows."""
    values, index = jax.lax.optimization_barrier(tuple(jax.lax.top_k(rows, count)))
    return values, index
