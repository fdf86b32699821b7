"""Selfish ascent, a baseline (paper, remark 5 on the noncooperative game). Every agent increases its own α_i by moving only itself:

    ẋ_i       = k1 ∂α_i/∂x_i
    ẋ_j^(i)   = −k2 Σ_l (x_j^(i) − x_j^(l))      for its copies of the other positions

Sends x^(i). It converges to a Nash equilibrium, which may violate constraints that a cooperating team satisfies.
"""

from __future__ import annotations

from dataclasses import dataclass

import jax.numpy as jnp
from jax import Array

from consat.protocols.base import Local, State


@dataclass(frozen=True)
class Selfish:
    """Gains of the selfish ascent; the equations are in the module docstring.

    Attributes:
        k1: gain on the ascent.
        k2: gain with which an agent's copies follow their owners, 1/s.
    """

    k1: float = 1.0
    k2: float = 5.0
    name = "selfish"

    def start(self, x: Array) -> State:
        return State(x, jnp.zeros_like(x))

    def message(self, state: State) -> Array:
        return state.x

    def rate(self, state: State, local: Local, disagreement: Array) -> State:
        climb = local.own * self.k1 * local.ascent(state.x)
        follow = (1.0 - local.own) * -self.k2 * disagreement
        return State(x=climb + follow, z=jnp.zeros_like(state.z))
