"""State of an agent in the interior-point step, and how it begins. The last axis of every array is the agent (the lane), size A."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import Array

from consat.protocols.local.interior.lanes import Lanes, number

NUDGE = 1e-3
"""Copies start at this fraction of the way from the agent's own position to the initial estimate, so that no two copies coincide."""
WIDER = 0.5
"""`NUDGE` for agents with a ψ that is not quadratic. Near coinciding positions norms have a kink and inverse distances a pole, which the
steps leave slowly."""
TRIES = 24
"""Number of starting positions tried, at growing distance, while a ψ is not finite."""
NEAR = 1e-3
"""Smallest initial slack, in units of ψ."""


class Memory(NamedTuple):
    """State of the interior-point step. Shapes are for one agent; inside a batch the last axis is the agent.

    Attributes:
        y: (n, d) copies.
        drift: (n, d) smoothed displacement of the copies in a round, in the team's unit of length; see
            `consat.protocols.local.interior.prediction`.
        multiplier: (m,) λ_ik; 0 where padded.
        went: sum of the squared displacements, older ones with less weight.
        missed: the same of their differences from `drift`.
        lid: λ of the cap.
        level: t_i.
        barrier: μ_i.
        bound: smallest proven bound on the best margin so far.
        age: rounds since the start.
        inertia: κ_i, as a multiple of the gain `inertia`.
        swing: component of the last step along a fixed direction, to detect oscillation.
        warm: remaining rounds in which the mean of the margins is maximised.
        changes: largest known number of constraint changes, own or received. A proof is valid only for constraints with the same number.
    """

    y: Array
    drift: Array
    multiplier: Array
    went: Array
    missed: Array
    lid: Array
    level: Array
    barrier: Array
    bound: Array
    age: Array
    inertia: Array
    swing: Array
    warm: Array
    changes: Array


@dataclass(frozen=True)
class Gains:
    """Gains of the step; see `consat.protocols.interior_point.InteriorPoint`."""

    cap: float | None
    inertia: float
    centering: float
    boundary: float
    floor: float
    couple: float
    apart: float
    drop: float
    warm: int
    far: float


def begin(lanes: Lanes, y: Array, gains: Gains) -> Memory:
    """Initial state: every copy near the agent's own position, and the level below its margin there.

    Args:
        lanes: the agents' constraints.
        y: (n, d, A) initial estimates, the own position first.
        gains: gains of the protocol.
    """
    y = placed(lanes, y)
    psi = lanes.psi(y)
    number = jnp.zeros(y.shape[-1])
    multiplier, lid, level, barrier = centered(lanes, psi)
    violated = (jnp.min(psi[:-1], axis=0, initial=jnp.inf) < -gains.far) & lanes.quadratic
    return Memory(
        y, jnp.zeros_like(y), multiplier, number, number, lid, level, barrier,
        bound=number + jnp.inf, age=number, inertia=number + 1.0, swing=number, warm=jnp.where(violated, float(gains.warm), 0.0),
        changes=number,
    )  # fmt: skip


def placed(lanes: Lanes, y: Array) -> Array:
    """(n, d, A) initial copies: near the agent's own position. Where a ψ is not finite there, the initial estimates `y` are used. Where a ψ
    is not finite at these either, the nearest of `TRIES` pseudo-random points around them at which all ψ are finite is used."""
    near = y[:1] + jnp.where(lanes.quadratic, NUDGE, WIDER)[None, None] * (y - y[:1])

    def wrong(y: Array) -> Array:
        return jnp.any(lanes.used & (lanes.psi(y) == -jnp.inf), axis=0)

    def body(at: tuple[Array, Array]) -> tuple[Array, Array]:
        k, now = at
        phase = jnp.arange(1.0, now[..., 0].size + 1).reshape(now.shape[:2])[:, :, None]
        away = jnp.sin(1e3 * (k + 1.0) * phase + 1e2 * y) * lanes.units.reach * 2.0 ** (0.25 * (k - 20.0))
        return k + 1.0, jnp.where(wrong(now), jnp.where(k == 0.0, y, y + away), now)

    def more(at: tuple[Array, Array]) -> Array:
        return (at[0] <= float(TRIES)) & jnp.any(wrong(at[1]))

    return jax.lax.while_loop(more, body, (jnp.zeros(()), near))[1]


def centered(lanes: Lanes, psi: Array) -> tuple[Array, Array, Array, Array]:
    """Multipliers, level and barrier on the central path, for a level well below the margin. `psi`: (m, A).

    Returns:
        (m − 1, A) λ, (A,) λ of the cap, (A,) level, and (A,) barrier.
    """
    used = lanes.used & (psi > -jnp.inf)
    margin = jnp.min(jnp.where(used, psi, jnp.inf)[:-1], axis=0, initial=jnp.inf)
    some = jnp.isfinite(margin)
    level = jnp.where(some, margin - jnp.maximum(NEAR, jnp.abs(margin)), 0.0)
    if lanes.cap is not None:
        level = jnp.minimum(level, lanes.cap - NEAR)
    s = jnp.where(used, psi - level[None], 1.0)
    inverse = jnp.where(used, 1.0 / s, 0.0)
    multiplier = inverse / jnp.maximum(jnp.sum(inverse, axis=0), jnp.finfo(s.dtype).tiny)[None]
    return multiplier[:-1], multiplier[-1], level, mean(multiplier, s, used)


def mean(multiplier: Array, s: Array, used: Array) -> Array:
    """(A,) mean of λ s over the used constraints of each agent; all arguments have shape (m, A)."""
    return jnp.sum(jnp.where(used, multiplier * s, 0.0), axis=0) / jnp.maximum(number(used), 1.0)
