"""Validation of constraint parameters: numbers, vectors and schedules of them; for groups also arrays with one value per constraint."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from typing import Any, NamedTuple, TypeAlias

import jax
import numpy as np

from consat.errors import Fault, counted, shown
from consat.problem.constraints.record import Fixed, Number, Parameter, Vector
from consat.problem.schedule import KEYS, MOST_TIMES, Schedule

LARGEST = 1e100
"""Largest size of a number in the input. The square must stay finite in float64."""

Path = tuple[str | int, ...]
"""A place in the input as keys and indices; see `consat.errors.Fault`."""
Moving: TypeAlias = "np.ndarray | Schedule"
"""A checked parameter: a constant array, or a schedule if it moves with time."""


class Spot(NamedTuple):
    """Where a value stands in the input.

    Attributes:
        path: its place as keys and indices.
        name: what messages call it: its key.
        where: the agent and constraint in words.
        faults: list to which its faults are added.
    """

    path: Path
    name: str
    where: str
    faults: list[Fault]

    def under(self, key: str) -> Spot:
        """The spot of the value under a key of this one."""
        return Spot((*self.path, key), key, self.where, self.faults)

    def fault(self, message: str, *part: str | int) -> None:
        """Add a fault of the value, or of a part of it. Returns None, so that a check can end with it."""
        self.faults.append(Fault((*self.path, *part), message, self.where))


def checked(parameter: Parameter, dimension: int, spot: Spot) -> Moving | None:
    """Check one parameter.

    Args:
        parameter: the value and what it must satisfy.
        dimension: d, the length of a vector.
        spot: where it stands.

    Returns:
        the value as an array, or a schedule of arrays; None if it is not valid.
    """
    moves = isinstance(parameter.value, Schedule | Mapping)
    value = (scheduled if moves else still)(parameter, dimension, spot)
    if value is not None and isinstance(parameter, Vector) and parameter.above is not None:
        low = checked(Vector(parameter.above), dimension, spot._replace(path=(*spot.path[:-1], "low"), name="low"))
        if low is not None:
            _require_above(value, low, spot)
    return value


def _require_above(value: Moving, low: Moving, spot: Spot) -> None:
    times = np.unique(np.concatenate([np.zeros(1), *(each.times for each in (value, low) if isinstance(each, Schedule))]))
    for time in times.tolist():
        high, floor = (each.at(time) if isinstance(each, Schedule) else each for each in (value, low))
        if not np.all(high > floor):
            when = f" at {time:g} s" if len(times) > 1 else ""
            spot.fault(f"{spot.name} is {high.tolist()}{when}, but must be above low {floor.tolist()} on every axis")
            return


def scheduled(parameter: Parameter, dimension: int, spot: Spot) -> Schedule | None:
    """A schedule of arrays, each value checked as a constant one is; None, and a fault, if it is not valid. Arguments as in `checked`."""
    times, values = _schedule(parameter.value, spot)
    if times is None or values is None:
        return None
    known = len(spot.faults)
    each = [
        still(dataclasses.replace(parameter, value=value), dimension, spot._replace(path=(*spot.path, "values", k)))
        for k, value in enumerate(values)
    ]
    if len(spot.faults) > known:
        return None
    found = [value for value in each if value is not None]
    if any(value.shape != found[0].shape for value in found):
        return spot.fault(f"the values of {spot.name} must have one shape throughout", "values")
    made = Schedule(np.array(times, dtype=float), np.stack(found))
    if isinstance(parameter, Vector) and parameter.nonzero and (k := _through_zero(made.values)) is not None:
        when = f"between {times[k]:g} s and {times[k + 1]:g} s"
        return spot.fault(f"{spot.name} passes through zero {when}, but must point somewhere at all times", "values", k + 1)
    return made


def _schedule(value: Any, spot: Spot) -> tuple[list[float] | None, list[Any] | None]:
    """The times and values of a schedule: lists of equal length, with increasing finite times. (None, None), and a fault, otherwise."""
    key = spot.name
    example = f"{key}: {{times: [0, 10], values: [.., ..]}}"

    def wrong(message: str, *at: str | int) -> tuple[None, None]:
        spot.fault(message, *at)
        return None, None

    if isinstance(value, Mapping):
        if unknown := [name for name in value if name not in KEYS]:
            return wrong(f"a schedule has no key {shown(unknown[0])}; it has times and values, as in {example}", unknown[0])
        if missing := [name for name in KEYS if name not in value]:
            return wrong(f"{key} is a schedule without {missing[0]}; it has times and values, as in {example}")
        value = Schedule(value["times"], value["values"])
    both = (value.times, value.values)
    times, values = (entries.tolist() if isinstance(entries, np.ndarray | jax.Array) else entries for entries in both)
    for name, entries in zip(KEYS, (times, values), strict=True):
        if not isinstance(entries, list | tuple) or not entries or len(entries) > MOST_TIMES:
            return wrong(f"{name} of {key} is {shown(entries)}, but must be a list of 1 to {MOST_TIMES:,} entries, as in {example}", name)
    if bad := [k for k, time in enumerate(times) if not is_number(time) or not abs(time) <= LARGEST]:
        return wrong(f"times of {key} hold {shown(times[bad[0]])}, but must be finite numbers, s", "times", bad[0])
    if bad := [k for k in range(1, len(times)) if not times[k] > times[k - 1]]:
        message = f"times of {key} must rise, but {shown(times[bad[0]])} follows {shown(times[bad[0] - 1])}"
        return wrong(message, "times", bad[0])
    if len(values) != len(times):
        message = f"{key} has {counted(len(times), 'time')} and {counted(len(values), 'value')}, but must have a value for each time"
        return wrong(message, "values")
    return [float(time) for time in times], list(values)


def _through_zero(values: np.ndarray) -> int | None:
    """Index of the first of (K, d) vectors whose straight segment to the next one passes through zero; None if there is none."""
    here, there = values[:-1], values[1:]
    along = there - here
    part = np.clip(-np.sum(here * along, axis=1) / np.maximum(np.sum(along**2, axis=1), 1e-300), 0.0, 1.0)
    least = np.linalg.norm(here + part[:, None] * along, axis=1)
    size = np.linalg.norm(here, axis=1) + np.linalg.norm(there, axis=1)
    bad = np.flatnonzero(least <= 1e-12 * size)
    return int(bad[0]) if len(bad) else None


def still(parameter: Parameter, dimension: int, spot: Spot) -> np.ndarray | None:
    """The value of a constant parameter as an array; None, and a fault, if it is not valid. Arguments as in `checked`."""
    if isinstance(parameter, Fixed):
        try:
            return np.asarray(parameter.value, dtype=float)
        except (TypeError, ValueError, OverflowError):
            return spot.fault(f"{spot.name} must be a number or an array of numbers, but is {parameter.value!r}")
    if isinstance(parameter, Number):
        return number(parameter, spot)
    value = vector(parameter.value, dimension, spot)
    if value is not None and parameter.nonzero and not np.any(value):
        return spot.fault(f"{spot.name} is zero, but must point somewhere")
    return value


def checked_rows(parameter: Parameter, size: tuple[int, int], spot: Spot) -> np.ndarray | None:
    """Check an array with one value per constraint.

    Args:
        parameter: the array and what each value must satisfy.
        size: (M, d), the number of constraints and the dimension.
        spot: where it stands.

    Returns:
        (M,) numbers or (M, d) vectors as floats; None, and a fault, if they are not valid.
    """
    shape = size if isinstance(parameter, Vector) else size[:1]
    value = np.asarray(parameter.value)
    message = None
    if value.shape != shape or value.dtype.kind not in "iuf":
        message = (
            f"has shape {value.shape} and holds {value.dtype}, but must be numbers of shape {shape}, one for each of these constraints"
        )
    elif not (np.abs(value) <= LARGEST).all():
        message = f"must be finite and of size at most {LARGEST:g} throughout"
    elif isinstance(parameter, Number) and parameter.positive and not (value >= 1 / LARGEST).all():
        message = "must be positive throughout"
    elif isinstance(parameter, Vector) and parameter.nonzero and not value.any(axis=1).all():
        message = "must be nonzero throughout"
    elif isinstance(parameter, Vector) and parameter.above is not None and not (value > np.asarray(parameter.above)).all():
        message = "must be above low on every axis, throughout"
    if message is None:
        return value.astype(float)
    return spot.fault(f"{spot.name} {message}")


def is_number(value: Any) -> bool:
    """Whether `value` is a real number. Booleans are not."""
    return isinstance(value, int | float | np.integer | np.floating) and not isinstance(value, bool)


def is_whole(value: Any, low: int, high: int) -> bool:
    """Whether `value` is an integer from `low` to `high`. Booleans are not."""
    return isinstance(value, int | np.integer) and not isinstance(value, bool) and bool(low <= value <= high)


def is_printable(value: Any) -> bool:
    """Whether `value` is a text that can be shown: an id or a name."""
    return isinstance(value, str) and bool(value.strip()) and value.isprintable()


def number(parameter: Number, spot: Spot) -> np.ndarray | None:
    """The value of a scalar parameter as an array of shape (); None, and a fault, if it is not valid."""
    value = parameter.value
    want = "a positive number" if parameter.positive else "a number"
    if isinstance(value, np.ndarray | jax.Array) and value.ndim == 0:
        value = value.item()
    if not is_number(value) or not abs(value) <= LARGEST:
        return spot.fault(f"{spot.name} is {shown(value)}, but must be {want}{_limit(value)}")
    if parameter.positive and value < 1 / LARGEST:
        return spot.fault(f"{spot.name} is {value!r}, but must be {want}")
    return np.asarray(float(value))


def vector(value: Any, dimension: int, spot: Spot) -> np.ndarray | None:
    """A vector as a (dimension,) array; None, and a fault, if it is not valid. `dimension` 0 means unknown: any length is accepted."""
    entries = value.tolist() if isinstance(value, np.ndarray | jax.Array) else value
    numbers = f"{dimension} number" + ("s" if dimension > 1 else "")
    if not isinstance(entries, list | tuple):
        return spot.fault(f"{spot.name} is {shown(value)}, but must be a list of {numbers}")
    if dimension and len(entries) != dimension:
        has = counted(len(entries), "entry", "entries")
        return spot.fault(f"{spot.name} has {has}, but must have {dimension}, one for each dimension of the team")
    if bad := [entry for entry in entries if not is_number(entry) or not abs(entry) <= LARGEST]:
        return spot.fault(f"{spot.name} holds {shown(bad[0])}, but must be a list of {numbers}{_limit(bad[0])}")
    return np.array(entries, dtype=float)


def _limit(value: Any) -> str:
    return f" of size at most {LARGEST:g}" if is_number(value) and abs(value) > LARGEST else ""
