"""`Result`: the outcome of a run as a summary and labelled arrays. It can be saved and loaded."""

from __future__ import annotations

import functools
import json
import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

import numpy as np

from consat.errors import InvalidResult
from consat.problem.team import Team
from consat.results.netcdf import FINAL, SCHEMA, UNITS, VARIABLES, axis_names
from consat.results.summaries import RunSummary
from consat.results.trace import Trace

if TYPE_CHECKING:
    import xarray as xr

RESULT = "result.nc"
"""Name of the result file in the directory of a run."""
LARGE = 2**28
"""Size of a file, in bytes, above which its arrays are loaded on access only."""
MOST_EXPLAINED = 200
"""Largest number of agents for which `Result.reasons` explains an infeasible team. For larger teams use `consat.solve`."""
SLIGHT = 1e-3
"""A constraint with a multiplier up to this does not bind."""


class Result:
    """The outcome of a run.

    Attributes:
        summary: what ``consat run --json`` prints: status, verdict, margin, bounds, satisfied_from, positions, agents …
        data: labelled arrays over time (or round), agent and axis; see `dataset`.
        scenario: text of the scenario; None if the team has Python functions, which a scenario file cannot hold.
    """

    def __init__(self, summary: Mapping[str, Any], data: xr.Dataset | None = None, *, trace: Trace | None = None, team: Team | None = None,
                 scenario: str | None = None) -> None:  # fmt: skip
        self.summary = cast(RunSummary, dict(summary))
        self.scenario = scenario
        self._data = data
        self._trace = trace
        self._team = team

    @functools.cached_property
    def data(self) -> xr.Dataset:
        """The recorded arrays with named dimensions and units. The attributes hold everything needed to repeat the run."""
        if self._data is not None:
            return self._data
        assert self._trace is not None
        assert self._team is not None
        if self._trace.file is not None:
            return _read(self._trace.file)
        return dataset(self._trace, self._team, self.summary, self.scenario)

    @functools.cached_property
    def team(self) -> Team | None:
        """The team of the run. After loading, it is read from the scenario text; None if there is no text."""
        if self._team is not None or self.scenario is None:
            return self._team
        from consat.scenario import loads

        return loads(self.scenario, name=self.summary["scenario"]).team

    def binding(self, name: str) -> list[str]:
        """The ids of agents whose constraint with this name binds at the end of the run; empty if the summary does not list agents."""
        agents = (self.summary["agents"] or {}).items()
        return [
            agent for agent, entry in agents if any(c["name"] == name and (c["multiplier"] or 0) > SLIGHT for c in entry["constraints"])
        ]

    def save(self, path: str | os.PathLike[str]) -> Path:
        """Write a NetCDF-4 file, which `Result.load` reads back without loss. Returns its path."""
        target = Path(path)
        if self._trace is not None and self._trace.file is not None and target.resolve() == self._trace.file.resolve():
            return target  # the file was written during the run
        target.parent.mkdir(parents=True, exist_ok=True)
        self.data.to_netcdf(target, engine="h5netcdf", format="NETCDF4")
        return target

    @classmethod
    def load(cls, path: str | os.PathLike[str]) -> Result:
        """Read a file written by `save`.

        Args:
            path: path of the file, or of the directory of a run that contains it.

        Raises:
            InvalidResult: there is no such file, or it is not a result of consat.
        """
        path = Path(path) / RESULT if Path(path).is_dir() else Path(path)
        if not path.is_file():
            raise InvalidResult(f"{path}: there is no such file; `consat run SCENARIO --out DIR` writes DIR/{RESULT}")
        try:
            data = _read(path)
            schema, summary, scenario = data.attrs["schema"], json.loads(data.attrs["summary"]), data.attrs["scenario"]
        except (OSError, ValueError, KeyError, TypeError, RuntimeError) as error:
            raise InvalidResult(f"{path}: this is not a result of consat ({error}); give a file that `consat run --out` wrote") from error
        if schema != SCHEMA:
            raise InvalidResult(f"{path}: this is a {schema!r}, but this version of consat reads {SCHEMA!r}")
        return cls(summary, data, scenario=scenario or None)

    def plot(self, directory: str | os.PathLike[str] | None = None) -> list[Path]:
        """Draw the figures of the run: as files in `directory`, or on the screen if None. See `consat.views.figures`."""
        from consat.views import figures

        return figures.save(self, directory) if directory is not None else figures.show(self)

    def animate(self, path: str | os.PathLike[str]) -> Path:
        """Write the run as an animated GIF or an MP4 video; see `consat.views.animation`."""
        from consat.views import animation

        return animation.save(self, path)

    def html(self, path: str | os.PathLike[str]) -> Path:
        """Write the run as one HTML file that replays it offline; see `consat.views.replay`."""
        from consat.views import replay

        return replay.save(self, path)

    def export(self, path: str | os.PathLike[str]) -> Path:
        """Write the run in the format of the file name's ending: .csv, .gif, .html, .mcap, .mp4. See `consat.views.export`."""
        from consat.views import export

        return export.save(self, path)

    def __str__(self) -> str:
        from consat.views import words

        return words.summary(self.summary, self.reasons)

    @functools.cached_property
    def reasons(self) -> list[str]:
        """Sentences that explain why the team cannot be satisfied, as `consat.solve` gives them: the conflict, how much is missing, a cure.

        Empty unless the verdict is ``infeasible``, and for teams of more than `MOST_EXPLAINED` agents.
        """
        team = self.team if self.summary["verdict"] == "infeasible" else None
        if team is None or team.count > MOST_EXPLAINED:
            return []
        from consat.certify.optimum import max_min
        from consat.certify.reasons import explain

        if over_time := self.summary.get("verdicts"):
            team = team.at(over_time[-1]["to"])  # the verdict is of the end
        return explain(team, max_min(team))

    def _repr_html_(self) -> str:
        from consat.views import notebook

        return notebook.result(self)

    def __repr__(self) -> str:
        return f"<Result of {self.summary['scenario']}: {self.summary['status']}, margin {self.summary['margin']}>"


