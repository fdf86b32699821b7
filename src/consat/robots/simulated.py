"""Robots whose bodies another program integrates, such as a simulator of rigid bodies.

What commands move is a reference: the robot's model, stepped exactly, which the safety filter keeps apart from others. The simulator's body
follows it with a controller of its own. Bodies stay within `tube` of their references, which is a condition of the theorem in
docs/robots.md; a reference whose body is farther away than half of that halts and waits for it. Positions and headings are those that the
simulator measures.
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
from consat.robots.double import Double
from consat.robots.fleet import Fleet
from consat.robots.model import Model, shortened
from consat.robots.quadrotor import Quadrotor

SIMULATORS: Final = ("mujoco",)
"""Modules of `consat.robots`, each with a class `Simulator`: a new one is one file, and its name here."""


WAITS = 0.5
"""Of its tube: a reference waits for a body that is farther away."""


class Bodies(NamedTuple):
    """N bodies in a simulator.

    Attributes:
        position: (N, 3) of the body's middle, m.
        velocity: (N, 3) of it, m/s.
        heading: (N,) rad.
        inner: (N, S) all else that the simulator must know to go on.
        touching: (N, N) pairs (i, j), i < j, that touched in the last step.
        struck: (N,) who touched an obstacle in the last step.
    """

    position: Any
    velocity: Any
    heading: Any
    inner: Any
    touching: Any
    struck: Any


class Simulator(Protocol):
    """Integrates the bodies of N robots; made from their model, how many they are, the dimension d and the obstacles.

    Its functions take and return NumPy arrays, and what they return depends on their arguments only.
    """

    @property
    def width(self) -> int:
        """S: numbers in `Bodies.inner` of each robot."""

    @property
    def tube(self) -> np.ndarray:
        """(N,) how far a body may be from its reference, m; see `Simulated.strayed`."""

    @property
    def acceleration(self) -> np.ndarray:
        """(N,) at most, at which references set out, m/s²; infinite where their models have limits of their own."""

    def start(self, place: np.ndarray) -> Bodies:
        """Bodies at rest at (N, d) places of their references, with heading 0."""

    def step(self, bodies: Bodies, before: Any, after: Any, wind: np.ndarray, *, dt: float) -> Bodies:
        """The bodies after `dt`, in which references went from one state of their models to another; wind: (N, d) velocity of the air."""


class SimulatedState(NamedTuple):
    """reference: of the model that commands move; bodies: of the simulator."""

    reference: Any
    bodies: Bodies


@dataclass(frozen=True, eq=False)
class Simulated:
    """A robot model whose bodies are in a simulator; made by `simulated`.

    Args:
        name: of the simulator.
        reference: the model that commands move.
        simulator: integrates the bodies.
    """

    name: str
    reference: Model[Any]
    simulator: Simulator = field(repr=False)

    @property
    def dimensions(self) -> tuple[int, ...]:
        return self.reference.dimensions

    @property
    def inertial(self) -> bool:
        return self.reference.inertial

    @property
    def radius(self) -> Any:
        return self.reference.radius

    def start(self, position: Array) -> SimulatedState:
        bodies = on_host(self.simulator.start, self._shapes(len(position)), position)
        return SimulatedState(self.reference.start(position), bodies)

    def place(self, state: SimulatedState) -> Array:
        return self.reference.place(state.reference)

    def position(self, state: SimulatedState) -> Array:
        """(N, d) the point that constraints see, as the simulator measures it: as far from the body's middle as the reference's."""
        ahead = self.reference.place(state.reference) - self.reference.body(state.reference)
        turn = state.bodies.heading - self.reference.heading(state.reference)
        return self.body(state) + _turned(ahead, turn)

    def body(self, state: SimulatedState) -> Array:
        return state.bodies.position[:, : self.reference.place(state.reference).shape[1]]

    def heading(self, state: SimulatedState) -> Array:
        return state.bodies.heading

    def velocity(self, state: SimulatedState, command: Array) -> Array:
        return self.reference.velocity(state.reference, command)

    def stop(self, state: SimulatedState, dt: float) -> Array:
        return self.reference.stop(state.reference, dt)

    def size(self, count: int, dt: float) -> Array:
        return self.reference.size(count, dt) + jnp.asarray(self.simulator.tube)

    def pace(self, count: int) -> Array:
        return self.reference.pace(count)

    def braking(self, count: int) -> Array:
        return self.reference.braking(count)

    def command(self, state: SimulatedState, velocity: Array, dt: float) -> Array:
        """As the reference's, but no faster than the body can come to be by then: who sets out does not leave its body behind."""
        body = state.bodies.velocity[:, : velocity.shape[1]]
        pace = jnp.linalg.norm(velocity, axis=1)
        along = jnp.sum(body * velocity, axis=1) / jnp.where(pace > 0.0, pace, 1.0)
        limit = jnp.maximum(along, 0.0) + jnp.asarray(self.simulator.acceleration) * dt
        return self.reference.command(state.reference, shortened(velocity, limit), dt)

    def strayed(self, state: SimulatedState) -> Array:
        """(N,) how far the body is out of the disc that its model keeps round its reference, m; negative inside."""
        reference, body = state.reference, self.body(state)
        place = self.reference.place(reference)
        return jnp.linalg.norm(body - place, axis=1) - jnp.linalg.norm(self.reference.body(reference) - place, axis=1)

    def halt(self, state: SimulatedState, dt: float) -> Array:
        return self.reference.halt(state.reference, dt)

    def step(self, state: SimulatedState, command: Array, dt: float, wind: Array | None = None) -> SimulatedState:
        """The reference moves as its model does, unless its body is left behind; the simulator's body follows. Wind is the body's."""
        before, body = state.reference, self.body(state)
        behind = self.strayed(state) > WAITS * jnp.asarray(self.simulator.tube)
        command = jnp.where(behind[:, None], self.reference.halt(before, dt), command)
        after = self.reference.step(before, command, dt)
        air = jnp.zeros_like(body) if wind is None else wind

        follow = functools.partial(self.simulator.step, dt=dt)
        return SimulatedState(after, on_host(follow, self._shapes(len(body)), state.bodies, before, after, air))

    def lowest(self, state: SimulatedState, command: Array, normals: Array, dt: float) -> Array:
        return self.reference.lowest(state.reference, command, normals, dt)

    def rows(self, state: SimulatedState, normals: Array, least: Array, dt: float) -> Array:
        return self.reference.rows(state.reference, normals, least, dt)

    def farthest(self, state: SimulatedState, command: Array, dt: float) -> Array:
        return self.reference.farthest(state.reference, command, dt)

    def bounded(self, slack: Array, dt: float) -> Array:
        return self.reference.bounded(slack, dt)

    def approach(self, distance: Array, dt: float) -> Array:
        return self.reference.approach(distance, dt)

    def reach(self, state: SimulatedState, dt: float) -> tuple[Array, Array]:
        return self.reference.reach(state.reference, dt)

    def _shapes(self, count: int) -> Bodies:
        real = {"position": (count, 3), "velocity": (count, 3), "heading": (count,), "inner": (count, self.simulator.width)}
        flags = {"touching": (count, count), "struck": (count,)}
        return Bodies(
            **{name: jax.ShapeDtypeStruct(shape, jnp.float64) for name, shape in real.items()},
            **{name: jax.ShapeDtypeStruct(shape, jnp.bool_) for name, shape in flags.items()},
        )


