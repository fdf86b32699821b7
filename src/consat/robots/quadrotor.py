"""A quadrotor under a geometric controller (Lee, Leok, McClamroch, CDC 2010), reduced to what a team needs.

The body obeys ẍ = (f/m) R e₃ − g e₃ − drag (ẋ − wind), Ṙ = R ω̂; thrust f and turn rates ω are what is commanded. It follows a reference,
a double integrator with limits of its own, which is what commands move and what the safety filter keeps apart: bodies stay within `tube` of
it.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Any, NamedTuple, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.scipy.spatial.transform import Rotation

from consat.errors import Fault, InvalidInput
from consat.robots.double import Double, DoubleState
from consat.robots.model import Following, Number, checked, each

GRAVITY = 9.81
"""m/s²."""
STIFFNESS, DAMPING = 12.0, 7.0
"""Of the position loop, 1/s² and 1/s: critically damped."""
TURNING, TURN_RATE = 18.0, 12.0
"""Of the attitude loop, 1/s, and the turn rate that it may ask for, rad/s."""
DRAG = 0.3
"""1/s."""
INNER_STEP = 0.005
"""Of the inner loop, s: 200 Hz."""


A = TypeVar("A", Array, np.ndarray)
"""Arrays of JAX or of NumPy."""


class QuadrotorState(NamedTuple):
    """position: (N, 3); velocity: (N, 3); attitude: (N, 3, 3) R; reference: of d dimensions, the others are held at 0."""

    position: Array
    velocity: Array
    attitude: Array
    reference: DoubleState


@dataclass(frozen=True, eq=False)
class Quadrotor(Following):
    """A quadrotor in space, or, in the plane, at a constant height.

    Args:
        radius: of a ball around the body, m; a number, or one for each robot, as for all parameters.
        speed: limit of the reference, m/s.
        acceleration: limit of the reference, m/s².
        tilt: limit of the body's inclination, rad; must leave the acceleration, and a quarter more.
        tube: how far the body may be from the reference, m. What a run came to is in its report.

    Raises:
        InvalidInput: a parameter is not a positive finite number, or the tilt is too small for the acceleration.
    """

    radius: Number = 0.15
    speed: Number = 1.0
    acceleration: Number = 2.0
    tilt: Number = field(default=0.6, metadata={"below": math.pi / 2})
    tube: Number = 0.06

    dimensions = (2, 3)

    def __post_init__(self) -> None:
        checked(self)
        object.__setattr__(self, "reference", Double(self.radius, self.speed, self.acceleration))
        least = np.arctan(1.25 * np.asarray(self.acceleration) / GRAVITY)
        if np.any(np.asarray(self.tilt) < least):
            text = f"must be at least {float(np.max(least)):.3f} rad for an acceleration of {np.max(self.acceleration):g} m/s²"
            raise InvalidInput([Fault(("tilt",), f"{text}, but is {np.min(self.tilt):g}", "robot 'quadrotor', tilt")])

    def start(self, position: Array) -> QuadrotorState:
        count = len(position)
        whole = _in_space(position)
        level = jnp.broadcast_to(jnp.eye(3), (count, 3, 3))
        return QuadrotorState(whole, jnp.zeros_like(whole), level, self.reference.start(position))

    def body(self, state: QuadrotorState) -> Array:
        return state.position[:, : state.reference.position.shape[1]]

    def heading(self, state: QuadrotorState) -> Array:
        return jnp.arctan2(state.attitude[:, 1, 0], state.attitude[:, 0, 0])

    def size(self, count: int, dt: float) -> Array:
        return each(self.radius, count) + each(self.tube, count)

    def step(self, state: QuadrotorState, command: Array, dt: float, wind: Array | None = None) -> QuadrotorState:
        """The inner loop at 200 Hz or more; the reference moves exactly."""
        count = max(1, math.ceil(dt / INNER_STEP - 1e-9))
        inner = dt / count
        air = jnp.zeros_like(state.position) if wind is None else _in_space(wind)
        reference = self.reference.step(state.reference, command, dt)
        old, new = _in_space(state.reference.velocity), _in_space(reference.velocity)
        begin, pull = _in_space(state.reference.position), (new - old) / dt

        def one(index: int, body: tuple[Array, Array, Array]) -> tuple[Array, Array, Array]:
            time = inner * (index + 0.5)
            target = begin + time * old + 0.5 * time**2 * pull
            thrust, rates = self.control(*body, target, old + time * pull, pull)
            position, velocity, attitude = body
            up = attitude[:, :, 2]
            force = thrust[:, None] * up - jnp.array([[0.0, 0.0, GRAVITY]]) - DRAG * (velocity - air)
            after = velocity + inner * force
            return position + 0.5 * inner * (velocity + after), after, attitude @ Rotation.from_rotvec(inner * rates).as_matrix()

        position, velocity, attitude = jax.lax.fori_loop(0, count, one, (state.position, state.velocity, state.attitude))
        return QuadrotorState(position, velocity, attitude, reference)

    def control(self, position: A, velocity: A, attitude: A, target: A, pace: A, pull: A) -> tuple[A, A]:
        """Thrust per mass (N,), m/s², and turn rates (N, 3) in the body's frame, rad/s; of arrays of JAX or of NumPy.

        Args:
            position: (N, 3) of the body.
            velocity: (N, 3) of the body.
            attitude: (N, 3, 3) of the body.
            target: (N, 3) position of the reference.
            pace: (N, 3) velocity of the reference.
            pull: (N, 3) acceleration of the reference.
        """
        xp: Any = position.__array_namespace__()
        wanted = pull + DRAG * pace + STIFFNESS * (target - position) + DAMPING * (pace - velocity)
        lift = xp.maximum(wanted[:, 2] + GRAVITY, 0.3 * GRAVITY)
        level = xp.linalg.norm(wanted[:, :2], axis=1)
        limit = lift * np.tan(np.asarray(self.tilt))
        cut = xp.where(level > limit, limit / xp.where(level > 0.0, level, 1.0), 1.0)
        force = xp.concatenate([wanted[:, :2] * cut[:, None], lift[:, None]], axis=1)
        up = force / xp.linalg.norm(force, axis=1)[:, None]
        first = xp.stack([up[:, 2], xp.zeros_like(lift), -up[:, 0]], axis=1)  # across `up` and the second axis: no yaw
        first = first / xp.linalg.norm(first, axis=1)[:, None]
        goal = xp.stack([first, xp.cross(up, first), up], axis=2)
        error = xp.swapaxes(goal, 1, 2) @ attitude
        twist = 0.5 * xp.stack([error[:, 2, 1] - error[:, 1, 2], error[:, 0, 2] - error[:, 2, 0], error[:, 1, 0] - error[:, 0, 1]], axis=1)
        rates = -TURNING * twist
        speed = xp.linalg.norm(rates, axis=1)
        rates = rates * xp.where(speed > TURN_RATE, TURN_RATE / xp.where(speed > 0.0, speed, 1.0), 1.0)[:, None]
        return xp.maximum(xp.sum(force * attitude[:, :, 2], axis=1), 0.0), rates


def _in_space(vectors: Array) -> Array:
    """(N, d) → (N, 3)."""
    return jnp.pad(vectors, ((0, 0), (0, 3 - vectors.shape[1])))
