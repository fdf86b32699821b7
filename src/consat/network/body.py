"""The body of an agent: it is where it is, and follows the agent's estimate of where to be under a speed limit."""

from __future__ import annotations

from typing import Protocol

import numpy as np


class Body(Protocol):
    """Sensor and actuator."""

    def position(self) -> np.ndarray | None:
        """(d,) where it is, None before the first measurement."""
        ...

    def follow(self, target: np.ndarray, now: float) -> np.ndarray:
        """Go towards `target`, (d,); the velocity commanded, (d,), length/s."""
        ...


def limited(velocity: np.ndarray, speed: float) -> np.ndarray:
    """In the same direction, no faster than `speed`."""
    size = float(np.linalg.norm(velocity))
    return velocity * (speed / size) if size > speed else velocity


class SimulatedBody:
    """Moves as commanded, from one command to the next.

    Args:
        start: (d,).
        speed: the most that it moves, length/s; if infinite it is at once where it should be.
    """

    def __init__(self, start: np.ndarray, speed: float = np.inf) -> None:
        self._position = np.array(start, dtype=float)
        self._speed = speed
        self._last: float | None = None

    def position(self) -> np.ndarray:
        return self._position

    def follow(self, target: np.ndarray, now: float) -> np.ndarray:
        elapsed, self._last = (0.0 if self._last is None else now - self._last), now
        if not np.isfinite(self._speed):
            step = target - self._position
            self._position = target.copy()
            return step / elapsed if elapsed > 0 else np.zeros_like(target)
        if elapsed <= 0:
            return np.zeros_like(target)
        velocity = limited((target - self._position) / elapsed, self._speed)
        self._position = self._position + velocity * elapsed
        return velocity


class MeasuredBody:
    """A real one: its position is measured from outside, and what `follow` returns is commanded to it.

    Args:
        speed: the most that is commanded, length/s.
        lag: the time in which it would cover the distance, were there no limit, s.
    """

    def __init__(self, speed: float = np.inf, lag: float = 0.5) -> None:
        self._speed = speed
        self._lag = lag
        self._position: np.ndarray | None = None

    def measure(self, position: np.ndarray) -> None:
        """What the sensor says."""
        self._position = position

    def position(self) -> np.ndarray | None:
        return self._position

    def follow(self, target: np.ndarray, now: float) -> np.ndarray:
        if self._position is None:
            return np.zeros_like(target)
        return limited((target - self._position) / self._lag, self._speed)
