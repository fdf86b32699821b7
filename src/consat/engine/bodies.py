"""Bodies of the agents: they jump to the estimates, follow them at a limited speed, or are robots that drive."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

if TYPE_CHECKING:
    from consat.robots.drive import Drive

PATH = 8
"""Initial number of waypoints of a path. A path with more waypoints causes another compilation, which few maps need."""


@dataclass(frozen=True)
class Body:
    """Motion of the bodies in a round: p ← p + clip(x − p), at most speed/rate; or that of robots.

    Attributes:
        rate: rounds per second, Hz.
        speed: speed limit, length/s; infinite if a body is always at its agent's estimate.
        drive: the robots; None for bodies that follow the estimates.
        wind: (d,) velocity of the air, m/s.
        noise: largest error of a measured position, m.
    """

    rate: float
    speed: float = np.inf
    drive: Drive | None = None
    wind: tuple[float, ...] = ()
    noise: float = 0.0

    @property
    def reach(self) -> float | None:
        """Largest distance that a body moves in a round; None without a limit."""
        if self.drive is not None:
            return float(np.max(np.asarray(self.drive.model.pace(self.drive.count)))) / self.rate
        return self.speed / self.rate if np.isfinite(self.speed) else None


class Driven(NamedTuple):
    """State of the robots.

    Attributes:
        state: state of the models.
        memory: state of `consat.robots.drive`.
        paths: (N, W, d) planned paths; None without obstacles.
    """

    state: Any
    memory: Any
    paths: Array | None


def started(drive: Drive, place: Array) -> Driven:
    """Robots at rest at `place`, (N, d)."""
    state = drive.model.start(place)
    return Driven(state, drive.start(state), jnp.repeat(place[:, None], PATH, axis=1) if drive.map.count else None)


def moved(place: Array, target: Array, reach: Array | None) -> Array:
    """(N, d) positions after moving from `place` towards `target` by at most `reach`, (); to the target if `reach` is None."""
    if reach is None:
        return target
    away = target - place
    distance = jnp.linalg.norm(away, axis=1, keepdims=True)
    return jnp.where(distance > reach, place + away * (reach / jnp.where(distance > 0, distance, 1.0)), target)


def driven(drive: Drive, robots: Driven, targets: Array, key: Array, *, wind: Array | None, noise: Array | None) -> Driven:
    """The robots after driving for one round.

    Args:
        drive: model and filter of the robots.
        robots: state before the round.
        targets: (N, d) targets.
        key: random key of the measurement errors.
        wind: (d,) velocity of the air, m/s; None without wind.
        noise: () largest error of a measured position, m; None for exact measurements.
    """
    measured = None
    if noise is not None:
        direction = jax.random.normal(key, targets.shape)
        size = noise * jax.random.uniform(jax.random.fold_in(key, 1), (len(targets), 1))
        measured = drive.model.place(robots.state) + size * direction / jnp.linalg.norm(direction, axis=1, keepdims=True)
    wind = None if wind is None else jnp.broadcast_to(wind[None], targets.shape)
    paths = robots.paths
    if paths is not None:  # the path ends at the present target
        end = jnp.all(paths == paths[:, -1:], axis=2, keepdims=True)
        paths = jnp.where(end, targets[:, None], paths)
    state, memory, _ = drive.step(robots.state, robots.memory, targets, paths=paths, measured=measured, wind=wind)
    return Driven(state, memory, robots.paths)
