"""Interface of all robot models, the two bases that models share, and the check of their parameters.

A model holds parameters only; the state is passed in and returned. All functions compute N robots at once and can be traced by JAX; a
process of one robot has N = 1. Positions have shape (N, d), in metres; times are in seconds and angles in radians.
"""

from __future__ import annotations

import dataclasses
import math
from typing import Any, Generic, Protocol, TypeVar

import jax.numpy as jnp
import numpy as np
from jax import Array

from consat.errors import Fault, InvalidInput, shown
from consat.numerics import add_up

Number = float | np.ndarray
"""A parameter: one number for all robots, or one for each, (N,)."""

S = TypeVar("S")
"""The state of a model: a NamedTuple of arrays whose first axis is the robot."""

LARGEST = 1e6
"""Largest parameter that is accepted. Its square is far from the limits of float64."""


class Model(Protocol, Generic[S]):
    """A robot model.

    `place` is the point that constraints read. The safety filter keeps a disc of radius `size` around it free. A robot that halts from now
    on stays on the segment from `place` to `stop`. If it can halt at once, the segment is a point.
    """

    @property
    def dimensions(self) -> tuple[int, ...]:
        """The dimensions of space in which the model is defined."""

    @property
    def inertial(self) -> bool:
        """Whether a robot that halts moves on for a while. If not, `stop` is `place`."""

    @property
    def radius(self) -> Number:
        """Radius of the body, m."""

    def start(self, position: Array) -> S:
        """The state at rest whose `place` is `position`, (N, d)."""

    def place(self, state: S) -> Array:
        """(N, d) points that constraints read."""

    def body(self, state: S) -> Array:
        """(N, d) centres of the bodies, which are discs or balls."""

    def velocity(self, state: S, command: Array) -> Array:
        """(N, d) velocity of `place` under the command, as others measure it, m/s."""

    def heading(self, state: S) -> Array:
        """(N,) heading in the plane, rad, for drawings."""

    def stop(self, state: S, dt: float) -> Array:
        """(N, d) point at which `place` comes to rest if the robot halts from now on, in steps of `dt`."""

    def size(self, count: int, dt: float) -> Array:
        """(N,) radius of a disc around `place` that contains the body during a step of `dt`, if the filter has checked both ends, m."""

    def pace(self, count: int) -> Array:
        """(N,) speed limit, m/s."""

    def halting(self, count: int, dt: float) -> Array:
        """(N,) distance of a halt from full speed, m."""

    def command(self, state: S, velocity: Array, dt: float) -> Array:
        """(N, m) command within the limits whose mean velocity over `dt` is `velocity`; if out of reach, with the same direction."""

    def halt(self, state: S, dt: float) -> Array:
        """(N, m) command that stops as soon as the limits allow."""

    def step(self, state: S, command: Array, dt: float, wind: Array | None = None) -> S:
        """The state after `dt` under a constant command, cut to the limits. wind: (N, d) velocity of the air, m/s; None without wind."""

    def lowest(self, state: S, command: Array, normals: Array, dt: float) -> Array:
        """(N, k) smallest n·x of `place` during the step and a halt after it, for k unit vectors (N, k, d) of each robot. Without wind."""

    def rows(self, state: S, normals: Array, least: Array, dt: float) -> Array:
        """(N, k) b such that n·u ≥ b, for the next velocity u, keeps the step and the halt after it in n·x ≥ `least`."""

    def farthest(self, state: S, command: Array, dt: float) -> Array:
        """(N,) upper bound on the distance of `place` from its present point during the step and a halt after it, m. Without wind."""

    def bounded(self, slack: Array, dt: float) -> Array:
        """(N,) speed at which a step and a halt after it cover at most the distance `slack`, m."""

    def approach(self, distance: Array, dt: float) -> Array:
        """(N,) speed at a distance, m, from the end of the path."""

    def reach(self, state: S, dt: float) -> tuple[Array, Array]:
        """Center (N, d) and radius (N,) of a ball of velocities that can be reached within `dt`."""


class Instant(Model[S]):
    """Base of models that halt at once: what the filter asks follows from `place` and `step`."""

    inertial = False
    speed: Number

    def stop(self, state: S, dt: float) -> Array:
        return self.place(state)

    def pace(self, count: int) -> Array:
        return each(self.speed, count)

    def halting(self, count: int, dt: float) -> Array:
        return jnp.zeros(count)

    def lowest(self, state: S, command: Array, normals: Array, dt: float) -> Array:
        return along(normals, self.place(self.step(state, command, dt)))

    def rows(self, state: S, normals: Array, least: Array, dt: float) -> Array:
        return (least - along(normals, self.place(state))) / dt

    def farthest(self, state: S, command: Array, dt: float) -> Array:
        return jnp.linalg.norm(self.place(self.step(state, command, dt)) - self.place(state), axis=1)

    def bounded(self, slack: Array, dt: float) -> Array:
        return slack / dt

    def approach(self, distance: Array, dt: float) -> Array:
        return jnp.minimum(self.pace(len(distance)), distance / (2.0 * dt))

    def reach(self, state: S, dt: float) -> tuple[Array, Array]:
        place = self.place(state)
        return jnp.zeros_like(place), self.pace(len(place))


