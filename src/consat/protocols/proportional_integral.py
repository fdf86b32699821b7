"""Proportional–integral flow (paper, remark 8; Wang, Elia 2011; Gharesifard, Cortés 2013): the saddle-point flow of
f(x) + xᵀLz + ½xᵀLx,

    ẋ^(i) = −∇f_i(x^(i)) − Σ_j (z_i − z_j) − Σ_j (x^(i) − x^(j))
    ż_i   = Σ_j (x^(i) − x^(j))

Sends x^(i) and z_i. Convexity of f suffices.
"""

from __future__ import annotations

from dataclasses import dataclass

import jax.numpy as jnp
from jax import Array

from consat.protocols.base import Local, State


@dataclass(frozen=True)
class ProportionalIntegral:
    """Proportional–integral flow; the equations are in the module docstring."""

    name = "proportional-integral"

    def start(self, x: Array) -> State:
        return State(x, jnp.zeros_like(x))

    def message(self, state: State) -> State:
        return state

    def rate(self, state: State, local: Local, disagreement: State) -> State:
        return State(x=-local.gradient(state.x) - disagreement.z - disagreement.x, z=disagreement.x)
