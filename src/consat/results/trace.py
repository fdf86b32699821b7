"""`Trace`: the record of a run as plain arrays. Every run ends in one, in one process or over a network."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np

Ending = Literal["satisfied", "settled", "out of time", "diverged", "too stiff", "interrupted"]
"""Why a run ended."""


@dataclass(frozen=True, eq=False)
class Trace:
    """The record of a run at T steps.

    Attributes:
        clock: unit of `steps`: ``time`` in s, or ``round``.
        steps: (T,) increasing.
        position: (T, N, d) positions of the agents, in the scenario's unit of length; (T, R, d) if `recorded` is given.
        velocity: (T, N, d) velocity commands u_i, length/s; (T, R, d) if `recorded` is given.
        margin: (T,) β̄ at the positions.
        smooth_margin: (T,) β at the positions.
        agent_margin: (T, N) ᾱ_i; (T, R) if `recorded` is given.
        estimate: (T, C, d) all estimates; None if not recorded.
        integral: (T, C, d) integral states; None if not recorded.
        holder: (C,) agent that holds each estimate.
        held: (C,) agent whose position is estimated.
        cluster: (N,) cluster of each agent.
        ending: why the run ended.
        satisfied_from: first step after the last step with a margin ≤ 0; None if the last margin is ≤ 0.
        messages: total number of messages sent; None in continuous time.
        floats_sent: total number of floats sent; None in continuous time.
        bytes: total size of the messages with their headers, without names of agents and shapes of arrays; None in continuous time.
        known: what all agents know at the end: that all are ``satisfied``, that the team is ``infeasible``, or None.
        known_from: the round from which they know it, or the time, s, over a network without common rounds. None in continuous time, and if
            they know nothing.
        seconds: wall-clock time spent on ``compile`` and ``run``, s.
        period: duration of a round, s; None in continuous time, and if rounds take no time.
        recorded: (R,) indices of the recorded agents; None if all are recorded.
        final: (N, d) last positions of all agents, if not all are recorded; else None.
        violated: (M,) fraction of all steps, including the start, at which each constraint is violated. NaN for constraints that are not
            watched, see `consat.engine.violations`. None if violations were not counted.
        file: the result file to which the record was written during the run; the arrays then hold its end only. None if there is no file.
        turned: the round after which the team changed from its links to a spanning tree; None if it did not.
        bound: (T,) upper bound on the best margin, proven by all agents together; NaN where none is proven. None if no bound is computed.
        motion: summary of a team that moves, see ``run --json``; None in continuous time, and if rounds take no time.
        heading: (T, N) headings of the robots, rad; None if they have none.
    """

    clock: Literal["time", "round"]
    steps: np.ndarray
    position: np.ndarray
    velocity: np.ndarray
    margin: np.ndarray
    smooth_margin: np.ndarray
    agent_margin: np.ndarray
    estimate: np.ndarray | None
    integral: np.ndarray | None
    holder: np.ndarray
    held: np.ndarray
    cluster: np.ndarray
    ending: Ending
    satisfied_from: float | None
    messages: int | None
    floats_sent: int | None
    known: Literal["satisfied", "infeasible"] | None
    known_from: float | None
    seconds: Mapping[str, float]
    period: float | None = None
    recorded: np.ndarray | None = None
    final: np.ndarray | None = None
    violated: np.ndarray | None = None
    file: Path | None = None
    turned: float | None = None
    bound: np.ndarray | None = None
    motion: Mapping[str, Any] | None = None
    heading: np.ndarray | None = None
    bytes: int | None = None

    @property
    def end(self) -> np.ndarray:
        """(N, d) last positions of all agents."""
        return self.position[-1] if self.final is None else self.final


def satisfied_from(steps: np.ndarray, margin: np.ndarray, *, interpolate: bool) -> float | None:
    """The first step after the last step with a margin ≤ 0; None if the last margin is ≤ 0.

    Args:
        steps: (T,) increasing, s or rounds.
        margin: (T,) margins.
        interpolate: whether to interpolate the zero between two samples, for continuous time.
    """
    bad = np.flatnonzero(~(margin > 0))
    if not len(bad):
        return float(steps[0])
    last = int(bad[-1])
    if last == len(steps) - 1:
        return None
    if not interpolate or not np.isfinite(margin[last]):
        return float(steps[last + 1])
    return float(np.interp(0.0, margin[last : last + 2], steps[last : last + 2]))
