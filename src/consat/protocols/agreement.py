"""How agents know that all are satisfied, without learning whose margin is what: min-consensus on ages.

Each agent counts the rounds for which its own constraints have held, but counts no farther than one more than the smallest count a
neighbour last told it:

    age_i⁺ = 1 + min(age_i, min_j age_ij)   while its constraints hold, else 0

An age above the number of hops across the cluster means that everybody's constraints held, each within the last so many rounds it heard
from. A lost message leaves age_ij as it was, so that it can only hold the count back.

Where do constraints hold? A protocol paces itself by its estimates (`Ages`): what it looks for is found once they satisfy everything.
A team is satisfied when its bodies are (`Bodies`). Where bodies do not follow at once, every agent says with each message where its own
is. Agents that hold a copy of a position pass the newest word of the body on over the links of that copy, with the number s of rounds that
it has been on its way. Agent i hears of the body b_j from its neighbours k,

    b_j^(i) ← b_j^(k),  s_j^(i) ← s_j^(k) + 1   where s_j^(k) < s_j^(i);   otherwise  s_j^(i) ← s_j^(i) + 1

from j alone where that is a neighbour, so that nobody speaks for an agent that speaks for itself. Its constraints hold when they do at
its own measured position and at these; one that does not know where it is, or has not heard of a body yet, counts nothing.
"""

from __future__ import annotations

from typing import Final, NamedTuple

import jax.numpy as jnp
import numpy as np
from jax import Array

from consat.numerics import on_device, pick
from consat.protocols.base import Solver

NEVER: Final = 1e6
"""Word that has been on its way for so many rounds is none."""


class Ages(NamedTuple):
    """What an agent remembers.

    Attributes:
        age: one number an agent.
        heard: (links,) the neighbours' ages, as last received.
    """

    age: Array
    heard: Array


class Owners(NamedTuple):
    """Whose positions the copies are.

    Attributes:
        own: (agents,) the row of each agent's own position.
        source: (links,) whether word of the body may come over that end of a link.
    """

    own: Array
    source: Array

    @classmethod
    def of(cls, own: np.ndarray, row: np.ndarray, direct: np.ndarray, rows: int) -> Owners:
        """Args: own; row: (links,) the copy at each end; direct: (links,) whether the neighbour there owns the position; rows: how many."""
        closed = np.zeros(rows, dtype=bool)
        closed[row[direct]] = True
        closed[own] = True
        return cls(jnp.asarray(own, dtype=jnp.int32), on_device(direct | ~closed[row]))


class Bodies(NamedTuple):
    """What an agent knows of bodies.

    Attributes:
        position: (rows, d) where its own is, and where it last heard that the others are.
        stale: (rows,) for how many rounds each has been on its way; `NEVER` before it was heard of.
        ages: of those whose constraints hold there.
    """

    position: Array
    stale: Array
    ages: Ages


class Word(NamedTuple):
    """What is told of bodies over each link.

    Attributes:
        position: (links, d).
        stale: (links,).
        age: (links,).
    """

    position: Array
    stale: Array
    age: Array


def start(x: Array, solver: Solver) -> Ages:
    """Nobody knows anything; x are the first estimates."""
    return Ages(jnp.zeros_like(solver.margin(x)), jnp.zeros_like(solver.links.at(x[:, 0])))


def speak(ages: Ages, x: Array, solver: Solver) -> tuple[Ages, Array]:
    """The next ages, given the estimates, and the message: one number a link."""
    return _counted(ages, solver.margin(x) > 0, solver)


def _counted(ages: Ages, hold: Array, solver: Solver) -> tuple[Ages, Array]:
    age = jnp.where(hold, 1.0 + jnp.minimum(ages.age, solver.least(ages.heard)), 0.0)
    return Ages(age, ages.heard), solver.links.at(solver.to_rows(age))


def hear(ages: Ages, message: Array, arrived: Array) -> Ages:
    """Take in what came."""
    return Ages(ages.age, jnp.where(arrived, message, ages.heard))


def known(ages: Ages, solver: Solver) -> Array:
    """For how many rounds each agent has known that all are satisfied; 0 while it doesn't."""
    return jnp.maximum(ages.age - solver.hops, 0.0)


def start_bodies(x: Array, solver: Solver) -> Bodies:
    """No body was heard of; x are the first estimates, (rows, d)."""
    return Bodies(x, jnp.full_like(x[:, 0], NEVER), start(x, solver))


def speak_bodies(bodies: Bodies, measured: Array, owners: Owners, solver: Solver) -> tuple[Bodies, Word]:
    """The next knowledge, given where the agents' own bodies are, (agents, d), NaN where that is not known; and the message."""
    sure = jnp.isfinite(measured).all(axis=1)
    before = pick(bodies.position, owners.own)
    position = bodies.position.at[owners.own].set(jnp.where(sure[:, None], measured, before))
    stale = bodies.stale.at[owners.own].set(jnp.where(sure, 0.0, pick(bodies.stale, owners.own)))
    bodies = Bodies(position, stale, bodies.ages)
    ages, told = _counted(bodies.ages, sure & all_heard(bodies, solver) & (solver.margin(position) > 0), solver)
    return bodies._replace(ages=ages), Word(solver.links.at(position), solver.links.at(stale), told)


def all_heard(bodies: Bodies, solver: Solver) -> Array:
    """Of each agent, whether it has heard of every body of which it holds a copy."""
    return solver.least(-solver.links.at(bodies.stale)) > -NEVER


def hear_bodies(bodies: Bodies, word: Word, arrived: Array, owners: Owners, solver: Solver) -> Bodies:
    """Take in what came."""
    links, ages = solver.links, hear(bodies.ages, word.age, arrived)
    aged = jnp.minimum(bodies.stale + 1.0, NEVER)
    if not len(word.stale):
        return Bodies(bodies.position, aged, ages)
    offered = jnp.where(arrived & owners.source, jnp.clip(word.stale, 0.0, NEVER) + 1.0, jnp.inf)
    newest = links.least(offered)
    newer = newest < aged
    number = jnp.arange(len(offered), dtype=offered.dtype)
    first = links.least(jnp.where(offered == links.at(newest), number, jnp.inf))  # of several as new
    position = pick(word.position, jnp.where(newer, first, 0.0).astype(jnp.int32))
    return Bodies(jnp.where(newer[:, None], position, bodies.position), jnp.where(newer, newest, aged), ages)
