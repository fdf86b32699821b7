"""A body on two wheels: ẋ = v e(θ), θ̇ = ω, |v| ≤ speed, |ω| ≤ turn_rate, where e(θ) = (cos θ, sin θ).

What is steered is the point y = x + l e(θ), an offset l ahead of the axle, which obeys ẏ = v e(θ) + l ω e(θ)⊥: any velocity of y has a
command (near-identity map; Olfati-Saber, ACC 2002). Under a command that is held y moves on an arc, whose chord is made to point the way
that was asked for.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import jax.numpy as jnp
from jax import Array

from consat.robots.model import Instant, Number, checked, each, shortened

NEWTON_STEPS = 6
"""Number of iterations for the direction of the chord. With l > speed·dt/2, the third changes no digit any more."""


class UnicycleState(NamedTuple):
    """axle: (N, 2) its middle; angle: (N,) θ."""

    axle: Array
    angle: Array


@dataclass(frozen=True, eq=False)
class Unicycle(Instant[UnicycleState]):
    """A differential drive.

    Args:
        radius: of the body around the middle of the axle, m; a number, or one for each robot, as for all parameters.
        speed: limit, m/s.
        turn_rate: limit, rad/s.
        offset: of the steered point ahead of the axle, m.

    Raises:
        InvalidInput: a parameter is not a positive finite number.
    """

    radius: Number = 0.1
    speed: Number = 0.5
    turn_rate: Number = 3.6
    offset: Number = 0.05

    dimensions = (2,)

    def __post_init__(self) -> None:
        checked(self)

    def start(self, position: Array) -> UnicycleState:
        heading = jnp.zeros(len(position))
        return UnicycleState(position - each(self.offset, len(position))[:, None] * _ahead(heading), heading)

    def place(self, state: UnicycleState) -> Array:
        return state.axle + each(self.offset, len(state.angle))[:, None] * _ahead(state.angle)

    def body(self, state: UnicycleState) -> Array:
        return state.axle

    def velocity(self, state: UnicycleState, command: Array) -> Array:
        across = each(self.offset, len(state.angle)) * command[:, 1]
        ahead = _ahead(state.angle)
        return command[:, :1] * ahead + across[:, None] * jnp.stack([-ahead[:, 1], ahead[:, 0]], axis=1)

    def heading(self, state: UnicycleState) -> Array:
        return state.angle

    def size(self, count: int, dt: float) -> Array:
        """Radius and offset, and the height of the arc over its chord."""
        return each(self.radius, count) + each(self.offset, count) + each(self.speed, count) * each(self.turn_rate, count) * (dt**2 / 8.0)

    def command(self, state: UnicycleState, velocity: Array, dt: float) -> Array:
        """(v, ω) with the ratio that makes the chord of the arc point along `velocity`: φ' + ω(φ') dt/2 = φ, angles from the heading."""
        count = len(velocity)
        offset, turn, velocity = each(self.offset, count), each(self.turn_rate, count), shortened(velocity, self.pace(count))
        pace = jnp.linalg.norm(velocity, axis=1)
        moving = pace > 0.0
        asked = jnp.arctan2(velocity[:, 1], jnp.where(moving, velocity[:, 0], 1.0)) - state.angle
        asked = jnp.arctan2(jnp.sin(asked), jnp.cos(asked))
        angle = asked
        for _ in range(NEWTON_STEPS):
            rate = pace * jnp.sin(angle) / offset
            slope = jnp.where(jnp.abs(rate) < turn, jnp.maximum(0.5 * dt * pace * jnp.cos(angle) / offset, -0.5), 0.0)
            angle = angle - (angle + 0.5 * dt * jnp.clip(rate, -turn, turn) - asked) / (1.0 + slope)
        rate = pace * jnp.sin(angle) / offset
        part = jnp.where(jnp.abs(rate) > turn, turn / jnp.where(rate == 0.0, 1.0, jnp.abs(rate)), 1.0)
        return part[:, None] * jnp.stack([pace * jnp.cos(angle), rate], axis=1)

    def halt(self, state: UnicycleState, dt: float) -> Array:
        return jnp.zeros_like(state.axle)

    def step(self, state: UnicycleState, command: Array, dt: float, wind: Array | None = None) -> UnicycleState:
        """Exact: the axle moves on an arc. Wheels hold against the wind."""
        limits = jnp.stack([self.pace(len(command)), each(self.turn_rate, len(command))], axis=1)
        command = command / jnp.maximum(jnp.max(jnp.abs(command) / limits, axis=1), 1.0)[:, None]
        half = 0.5 * dt * command[:, 1]
        chord = dt * command[:, 0] * jnp.sinc(half / jnp.pi)
        return UnicycleState(state.axle + chord[:, None] * _ahead(state.angle + half), state.angle + 2.0 * half)


def _ahead(angle: Array) -> Array:
    return jnp.stack([jnp.cos(angle), jnp.sin(angle)], axis=1)
