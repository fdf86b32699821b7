"""Nearest neighbours of each robot, from a list of candidates that is rebuilt only when robots have moved far enough.

For a thousand robots, a rebuild (all distances, and the forty smallest for each robot) takes ten times as long as the rest of a step. The
list remains valid while no unlisted robot can be closer than the neighbours that are needed.
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import Array

from consat.numerics import add_up

LISTED = 40
"""Number of candidates of each robot. In a dense packing, the three shells around a robot have 36 robots."""
ROUNDED = 1.0 - 1e-6
"""Distances are compared in float32, where JAX sorts ten times as fast. Lower bounds are reduced by this factor against rounding."""


class Candidates(NamedTuple):
    """Candidates at the time of the last rebuild.

    Attributes:
        who: (N, K) indices of the listed robots.
        found: (N, d) positions of all robots at that time.
        beyond: (N,) lower bound on the distance to the nearest unlisted robot at that time.
    """

    who: Array
    found: Array
    beyond: Array


class Near(NamedTuple):
    """Neighbours of each robot.

    Attributes:
        who: (N, k) indices of the nearest robots; N where there is none.
        beyond: (N,) lower bound on the distance to every robot that is not in `who`.
    """

    who: Array
    beyond: Array


def candidates(place: Array) -> Candidates:
    """Build the lists of candidates for N robots at `place`, (N, d)."""
    count = len(place)
    squared = add_up([(place[:, axis][:, None] - place[:, axis][None]).astype(jnp.float32) ** 2 for axis in range(place.shape[1])])
    rows = jnp.arange(count, dtype=jnp.int32)
    squared = jnp.where(rows[:, None] == rows[None], jnp.float32(jnp.inf), squared)
    listed = min(LISTED, count - 1)
    least, index = _largest(-squared, min(listed + 1, count))
    found = jnp.sqrt(-least[:, -1]).astype(place.dtype) * ROUNDED
    return Candidates(index[:, :listed].astype(jnp.int32), place, found)


def near(known: Candidates, place: Array, seen: int, reach: float) -> tuple[Candidates, Near]:
    """The nearest robots of each robot within a range, and the candidates for the next call.

    Args:
        known: candidates from the last call.
        place: (N, d) present positions.
        seen: largest number of neighbours, k.
        reach: range of the sensors, m. Robots farther away are ignored.
    """
    least, index, beyond, enough = _near(known, place, seen)
    complete = known.who.shape[1] == len(place) - 1
    if not complete:
        known = jax.lax.cond(jnp.all(enough | (beyond >= reach)), lambda: known, lambda: candidates(place))
        least, index, beyond, _ = _near(known, place, seen)
    return known, Near(jnp.where(least <= reach, index, len(place)).astype(jnp.int32), jnp.minimum(beyond, reach))


def _near(known: Candidates, place: Array, seen: int) -> tuple[Array, Array, Array, Array]:
    """Nearest robots among the candidates.

    Returns:
        (N, k) distances, (N, k) indices, (N,) lower bound on the distance to all other robots, and (N,) whether the list is still valid:
        the nearest robots are surely among the candidates.
    """
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
    """The `count` largest values of each row, and their indices. Without the barrier, XLA fuses this with later slices to a full sort."""
    values, index = jax.lax.optimization_barrier(tuple(jax.lax.top_k(rows, count)))
    return values, index
