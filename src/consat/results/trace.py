"""What a run leaves behind, as plain arrays: every way of running a team, in one process or over a network, ends in a `Trace`."""

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
    """A run as it was recorded at T steps.

    Attributes:
        clock: what `steps` counts: ``time`` in s, or ``round``.
        steps: (T,).
        position: (T, N, d) the agents' own positions, in the scenario's unit of length.
        velocity: (T, N, d) u_i, length/s.
        margin: (T,) β̄ at the positions.
        smooth_margin: (T,) β at the positions.
        agent_margin: (T, N) ᾱ_i.
        estimate: (T, C, d) all copies, or None where not recorded.
        integral: (T, C, d) the integral states, or None.
        bound: (T,) on the best margin, proven by all agents, NaN where none is; None where nobody proves any.
        holder: (C,) who holds each copy.
        held: (C,) whose position it is.
        cluster: (N,) cluster of each agent.
        ending: why the run ended.
        satisfied_from: the first step after the last one whose margin was ≤ 0; None if the last margin is.
        messages: sent in all; None in continuous time.
        floats_sent: likewise.
        bytes: of all messages, headers and all, names of agents and shapes of arrays apart; None in continuous time.
        known: what every agent knows at the end: that all are ``satisfied``, that the team is ``infeasible``, or nothing.
        known_from: the round since when, or the time, s, where agents take turns in time; None in continuous time, or if they know nothing.
        seconds: spent on ``compile`` and ``run``.
        period: of a round, s; None in continuous time, and where rounds take no time.
        recorded: (R,) which agents `position`, `velocity` and `agent_margin` are of, where not all were recorded, else None.
        final: (N, d) everyone's last positions, where not all were recorded.
        violated: (M,) share of all steps, the start among them, at which each constraint was violated; NaN for those that are not watched,
            see `consat.engine.violations`; None where nobody counted.
        motion: what is said of a team that moves, see ``run --json``; None in continuous time, and where rounds take no time.
        heading: (T, N) of bodies, rad; None where they have none.
        turned: the round after which the team went over from its links to a spanning tree, or None.
        file: where the record went as the run went on; the arrays above then hold its end only.
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
        """(N, d) everyone's last positions."""
        return self.position[-1] if self.final is None else self.final


def satisfied_from(steps: np.ndarray, margin: np.ndarray, *, interpolate: bool) -> float | None:
    """The first step after the last one whose margin was ≤ 0, or None if the last margin is.

    Args:
        steps: (T,) rising.
        margin: (T,).
        interpolate: for continuous time, whether to find the zero between two samples.
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
