"""The loop around a run, in rounds or in continuous time: what is recorded of it, what is kept to go on from, and when it ends."""

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
    """What is counted as a run goes on; numbers, and arrays of them, which a checkpoint holds.

    Attributes:
        done: steps after the first: rounds, or samples of a flow.
        margin: the last.
        drift: how far any position moved over the last chunk.
        recorded: steps in the record.
        every: each how manieth step is recorded.
    """

    done: int = -1
    margin: float = np.nan
    drift: float = np.inf
    recorded: int = 0
    every: int = 1


class Course(Protocol):
    """What is run, a chunk of steps at a time."""

    tally: Any
    """Its `Steps`, and what else it counts."""
    end: int
    """Steps at most."""

    def start(self) -> tuple[Any, Rows]:
        """The state before the first step, and the record of it."""
        ...

    def advance(self, state: Any, every: int) -> tuple[Any, Rows, Ending | None]:
        """A chunk of steps from a state, which is given up; the record of every so manieth, and why the run should end."""
        ...

    def agree(self, stop: bool) -> bool:
        """Whether anybody wants to stop."""
        ...

    def look(self, state: Any) -> Rows:
        """The record of the state as it is."""
        ...

    def positions(self, state: Any) -> np.ndarray:
        """(N, d) everyone's positions."""
        ...

    def told(self, rows: Rows) -> Mapping[str, Any]:
        """Fields of the `Trace` that rounds and flows find differently."""
        ...


def follow(
    course: Course, copies: Estimates, choice: Choice, *, sink: Sink, checkpoint: Checkpoint | None, problem: str,
    progress: Callable[[float, float], None],
) -> Trace:  # fmt: skip
    """Run to the end.

    Args:
        course: what is run.
        copies: the layout of estimates.
        choice: what is recorded.
        sink: where to.
        checkpoint: where the state is kept, and what to take up; nowhere and nothing if None.
        problem: its fingerprint.
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
    """Whether whoever watches lets the run go on."""
    try:
        progress(done, margin)
    except KeyboardInterrupt:
        return False
    return True
