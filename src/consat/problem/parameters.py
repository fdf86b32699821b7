"""What the parameters of a constraint may be: numbers and vectors, one for a constraint, or arrays of them for a group's."""

from __future__ import annotations

import math
from typing import Any

import jax
import numpy as np

from consat.errors import Fault, counted, shown
from consat.problem.constraints.record import Fixed, Number, Parameter, Vector

LARGEST = 1e100
"""Numbers beyond this are refused: their squares must stay finite in float64."""

Path = tuple[str | int, ...]


def checked(parameter: Parameter, dimension: int, path: Path, key: str, where: str, faults: list[Fault]) -> np.ndarray | None:
    """The value of one parameter as an array; None, and a fault, if it may not be so."""
    if isinstance(parameter, Fixed):
        try:
            return np.asarray(parameter.value, dtype=float)
        except (TypeError, ValueError):
            faults.append(Fault(path, f"{key} must be a number or an array of numbers, but is {parameter.value!r}", where))
            return None
    if isinstance(parameter, Number):
        return number(parameter, path, key, where, faults)
    value = vector(parameter.value, dimension, path, key, where, faults)
    if value is not None and parameter.nonzero and not np.any(value):
        faults.append(Fault(path, f"{key} is zero, but must point somewhere", where))
    if value is not None and parameter.above is not None:
        low = vector(parameter.above, dimension, (*path[:-1], "low"), "low", where, faults)
        if low is not None and not np.all(value > low):
            faults.append(Fault(path, f"{key} is {value.tolist()}, but must be above low {low.tolist()} on every axis", where))
    return value


def checked_rows(parameter: Parameter, size: tuple[int, int], path: Path, key: str, where: str, faults: list[Fault]) -> np.ndarray | None:
    """As `checked`, for an array with one value for each of so many constraints; `size` is their number, and the dimension."""
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
    faults.append(Fault(path, f"{key} {message}", where))
    return None


def is_number(value: Any) -> bool:
    """Whether `value` is a number, which truth values are not."""
    return isinstance(value, int | float | np.integer | np.floating) and not isinstance(value, bool)


def number(parameter: Number, path: Path, key: str, where: str, faults: list[Fault]) -> np.ndarray | None:
    """The value of a real parameter."""
    value = parameter.value
    want = "a positive number" if parameter.positive else "a number"
    if isinstance(value, np.ndarray | jax.Array) and value.ndim == 0:
        value = value.item()
    if not is_number(value) or not math.isfinite(value) or abs(value) > LARGEST:
        faults.append(Fault(path, f"{key} is {shown(value)}, but must be {want}{_limit(value)}", where))
        return None
    if parameter.positive and value < 1 / LARGEST:
        faults.append(Fault(path, f"{key} is {value!r}, but must be {want}", where))
        return None
    return np.asarray(float(value))


def vector(value: Any, dimension: int, path: Path, key: str, where: str, faults: list[Fault]) -> np.ndarray | None:
    """A vector with `dimension` entries; with any number of them if that is 0, unknown."""
    entries = value.tolist() if isinstance(value, np.ndarray | jax.Array) else value
    numbers = f"{dimension} number" + ("s" if dimension > 1 else "")
    if not isinstance(entries, list | tuple):
        faults.append(Fault(path, f"{key} is {shown(value)}, but must be a list of {numbers}", where))
    elif dimension and len(entries) != dimension:
        message = f"{key} has {counted(len(entries), 'entry', 'entries')}, but must have {dimension}, one for each dimension of the team"
        faults.append(Fault(path, message, where))
    elif bad := [entry for entry in entries if not is_number(entry) or not math.isfinite(entry) or abs(entry) > LARGEST]:
        faults.append(Fault(path, f"{key} holds {shown(bad[0])}, but must be a list of {numbers}{_limit(bad[0])}", where))
    else:
        return np.array(entries, dtype=float)
    return None


def _limit(value: Any) -> str:
    return f" of size at most {LARGEST:g}" if is_number(value) and abs(value) > LARGEST else ""
