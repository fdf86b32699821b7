"""Prediction: copies that moved steadily go on moving. It concerns agents that have constraints which move with time.

Before a step all copies of an agent are moved by g v. v is the smoothed displacement of the last rounds, and the gain g compares how far
the copies went from where v had predicted them, with how far they went in all:

    v⁺ = v + σ (Δy − v)        g = max(0, 1 − Σ φᵏ ‖Δy − v‖² / Σ φᵏ ‖Δy‖²)        sums over the past rounds, k rounds ago

So the prediction fades where copies do not move steadily. Only the agent's own copies are moved. To move the neighbours' quadratics as well
diverged: every agent then believed that its neighbours go where it goes.
"""

from __future__ import annotations

import jax.numpy as jnp
from jax import Array

from consat.protocols.local.interior.lanes import Lanes
from consat.protocols.local.interior.state import Memory

SMOOTHING, FORGETTING = 0.1, 0.9
"""σ and φ."""
SETTLING = 10
"""Number of first rounds without a prediction: the team then comes together, and what moves says nothing about the constraints."""


def predicted(lanes: Lanes, memory: Memory) -> Array:
    """(n, d, A) the copies from which the step begins."""
    if not lanes.any_moves:
        return memory.y
    gain = jnp.clip(1.0 - memory.missed / jnp.maximum(memory.went, jnp.finfo(memory.went.dtype).tiny), 0.0, 1.0)
    there = memory.y + gain[None, None] * memory.drift
    possible = jnp.all((lanes.psi(there) > -jnp.inf) | ~lanes.used, axis=0) & lanes.moves & (memory.age > SETTLING)
    return jnp.where(possible[None, None], there, memory.y)


def observed(lanes: Lanes, memory: Memory, y: Array) -> dict[str, Array]:
    """The fields of `Memory` that say how copies move, after a step to `y`, (n, d, A)."""
    if not lanes.any_moves:
        return {"drift": memory.drift, "went": memory.went, "missed": memory.missed}
    step = y - memory.y
    off = step - memory.drift
    return {
        "drift": memory.drift + SMOOTHING * off,
        "went": FORGETTING * memory.went + jnp.sum(step**2, axis=(0, 1)),
        "missed": FORGETTING * memory.missed + jnp.sum(off**2, axis=(0, 1)),
    }
