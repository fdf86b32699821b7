"""Robots of several kinds as one model. Each kind computes its own robots; the results are joined."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any

import jax.numpy as jnp
import numpy as np
from jax import Array

from consat.errors import Fault, InvalidInput, counted
from consat.robots.model import Model


@dataclass(frozen=True, eq=False)
class Fleet:
    """Several models, and the model of each robot.

    The state is a tuple with the state of each model. A command has the columns of the widest model; the others are padded with 0.

    Args:
        models: the models. A parameter with one value per robot has the order of the robots of that model.
        kinds: (N,) the model of each robot, by index.

    Raises:
        InvalidInput: a number in `kinds` has no model, or a model has no robot.
    """

    models: Sequence[Model[Any]]
    kinds: np.ndarray
    members: tuple[np.ndarray, ...] = field(init=False)

    def __post_init__(self) -> None:
        kinds = np.asarray(self.kinds)
        if kinds.ndim != 1 or sorted(set(kinds.tolist())) != list(range(len(self.models))):
            text = (
                f"must name each of {counted(len(self.models), 'model')} by its index at least once, but has {sorted(set(kinds.tolist()))}"
            )
            raise InvalidInput([Fault(("kinds",), text, "fleet")])
        object.__setattr__(self, "kinds", kinds)
        object.__setattr__(self, "members", tuple(np.flatnonzero(kinds == kind) for kind in range(len(self.models))))

    @property
    def dimensions(self) -> tuple[int, ...]:
        return tuple(sorted(set.intersection(*(set(model.dimensions) for model in self.models))))

    @property
    def inertial(self) -> bool:
        return any(model.inertial for model in self.models)

    @property
    def radius(self) -> np.ndarray:
        parts = [np.broadcast_to(model.radius, len(rows)) for model, rows in zip(self.models, self.members, strict=True)]
        return np.concatenate(parts)[np.argsort(np.concatenate(self.members))]

    def start(self, position: Array) -> tuple[Any, ...]:
        return tuple(model.start(position[rows]) for model, rows in zip(self.models, self.members, strict=True))

    def place(self, state: tuple[Any, ...]) -> Array:
        return self._mapped(lambda model, part, rows: model.place(part), state)

    def body(self, state: tuple[Any, ...]) -> Array:
        return self._mapped(lambda model, part, rows: model.body(part), state)

    def heading(self, state: tuple[Any, ...]) -> Array:
        return self._mapped(lambda model, part, rows: model.heading(part), state)

    def stop(self, state: tuple[Any, ...], dt: float) -> Array:
        return self._mapped(lambda model, part, rows: model.stop(part, dt), state)

    def velocity(self, state: tuple[Any, ...], command: Array) -> Array:
        return self._mapped(lambda model, part, rows: model.velocity(part, self._own(model, part, command[rows])), state)

    def size(self, count: int, dt: float) -> Array:
        return self._joined([model.size(len(rows), dt) for model, rows in zip(self.models, self.members, strict=True)])

    def pace(self, count: int) -> Array:
        return self._joined([model.pace(len(rows)) for model, rows in zip(self.models, self.members, strict=True)])

    def halting(self, count: int, dt: float) -> Array:
        return self._joined([model.halting(len(rows), dt) for model, rows in zip(self.models, self.members, strict=True)])

    def command(self, state: tuple[Any, ...], velocity: Array, dt: float) -> Array:
        return self._mapped(lambda model, part, rows: model.command(part, velocity[rows], dt), state)

    def halt(self, state: tuple[Any, ...], dt: float) -> Array:
        return self._mapped(lambda model, part, rows: model.halt(part, dt), state)

    def step(self, state: tuple[Any, ...], command: Array, dt: float, wind: Array | None = None) -> tuple[Any, ...]:
        return tuple(
            model.step(part, self._own(model, part, command[rows]), dt, None if wind is None else wind[rows])
            for model, part, rows in zip(self.models, state, self.members, strict=True)
        )

    def lowest(self, state: tuple[Any, ...], command: Array, normals: Array, dt: float) -> Array:
        return self._mapped(lambda model, part, rows: model.lowest(part, self._own(model, part, command[rows]), normals[rows], dt), state)

    def rows(self, state: tuple[Any, ...], normals: Array, least: Array, dt: float) -> Array:
        return self._mapped(lambda model, part, rows: model.rows(part, normals[rows], least[rows], dt), state)

    def farthest(self, state: tuple[Any, ...], command: Array, dt: float) -> Array:
        return self._mapped(lambda model, part, rows: model.farthest(part, self._own(model, part, command[rows]), dt), state)

    def bounded(self, slack: Array, dt: float) -> Array:
        return self._joined([model.bounded(slack[rows], dt) for model, rows in zip(self.models, self.members, strict=True)])

    def approach(self, distance: Array, dt: float) -> Array:
        return self._joined([model.approach(distance[rows], dt) for model, rows in zip(self.models, self.members, strict=True)])

    def reach(self, state: tuple[Any, ...], dt: float) -> tuple[Array, Array]:
        parts = [model.reach(part, dt) for model, part in zip(self.models, state, strict=True)]
        return self._joined([center for center, _ in parts]), self._joined([radius for _, radius in parts])

    def _own(self, model: Model[Any], part: Any, command: Array) -> Array:
        """The columns of a command that a model has."""
        return command[:, : model.halt(part, 1.0).shape[1]]

    def _mapped(self, function: Callable[[Model[Any], Any, np.ndarray], Array], state: tuple[Any, ...]) -> Array:
        return self._joined([function(model, part, rows) for model, part, rows in zip(self.models, state, self.members, strict=True)])

    def _joined(self, parts: list[Array]) -> Array:
        """Join the rows of all models in the order of the robots. Narrower rows are padded with 0."""
        if parts[0].ndim == 2:
            width = max(part.shape[1] for part in parts)
            parts = [jnp.pad(part, ((0, 0), (0, width - part.shape[1]))) for part in parts]
        return jnp.concatenate(parts)[np.argsort(np.concatenate(self.members))]
