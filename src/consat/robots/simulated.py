"""Robots whose bodies are integrated by another program, such as a simulator of rigid bodies.

Commands move a reference: the robot's model, stepped exactly. The safety filter keeps references apart. The body in the simulator follows
its reference with a controller of its own and must stay within `tube` of it, a condition of the theorem in docs/robots.md. If it is farther
away than half of that, the reference halts and waits. Positions and headings are measured in the simulator.
"""

from __future__ import annotations

import functools
import importlib
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, Final, NamedTuple, Protocol

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from consat.errors import InvalidSettings, closest
from consat.numerics import on_host
from consat.robots.fleet import Fleet
from consat.robots.model import Following, Model, shortened
from consat.robots.quadrotor import Quadrotor

SIMULATORS: Final = ("mujoco",)
"""Modules of `consat.robots` with a class `Simulator`. To add one, write the module and add its name."""
WAITS = 0.5
"""Fraction of the tube beyond which a reference waits for its body."""


class Bodies(NamedTuple):
    """N bodies in a simulator.

    Attributes:
        position: (N, 3) centres, m.
        velocity: (N, 3) velocities of the centres, m/s.
        heading: (N,) headings, rad.
        inner: (N, S) further state of the simulator.
        touching: (N, N) whether robots i < j touched in the last step.
        struck: (N,) whether a robot touched an obstacle in the last step.
    """

    position: Any
    velocity: Any
    heading: Any
    inner: Any
    touching: Any
    struck: Any


class Simulator(Protocol):
    """Integrates the bodies of N robots. Its constructor takes the model, N, the dimension d and the obstacles.

    Its functions take and return NumPy arrays, and are pure.
    """

    @property
    def width(self) -> int:
        """Number of columns of `Bodies.inner`, S."""

    @property
    def tube(self) -> np.ndarray:
        """(N,) largest allowed distance of a body from its reference, m; see `Simulated.strayed`."""

    @property
    def acceleration(self) -> np.ndarray:
        """(N,) largest acceleration of references that set out, m/s²; infinite if the model has a limit of its own."""

    def start(self, place: np.ndarray) -> Bodies:
        """Bodies at rest with heading 0, at the places of their references, (N, d)."""

    def step(self, bodies: Bodies, before: Any, after: Any, wind: np.ndarray, *, dt: float) -> Bodies:
        """The bodies after `dt`. References move from state `before` to `after`; wind: (N, d) velocity of the air, m/s."""


class SimulatedState(NamedTuple):
    """reference: state of the reference's model; bodies: state of the simulator."""

    reference: Any
    bodies: Bodies


