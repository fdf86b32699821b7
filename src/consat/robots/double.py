"""A body that obeys accelerations: ṗ = v, v̇ = a, ‖v‖ ≤ speed, ‖a‖ ≤ acceleration."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import jax.numpy as jnp
from jax import Array

from consat.robots.model import LARGEST, Number, along, checked, each, shortened


class DoubleState(NamedTuple):
    """position: (N, d); velocity: (N, d)."""

    position: Array
    velocity: Array


@dataclass(frozen=True, eq=False)
class Double:
    """A double integrator.

    Args:
        radius: of the body, m; a number, or one for each robot, as for all parameters.
        speed: limit, m/s.
        acceleration: limit, m/s².

    Raises:
        InvalidInput: a parameter is not a positive finite number.
    """

    radius: Number = 0.1
    speed: Number = 0.5
    acceleration: Number = 2.0

    dimensions = (1, 2, 3)
    inertial = True

    def __post_init__(self) -> None:
        checked(self)

    def start(self, position: Array) -> DoubleState:
        return DoubleState(position, jnp.zeros_like(position))

    def place(self, state: DoubleState) -> Array:
        return state.position

    def body(self, state: DoubleState) -> Array:
        return state.position

    def velocity(self, state: DoubleState, command: Array) -> Array:
        return state.velocity

    def heading(self, state: DoubleState) -> Array:
        return jnp.zeros(len(state.position))

    def stop(self, state: DoubleState, dt: float) -> Array:
        """Braking along the velocity takes (s² − r²)/2A in whole steps, and r dt/2 in the last, which removes the rest, r < A dt."""
        speed = jnp.linalg.norm(state.velocity, axis=1)
        limit = each(self.acceleration, len(speed))
        left = speed - limit * dt * jnp.floor(speed / (limit * dt))
        way = (speed**2 - left**2) / (2.0 * limit) + 0.5 * dt * left
        return state.position + state.velocity * (way / jnp.where(speed > 0.0, speed, 1.0))[:, None]

    def size(self, count: int, dt: float) -> Array:
        return each(self.radius, count)

    def pace(self, count: int) -> Array:
        return each(self.speed, count)

    def halting(self, count: int, dt: float) -> Array:
        limit = each(self.acceleration, count)
        return self.pace(count) ** 2 / (2.0 * limit) + limit * dt**2 / 8.0

    def command(self, state: DoubleState, velocity: Array, dt: float) -> Array:
        count = len(velocity)
        change = shortened(velocity, self.pace(count)) - state.velocity
        return shortened(change / dt, each(self.acceleration, count))

    def halt(self, state: DoubleState, dt: float) -> Array:
        return shortened(-state.velocity / dt, each(self.acceleration, len(state.velocity)))

    def step(self, state: DoubleState, command: Array, dt: float, wind: Array | None = None) -> DoubleState:
        count = len(command)
        velocity = shortened(state.velocity + dt * shortened(command, each(self.acceleration, count)), self.pace(count))
        mean = 0.5 * (state.velocity + velocity)
        return DoubleState(state.position + dt * (mean if wind is None else mean + wind), velocity)

    def lowest(self, state: DoubleState, command: Array, normals: Array, dt: float) -> Array:
        """Within the step n·p is a parabola, whose vertex counts where the velocity along n turns from negative to positive."""
        after = self.step(state, command, dt)
        old, new = along(normals, state.velocity), along(normals, after.velocity)
        turns = (old < 0.0) & (new > 0.0)
        dip = along(normals, state.position) - jnp.where(turns, 0.5 * dt * old**2 / jnp.where(turns, new - old, 1.0), 0.0)
        end = jnp.minimum(along(normals, after.position), along(normals, self.stop(after, dt)))
        return jnp.where(turns, jnp.minimum(dip, end), end)

    def rows(self, state: DoubleState, normals: Array, least: Array, dt: float) -> Array:
        """With w the next velocity, n·p' + min(0, n·w) c is a bound from below on where a halt leads, where c is the largest ratio of the
        way of a halt to the speed, up to the largest speed that can be reached: s/2A + A dt²/8s, or dt/2 where that is more."""
        count = len(state.velocity)
        _, reachable = self.reach(state, dt)
        top = jnp.minimum(self.pace(count), jnp.linalg.norm(state.velocity, axis=1) + reachable)
        limit = each(self.acceleration, count)
        halting = 0.5 * dt + jnp.maximum(0.5 * dt, top / (2.0 * limit) + limit * dt**2 / (8.0 * top))
        rest = least - along(normals, state.position + 0.5 * dt * state.velocity)
        return rest / jnp.where(rest > 0.0, 0.5 * dt, halting[:, None])

    def farthest(self, state: DoubleState, command: Array, dt: float) -> Array:
        after = self.step(state, command, dt)
        top = jnp.maximum(jnp.linalg.norm(state.velocity, axis=1), jnp.linalg.norm(after.velocity, axis=1))
        return jnp.maximum(dt * top, jnp.linalg.norm(self.stop(after, dt) - state.position, axis=1))

    def bounded(self, slack: Array, dt: float) -> Array:
        """The positive root of s dt + s²/2A + A dt²/8 = slack."""
        limit = each(self.acceleration, len(slack))
        finite = jnp.clip(slack - limit * dt**2 / 8.0, 0.0, LARGEST)
        return limit * (jnp.sqrt(dt**2 + 2.0 * finite / limit) - dt)

    def approach(self, distance: Array, dt: float) -> Array:
        """Braking uses half of the acceleration. The other half remains for avoiding others."""
        braking = jnp.sqrt(each(self.acceleration, len(distance)) * distance)
        return jnp.minimum(jnp.minimum(self.pace(len(distance)), distance / (2.0 * dt)), braking)

    def reach(self, state: DoubleState, dt: float) -> tuple[Array, Array]:
        return state.velocity, dt * each(self.acceleration, len(state.velocity))
