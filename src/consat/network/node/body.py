"""The body of an agent: it is where it is, and follows the agent's estimate of where to be under a speed limit."""

from __future__ import annotations

from typing import Any, Final, NamedTuple, Protocol

import numpy as np

SLACK: Final = 0.5
"""A measurement is believed where the body could be by now, and as far beyond as it moves in so long, s."""
VALID: Final = 0.5
"""A command is valid for so long, s: a robot that has got no other by then must stand."""
CONFIRMED: Final = 5
"""So many measurements on end that agree with each other, but not with the last good one, are believed: the body was moved."""


class Body(Protocol):
    """Sensor and actuator."""

    def position(self) -> np.ndarray | None:
        """(d,) where it is, as far as is known; None before the first measurement."""
        ...

    def sensed(self, now: float) -> bool:
        """Whether its position is known as of now."""
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

    def sensed(self, now: float) -> bool:
        return True

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


class Measurement(NamedTuple):
    """What a sensor said.

    Attributes:
        position: (d,) finite.
        time: when it came, by the agent's clock, s.
        stamp: the sensor's own number for it, which rises; None if it gives none.
        heading: which way the body looks, rad; None if nobody says.
        neighbours: (k, d) where others near it are; None if nobody says.
    """

    position: np.ndarray
    time: float
    stamp: float | None = None
    heading: float | None = None
    neighbours: np.ndarray | None = None


class MeasuredBody:
    """A real one: its position is measured from outside, and what `follow` returns is commanded to it.

    A measurement that cannot follow the last good one, by its stamp or by its distance, is not believed. After `CONFIRMED` on end that
    can follow each other the body was moved, and they are. Stamps turn back only after the sensor was silent for `timeout`: it was
    started anew.

    Args:
        speed: the most that is commanded, length/s. Without one any distance is believed.
        timeout: a body not measured for so long, s, is not known to be anywhere, and stands.
        lag: the time in which it would cover the distance, were there no limit, s.
    """

    valid = VALID

    def __init__(self, speed: float = np.inf, timeout: float = np.inf, lag: float = 0.5) -> None:
        self._speed, self._timeout, self._lag = speed, timeout, lag
        self._good: Measurement | None = None
        self._rival: Measurement | None = None
        self._agreeing = 0

    def measure(self, new: Measurement) -> str | None:
        """Take in what the sensor says; why not, if it is not believed."""
        good = self._good
        why = None if good is None else self._doubt(good, new)
        if good is not None and why is not None:
            agrees = self._rival is not None and self._doubt(self._rival, new) is None
            self._agreeing = self._agreeing + 1 if agrees else 1
            self._rival = new
            early = _turns_back(good, new) and self.sensed(new.time)
            if self._agreeing < CONFIRMED or early:
                return why
        elif good is not None and new.stamp is None:
            new = new._replace(stamp=good.stamp)
        self._good, self._rival, self._agreeing = new, None, 0
        return None

    def _doubt(self, last: Measurement, new: Measurement) -> str | None:
        """Why a measurement cannot follow another one, if it cannot."""
        if _turns_back(last, new):
            return f"its stamp is {new.stamp:.17g}, but must be above {last.stamp:.17g}, the last one"
        distance, elapsed = float(np.linalg.norm(new.position - last.position)), max(new.time - last.time, 0.0)
        if distance > self._speed * (elapsed + SLACK):
            return f"it is {distance:.3g} from the last one, {elapsed:.2g} s ago, but the body moves by {self._speed:.3g} a second"
        return None

    def named(self, command: np.ndarray) -> dict[str, Any]:
        """A command as it is told."""
        return {"velocity": command.tolist()}

    def position(self) -> np.ndarray | None:
        return None if self._good is None else self._good.position

    def sensed(self, now: float) -> bool:
        return self._good is not None and now - self._good.time <= self._timeout

    def follow(self, target: np.ndarray, now: float) -> np.ndarray:
        if self._good is None or not self.sensed(now):
            return np.zeros_like(target)
        return limited((target - self._good.position) / self._lag, self._speed)


def _turns_back(last: Measurement, new: Measurement) -> bool:
    return last.stamp is not None and new.stamp is not None and new.stamp <= last.stamp
