"""Main loop of a run, in rounds or in continuous time: advances the state by chunks, records, saves checkpoints and stops."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
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


class Course(Protocol):
    """A simulation that advances by chunks of steps."""

    tally: Any
    """Counters: `Steps` or a subclass."""
    end: int
    """Largest number of steps."""

    def start(self) -> tuple[Any, Rows]:
        """The initial state and its record."""
        ...

    def advance(self, state: Any, every: int) -> tuple[Any, Rows, Ending | None]:
        """Advance `state` by one chunk. The input buffers are donated and must not be used again.

        Args:
            state: the state.
            every: record one step in `every`.

        Returns:
            The new state, the record, and the reason to end the run; None to go on.
        """
        ...

    def agree(self, stop: bool) -> bool:
        """Whether any of the processes wants to stop. `stop`: whether this one does."""
        ...

    def look(self, state: Any) -> Rows:
        """Record of the present state."""
        ...

    def positions(self, state: Any) -> np.ndarray:
        """(N, d) positions of all agents."""
        ...

    def told(self, rows: Rows) -> Mapping[str, Any]:
        """Fields of the `Trace` that differ between rounds and flows. `rows`: the record of the run."""
        ...


def follow(
    course: Course, copies: Estimates, choice: Choice, *, sink: Sink, checkpoint: Checkpoint | None, problem: str,
    progress: Callable[[float, float], None],
) -> Trace:  # fmt: skip
    """Run a simulation to its end.

    Args:
        course: the simulation.
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
        course.tally.recorded += len(rows.step)
        course.tally.every = sink.every

    def save() -> None:
        if checkpoint is not None:
            sink.flush()
            checkpoint.write(state, course.tally.__dict__, problem)

    with CompileClock() as clock, heeded() as stopped:
        state, rows = course.start()
        taken = None if checkpoint is None else checkpoint.restore(state, problem)
        if taken is None:
            keep(rows)
        else:
            state, course.tally = taken[0], type(course.tally)(**taken[1])
            sink.every = course.tally.every
        while course.tally.done < course.end:
            state, rows, found = course.advance(state, sink.every)
            keep(rows)
            heard = _heard(progress, course.tally.done / course.end, course.tally.margin)
            if course.agree(stopped() or not heard) and found is None:
                found = "interrupted"
            if found is not None:
                ending = found
                break
            if checkpoint is not None and checkpoint.due():
                save()
        save()
    if course.tally.done % sink.every:  # the last step is always recorded
        sink.append(course.look(state))
    rows = sink.close()
    held = slice(None) if choice.copies is None else choice.copies
    return Trace(
        steps=rows.step,
        position=rows.position,
        margin=rows.margin,
        smooth_margin=rows.smooth_margin,
        agent_margin=rows.agent_margin,
        estimate=rows.estimate,
        integral=rows.integral,
        bound=rows.bound,
        holder=copies.holder[held],
        held=copies.position[held],
        cluster=copies.cluster,
        ending=ending,
        seconds=clock.seconds,
        recorded=None if choice.everyone else choice.agents,
        final=course.positions(state),
        file=sink.path,
        **course.told(rows),
    )


def _heard(progress: Callable[[float, float], None], done: float, margin: float) -> bool:
    """Report the progress. False if `progress` raises KeyboardInterrupt, which ends the run."""
    try:
        progress(done, margin)
    except KeyboardInterrupt:
        return False
    return True
