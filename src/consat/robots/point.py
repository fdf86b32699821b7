"""A point that moves as it is told: ẋ = u, ‖u‖ ≤ speed."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import jax.numpy as jnp
from jax import Array

from consat.robots.model import Instant, Number, checked, each, shortened


class PointState(NamedTuple):
    """position: (N, d)."""

    position: Array


@dataclass(frozen=True, eq=False)
class Point(Instant[PointState]):
    """A body that obeys velocity commands at once.

    Args:
        radius: of the body, m; a number, or one for each robot, as for all parameters.
        speed: limit, m/s.

    Raises:
        InvalidInput: a parameter is not a positive finite number.
    """

    radius: Number = 0.1
    speed: Number = 0.5

    dimensions = (1, 2, 3)

    def __post_init__(self) -> None:
        checked(self)

    def start(self, position: Array) -> PointState:
        return PointState(position)

    def place(self, state: PointState) -> Array:
        return state.position

    def body(self, state: PointState) -> Array:
        return state.position

    def velocity(self, state: PointState, command: Array) -> Array:
        return command

    def heading(self, state: PointState) -> Array:
        return jnp.zeros(len(state.position))

    def size(self, count: int, dt: float) -> Array:
        return each(self.radius, count)

    def command(self, state: PointState, velocity: Array, dt: float) -> Array:
        return shortened(velocity, self.pace(len(velocity)))

    def halt(self, state: PointState, dt: float) -> Array:
        return jnp.zeros_like(state.position)

    def step(self, state: PointState, command: Array, dt: float, wind: Array | None = None) -> PointState:
        velocity = shortened(command, self.pace(len(command)))
        return PointState(state.position + dt * (velocity if wind is None else velocity + wind))
