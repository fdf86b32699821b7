"""Interior point by message passing (design, section 8; after Khoshfetrat Pakazad, Hansson, Andersen, arXiv 1502.06384, without sweeps)."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar, NamedTuple

import jax
import jax.numpy as jnp
from jax import Array

from consat.interior import Gains, Mail, Memory


class InteriorState(NamedTuple):
    x: Array
    memory: Memory
    inbox: Mail


@dataclass(frozen=True)
class InteriorPoint:
    cap: float | None = 0.1
    inertia: float = 0.1
    centering: float = 0.5
    boundary: float = 0.7
    floor: float = 1e-4
    couple: float = 3.0
    apart: float = 0.3
    drop: float = 3.0
    warm: int = 0
    damp: float = 0.0
    name = "interior-point"

    @property
    def gains(self) -> Gains:
        return Gains(self.cap, self.inertia, self.centering, self.boundary, self.floor, self.couple, self.apart, self.drop, self.warm)

    def start(self, x: Array, solver: Any) -> InteriorState:
        x = solver.nearby(x)
        memory = solver.begin(x, self.gains)
        return InteriorState(memory.y, memory._replace(y=jnp.zeros((0, x.shape[1]))), solver.silence())

    def speak(self, state: InteriorState, solver: Any, round_: Array, known: Array) -> tuple[InteriorState, Mail]:
        memory, mail = solver.round(state.memory._replace(y=state.x), state.inbox, self.gains)
        return state._replace(x=memory.y, memory=memory._replace(y=jnp.zeros((0, state.x.shape[1])))), mail

    def hear(self, state: InteriorState, message: Mail, arrived: Array, solver: Any) -> InteriorState:
        def take(new: Array, old: Array) -> Array:
            return jnp.where(arrived.reshape(-1, *[1] * (new.ndim - 1)), new, old)

        return state._replace(inbox=jax.tree.map(take, message, state.inbox))
