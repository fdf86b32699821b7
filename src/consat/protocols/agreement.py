"""How agents know that all are satisfied, without learning whose margin is what: min-consensus on ages.

Each agent counts the rounds for which its own constraints have held, as far as its estimates tell, but counts no farther than one more than
the smallest count a neighbour last told it:

    age_i⁺ = 1 + min(age_i, min_j age_ij)   while its constraints hold, else 0

An age above the number of hops across the cluster means that everybody's constraints held, each within the last so many rounds it heard
from. A lost message leaves age_ij as it was, so that it can only hold the count back.
"""

from __future__ import annotations

from typing import NamedTuple

import jax.numpy as jnp
from jax import Array

from consat.protocols.base import Solver


class Ages(NamedTuple):
    """What an agent remembers.

    Attributes:
        age: one number an agent.
        heard: (links,) the neighbours' ages, as last received.
    """

    age: Array
    heard: Array


def start(x: Array, solver: Solver) -> Ages:
    """Nobody knows anything; x are the first estimates."""
    return Ages(jnp.zeros_like(solver.margin(x)), jnp.zeros_like(solver.links.at(x[:, 0])))


def speak(ages: Ages, x: Array, solver: Solver) -> tuple[Ages, Array]:
    """The next ages, given the estimates, and the message: one number a link."""
    age = jnp.where(solver.margin(x) > 0, 1.0 + jnp.minimum(ages.age, solver.least(ages.heard)), 0.0)
    return Ages(age, ages.heard), solver.links.at(solver.to_rows(age))


def hear(ages: Ages, message: Array, arrived: Array) -> Ages:
    """Take in what came."""
    return Ages(ages.age, jnp.where(arrived, message, ages.heard))


def known(ages: Ages, solver: Solver) -> Array:
    """For how many rounds each agent has known that all are satisfied; 0 while it doesn't."""
    return jnp.maximum(ages.age - solver.hops, 0.0)