def _read(path: Path) -> xr.Dataset:
    import xarray as xr

    if path.stat().st_size > LARGE:
        return xr.open_dataset(path, engine="h5netcdf")
    return xr.load_dataset(path, engine="h5netcdf")


def labels(
    ids: Sequence[str], agents: np.ndarray | None, cluster: np.ndarray, copies: tuple[np.ndarray, np.ndarray] | None
) -> dict[str, np.ndarray]:
    """The coordinates of a record: (R,) ``agent`` and ``cluster`` if any agent is recorded; (E,) ``holder`` and ``held`` if estimates are.

    Args:
        ids: ids of the team.
        agents: (R,) indices of the recorded agents; None for all.
        cluster: (N,) cluster of each agent.
        copies: (E,) holder and (E,) held agent of each recorded estimate; None if estimates are not recorded.
    """
    found: dict[str, np.ndarray] = {}
    if agents is None or len(agents):
        names = list(ids) if agents is None else [ids[int(i)] for i in agents]
        found |= {"agent": np.array(names, dtype=object), "cluster": cluster if agents is None else cluster[agents]}
    if copies is not None and len(copies[0]):
        for name, members in zip(("holder", "held"), copies, strict=True):
            found[name] = np.array([ids[int(i)] for i in members], dtype=object)
    return found


def variables(named: Mapping[str, np.ndarray], *, integral: bool, bound: bool, heading: bool) -> list[str]:
    """The names of the recorded variables.

    Args:
        named: the coordinates, as `labels` returns.
        integral: whether integral states are recorded.
        bound: whether bounds on the margin are recorded.
        heading: whether headings are recorded.
    """
    of_agents = ["position", "velocity", "agent_margin", *(["heading"] if heading else [])] if "agent" in named else []
    of_copies = ["estimate", *(["integral"] if integral else [])] if "holder" in named else []
    return ["margin", "smooth_margin", *(["bound"] if bound else []), *of_agents, *of_copies]


def attributes(summary: Mapping[str, Any], scenario: str | None) -> dict[str, Any]:
    """The attributes of a result file: schema, summary, scenario text, and some values of the summary."""
    chosen = {key: summary[key] for key in ("version", "seed", "protocol", "status", "verdict")}
    return {"schema": SCHEMA, "summary": json.dumps(summary), "scenario": scenario or "", **chosen}


def dataset(trace: Trace, team: Team, summary: Mapping[str, Any], scenario: str | None) -> xr.Dataset:
    """A trace as a labelled dataset. Dimensions: time or round, agent, axis; for estimates ``copy``, with its holder and the agent held."""
    import xarray as xr

    clock = trace.clock
    copies = None if trace.estimate is None else (trace.holder, trace.held)
    named = labels(team.ids, trace.recorded, trace.cluster, copies)
    along = {"agent": "agent", "cluster": "agent", "holder": "copy", "held": "copy"}
    data = xr.Dataset(
        {
            name: ((clock, *VARIABLES[name][0]), getattr(trace, name), VARIABLES[name][1])
            for name in variables(
                named, integral=trace.integral is not None, bound=trace.bound is not None, heading=trace.heading is not None
            )
        },
        coords={
            clock: (clock, trace.steps, {"units": UNITS[clock]}),
            "axis": axis_names(team.dimension),
            **{name: (along[name], values) for name, values in named.items()},
        },
        attrs=attributes(summary, scenario),
    )
    if trace.recorded is not None:
        data["final_position"] = (("member", "axis"), trace.end, FINAL)
    return data
