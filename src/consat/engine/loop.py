"""Main loop of a run, in rounds or in continuous time: advances the state by chunks, records, saves checkpoints and stops."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from consat.engine.checkpoint import Checkpoint
from consat.engine.interruption import heeded
from consat.engine.recording import Choice, Rows, Sink
from consat.numerics import CompileClock
from consat.protocols.estimates import Estimates
from consat.results.trace import Ending, Trace


@dataclass
class Steps:
    """Counters of a run. All fields are scalars or arrays, so that a checkpoint can store them.

    Attributes:
        done: number of the last step; a step is a round or a sample of a flow, and the start is step 0.
        margin: the last margin of the team.
        drift: largest distance that a position moved over the last chunk.
        recorded: number of steps in the record.
        every: record one step in `every`.
    """

    done: int = -1
    margin: float = np.nan
    drift: float = np.inf
    recorded: int = 0
    every: int = 1


class Traceable(Protocol):
    """A simulation of which `traced` makes a trace."""

    def positions(self) -> np.ndarray:
        """(N, d) positions of all agents."""
        ...

    def account(self, rows: Rows) -> Mapping[str, Any]:
        """Fields of the `Trace` that differ between rounds and flows. `rows`: the record of the run."""
        ...


class Simulation(Traceable, Protocol):
    """A simulation, in rounds or in continuous time, that advances by chunks of steps until it ends."""

    state: Any
    """State after the last step."""
    tally: Any
    """Counters: `Steps` or a subclass."""

    @property
    def end(self) -> int:
        """Largest number of steps."""
        ...

    def start(self) -> Rows:
        """Begin. Returns the record of the start."""
        ...

    def advance(self, every: int) -> tuple[Rows, Ending | None]:
        """Advance by one chunk.

        Args:
            every: record one step in `every`.

        Returns:
            The record, and the reason to end the run; None to go on.
        """
        ...

    def agree(self, stop: bool) -> bool:
        """Whether any of the processes wants to stop. `stop`: whether this one does."""
        ...

    def look(self) -> Rows:
        """Record of the present state."""
        ...


def follow(
    simulation: Simulation, copies: Estimates, choice: Choice, *, sink: Sink, checkpoint: Checkpoint | None, problem: str,
    progress: Callable[[float, float], None],
) -> Trace:  # fmt: skip
    """Run a simulation to its end.

    Args:
        simulation: the simulation.
        copies: the layout of estimates.
        choice: what is recorded.
        sink: where to record.
        checkpoint: where to save the state, and the checkpoint to resume from; None for neither.
        problem: fingerprint of the problem; see `consat.engine.checkpoint.fingerprint`.
        progress: called with the fraction done (of the longest possible run) and the margin.
    """
    ending: Ending = "out of time"

    def keep(rows: Rows) -> None:
        sink.append(rows)
        simulation.tally.recorded += len(rows.step)
        simulation.tally.every = sink.every

    def save() -> None:
        if checkpoint is not None:
            sink.flush()
            checkpoint.write(simulation.state, simulation.tally.__dict__, problem)

    with CompileClock() as clock, heeded() as stopped:
        rows = simulation.start()
        taken = None if checkpoint is None else checkpoint.restore(simulation.state, problem)
        if taken is None:
            keep(rows)
        else:
            simulation.state, simulation.tally = taken[0], type(simulation.tally)(**taken[1])
            sink.every = simulation.tally.every
        while simulation.tally.done < simulation.end:
            rows, found = simulation.advance(sink.every)
            keep(rows)
            heard = _heard(progress, simulation.tally.done / simulation.end, simulation.tally.margin)
            if simulation.agree(stopped() or not heard) and found is None:
                found = "interrupted"
            if found is not None:
                ending = found
                break
            if checkpoint is not None and checkpoint.due():
                save()
        save()
    if simulation.tally.done % sink.every:  # the last step is always recorded
        sink.append(simulation.look())
    return traced(simulation, sink.close(), copies, choice, ending=ending, seconds=clock.seconds, file=sink.path)


def traced(
    simulation: Traceable, rows: Rows, copies: Estimates, choice: Choice, *, ending: Ending, seconds: Mapping[str, float],
    file: Path | None = None,
) -> Trace:  # fmt: skip
    """The trace of a simulation.

    Args:
        simulation: the simulation.
        rows: its record.
        copies: the layout of estimates.
        choice: what was recorded.
        ending: why it ended.
        seconds: wall-clock time, s, for ``compile`` and ``run``.
        file: the file of the record; None if it is in memory.
    """
    held = slice(None) if choice.copies is None else choice.copies
    return Trace(
        steps=rows.step, position=rows.position, margin=rows.margin, smooth_margin=rows.smooth_margin, agent_margin=rows.agent_margin,
        estimate=rows.estimate, integral=rows.integral, bound=rows.bound,
        holder=copies.holder[held], held=copies.position[held], cluster=copies.cluster,
        ending=ending, seconds=seconds, recorded=None if choice.everyone else choice.agents, final=simulation.positions(), file=file,
        **simulation.account(rows),
    )  # fmt: skip


def _heard(progress: Callable[[float, float], None], done: float, margin: float) -> bool:
    """Report the progress. False if `progress` raises KeyboardInterrupt, which ends the run."""
    try:
        progress(done, margin)
    except KeyboardInterrupt:
        return False
    return True
