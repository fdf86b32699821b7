"""Sensor and actuator interface of a robot: measured positions, and commands towards the agent's estimate of its own position."""

from __future__ import annotations

from typing import Any, Final, NamedTuple, Protocol

import numpy as np

SLACK: Final = 0.5
"""Additional travel time, s, in the plausibility check: a measurement is accepted up to speed × (elapsed time + `SLACK`) from the last."""
VALID: Final = 0.5
"""Validity of a command, s. A robot that has received no other command by then must stop."""
LAG: Final = 0.5
"""Time constant of the motion towards a target, s: the commanded velocity is distance/`LAG`, up to the largest speed."""
CONFIRMED: Final = 5
"""Number of consecutive measurements, consistent with each other but not with the last good one, that are accepted: the body was moved."""


class Body(Protocol):
    """Sensor and actuator interface of a robot."""

    def position(self) -> np.ndarray | None:
        """(d,) the last known position; None before the first measurement."""
        ...

    def sensed(self, now: float) -> bool:
        """Whether the position is known at the time `now`, s."""
        ...

    def follow(self, target: np.ndarray, now: float) -> None:
        """Move towards `target`, (d,), if the body is simulated. `now`: time, s."""
        ...


def limited(vector: np.ndarray, most: float) -> np.ndarray:
    """The vector, (d,), scaled down to at most the length `most`."""
    size = float(np.linalg.norm(vector))
    return vector * (most / size) if size > most else vector


class SimulatedBody:
    """Simulated body, which moves as commanded.

    Args:
        start: (d,) initial position.
        speed: largest speed, length/s; if infinite, the body is at its target at once.
    """

    def __init__(self, start: np.ndarray, speed: float = np.inf) -> None:
        self._position = np.array(start, dtype=float)
        self._speed = speed
        self._last: float | None = None

    def position(self) -> np.ndarray:
        return self._position

    def sensed(self, now: float) -> bool:
        return True

    def follow(self, target: np.ndarray, now: float) -> None:
        elapsed, self._last = (0.0 if self._last is None else now - self._last), now
        if not np.isfinite(self._speed):
            self._position = target.copy()
        elif elapsed > 0:
            self._position = self._position + limited(target - self._position, self._speed * elapsed)


class Measurement(NamedTuple):
    """One measurement of a sensor.

    Attributes:
        position: (d,) position; finite.
        time: time of arrival, by the agent's clock, s.
        stamp: increasing number that the sensor assigns; None without one.
        heading: heading of the body, rad; None if not measured.
        neighbours: (k, d) positions of robots nearby; None if not measured.
    """

    position: np.ndarray
    time: float
    stamp: float | None = None
    heading: float | None = None
    neighbours: np.ndarray | None = None


class MeasuredBody:
    """A real body: its position is measured externally, and `Commander` sends it the result of `command`.

    A measurement is rejected if it is inconsistent with the last good one, by its stamp or by its distance. After `CONFIRMED` consecutive
    measurements that are consistent with each other the new position is accepted: the body was moved. Smaller stamps are accepted only
    after the sensor was silent for `timeout`: it was restarted.

    Args:
        speed: largest commanded speed, length/s. If infinite, any distance is plausible.
        timeout: time without a measurement, s, after which the position counts as unknown, and the body is commanded to stop.
    """

    valid = VALID

    def __init__(self, speed: float = np.inf, timeout: float = np.inf) -> None:
        self._speed, self._timeout = speed, timeout
        self._good: Measurement | None = None
        self._rival: Measurement | None = None
        self._agreeing = 0

    def measure(self, new: Measurement) -> str | None:
        """Process a measurement. Returns the reason if it is rejected, else None."""
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
        """Reason why the measurement `new` is inconsistent with `last`; None if it is consistent."""
        if _turns_back(last, new):
            return f"its stamp is {new.stamp:.17g}, but must be above {last.stamp:.17g}, the last one"
        distance, elapsed = float(np.linalg.norm(new.position - last.position)), max(new.time - last.time, 0.0)
        if distance > self._speed * (elapsed + SLACK):
            return f"it is {distance:.3g} from the last one, {elapsed:.2g} s ago, but the body moves by {self._speed:.3g} a second"
        return None

    def named(self, command: np.ndarray) -> dict[str, Any]:
        """A command as fields of a log event."""
        return {"velocity": command.tolist()}

    def position(self) -> np.ndarray | None:
        return None if self._good is None else self._good.position

    def sensed(self, now: float) -> bool:
        return self._good is not None and now - self._good.time <= self._timeout

    def follow(self, target: np.ndarray, now: float) -> None:
        """Does nothing: the body is commanded, see `consat.network.node.commander`."""

    def command(self, target: np.ndarray, now: float) -> np.ndarray:
        """The command, (m,), that moves the body towards `target`, (d,); to stop if its position is unknown. `now`: time, s."""
        if self._good is None or not self.sensed(now):
            return np.zeros_like(target)
        return limited((target - self._good.position) / LAG, self._speed)


def _turns_back(last: Measurement, new: Measurement) -> bool:
    return last.stamp is not None and new.stamp is not None and new.stamp <= last.stamp
