"""Parameters that move with time: linear between given times, held before the first and after the last."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

KEYS: Final = ("times", "values")
MOST_TIMES: Final = 100_000
FOREVER: Final = 2.0**40
"""s; a power of two, so that the time itself, as a schedule, is exact."""


@dataclass(frozen=True, eq=False)
class Schedule:
    """A number or a vector that moves; see `schedule`.

    Attributes:
        times: K, s.
        values: K, as the parameter is.
    """

    times: Any
    values: Any

    def at(self, time: float) -> np.ndarray:
        """The value at a time, s; of a checked one, whose times and values are arrays."""
        return np.asarray(Track.of({0: self}).at(time)[0])

    def plain(self) -> dict[str, Any]:
        """As a scenario file has it."""
        return {"times": np.asarray(self.times).tolist(), "values": np.asarray(self.values).tolist()}


def schedule(times: ArrayLike, values: ArrayLike) -> Schedule:
    """A parameter of a constraint that moves: linear between `times`, held before the first and after the last.

    ``cs.within(cs.schedule([0, 10], [[0, 0], [5, 0]]), 1)`` is a disc that moves by 5 in ten seconds. `consat.Team` checks it.

    Args:
        times: (K,) rising, s.
        values: (K,) numbers or (K, d) vectors, whichever the parameter is.
    """
    return Schedule(times, values)


CLOCK: Final = Schedule([0.0, FOREVER], [0.0, FOREVER])
"""The time itself, s."""


class Track(NamedTuple):
    """How a parameter of some constraints of a family moves.

    Attributes:
        rows: (R,) which constraints, rising.
        times: (R, K) s, rising.
        values: (R, K, …).
    """

    rows: np.ndarray
    times: np.ndarray
    values: np.ndarray

    @classmethod
    def of(cls, moving: Mapping[int, Schedule]) -> Track:
        """From the checked schedules of some constraints."""
        most = max(len(each.times) for each in moving.values())
        padded = [_padded(np.asarray(each.times, dtype=float), np.asarray(each.values, dtype=float), most) for each in moving.values()]
        times, values = (np.stack(column) for column in zip(*padded, strict=True))
        return cls(np.array(list(moving), dtype=np.int32), times, values)

    def at(self, time: float) -> np.ndarray:
        """(R, …) the values at a time, s."""
        k, part = _place(self.times, time)
        row = np.arange(len(k))
        low, high = self.values[row, k], self.values[row, np.minimum(k + 1, self.times.shape[1] - 1)]
        return np.asarray(low + part.reshape(-1, *[1] * (low.ndim - 1)) * (high - low))

    def joined(self, more: Sequence[tuple[Track, int]]) -> Track:
        """With those of further constraints, whose rows begin so much later."""
        tracks = [self, *(track for track, _ in more)]
        most = max(track.times.shape[1] for track in tracks)
        padded = [_padded(track.times, track.values, most) for track in tracks]
        rows = np.concatenate([self.rows, *(track.rows + np.int32(offset) for track, offset in more)])
        return Track(rows, *(np.concatenate(column) for column in zip(*padded, strict=True)))

    def chosen(self, rows: np.ndarray) -> Track | None:
        """Of some constraints, (M',) ascending, which are numbered anew; None if none of them moves."""
        where = np.searchsorted(rows, self.rows)
        inside = (where < len(rows)) & (rows[np.minimum(where, len(rows) - 1)] == self.rows) if len(rows) else np.zeros(0, dtype=bool)
        if not np.any(inside):
            return None
        return Track(where[inside].astype(np.int32), self.times[inside], self.values[inside])

    @property
    def knots(self) -> np.ndarray:
        """The times at which it bends; not those of the clock."""
        return np.unique(self.times[self.times < FOREVER])

    def schedule(self, row: int) -> Schedule | None:
        """Of one constraint, as it was given; None if it does not move."""
        place = int(np.searchsorted(self.rows, row))
        if place == len(self.rows) or self.rows[place] != row:
            return None
        times, values = self.times[place], self.values[place]
        kept = np.concatenate([[True], np.isfinite(times[1:])])
        return Schedule(times[kept], values[kept])


def chosen(tracks: Mapping[str, Track], rows: np.ndarray) -> dict[str, Track]:
    """The tracks of some constraints, (M',) ascending."""
    kept = ((key, track.chosen(rows)) for key, track in tracks.items())
    return {key: track for key, track in kept if track is not None}


def _padded(times: np.ndarray, values: np.ndarray, most: int) -> tuple[np.ndarray, np.ndarray]:
    """(…, K) and (…, K, …) → with `most` times; the last value is held at times without end."""
    axis = times.ndim - 1
    missing = most - times.shape[axis]
    if not missing:
        return times, values
    width = [(0, 0)] * axis + [(0, missing)]
    return np.pad(times, width, constant_values=np.inf), np.pad(values, width + [(0, 0)] * (values.ndim - axis - 1), mode="edge")


def _place(times: np.ndarray, time: float) -> tuple[np.ndarray, np.ndarray]:
    """(R,) the last of the times, (R, K), that is past, and which part of the way to the next has passed."""
    k = np.maximum((times <= time).sum(axis=1) - 1, 0)
    row = np.arange(len(times))
    here, there = times[row, k], times[row, np.minimum(k + 1, times.shape[1] - 1)]
    gap = there - here
    with np.errstate(invalid="ignore", divide="ignore"):
        part = np.where((gap > 0) & np.isfinite(gap), (time - here) / np.where(gap > 0, gap, 1.0), 0.0)
    return k, np.clip(part, 0.0, 1.0)