@dataclass(frozen=True, eq=False)
class Simulated(Following):
    """A robot model whose bodies are in a simulator; see `simulated`.

    Args:
        name: name of the simulator.
        reference: model of the references, which commands move.
        simulator: integrates the bodies.
    """

    name: str
    reference: Model[Any]
    simulator: Simulator = field(repr=False)

    @property
    def dimensions(self) -> tuple[int, ...]:
        return self.reference.dimensions

    @property
    def radius(self) -> Any:
        return self.reference.radius

    def start(self, position: Array) -> SimulatedState:
        bodies = on_host(self.simulator.start, self._shapes(len(position)), position)
        return SimulatedState(self.reference.start(position), bodies)

    def position(self, state: SimulatedState) -> Array:
        """(N, d) points that constraints read, measured in the simulator: as far from the body's centre as in the reference."""
        ahead = self.reference.place(state.reference) - self.reference.body(state.reference)
        turn = state.bodies.heading - self.reference.heading(state.reference)
        return self.body(state) + _turned(ahead, turn)

    def body(self, state: SimulatedState) -> Array:
        return state.bodies.position[:, : self.reference.place(state.reference).shape[1]]

    def heading(self, state: SimulatedState) -> Array:
        return state.bodies.heading

    def size(self, count: int, dt: float) -> Array:
        return self.reference.size(count, dt) + jnp.asarray(self.simulator.tube)

    def command(self, state: SimulatedState, velocity: Array, dt: float) -> Array:
        """The command of the reference, no faster than its body can be after `dt`, so that the body is not left behind."""
        body = state.bodies.velocity[:, : velocity.shape[1]]
        pace = jnp.linalg.norm(velocity, axis=1)
        along = jnp.sum(body * velocity, axis=1) / jnp.where(pace > 0.0, pace, 1.0)
        limit = jnp.maximum(along, 0.0) + jnp.asarray(self.simulator.acceleration) * dt
        return self.reference.command(state.reference, shortened(velocity, limit), dt)

    def strayed(self, state: SimulatedState) -> Array:
        """(N,) distance of the body from the disc that its model keeps around its reference, m; negative inside."""
        reference, body = state.reference, self.body(state)
        place = self.reference.place(reference)
        return jnp.linalg.norm(body - place, axis=1) - jnp.linalg.norm(self.reference.body(reference) - place, axis=1)

    def step(self, state: SimulatedState, command: Array, dt: float, wind: Array | None = None) -> SimulatedState:
        """Move the reference by its model, unless its body is behind; then the body, by the simulator. Wind acts on the body only."""
        before, body = state.reference, self.body(state)
        behind = self.strayed(state) > WAITS * jnp.asarray(self.simulator.tube)
        command = jnp.where(behind[:, None], self.reference.halt(before, dt), command)
        after = self.reference.step(before, command, dt)
        air = jnp.zeros_like(body) if wind is None else wind

        follow = functools.partial(self.simulator.step, dt=dt)
        return SimulatedState(after, on_host(follow, self._shapes(len(body)), state.bodies, before, after, air))

    def _shapes(self, count: int) -> Bodies:
        real = {"position": (count, 3), "velocity": (count, 3), "heading": (count,), "inner": (count, self.simulator.width)}
        flags = {"touching": (count, count), "struck": (count,)}
        return Bodies(
            **{name: jax.ShapeDtypeStruct(shape, jnp.float64) for name, shape in real.items()},
            **{name: jax.ShapeDtypeStruct(shape, jnp.bool_) for name, shape in flags.items()},
        )


def simulated(name: str, model: Model[Any], count: int, dimension: int, obstacles: Sequence[Any]) -> Simulated:
    """A model with its bodies in a simulator.

    Args:
        name: one of `SIMULATORS`.
        model: model of the robots.
        count: number of robots, N.
        dimension: dimension of space, d.
        obstacles: public map.

    Raises:
        InvalidSettings: there is no such simulator, its library is not installed, or it has no body for a kind of robot.
    """
    if name not in SIMULATORS:
        raise InvalidSettings(f"there is no simulator {name!r}{closest(name, SIMULATORS)}; choose {' or '.join(SIMULATORS)}")
    simulator = importlib.import_module(f"consat.robots.{name}").Simulator(model, count, dimension, obstacles)
    return Simulated(name, _reference(model), simulator)


def kinds_of(model: Model[Any], count: int) -> list[tuple[Any, np.ndarray]]:
    """The models of N robots, each with the indices of its robots."""
    return list(zip(model.models, model.members, strict=True)) if isinstance(model, Fleet) else [(model, np.arange(count))]


def _reference(model: Model[Any]) -> Model[Any]:
    """The model of the reference. A quadrotor follows a double integrator."""
    if isinstance(model, Fleet):
        return Fleet([_reference(kind) for kind in model.models], model.kinds)
    return model.reference if isinstance(model, Quadrotor) else model


def _turned(vectors: Array, angle: Array) -> Array:
    """Vectors (N, d), turned in the plane by angles (N,)."""
    cosine, sine = jnp.cos(angle), jnp.sin(angle)
    x, y = vectors[:, 0], vectors[:, 1]
    return jnp.concatenate([jnp.stack([cosine * x - sine * y, sine * x + cosine * y], axis=1), vectors[:, 2:]], axis=1)
