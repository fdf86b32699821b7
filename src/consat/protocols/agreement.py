"""Distributed detection that all constraints of a cluster are satisfied: min-consensus on ages. No margin is disclosed.

The age of an agent is the number of rounds for which its own constraints have held, limited to one more than the smallest age that it last
received from a neighbour:

    age_i⁺ = 1 + min(age_i, min_j age_ij)   while its constraints hold, else 0

An age above the number of hops across the cluster means that the constraints of every agent held, as of the last ages that have reached
this agent. A lost message leaves age_ij unchanged, so that message loss can only delay the detection.

The constraints are evaluated at two kinds of positions. `Ages` evaluates them at the estimates: protocols use it to pace themselves.
`Bodies` evaluates them at the measured positions of the bodies, which decide whether the team is satisfied. Where the bodies lag behind the
estimates, every agent adds the measured position of its body to each message. Agents that hold a copy of a position forward the newest
measurement over the links of that copy, with its age s in rounds. Agent i receives the measurement b_j from its neighbours k:

    b_j^(i) ← b_j^(k),  s_j^(i) ← s_j^(k) + 1   where s_j^(k) < s_j^(i);   otherwise  s_j^(i) ← s_j^(i) + 1

Where j itself is a neighbour, measurements of j are accepted from j alone. The constraints of an agent count as satisfied when they hold at
its own measured position and at the received ones. The age of an agent is 0 while its own position or one of the received ones is unknown.
"""

from __future__ import annotations

from typing import Final, NamedTuple

import jax.numpy as jnp
import numpy as np
from jax import Array

from consat.numerics import on_device, pick
from consat.protocols.base import Solver

NEVER: Final = 1e6
"""Age in rounds, from which on a measurement of a body counts as not received."""


class Ages(NamedTuple):
    """State of the detection.

    Attributes:
        age: (N,) age of each agent, in rounds.
        heard: (links,) the neighbours' ages, as last received.
    """

    age: Array
    heard: Array


class Owners(NamedTuple):
    """Ownership of the copies.

    Attributes:
        own: (agents,) the row of each agent's own position.
        source: (links,) whether measurements of the body are accepted over that end of a link.
    """

    own: Array
    source: Array

    @classmethod
    def of(cls, own: np.ndarray, row: np.ndarray, direct: np.ndarray, rows: int) -> Owners:
        """Compute which ends of links may deliver measurements.

        Args:
            own: (agents,) the row of each agent's own position.
            row: (links,) the row of the copy at each end of a link.
            direct: (links,) whether the neighbour at the other end owns that position.
            rows: number of rows.
        """
        closed = np.zeros(rows, dtype=bool)
        closed[row[direct]] = True
        closed[own] = True
        return cls(jnp.asarray(own, dtype=jnp.int32), on_device(direct | ~closed[row]))


class Bodies(NamedTuple):
    """State of the forwarding of measured positions.

    Attributes:
        position: (rows, d) the newest measured position of each body, as known to the holder of the row.
        stale: (rows,) age of that measurement in rounds; `NEVER` before the first one.
        ages: detection state, with constraints evaluated at `position`.
    """

    position: Array
    stale: Array
    ages: Ages


class Word(NamedTuple):
    """Message about bodies over each link.

    Attributes:
        position: (links, d) newest measured position of the shared copy.
        stale: (links,) age of that measurement in rounds.
        age: (links,) age of the sender in the detection.
    """

    position: Array
    stale: Array
    age: Array


def start(x: Array, solver: Solver) -> Ages:
    """Initial state: every age is 0. `x`: (rows, d) initial estimates."""
    return Ages(jnp.zeros_like(solver.margin(x)), jnp.zeros_like(solver.links.at(x[:, 0])))


def speak(ages: Ages, x: Array, solver: Solver) -> tuple[Ages, Array]:
    """Advance the ages by one round, with constraints evaluated at `x`, (rows, d). Returns the state and the message, (links,)."""
    return _counted(ages, solver.margin(x) > 0, solver)


def _counted(ages: Ages, hold: Array, solver: Solver) -> tuple[Ages, Array]:
    age = jnp.where(hold, 1.0 + jnp.minimum(ages.age, solver.least(ages.heard)), 0.0)
    return Ages(age, ages.heard), solver.links.at(solver.to_rows(age))


def hear(ages: Ages, message: Array, arrived: Array) -> Ages:
    """Store the received ages. `message`: (links,); `arrived`: (links,) whether each message arrived."""
    return Ages(ages.age, jnp.where(arrived, message, ages.heard))


def known(ages: Ages, solver: Solver) -> Array:
    """(N,) number of rounds for which each agent has known that all agents are satisfied; 0 while it does not know."""
    return jnp.maximum(ages.age - solver.hops, 0.0)


def start_bodies(x: Array, solver: Solver) -> Bodies:
    """Initial state: no measurement has been received. `x`: (rows, d) initial estimates."""
    return Bodies(x, jnp.full_like(x[:, 0], NEVER), start(x, solver))


def speak_bodies(bodies: Bodies, measured: Array, owners: Owners, solver: Solver) -> tuple[Bodies, Word]:
    """Advance by one round. `measured`: (agents, d) positions of the bodies, NaN where unknown. Returns the state and the message."""
    sure = jnp.isfinite(measured).all(axis=1)
    before = pick(bodies.position, owners.own)
    position = bodies.position.at[owners.own].set(jnp.where(sure[:, None], measured, before))
    stale = bodies.stale.at[owners.own].set(jnp.where(sure, 0.0, pick(bodies.stale, owners.own)))
    bodies = Bodies(position, stale, bodies.ages)
    ages, age = _counted(bodies.ages, sure & all_heard(bodies, solver) & (solver.margin(position) > 0), solver)
    return bodies._replace(ages=ages), Word(solver.links.at(position), solver.links.at(stale), age)


def all_heard(bodies: Bodies, solver: Solver) -> Array:
    """(N,) whether each agent has a measurement of every body of which it holds a copy."""
    return solver.least(-solver.links.at(bodies.stale)) > -NEVER


def hear_bodies(bodies: Bodies, word: Word, arrived: Array, owners: Owners, solver: Solver) -> Bodies:
    """Store the received ages, and for every row the newest of the received measurements if it is newer than the one held."""
    links, ages = solver.links, hear(bodies.ages, word.age, arrived)
    aged = jnp.minimum(bodies.stale + 1.0, NEVER)
    if not len(word.stale):
        return Bodies(bodies.position, aged, ages)
    offered = jnp.where(arrived & owners.source, jnp.clip(word.stale, 0.0, NEVER) + 1.0, jnp.inf)
    newest = links.least(offered)
    newer = newest < aged
    number = jnp.arange(len(offered), dtype=offered.dtype)
    first = links.least(jnp.where(offered == links.at(newest), number, jnp.inf))  # the first of several with the same age
    position = pick(word.position, jnp.where(newer, first, 0.0).astype(jnp.int32))
    return Bodies(jnp.where(newer[:, None], position, bodies.position), jnp.where(newer, newest, aged), ages)
