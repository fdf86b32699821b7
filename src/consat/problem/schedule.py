"""Parameters that move with time: linear between the given times, constant before the first and after the last."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

KEYS: Final = ("times", "values")
MOST_TIMES: Final = 100_000
FOREVER: Final = 2.0**40
"""End of `CLOCK`, s. A power of two, so that linear interpolation of the clock is exact."""


@dataclass(frozen=True, eq=False)
class Schedule:
    """A number or vector that moves with time; see `schedule`.

    Attributes:
        times: (K,) increasing, s.
        values: (K,) numbers or (K, d) vectors, in the unit of the parameter.
    """

    times: Any
    values: Any

    def at(self, time: float) -> np.ndarray:
        """The value at `time`, s. The schedule must be checked: its times and values must be arrays."""
        return np.asarray(Track.of({0: self}).at(time)[0])

    def plain(self) -> dict[str, Any]:
        """The schedule as plain lists, as a scenario file writes it."""
        return {"times": np.asarray(self.times).tolist(), "values": np.asarray(self.values).tolist()}


def schedule(times: ArrayLike, values: ArrayLike) -> Schedule:
    """A constraint parameter that moves: linear between `times`, constant before the first and after the last.

    ``cs.within(cs.schedule([0, 10], [[0, 0], [5, 0]]), 1)`` is a disc that moves by 5 in ten seconds. `consat.Team` checks the schedule.

    Args:
        times: (K,) increasing, s.
        values: (K,) numbers or (K, d) vectors, as the parameter requires.
    """
    return Schedule(times, values)


CLOCK: Final = Schedule([0.0, FOREVER], [0.0, FOREVER])
"""The schedule whose value is the time, s."""


class Track(NamedTuple):
    """The schedules of one parameter for R constraints of a family, stacked.

    Attributes:
        rows: (R,) int32 indices of the constraints in the family, increasing.
        times: (R, K) increasing, s; padded with infinity.
        values: (R, K, …) values at these times; padded with the last one.
    """

    rows: np.ndarray
    times: np.ndarray
    values: np.ndarray

    @classmethod
    def of(cls, moving: Mapping[int, Schedule]) -> Track:
        """The track of checked schedules, given by the indices of their constraints in the family."""
        most = max(len(each.times) for each in moving.values())
        padded = [_padded(np.asarray(each.times, dtype=float), np.asarray(each.values, dtype=float), most) for each in moving.values()]
        times, values = (np.stack(column) for column in zip(*padded, strict=True))
        return cls(np.array(list(moving), dtype=np.int32), times, values)

    def at(self, time: Any, xp: Any = np) -> Any:
        """(R, …) the values at `time`, s. `xp`: the library of the arrays, `numpy` or `jax.numpy`."""
        times, values = self.times, self.values
        k = xp.maximum((times <= time).sum(axis=1).astype(np.int32) - 1, 0)  # the last time that is ≤ `time`
        row, after = xp.arange(len(k), dtype=k.dtype), xp.minimum(k + 1, times.shape[1] - 1)
        here, gap = times[row, k], times[row, after] - times[row, k]
        moving = (gap > 0) & xp.isfinite(gap)
        part = xp.clip(xp.where(moving, (time - here) / xp.where(moving, gap, 1.0), 0.0), 0.0, 1.0)
        low, high = values[row, k], values[row, after]
        return low + part.reshape(-1, *[1] * (low.ndim - 1)) * (high - low)

    @classmethod
    def joined(cls, parts: Sequence[tuple[Track, int]]) -> Track:
        """Several tracks as one.

        Args:
            parts: pairs of a track and the offset to add to its rows.
        """
        most = max(track.times.shape[1] for track, _ in parts)
        padded = [_padded(track.times, track.values, most) for track, _ in parts]
        rows = np.concatenate([track.rows + np.int32(offset) for track, offset in parts])
        return cls(rows, *(np.concatenate(column) for column in zip(*padded, strict=True)))

    def chosen(self, rows: np.ndarray) -> Track | None:
        """The track of a subset of the constraints, renumbered from 0; None if none of them moves.

        Args:
            rows: (M',) ascending indices of the constraints to keep.
        """
        kept = np.isin(self.rows, rows)
        if not kept.any():
            return None
        return Track(np.searchsorted(rows, self.rows[kept]).astype(np.int32), self.times[kept], self.values[kept])

    @property
    def knots(self) -> np.ndarray:
        """The distinct times of all schedules, s, except the end of the clock."""
        return np.unique(self.times[self.times < FOREVER])

    def schedule(self, row: int) -> Schedule | None:
        """The schedule of one constraint, without padding; None if it does not move."""
        place = int(np.searchsorted(self.rows, row))
        if place == len(self.rows) or self.rows[place] != row:
            return None
        times, values = self.times[place], self.values[place]
        kept = np.concatenate([[True], np.isfinite(times[1:])])
        return Schedule(times[kept], values[kept])


def _padded(times: np.ndarray, values: np.ndarray, most: int) -> tuple[np.ndarray, np.ndarray]:
    """Pads (…, K) times and (…, K, …) values to `most` entries: times with infinity, values with the last value."""
    axis = times.ndim - 1
    missing = most - times.shape[axis]
    if not missing:
        return times, values
    width = [(0, 0)] * axis + [(0, missing)]
    return np.pad(times, width, constant_values=np.inf), np.pad(values, width + [(0, 0)] * (values.ndim - axis - 1), mode="edge")