class Following(Model[Any]):
    """Base of models whose bodies follow a reference. Commands move the reference, and the filter keeps references apart.

    Attributes:
        reference: model of the references. Its state is the entry `reference` of the state.
    """

    reference: Model[Any]

    @property
    def inertial(self) -> bool:
        return self.reference.inertial

    def place(self, state: Any) -> Array:
        return self.reference.place(state.reference)

    def velocity(self, state: Any, command: Array) -> Array:
        return self.reference.velocity(state.reference, command)

    def stop(self, state: Any, dt: float) -> Array:
        return self.reference.stop(state.reference, dt)

    def pace(self, count: int) -> Array:
        return self.reference.pace(count)

    def halting(self, count: int, dt: float) -> Array:
        return self.reference.halting(count, dt)

    def command(self, state: Any, velocity: Array, dt: float) -> Array:
        return self.reference.command(state.reference, velocity, dt)

    def halt(self, state: Any, dt: float) -> Array:
        return self.reference.halt(state.reference, dt)

    def lowest(self, state: Any, command: Array, normals: Array, dt: float) -> Array:
        return self.reference.lowest(state.reference, command, normals, dt)

    def rows(self, state: Any, normals: Array, least: Array, dt: float) -> Array:
        return self.reference.rows(state.reference, normals, least, dt)

    def farthest(self, state: Any, command: Array, dt: float) -> Array:
        return self.reference.farthest(state.reference, command, dt)

    def bounded(self, slack: Array, dt: float) -> Array:
        return self.reference.bounded(slack, dt)

    def approach(self, distance: Array, dt: float) -> Array:
        return self.reference.approach(distance, dt)

    def reach(self, state: Any, dt: float) -> tuple[Array, Array]:
        return self.reference.reach(state.reference, dt)


def each(value: Number, count: int) -> Array:
    """(N,) values of a parameter, one for each robot."""
    return jnp.broadcast_to(jnp.asarray(value, dtype=jnp.float64), (count,))


def shortened(vectors: Array, limit: Array) -> Array:
    """Vectors (N, d) no longer than `limit`, (N,), in the same directions."""
    length = jnp.linalg.norm(vectors, axis=1)
    return vectors * jnp.where(length > limit, limit / jnp.where(length > 0.0, length, 1.0), 1.0)[:, None]


def along(normals: Array, points: Array) -> Array:
    """(N, k) n·x for k vectors (N, k, d) and one point (N, d) of each robot."""
    return dot(normals, points[:, None])


def squared(vectors: Array) -> Array:
    """(…, d) → (…) ‖x‖²."""
    return dot(vectors, vectors)


def dot(first: Array, second: Array) -> Array:
    """(…, d) → (…)."""
    return add_up([first[..., axis] * second[..., axis] for axis in range(first.shape[-1])])


def checked(model: Any) -> None:
    """Check that each field of a model is a positive number or a vector of them, one for each robot, and store vectors as float64.

    Fields whose metadata has ``zero`` may be 0; those with ``below`` must be smaller than that.

    Raises:
        InvalidInput: one line a field that cannot be used.
    """
    kind, faults, lengths = type(model).__name__.lower(), [], {}
    for field in dataclasses.fields(model):
        value = getattr(model, field.name)
        fault = _fault(value, bool(field.metadata.get("zero")), float(field.metadata.get("below", math.inf)))
        if fault:
            faults.append(Fault((field.name,), fault, f"robot {kind!r}, {field.name}"))
        elif isinstance(value, (list, tuple, np.ndarray)):
            array = np.array(value, dtype=float)
            array.setflags(write=False)
            lengths[field.name] = len(array)
            object.__setattr__(model, field.name, array)
        else:
            object.__setattr__(model, field.name, float(value))
    if len(set(lengths.values())) > 1:
        text = ", ".join(f"{name} {length}" for name, length in lengths.items())
        faults.append(Fault((), f"parameters given for each robot must have one length, but have {text}", f"robot {kind!r}"))
    if faults:
        raise InvalidInput(faults)


def _fault(value: Any, zero: bool, below: float) -> str | None:
    """What is wrong with a parameter, or None."""
    try:
        array = np.asarray(value)
    except ValueError:
        return f"must be a number or one number for each robot, but is {shown(value)}"
    if array.dtype.kind not in "iuf" or array.ndim > 1 or array.size == 0:
        return f"must be a number or one number for each robot, but is {shown(value)}"
    if not (np.isfinite(array).all() and (np.abs(array) <= LARGEST).all()):
        return f"must be finite and at most {LARGEST:g}, but is {shown(value)}"
    if zero and (array < 0).any():
        return f"must not be negative, but is {shown(value)}"
    if not zero and (array <= 0).any():
        return f"must be positive, but is {shown(value)}"
    if (array >= below).any():
        return f"must be below {below:.4g}, but is {shown(value)}"
    return None
