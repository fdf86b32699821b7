"""Gradient flow with integral action (paper, eq. 22; Kia, Cortés, Martínez 2015):

    ẋ^(i) = −k1 ∇f_i(x^(i)) − k2 Σ_j (x^(i) − x^(j)) − z_i
    ż_i   = k1 k2 Σ_j (x^(i) − x^(j)),        Σ_i z_i(0) = 0

Sends x^(i). Converges when f is strictly convex (paper, theorem 1).
"""

from __future__ import annotations

from dataclasses import dataclass

import jax.numpy as jnp
from jax import Array

from consat.protocols.base import Local, State


@dataclass(frozen=True)
class GradientFlow:
    """Gains of the gradient flow; the equations are in the module docstring.

    Attributes:
        k1: gain on the gradient, 1/s.
        k2: gain on the disagreement, 1/s.
    """

    k1: float = 1.0
    k2: float = 1.0
    name = "gradient-flow"

    def start(self, x: Array) -> State:
        return State(x, jnp.zeros_like(x))

    def message(self, state: State) -> Array:
        return state.x

    def rate(self, state: State, local: Local, disagreement: Array) -> State:
        return State(
            x=-self.k1 * local.gradient(state.x) - self.k2 * disagreement - state.z,
            z=self.k1 * self.k2 * disagreement,
        )