def simulated(name: str, model: Model[Any], count: int, dimension: int, obstacles: Sequence[Any]) -> Simulated:
    """The model with its bodies in a simulator.

    Args:
        name: one of `SIMULATORS`.
        model: what the robots are.
        count: N.
        dimension: d.
        obstacles: the public map.

    Raises:
        InvalidSettings: there is no such simulator, what it needs is not installed, or it has no body for a kind of robot.
    """
    if name not in SIMULATORS:
        raise InvalidSettings(f"there is no simulator {name!r}{closest(name, SIMULATORS)}; choose {' or '.join(SIMULATORS)}")
    simulator = importlib.import_module(f"consat.robots.{name}").Simulator(model, count, dimension, obstacles)
    return Simulated(name, _reference(model), simulator)


def kinds_of(model: Model[Any], count: int) -> list[tuple[Any, np.ndarray]]:
    """The kinds of N robots, and which robots are of each."""
    return list(zip(model.models, model.members, strict=True)) if isinstance(model, Fleet) else [(model, np.arange(count))]


def _reference(model: Model[Any]) -> Model[Any]:
    """What commands move: of a quadrotor what it follows anyway."""
    if isinstance(model, Fleet):
        return Fleet([_reference(kind) for kind in model.models], model.kinds)
    return Double(model.radius, model.speed, model.acceleration) if isinstance(model, Quadrotor) else model


def _turned(vectors: Array, angle: Array) -> Array:
    """(N, d) vectors turned in the plane by (N,) angles."""
    if vectors.shape[1] == 1:
        return vectors
    cosine, sine = jnp.cos(angle), jnp.sin(angle)
    x, y = vectors[:, 0], vectors[:, 1]
    return jnp.concatenate([jnp.stack([cosine * x - sine * y, sine * x + cosine * y], axis=1), vectors[:, 2:]], axis=1)
