"""Writes the result file: NetCDF-4, a chunk of steps at a time."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import h5netcdf
import h5py
import numpy as np

SCHEMA = "consat.result/1"
AXES = ("x", "y", "z")
VARIABLES: Mapping[str, tuple[tuple[str, ...], Mapping[str, str]]] = {
    "position": (("agent", "axis"), {"units": "length", "long_name": "own position x_i"}),
    "velocity": (("agent", "axis"), {"units": "length/s", "long_name": "velocity command u_i"}),
    "margin": ((), {"long_name": "margin β̄, the smallest ψ of the team"}),
    "smooth_margin": ((), {"long_name": "smooth margin β"}),
    "bound": ((), {"long_name": "bound on the best margin, proven by all agents"}),
    "agent_margin": (("agent",), {"long_name": "agent margin ᾱ_i"}),
    "heading": (("agent",), {"units": "rad", "long_name": "heading of the body"}),
    "estimate": (("copy", "axis"), {"long_name": "estimate x_j^(i)"}),
    "integral": (("copy", "axis"), {"long_name": "integral state z_i"}),
}
"""For each recorded array: its dimensions after that of the clock, and its attributes."""
FINAL = {"units": "length", "long_name": "last position of every agent, in the team's order"}
"""Attributes of ``final_position``, (member, axis), which is written if not all agents are recorded."""
UNITS = {"time": "s", "round": "1"}


def axis_names(dimension: int) -> list[str]:
    """The names of the axes of space: x, y, z; in more than three dimensions x1, x2, …"""
    return [AXES[k] if dimension <= len(AXES) else f"x{k + 1}" for k in range(dimension)]


def attribute(path: Path, name: str) -> str:
    """An attribute of a result file, as text.

    Raises:
        OSError: there is no such file, or it is not a NetCDF-4 file.
        KeyError: the file has no such attribute.
    """
    with h5netcdf.File(path, "r") as file:
        return str(file.attrs[name])


def write(
    path: Path,
    clock: str,
    names: Sequence[str],
    labels: Mapping[str, np.ndarray],
    dimension: int,
    *,
    count: int,
    steps: Iterable[Mapping[str, Any]],
    attributes: Mapping[str, Any],
    final: np.ndarray | None,
) -> None:
    """Write a result file in chunks of steps, so that the whole record is never in memory.

    The file is written under a temporary name and renamed at the end, so it is complete or missing.

    Args:
        path: path of the file.
        clock: ``time`` or ``round``.
        names: the variables to write, of `VARIABLES`.
        labels: coordinates as `consat.results.result.labels` returns: ``agent`` and ``cluster``, (R,), if any agent is recorded; ``holder``
            and ``held``, (E,), if estimates are.
        dimension: d.
        count: total number of steps.
        steps: chunks, each with ``step`` and the variables as arrays with the steps along axis 0.
        attributes: attributes of the file.
        final: (N, d) last positions of all agents, if not all are recorded; else None.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    part = path.with_name(path.name + ".part")
    text = h5py.string_dtype()
    with h5netcdf.File(part, "w") as file:
        sizes = {"agent": len(labels["agent"])} if "agent" in labels else {}
        sizes |= {"copy": len(labels["holder"])} if "holder" in labels else {}
        file.dimensions = {clock: count, "axis": dimension, **sizes}
        _variable(file, clock, (clock,), np.int64 if clock == "round" else np.float64, {"units": UNITS[clock]})
        _variable(file, "axis", ("axis",), text, {})[:] = np.array(axis_names(dimension), dtype=object)
        for name, values in labels.items():
            along = "agent" if name in ("agent", "cluster") else "copy"
            _variable(file, name, (along,), text if values.dtype == object else values.dtype, {})[:] = values
        for name in names:
            dimensions, words = VARIABLES[name]
            _variable(file, name, (clock, *dimensions), np.float64, words)
        done = 0
        for rows in steps:
            more = len(rows["step"])
            for name, values in rows.items():
                file.variables[clock if name == "step" else name][done : done + more] = values
            done += more
        if final is not None:
            file.dimensions["member"] = len(final)
            _variable(file, "final_position", ("member", "axis"), np.float64, FINAL)[:] = final
        for name, value in {**attributes, "coordinates": " ".join(name for name in labels if name != "agent")}.items():
            file.attrs[name] = value
    part.replace(path)


def _variable(file: Any, name: str, along: tuple[str, ...], dtype: Any, attributes: Mapping[str, str]) -> Any:
    variable = file.create_variable(name, along, dtype)
    for key, value in attributes.items():
        variable.attrs[key] = value
    return variable
