"""The record of a run as views draw it: positions and margins at any moment.

A moment is a sample index; a fractional one is interpolated between two samples.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

import numpy as np

from consat.results.result import Result

if TYPE_CHECKING:
    import xarray as xr


MOST_NUMBERS = 10_000_000
"""Most numbers of a record that are drawn. A larger record is thinned to evenly spaced steps."""


class Record:
    """Positions and margins of the recorded agents.

    Args:
        result: result of a run with recorded positions.

    Attributes:
        data: the recorded steps, as in the result.
        team: the team; None if it is unknown, or if not all agents are recorded, whose positions regions need.
        ids: ids of the recorded agents.
        x: (T, N, d) positions.
        times: (T,) times, s; round numbers if rounds have no duration.
        steps: (T,) what is shown: times, s, or round numbers if rounds have no duration.
        clock: ``time`` or ``round``: what `steps` are.
        margin: (T,) margins of the team.
        agent_margin: (T, N) margins of the agents.
        last: index of the last sample at which every position is finite.
    """

    def __init__(self, result: Result) -> None:
        self.data = recorded(result)
        self.team = None if "final_position" in self.data else result.team
        self.ids = [str(name) for name in self.data["agent"].values]
        self.x, self.clock = self.data["position"].values, str(self.data["position"].dims[0])
        self.steps, self.margin, self.agent_margin = (self.data[name].values for name in (self.clock, "margin", "agent_margin"))
        finite = np.flatnonzero(np.isfinite(self.x).all(axis=(1, 2)))
        self.last = int(finite[-1]) if len(finite) else 0
        self.times = seconds(result, self.steps.astype(float))
        if period(result) is not None:
            self.clock, self.steps = "time", self.times

    def time(self, moment: float) -> float:
        """Time of a moment, s."""
        return float(between(self.times, moment)[0])

    def where(self, moment: float) -> np.ndarray:
        """(N, d) positions at a moment."""
        return between(self.x, moment)[0]

    def trail(self, moment: float) -> np.ndarray:
        """(K, N, 2 or 3) drawn coordinates of the agents from the start to a moment. On a line, the first coordinate is the clock."""
        dimension = self.x.shape[2]
        passed = np.append(np.arange(math.ceil(moment), dtype=float), moment)
        x = between(self.x, passed)[:, :, : 3 if dimension == 3 else 2]
        clock = np.broadcast_to(between(self.steps, passed)[:, None, None], x.shape)
        return np.concatenate([clock, x], axis=2) if dimension == 1 else x

    def moments(self, count: int, movement: float, longest: float = 1.0) -> np.ndarray:
        """Moments from start to end, (count,), spaced by a mean of distance travelled and clock.

        Args:
            count: number of moments.
            movement: weight of the distance, 0 to 1.
            longest: largest share of the moments within one recorded step, if there are enough steps.
        """
        return spread(self.x[: self.last + 1], self.steps[: self.last + 1], count, movement, longest)


def spread(x: np.ndarray, steps: np.ndarray, count: int, movement: float, longest: float = 1.0) -> np.ndarray:
    """The moments of `Record.moments` for positions x, (T, N, d), at steps, (T,)."""
    way = np.append(0.0, np.cumsum(np.linalg.norm(np.nan_to_num(np.diff(x, axis=0)), axis=(1, 2))))
    clock = np.asarray(steps, dtype=float) - float(steps[0])
    share = movement * way / (way[-1] or 1.0) + (1 - movement) * clock / (clock[-1] or 1.0)
    gaps, longest = np.diff(share), max(longest, 1.2 / max(1, len(share) - 1))
    for _ in range(100 if longest < 1.0 else 0):  # cutting gaps makes the others larger, relative to the sum
        gaps = np.minimum(gaps, longest * gaps.sum())
    share = np.append(0.0, np.cumsum(gaps))
    return np.interp(np.linspace(0.0, share[-1], count), share, np.arange(len(share)))


def between(series: np.ndarray, moment: Any) -> np.ndarray:
    """(K, …) values of a series (T, …) at K moments, interpolated linearly."""
    moment = np.atleast_1d(moment)
    share = (moment % 1).reshape(-1, *(1,) * (series.ndim - 1))
    return (1 - share) * series[moment.astype(int)] + share * series[np.ceil(moment).astype(int)]


def recorded(result: Result) -> xr.Dataset:
    """The record of a run. A very long record is thinned to evenly spaced steps, first and last included."""
    data = result.data
    clock = str(data["margin"].dims[0])
    count, row = data.sizes[clock], sum(math.prod(data[name].shape[1:]) for name in data.data_vars if clock in data[name].dims)
    most = max(2, MOST_NUMBERS // max(row, 1))
    return data if count <= most else data.isel({clock: evenly(count, most)})


def seconds(result: Result, steps: np.ndarray) -> np.ndarray:
    """Times, s, of recorded steps. If rounds have no duration, the round numbers."""
    return steps * (period(result) or 1.0)


def period(result: Result) -> float | None:
    """Duration of one unit of the record's clock, s; None if rounds have no known duration."""
    clock = str(result.data["margin"].dims[0])
    last, motion, verdicts = float(result.data[clock].values[-1]), result.summary.get("motion"), result.summary.get("verdicts")
    duration = motion["duration"] if motion else verdicts[-1]["to"] if verdicts else None
    return 1.0 if clock == "time" else None if duration is None or not last > 0 else float(duration) / last


def evenly(count: int, most: int) -> list[int]:
    """At most `most` evenly spaced indices out of `count`."""
    return [int(place) for place in np.linspace(0, count - 1, min(count, most))]
