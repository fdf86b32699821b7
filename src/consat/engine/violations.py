"""For how much of a run each constraint was violated on the way.

A concave ψ holds on a convex set, such as a disc around a goal, which a robot enters from outside: that it is violated at first says
nothing. Every other ψ may keep out of something: those of `outside` and `apart`, and own ones that are not known to be concave. These are
watched.
"""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from consat.certify.quadratics import shape_of
from consat.numerics import on_device
from consat.problem.objective import Objective
from consat.problem.team import Team


def watched(team: Team) -> np.ndarray:
    """(W,) the constraints that are watched, as places in the team's order."""
    return np.flatnonzero(~shape_of(team).concave).astype(np.int32)


def violated(observer: Objective, which: Array, position: Array) -> Array:
    """(W,) whether each watched constraint is violated at the (N, d) positions; it is where ψ is not a number, too."""
    return ~(observer.psi(position)[which] > 0)


def shares(team: Team, counts: Any, steps: int) -> np.ndarray:
    """(M,) the share of the steps of a run at which each constraint was violated, NaN for those that are not watched.

    Args:
        team: the team.
        counts: (W,) at how many steps each watched constraint was violated.
        steps: of the run, the start among them.
    """
    found = np.full(len(team.owner), np.nan)
    found[watched(team)] = np.asarray(counts) / steps
    return found


def shares_of(team: Team, position: np.ndarray) -> np.ndarray:
    """`shares` of a run whose (T, N, d) positions are known."""
    return shares(team, _count(Objective.at_positions(team), on_device(watched(team)), on_device(position)), len(position))


@jax.jit
def _count(observer: Objective, which: Array, position: Array) -> Array:
    return jnp.sum(jax.vmap(lambda x: violated(observer, which, x))(position), axis=0)
