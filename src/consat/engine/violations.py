"""Fraction of a run for which each constraint was violated.

A concave ψ holds on a convex set, such as a disc around a goal, which a robot enters from outside: its violation at the start is expected.
Every other ψ may describe a forbidden region: `outside`, `apart`, and user-defined ψ that are not known to be concave. Only violations of
these are counted; they are the watched constraints.
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
    """(W,) indices of the watched constraints, in the team's order."""
    return np.flatnonzero(~shape_of(team).concave).astype(np.int32)


def violated(observer: Objective, which: Array, position: Array) -> Array:
    """(W,) whether each watched constraint is violated. A ψ that is NaN counts as violated.

    Args:
        observer: objective over the agents' positions.
        which: (W,) indices of the watched constraints.
        position: (N, d) positions.
    """
    return ~(observer.psi(position)[which] > 0)


def shares(team: Team, counts: Any, steps: int) -> np.ndarray:
    """(M,) fraction of the steps of a run at which each constraint was violated; NaN for constraints that are not watched.

    Args:
        team: the team.
        counts: (W,) number of steps at which each watched constraint was violated.
        steps: number of steps of the run, including the start.
    """
    found = np.full(len(team.owner), np.nan)
    found[watched(team)] = np.asarray(counts) / steps
    return found


def shares_of(team: Team, position: np.ndarray) -> np.ndarray:
    """`shares` of a run with known positions, (T, N, d)."""
    return shares(team, _count(Objective.at_positions(team), on_device(watched(team)), on_device(position)), len(position))


@jax.jit
def _count(observer: Objective, which: Array, position: Array) -> Array:
    return jnp.sum(jax.vmap(lambda x: violated(observer, which, x))(position), axis=0)
