"""Files in the directory of a run: the record, the checkpoint, and the result file at the end."""

from __future__ import annotations

import dataclasses
import json
import tempfile
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from consat.engine import checkpoint
from consat.engine.checkpoint import Checkpoint
from consat.engine.recording import Choice, Log
from consat.errors import InvalidResult, InvalidSettings
from consat.problem.team import Team
from consat.protocols.estimates import Estimates
from consat.results.netcdf import VARIABLES, attribute, write
from consat.results.result import RESULT, attributes, labels, variables
from consat.results.trace import Trace

LOG = "record.bin"
SECONDS = 10.0
"""Default time between two checkpoints, s."""


SWEEP = "sweep.json"
"""Summary file of `consat.sweep`, beside its figure and table."""


def claim(directory: Path, scenario: str, *, force: bool) -> None:
    """Check, before a run, that a directory is writable and holds no results of another scenario.

    Args:
        directory: directory of the results; created if missing.
        scenario: name of the scenario whose results will be written.
        force: whether to overwrite existing files of any origin.

    Raises:
        InvalidSettings: the directory is not writable, holds results of another scenario, or holds a foreign file with a name of a result.
    """
    try:
        directory.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=directory):
            pass
    except OSError as error:
        raise InvalidSettings(f"results cannot be written to {directory} ({error.strerror or error}); choose another folder") from error
    if force:
        return
    for name, whose in ((RESULT, _of_result), (SWEEP, _of_sweep), (checkpoint.NAME, checkpoint.scenario)):
        if not (directory / name).is_file():
            continue
        try:
            other = whose(directory / name)
        except (OSError, ValueError, KeyError, TypeError, InvalidResult):
            raise InvalidSettings(f"{directory / name} is not of consat, and would be overwritten; {CHOOSE}") from None
        if other not in (None, scenario):
            raise InvalidSettings(f"{directory} holds results of another scenario, {other!r}; {CHOOSE}")


CHOOSE = "choose another folder, or overwrite it with --force (force=True in Python)"


def _of_result(path: Path) -> str:
    return str(json.loads(attribute(path, "summary"))["scenario"])


def _of_sweep(path: Path) -> str:
    return str(json.loads(path.read_text(encoding="utf-8"))["scenario"])


@dataclass(frozen=True)
class Files:
    """Output files of a run.

    Attributes:
        directory: directory of the files; created if missing.
        seconds: time between two checkpoints, s. None writes no checkpoints; a resumed run then keeps the interval of its checkpoint.
        taken_up: arrays and metadata of the checkpoint to resume from; None for a new run.
    """

    directory: Path
    seconds: float | None = None
    taken_up: tuple[Mapping[str, np.ndarray], Mapping[str, Any]] | None = None

    @property
    def about(self) -> Mapping[str, Any]:
        """Metadata of the checkpoint to resume from; empty for a new run."""
        return {} if self.taken_up is None else self.taken_up[1]

    def sink(self, team: Team, copies: Estimates, choice: Choice, clock: str, *, heading: bool = False) -> Log:
        """Create the record.

        Args:
            team: the team.
            copies: the layout of estimates.
            choice: what is recorded.
            clock: ``time`` or ``round``.
            heading: whether bodies have a heading.

        Raises:
            InvalidResult: the record of the run to resume is missing.
        """
        names = variables(self._labels(team, copies, choice), integral=clock == "time", bound=clock == "round", heading=heading)
        sizes = {"agent": len(choice.agents), "axis": team.dimension, "copy": 0 if choice.copies is None else len(choice.copies)}
        shapes = {name: tuple(sizes[along] for along in VARIABLES[name][0]) for name in names if clock == "time" or name != "velocity"}
        path = self.directory / LOG
        if self.taken_up is None:
            return Log(path, {"step": (), **shapes}, choice.every)
        if not path.is_file():
            raise InvalidResult(f"{path}: this is missing, but belongs to the checkpoint beside it")
        return Log(path, {"step": (), **shapes}, choice.every, int(self.about["tally"]["recorded"]))

    def _labels(self, team: Team, copies: Estimates, choice: Choice) -> dict[str, np.ndarray]:
        held = None if choice.copies is None else (copies.holder[choice.copies], copies.position[choice.copies])
        return labels(team.ids, None if choice.everyone else choice.agents, copies.cluster, held)

    def checkpoints(self, about: Mapping[str, Any]) -> Checkpoint | None:
        """Create the checkpoint writer; None without checkpoints. `about`: metadata needed to resume the run."""
        seconds = self.about.get("seconds", SECONDS) if self.taken_up is not None and self.seconds is None else self.seconds
        if seconds is None:
            return None
        return Checkpoint(self.directory / checkpoint.NAME, seconds, {**about, "seconds": seconds}, self.taken_up)

    def finish(self, log: Log, trace: Trace, team: Team, summary: Mapping[str, Any], scenario: str | None) -> Trace:
        """Write the result file, and delete the record if no checkpoint needs it. Returns the trace with the path of the result."""
        path = self.directory / RESULT
        copies = None if trace.estimate is None else (trace.holder, trace.held)
        named = labels(team.ids, trace.recorded, trace.cluster, copies)
        write(
            path, trace.clock,
            variables(named, integral=trace.integral is not None, bound=trace.bound is not None, heading=trace.heading is not None),
            named, team.dimension, count=log.count, steps=log.steps(1.0 if trace.period is None else trace.period),
            attributes=attributes(summary, scenario), final=None if trace.recorded is None else trace.end,
        )  # fmt: skip
        if self.seconds is None and self.taken_up is None:
            (self.directory / LOG).unlink()
        return dataclasses.replace(trace, file=path)
