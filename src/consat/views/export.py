"""Export of a result to other file formats, chosen by the ending of the path."""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping
from importlib.util import find_spec
from pathlib import Path
from typing import Final

import numpy as np

from consat.errors import InvalidSettings, closest
from consat.results.result import Result

Progress = Callable[[float], None]


def _csv(result: Result, target: Path, progress: Progress | None) -> None:
    """One row per agent and recorded time or round: the time in s if rounds have a duration, position, and margin, empty if infinite."""
    import xarray as xr

    from consat.views.record import period, seconds

    data = result.data
    clock = str(data["position"].dims[0])
    columns = {str(axis): data["position"].sel(axis=axis, drop=True) for axis in data["axis"].values}
    if clock != "time" and period(result) is not None:
        columns = {"time": data[clock].copy(data=seconds(result, data[clock].values)), **columns}
    table = xr.Dataset({**columns, "margin": data["agent_margin"].where(np.isfinite(data["agent_margin"]))})
    table = table.drop_vars([name for name in table.coords if name not in (clock, "agent")])
    table.to_dataframe(dim_order=[clock, "agent"]).to_csv(target)


def _html(result: Result, target: Path, progress: Progress | None) -> None:
    from consat.views import replay

    replay.save(result, target)


def _film(result: Result, target: Path, progress: Progress | None) -> None:
    from consat.views import animation

    animation.save(result, target, progress=progress)


def _mcap(result: Result, target: Path, progress: Progress | None) -> None:
    if find_spec("foxglove") is None:
        raise InvalidSettings("an MCAP file needs foxglove-sdk; install it with: pip install 'consat[mcap]'")
    from consat.views import mcap

    mcap.save(result, target)


FORMATS: Final[Mapping[str, Callable[[Result, Path, Progress | None], None]]] = {
    ".csv": _csv,
    ".gif": _film,
    ".html": _html,
    ".mcap": _mcap,
    ".mp4": _film,
}
"""The function that writes each format, by ending."""


def save(result: Result, path: str | os.PathLike[str], *, progress: Progress | None = None) -> Path:
    """Write a result in one of `FORMATS`.

    Args:
        result: result of a run.
        path: path of the file.
        progress: called with the fraction that is done, 0 to 1, of a film.

    Raises:
        InvalidSettings: the ending is unknown, no positions were recorded, or an extra is not installed.
    """
    target = Path(path)
    suffix = target.suffix.lower()
    if suffix not in FORMATS:
        kinds = ", ".join(FORMATS)
        what = f"ends in {target.suffix}" if suffix else "has no ending"
        raise InvalidSettings(f"{target} {what}, but must end in one of {kinds}{closest(suffix, FORMATS) if suffix else ''}")
    if "position" not in result.data:
        raise InvalidSettings("nobody's positions were recorded, so there is nothing to export; run with --record all")
    target.parent.mkdir(parents=True, exist_ok=True)
    FORMATS[suffix](result, target, progress)
    return target
