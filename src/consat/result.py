"""What came out of a run: a summary, labelled arrays, save and load."""

from __future__ import annotations

import functools
import json
import os
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from consat.errors import InvalidResult
from consat.team import Team
from consat.trace import Trace

if TYPE_CHECKING:
    import xarray as xr

SCHEMA = "consat.result/1"
AXES = ("x", "y", "z")
SLIGHT = 1e-3
"""A constraint with a smaller multiplier does not bind."""


class Result:
    """The outcome of a run.

    Attributes:
        summary: what ``consat run --json`` prints: status, verdict, margin, bounds, satisfied_from, positions, agents …
        data: labelled arrays over time (or round), agent and axis; see `dataset`.
        scenario: the scenario text, or None for a team that no text can say (own callables).
    """

    def __init__(self, summary: Mapping[str, Any], data: xr.Dataset | None = None, *, trace: Trace | None = None, team: Team | None = None,
                 scenario: str | None = None) -> None:  # fmt: skip
        self.summary = dict(summary)
        self.scenario = scenario
        self._data = data
        self._trace = trace
        self._team = team

    @functools.cached_property
    def data(self) -> xr.Dataset:
        """The recorded arrays with named dimensions, units and everything needed to repeat the run among the attributes."""
        if self._data is not None:
            return self._data
        assert self._trace is not None
        assert self._team is not None
        return dataset(self._trace, self._team, self.summary, self.scenario)

    @functools.cached_property
    def team(self) -> Team | None:
        """The team that was run; read from the scenario text after loading, None if there is none."""
        if self._team is not None or self.scenario is None:
            return self._team
        from consat.scenario import loads

        return loads(self.scenario, name=self.summary["scenario"]).team

    def binding(self, name: str) -> list[str]:
        """The agents on whom their constraint of this name binds at the end of the run; empty where agents are not listed."""
        agents = (self.summary["agents"] or {}).items()
        return [agent for agent, told in agents if any(c["name"] == name and (c["multiplier"] or 0) > SLIGHT for c in told["constraints"])]

    def save(self, path: str | os.PathLike[str]) -> Path:
        """Write NetCDF-4; `Result.load` reads it back without loss."""
        target = Path(path)
        target.parent.mkdir(parents=True, exist_ok=True)
        self.data.to_netcdf(target, engine="h5netcdf", format="NETCDF4")
        return target

    @classmethod
    def load(cls, path: str | os.PathLike[str]) -> Result:
        """Read what `save` wrote.

        Raises:
            InvalidResult: no such file, or not a result of consat.
        """
        import xarray as xr

        if not Path(path).is_file():
            raise InvalidResult(f"{path}: there is no such file; `consat run SCENARIO --out DIR` writes DIR/result.nc")
        try:
            data = xr.load_dataset(path, engine="h5netcdf")
            schema, summary, scenario = data.attrs["schema"], json.loads(data.attrs["summary"]), data.attrs["scenario"]
        except (OSError, ValueError, KeyError, TypeError, RuntimeError) as error:
            raise InvalidResult(f"{path}: this is not a result of consat ({error}); give a file that `consat run --out` wrote") from error
        if schema != SCHEMA:
            raise InvalidResult(f"{path}: this is a {schema!r}, but this version of consat reads {SCHEMA!r}")
        return cls(summary, data, scenario=scenario or None)

    def plot(self, directory: str | os.PathLike[str] | None = None) -> list[Path]:
        """The figures of the run, as files in `directory`, or on the screen if None; see `consat.views.figures`."""
        from consat.views import figures

        return figures.save(self, directory) if directory is not None else figures.show(self)

    def animate(self, path: str | os.PathLike[str]) -> Path:
        """The run as an animated GIF; see `consat.views.animation`."""
        from consat.views import animation

        return animation.save(self, path)

    def __str__(self) -> str:
        from consat.views import words

        return words.summary(self.summary)

    def __repr__(self) -> str:
        return f"<Result of {self.summary['scenario']}: {self.summary['status']}, margin {self.summary['margin']}>"


def dataset(trace: Trace, team: Team, summary: Mapping[str, Any], scenario: str | None) -> xr.Dataset:
    """A trace with names: dimensions time or round, agent, axis, and for copies `copy` with its holder and the agent it is of."""
    import xarray as xr

    clock = trace.clock
    ids = np.array(team.ids, dtype=object)
    axes = [AXES[k] if team.dimension <= len(AXES) else f"x{k + 1}" for k in range(team.dimension)]
    along = {"time": "s", "round": "1"}[clock]
    space = (clock, "agent", "axis")
    data = xr.Dataset(
        {
            "position": (space, trace.position, {"units": "length", "long_name": "own position x_i"}),
            "velocity": (space, trace.velocity, {"units": "length/s", "long_name": "velocity command u_i"}),
            "margin": (clock, trace.margin, {"long_name": "margin β̄, the smallest ψ of the team"}),
            "smooth_margin": (clock, trace.smooth_margin, {"long_name": "smooth margin β"}),
            "agent_margin": ((clock, "agent"), trace.agent_margin, {"long_name": "agent margin ᾱ_i"}),
        },
        coords={clock: (clock, trace.steps, {"units": along}), "agent": ids, "axis": axes, "cluster": ("agent", trace.cluster)},
        attrs={"schema": SCHEMA, "summary": json.dumps(summary), "scenario": scenario or ""},
    )
    data.attrs |= {key: summary[key] for key in ("version", "seed", "protocol", "status", "verdict")}
    for name, values, words in (("estimate", trace.estimate, "estimate x_j^(i)"), ("integral", trace.integral, "integral state z_i")):
        if values is not None:
            data[name] = ((clock, "copy", "axis"), values, {"long_name": words})
            data = data.assign_coords(holder=("copy", ids[trace.holder]), held=("copy", ids[trace.held]))
    return data
