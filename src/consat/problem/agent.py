"""One agent of a team."""

from __future__ import annotations

from dataclasses import dataclass

from numpy.typing import ArrayLike

from consat.problem.constraints.record import Constraints


@dataclass(frozen=True)
class Agent:
    """One agent with its private constraints.

    Attributes:
        id: unique in the team.
        constraints: what `consat.within` and the other factories return; lists may nest.
        start: initial position x_i(0), shape (d,), length. If None, it is drawn at random when the team runs.
    """

    id: str
    constraints: Constraints = ()
    start: ArrayLike | None = None
